"""A group with one command for each struct of a tagged union: methods, patterns.

What joins the union appears as a command, with its fields as options, its docstring as help.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, ClassVar, get_args

import msgspec
import typer
from typer.core import TyperGroup

from protocol.cli.app import command_of
from protocol.cli.options import build, options_of, with_options
from protocol.errors import Code, UmbraError
from protocol.spelling import did_you_mean


def members(union: Any) -> dict[str, type[msgspec.Struct]]:
    """The structs of a tagged union by tag, in its order."""
    return {str(struct.__struct_config__.tag): struct for struct in get_args(union)}


def member(union: Any, tag: str, option: str) -> type[msgspec.Struct]:
    """The struct of this tag. Raises UmbraError(bad_request) that names the option and the tags."""
    known = members(union)
    if tag not in known:
        raise UmbraError(
            Code.BAD_REQUEST,
            f"{option}: {tag!r} is not one of {', '.join(known)}" + did_you_mean(tag, known),
            option,
        )
    return known[tag]


def tag_option(union: Any, *names: str, help_text: str) -> Any:
    """An option that takes a tag of the union, by `member`."""
    known = [*members(union)]
    return typer.Option(
        *names, metavar="|".join(known), help=help_text, autocompletion=lambda: known
    )


def about(struct: type[msgspec.Struct]) -> str:
    """The first paragraph of a struct's docstring."""
    return " ".join((inspect.getdoc(struct) or "").split("\n\n")[0].split())


class Family(TyperGroup):
    """Set `union`, and `act`: a function whose first parameter takes the struct that was made.

    `more` are commands beside the union's: name -> a function with its own options.
    """

    union: ClassVar[Any]
    act: ClassVar[Callable[..., Any]]
    more: ClassVar[dict[str, Callable[..., Any]]] = {}
    title: ClassVar[str] = "Commands"
    prefix: ClassVar[str] = ""  # of the tags, left out of the commands' names

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """The further commands and the union's tags."""
        return [*self.more, *self._structs()]

    def _structs(self) -> dict[str, type[msgspec.Struct]]:
        return {tag.removeprefix(self.prefix): s for tag, s in members(self.union).items()}

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """The command of one struct, made now; None if there is none of this tag."""
        if cmd_name in self.more:
            return command_of(cmd_name, self.more[cmd_name])
        struct = self._structs().get(cmd_name)
        return command_of(cmd_name, command_for(struct, type(self).act)) if struct else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As typer does, with names to suggest that are not made yet."""
        names: Any = dict.fromkeys(self.list_commands(ctx))
        self.commands = names
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Names and docstrings."""
        rows = [(name, (inspect.getdoc(f) or "").split("\n")[0]) for name, f in self.more.items()]
        rows += [(tag, about(struct)) for tag, struct in self._structs().items()]
        with formatter.section(self.title):
            formatter.write_dl(rows)


def command_for(struct: type[msgspec.Struct], act: Callable[..., Any]) -> Callable[..., Any]:
    """A command whose options are a struct's fields, and which hands the struct to `act`."""
    options = options_of(struct)
    names = {option.name for option in options}
    takes = next(iter(inspect.signature(act).parameters))

    def command(**given: Any) -> Any:
        fields = {name: value for name, value in given.items() if name in names}
        rest = {name: value for name, value in given.items() if name not in names}
        return act(build(struct, fields), **rest)

    shared = list(inspect.signature(act, eval_str=True).parameters.values())
    made = with_options(
        command, [*(o.parameter() for o in options), *(p for p in shared if p.name != takes)]
    )
    made.__doc__ = about(struct)
    return made
