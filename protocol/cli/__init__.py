"""The `umbra` command: one module a group of commands; `app` has the table of them."""

from protocol.cli.app import main

__all__ = ["main"]
