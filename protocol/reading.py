"""Which of a scan's fields say how its frames are read, so that they may be changed afterwards.

A run's frames were exposed once; what was shown and how it was exposed is in them for good. The
rest is how they are read, and reprocessing may read them otherwise. Every field of every method is
in one of the two tables below, by its name (tests/protocol/test_reading.py); what is in neither is
refused, as if it had been exposed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import msgspec
from msgspec import inspect as shape

from protocol.errors import Code, UmbraError
from protocol.scans.anyscan import AnyScan
from protocol.scans.calibrations import Calibration

READ = frozenset({
    # of every run
    "note",
    # how counts become linear light, light becomes components
    "black", "tone", "leakage", "saturation", "lit_fraction", "estimator",
    # what a moving occluder's frames are used for: decided again
    "sun", "align",
    # the occluder: how it is made and where it is, not how it moved
    "hole_fraction", "hole_mm", "pitch_mm", "grid", "width_mm", "scene_mm", "source_deg",
    # of a single image
    "window", "along", "reduce",
    # of an advice
    "error",
})  # fmt: skip
"""Fields that may be changed when a run is reprocessed."""

EXPOSED = frozenset({
    # of every run
    "exposure_us", "gain", "auto_exposure",
    "deadline_s", "light_min", "light_max", "steady", "look_s",
    # which frames there are
    "references", "average", "bracket", "repeat", "frames", "patterns", "draws", "mode",
    "coverage", "time_limit_s", "drift_deg",
    # what was shown in them
    "checker", "shift", "shifts", "periods", "phases", "axis", "weave", "patch", "seed", "axes",
    "bits", "stripe", "points", "sizes", "fractions",
    # how the occluder moved, and before what
    "lights", "frame_rate_hz", "feed_mm_s", "sweeps", "sweep_mm", "radius_mm", "centre_mm",
    # calibrations are measured anew
    "exposures", "pairs", "levels", "longest_ms", "flashes",
})  # fmt: skip
"""Fields that are in the frames for good."""


def fields(struct: type[msgspec.Struct]) -> dict[str, tuple[str, ...]]:
    """The fields of a spec by name, and where they are: those of a nested struct are named like
    any other (`leakage` is at radiometry.leakage)."""
    info = shape.type_info(struct)
    assert isinstance(info, shape.StructType)
    found: dict[str, tuple[str, ...]] = {}
    for field in info.fields:
        if isinstance(field.type, shape.StructType):
            inner = fields(field.type.cls)
            found |= {name: (field.encode_name, *path) for name, path in inner.items()}
        else:
            found[field.encode_name] = (field.encode_name,)
    return found


def changeable(struct: type[msgspec.Struct]) -> list[str]:
    """The names of those fields of a spec that may be changed."""
    return [name for name in fields(struct) if name in READ]


def changed(spec: AnyScan, changes: Mapping[str, Any]) -> AnyScan:
    """The spec with other values (JSON-able) for some of its fields, by name; None: as if it had
    not been said.

    Raises UmbraError: unsuitable for a field that is in the frames and for a calibration,
    bad_request for one that there is not, or a value that it cannot have.
    """
    method = str(spec.__struct_config__.tag)
    if isinstance(spec, Calibration):
        raise UmbraError(
            Code.UNSUITABLE,
            f"a calibration is not reprocessed, it would pass for a new one: "
            f"`umbra calibrate {spec.kind}` measures again",
        )
    where = fields(type(spec))
    plain = msgspec.to_builtins(spec)
    for name, value in changes.items():
        path = f"$.changes.{name}"
        if name not in where:
            known = ", ".join(changeable(type(spec)))
            raise UmbraError(
                Code.BAD_REQUEST, f"{method} has no {name!r} that can be changed, but {known}", path
            )
        if name not in READ:
            raise UmbraError(
                Code.UNSUITABLE,
                f"{name} says what was shown or exposed, and that is in the frames: it cannot be "
                "changed afterwards; scan again",
                path,
            )
        level = plain
        for step in where[name][:-1]:
            level = level[step]
        if value is None:
            level.pop(name, None)
        else:
            level[name] = value
    try:
        return cast(AnyScan, msgspec.convert(plain, type(spec)))
    except msgspec.ValidationError as error:
        what, _, at = str(error).partition(" - at `$.")
        name = at.rstrip("`").rpartition(".")[2].partition("[")[0]
        message = f"{name}: {what}" if name else what
        raise UmbraError(
            Code.BAD_REQUEST, message.replace("`", ""), f"$.changes.{name}" if name else ""
        ) from None
