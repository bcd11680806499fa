"""What was mistyped is told with what was probably meant."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon import config
from protocol.cli.family import member
from protocol.cli.options import options_of
from protocol.cli.scan import spec_in
from protocol.errors import UmbraError
from protocol.scans.anyscan import AnyScan
from protocol.scans.projected import Checkerboard


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ('method = "chekerboard"', "checkerboard"),
        ('method = "checkerboard"\naverge = 4', "average"),
        ('method = "checkerboard"\n[ready]\ndeadlines = 4', "deadline_s"),
    ],
)
def test_in_a_spec_file(text: str, meant: str, tmp_path: Path) -> None:
    file = tmp_path / "scan.toml"
    file.write_text(text)
    with pytest.raises(UmbraError, match=f'did you mean "{meant}"\\?'):
        spec_in(file)


def test_nothing_near_is_no_suggestion(tmp_path: Path) -> None:
    file = tmp_path / "scan.toml"
    file.write_text('method = "checkerboard"\nxyzzy = 4')
    with pytest.raises(UmbraError, match="unknown field xyzzy") as caught:
        spec_in(file)
    assert "did you mean" not in caught.value.message


def test_in_an_options_value() -> None:
    with pytest.raises(UmbraError, match='did you mean "mesh"'):
        member(AnyScan, "mehs", "--method")
    option = next(o for o in options_of(Checkerboard) if o.choices)
    with pytest.raises(UmbraError, match=f'did you mean "{option.choices[0]}"'):
        option.value_of(option.choices[0] + "x")


def test_in_a_configuration() -> None:
    with pytest.raises(config.ConfigError, match=r'storage.reserv_mb: .*did you mean "reserve_mb"'):
        config.parse("[storage]\nreserv_mb = 1\n", "rig.toml")
    camera = '[camera]\ndriver = "virtual"\nwidht = 4\n'
    with pytest.raises(config.ConfigError, match='did you mean "width"'):
        config.parse(camera, "rig.toml")
