"""What may be changed of a run when it is reprocessed: each field of each method has its place."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest

from protocol.cli.reprocess import OPTIONS
from protocol.errors import Code, UmbraError
from protocol.reading import EXPOSED, READ, changeable, changed, fields
from protocol.scans.anyscan import AnyCalibration, AnyScan
from protocol.scans.calibrations import CalibrateLeak
from protocol.scans.occluded import Mesh
from protocol.scans.projected import Checkerboard, SingleImage
from protocol.scans.spec import Radiometry
from protocol.scans.verifications import Point, VerifyPatchSize

METHODS: tuple[Any, ...] = get_args(AnyScan)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__struct_config__.tag)
def test_each_field_either_says_how_frames_are_read_or_is_in_them(method: Any) -> None:
    names = set(fields(method))
    assert names <= READ | EXPOSED, "put new fields into one of the tables of protocol/reading.py"


def test_no_field_is_in_both_tables_and_none_is_of_no_method() -> None:
    assert READ.isdisjoint(EXPOSED)
    assert set().union(*map(fields, METHODS)) == READ | EXPOSED


def test_names_are_unique_within_a_method() -> None:
    for method in METHODS:
        leaves = [path for path in fields(method).values() if len(path) == 1]
        nested = {path[0] for path in fields(method).values() if len(path) > 1}
        whole = {*(path[0] for path in leaves), *nested}
        assert whole == set(method.__struct_encode_fields__)


def test_each_changeable_field_is_an_option_of_the_command_line() -> None:
    separating = [m for m in METHODS if m not in get_args(AnyCalibration)]
    wanted = set().union(*(changeable(method) for method in separating))
    assert {option.name for option in OPTIONS} == wanted


def test_changes_are_put_where_they_belong() -> None:
    spec = Checkerboard(checker=6, radiometry=Radiometry(black=3.0))
    new = changed(spec, {"leakage": 0.05, "estimator": "maxmin", "black": None, "note": "again"})
    assert new == Checkerboard(
        checker=6, radiometry=Radiometry(leakage=0.05), estimator="maxmin", note="again"
    )
    assert changed(spec, {}) == spec
    assert changed(Mesh(hole_fraction=0.5), {"hole_fraction": 0.3}) == Mesh(hole_fraction=0.3)
    assert changed(SingleImage(), {"window": 21, "reduce": 2}) == SingleImage(window=21, reduce=2)
    told = Checkerboard(radiometry=Radiometry(leakage=0.1, tone="srgb"))
    assert changed(told, {"leakage": None, "tone": None}) == Checkerboard()
    at = VerifyPatchSize(points=(Point(x=3, y=4),))
    assert changed(at, {"leakage": 0.1}) == msgspec.structs.replace(at, leakage=0.1)


@pytest.mark.parametrize(
    ("spec", "change", "code", "said"),
    [
        (Checkerboard(), {"shift": 2}, Code.UNSUITABLE, "shift says what was shown or exposed"),
        (Checkerboard(), {"look_s": 2.0}, Code.UNSUITABLE, "look_s says"),
        (Mesh(), {"radius_mm": 2.0}, Code.UNSUITABLE, "radius_mm says"),
        (Mesh(), {"radiometry": {}}, Code.BAD_REQUEST, "mesh has no 'radiometry'"),
        (Mesh(), {"lit_fraction": 0.3}, Code.BAD_REQUEST, "but note, black, tone, leakage"),
        (Mesh(), {"grid": "round"}, Code.BAD_REQUEST, "grid: Invalid enum value 'round'"),
        (Checkerboard(), {"tone": "odd"}, Code.BAD_REQUEST, "tone: "),
        (CalibrateLeak(), {}, Code.UNSUITABLE, "`umbra calibrate leak` measures again"),
    ],
)
def test_what_cannot_be_changed_is_refused_by_name(
    spec: AnyScan, change: dict[str, Any], code: Code, said: str
) -> None:
    with pytest.raises(UmbraError) as caught:
        changed(spec, change)
    assert caught.value.code is code
    assert said in caught.value.message
    for name in change:
        assert caught.value.where == f"$.changes.{name}"
