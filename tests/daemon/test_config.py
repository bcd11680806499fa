"""rig.toml: strict, and every mistake is one line with the key's path."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon import config
from daemon.serving.access import check_exposure, is_local


def test_no_file_is_the_virtual_rig_on_loopback() -> None:
    rig = config.load(None)
    assert [(d.kind, d.driver) for d in rig.devices] == [
        ("camera", "virtual"),
        ("projector", "virtual"),
    ]
    check_exposure((rig.network.command, rig.network.events), rig.network.keys)


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("[rig]\nnmae = 'x'", "rig.nmae", "no such key"),
        ("[riig]", "riig", "no such key"),
        ("[rig]\nname = 'a b'", "rig.name", "matching regex"),
        ("[rig]\ntime_scale = 0", "rig.time_scale", "> 0"),
        ("[sequencer]\nattempts = 'three'", "sequencer.attempts", "`int`"),
        ("[camera]\npath = 'x'", "camera.driver", "replay"),
        ("[camera]\ndriver = 'pinhole'", "camera.driver", "no camera driver 'pinhole'"),
        ("[camera]\ndriver = 'replay'\npth = 'x'", "camera.pth", "no such key"),
        ("[[light]]\ndriver = 'virtual'", "light[0].name", "name of its own"),
        (
            "[rig]\ntime_scale = 5\n[camera]\ndriver = 'replay'\npath = 'x'",
            "rig.time_scale",
            "virtual",
        ),
        ("[rig", "not TOML", ""),
    ],
)
def test_a_mistake_is_one_line_with_its_path(text: str, where: str, what: str) -> None:
    with pytest.raises(config.ConfigError) as caught:
        config.parse(text, "rig.toml")
    message = str(caught.value)
    assert message.startswith("rig.toml: ")
    assert where in message
    assert what in message
    assert "\n" not in message


def test_two_lights_of_one_name() -> None:
    text = "[[light]]\nname = 'left'\ndriver = 'virtual'\n" * 2
    with pytest.raises(config.ConfigError, match="'left' is taken"):
        config.parse(text, "rig.toml")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match="cannot be read"):
        config.load(tmp_path / "rig.toml")


def test_a_file_that_is_not_text(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(config.ConfigError, match="not UTF-8"):
        config.load(path)


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp://127.0.0.1:5750", True),
        ("tcp://localhost:5750", True),
        ("tcp://[::1]:5750", True),
        ("ipc:///run/umbra/c", True),
        ("tcp://*:5750", False),
        ("tcp://0.0.0.0:5750", False),
        ("tcp://192.168.1.4:5750", False),
        ("tcp://eth0:5750", False),
    ],
)
def test_what_the_network_can_reach_needs_keys(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) is local
    if local:
        check_exposure((endpoint,), "")
    else:
        with pytest.raises(config.ConfigError, match="umbra keys new"):
            check_exposure((endpoint,), "")
        check_exposure((endpoint,), "/etc/umbra/keys")
