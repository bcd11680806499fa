"""docs/notebook.md, as somebody types it in."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.system.harness import Daemon

pytestmark = pytest.mark.system

PAGE = Path(__file__).parents[2] / "docs/notebook.md"


def test_every_block_runs(
    daemon: Daemon,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    daemon.start().close()
    monkeypatch.setenv("UMBRA_RIG", daemon.endpoint)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"notebook.md, block {number}", "exec"), names)
    said = capsys.readouterr().out
    assert "done: 27 of 27" in said
    assert "unknown_run there is no run" in said
    assert 0.0 < float(str(names["share"])) < 1.0
    assert (tmp_path / "out" / "direct.tiff").exists()
