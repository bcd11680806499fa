"""`umbra reprocess`: a run's frames again, read with other numbers."""

from __future__ import annotations

import enum
from collections.abc import Collection
from dataclasses import replace
from typing import Annotated, Any

import typer

from protocol.cli.delivery import Delivery
from protocol.cli.link import Json, Keys, Rig, connect
from protocol.cli.methods import METHODS, union_options
from protocol.cli.options import options_of, with_options
from protocol.cli.runs import Force
from protocol.cli.scan import Wait, WaitOut, see_through
from protocol.errors import Code, UmbraError
from protocol.reading import EXPOSED, READ
from protocol.scans.measuring import Advise
from protocol.spelling import did_you_mean

_OPTIONS = [
    *union_options(METHODS, without=EXPOSED),
    *(option for option in options_of(Advise) if option.name in READ and option.name != "note"),
]
OPTIONS = [replace(option, default=None) for option in _OPTIONS]  # what is not given is as RUN's


class Applied(enum.StrEnum):
    """Which calibration."""

    RECORDED = "recorded"
    NOW = "now"


def _reprocess(
    *,
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run that has ended.")],
    calibration: Annotated[
        Applied,
        typer.Option(help="Apply the run's own, or what is known of the rig now."),
    ] = Applied.RECORDED,
    reset: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="What RUN was told of these counts no more: as calibrated, or their default.",
        ),
    ] = "",
    wait: Wait = False,
    out: WaitOut = None,
    force: Force = False,
    rig: Rig = None,
    keys: Keys = None,
    as_json: Json = False,
    **given: Any,
) -> int | None:
    """Separate a run's recorded frames anew, as a new run; prints its id. RUN stays as it is.

    What is not given is as RUN was told; with nothing given the result is the same, bit for bit.
    Only what says how frames are read can be changed, not what was shown or exposed. Needs no
    camera or projector, and waits for no scan.

    --json: a Run; with -o {"run": RunInfo, "files": [path, ...]}.
    """
    delivery = None if out is None else Delivery(out, force=force)
    if delivery is not None:
        delivery.check()
    changes = {
        option.name: option.value_of(given[option.name])
        for option in OPTIONS
        if given.get(option.name) is not None
    }
    changes |= dict.fromkeys(_reset(reset, changes))
    with connect(rig, keys) as client:
        made = client.reprocess(run, calibration=calibration.value, **changes)
        return see_through(client, made, delivery, wait=wait, as_json=as_json)


def _reset(names: str, given: Collection[str]) -> list[str]:
    """The fields of these options. Raises UmbraError for what is none, and for what is given."""
    fields = {option.flag[2:]: option.name for option in OPTIONS}
    found = []
    for name in (part.strip().removeprefix("--") for part in names.split(",") if part.strip()):
        plain = name.replace("_", "-")
        if plain not in fields:
            meant = did_you_mean(plain, fields)
            raise UmbraError(
                Code.BAD_REQUEST, f"--reset: {name!r} is none of the options{meant}", "--reset"
            )
        if fields[plain] in given:
            raise UmbraError(
                Code.BAD_REQUEST, f"--{plain} is given, and reset: one or the other", "--reset"
            )
        found.append(fields[plain])
    return found


reprocess = with_options(_reprocess, [option.parameter() for option in OPTIONS])
