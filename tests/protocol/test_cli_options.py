"""Options made from structs: a new method is a new command, with no code for it."""

from __future__ import annotations

import enum
from typing import Annotated, Any

import msgspec
import pytest
from msgspec import Meta

from protocol.cli.app import command_of
from protocol.cli.family import Family, members
from protocol.cli.options import build, options_of
from protocol.errors import UmbraError
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import Checkerboard
from protocol.scans.verifications import Point, VerifyPatchSize


class Mode(enum.StrEnum):
    SLOW = "slow"
    FAST = "fast"


class Inner(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    level: Annotated[float, Meta(gt=0, le=1, description="how bright")] = 0.5


class Base(msgspec.Struct, frozen=True, kw_only=True, tag_field="method"):
    note: str = ""


class New(Base, frozen=True, kw_only=True, tag="new-method"):
    """A method that was not there yesterday.

    With a second paragraph.
    """

    cycles: Annotated[int, Meta(ge=3, description="periods over the image")]
    mode: Mode = Mode.SLOW
    steps: tuple[int, ...] = (1, 2)
    names: tuple[Mode, ...] | None = None
    loud: bool = False
    inner: Inner = Inner()
    anything: dict[str, Any] = {}


class Other(Base, frozen=True, kw_only=True, tag="other"):
    """Another."""


def test_fields_become_options() -> None:
    options = {option.name: option for option in options_of(New)}
    assert next(iter(options)) == "cycles"
    assert "anything" not in options  # no command line can say it
    assert options["level"].path == ("inner", "level")
    assert options["level"].described() == "How bright; > 0 and <= 1; default 0.5"
    assert options["cycles"].required
    assert options["mode"].choices == ("slow", "fast")
    assert options["steps"].described() == "Default 1,2"


def test_symbols_keep_their_case() -> None:
    class Symbols(msgspec.Struct):
        beta: Annotated[float, Meta(description="β, the part that is hole")] = 0.5
        window: Annotated[int, Meta(description="n, camera px")] = 11
        plain: Annotated[int, Meta(description="a number")] = 1

    said = [option.described() for option in options_of(Symbols)]
    assert said == ["β, the part that is hole; default 0.5", "n, camera px; default 11",
                    "A number; default 1"]  # fmt: skip


def test_what_is_given_becomes_the_struct() -> None:
    given = {"cycles": 4, "mode": "fast", "steps": "3, 5", "names": "slow", "level": 0.25}
    assert build(New, {**given, "loud": True, "note": None}) == New(
        cycles=4,
        mode=Mode.FAST,
        steps=(3, 5),
        names=(Mode.SLOW,),
        loud=True,
        inner=Inner(level=0.25),
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cycles": 2}, "--cycles: expected int >= 3"),
        ({"cycles": 3, "level": 0.0}, "--level: expected float > 0.0"),
        ({"cycles": 3, "names": "slow,late"}, "--names: 'late' is not one of slow, fast"),
    ],
)
def test_an_error_names_the_option(given: dict[str, Any], said: str) -> None:
    with pytest.raises(UmbraError, match=said):
        build(New, given)


def test_a_struct_that_joins_the_union_is_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    import typer

    made: list[Any] = []

    def act(spec: Any, as_json: bool = False) -> None:
        made.append((spec, as_json))

    class Group(Family):
        union = New | Other

    Group.act = act
    app = typer.Typer(cls=Group, rich_markup_mode=None, add_completion=False)

    @app.callback()
    def root() -> None:
        """The group."""

    command = command_of("scan", app)
    command(["new-method", "--cycles", "5", "--loud", "--as-json"], standalone_mode=False)
    assert made == [(New(cycles=5, loud=True), True)]
    command(["--help"], standalone_mode=False)
    text = capsys.readouterr().out
    assert "new-method  A method that was not there yesterday.\n" in text


@pytest.mark.parametrize("tag", members(AnyScan))
def test_every_method_of_the_protocol_has_options_with_help(tag: str) -> None:
    for option in options_of(members(AnyScan)[tag]):
        assert option.help, f"{tag}: {option.flag} has no description in protocol/scans"


def test_own_fields_come_first() -> None:
    assert [o.name for o in options_of(Checkerboard)][:3] == ["checker", "shift", "shifts"]


def test_a_list_of_structs_is_an_option_given_several_times() -> None:
    [points] = [o for o in options_of(VerifyPatchSize) if o.name == "points"]
    assert points.metavar() == "x,y"
    spec = build(VerifyPatchSize, {"points": ["320,240", "wall=1.5,2"]})
    assert spec.points == (Point(x=320, y=240), Point(name="wall", x=1.5, y=2))
    with pytest.raises(UmbraError, match=r"--points: '3' is not \[NAME=\]x,y"):
        build(VerifyPatchSize, {"points": ["3"]})
