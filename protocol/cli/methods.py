"""The options of all methods together, for the commands that take a `--method`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any

from protocol.cli.family import member, members
from protocol.cli.options import Option, build, options_of
from protocol.errors import Code, UmbraError
from protocol.scans.anyscan import AnyScan, AnySeparation

METHODS = members(AnySeparation)


def spec_of(method: str, given: Mapping[str, Any], **fixed: Any) -> AnyScan:
    """The spec of a method from the options given, None meaning: not given.

    Raises UmbraError(bad_request) for an option of another method, or a bad value.
    """
    struct: Any = member(AnySeparation, method, "--method")
    own = {option.name for option in options_of(struct)}
    for name, value in given.items():
        if value is not None and name not in own:
            flag = "--" + name.replace("_", "-")
            theirs = [m for m, s in METHODS.items() if name in {o.name for o in options_of(s)}]
            raise UmbraError(
                Code.BAD_REQUEST,
                f"{flag} is not an option of {method}, but of {', '.join(theirs)}",
                flag,
            )
    made: AnyScan = build(struct, {n: v for n, v in given.items() if n in own}, **fixed)
    return made


def union_options(methods: Iterable[str], without: Collection[str] = ()) -> list[Option]:
    """The options of these methods together; a help line names the methods if not all have it."""
    methods = list(methods)
    found: dict[str, dict[str, Option]] = {}
    for method in methods:
        for option in options_of(METHODS[method]):
            if option.name not in without:
                found.setdefault(option.name, {})[method] = option
    return [_merged(same, len(same) == len(methods)) for same in found.values()]


def _merged(same: Mapping[str, Option], everywhere: bool) -> Option:
    """One option for what several methods call by one name."""
    first, *_ = same.values()
    return replace(
        first,
        help=first.help if everywhere else f"{first.help} ({', '.join(same)})",
        choices=tuple(dict.fromkeys(c for option in same.values() for c in option.choices)),
        default=first.default if len({o.default for o in same.values()}) == 1 else None,
        required=False,
    )
