"""`python -m protocol.cli` is `umbra`."""

from protocol.cli.app import main

main()
