"""docs/protocol.md is what the structs say, and the client in it works."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import msgspec
import pytest

from protocol import reference
from protocol.errors import Code, ErrorInfo
from protocol.messages import commands, replies
from protocol.messages.envelopes import Request
from protocol.messages.events import AnyEvent
from protocol.messages.runs import RunState
from protocol.scans.anyscan import AnyScan
from tests.protocol.fake import FakeRig

DOCS = Path(__file__).parents[2] / "docs" / "protocol.md"


@pytest.fixture
def endpoint(fake: FakeRig) -> str:
    """The rig that the thirty lines are run against; here its run is done when next asked for."""

    def finish(request: Request) -> None:
        if isinstance(request.command, commands.Submit):
            [run] = fake.runs
            fake.runs[run] = msgspec.structs.replace(fake.runs[run], state=RunState.DONE)

    fake.on_request = finish
    return fake.endpoint


def thirty_lines() -> str:
    [code] = re.findall(r"^```python\n(.*?)^```", DOCS.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    return str(code)


def test_the_page_is_current() -> None:
    assert DOCS.read_text("utf-8") == reference.page(), (
        "docs/protocol.md is out of date: python -m protocol.reference > docs/protocol.md"
    )


def test_everything_is_on_the_page() -> None:
    page = reference.page()
    for union in (commands.AnyCommand, replies.AnyReply, AnyEvent, AnyScan):
        for cls in get_args(union):
            assert f"### {cls.__name__}: `{cls.__struct_config__.tag}`" in page
    for code in Code:
        assert f"| `{code.value}` |" in page


def test_every_link_on_the_page_leads_somewhere() -> None:
    page = reference.page()
    headings = {
        re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        for title in re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    }
    links = set(re.findall(r"\]\(#([^)]*)\)", page))
    assert links
    assert links <= headings


def test_the_client_is_thirty_lines_of_pyzmq_and_json() -> None:
    code = thirty_lines()
    assert len(code.splitlines()) <= 30
    names = {
        alias.name
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    assert names <= {"zmq", "json", "sys", "uuid"}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(ast.parse(code)))


def run(code: str, endpoint: str, folder: Path) -> subprocess.CompletedProcess[str]:
    script = folder / "thirty.py"
    script.write_text(code)
    return subprocess.run(
        [sys.executable, "-I", script, endpoint],
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
    )


def test_the_client_scans(endpoint: str, tmp_path: Path) -> None:
    ran = run(thirty_lines(), endpoint, tmp_path)
    assert ran.stderr == ""
    assert re.fullmatch(r"done \(\d+(, \d+){1,2}\) brightest [\d.]+\n", ran.stdout)


def test_the_client_says_what_the_rig_says(fake: FakeRig, tmp_path: Path) -> None:
    fake.drop = 1  # and asks again
    fake.refuse["submit"] = ErrorInfo(code=Code.UNSUITABLE, message="the rig has no projector")
    code = thirty_lines()
    assert "wait_ms=5000" in code
    ran = run(code.replace("wait_ms=5000", "wait_ms=100"), fake.endpoint, tmp_path)
    assert ran.returncode == 1
    assert ran.stderr == "the rig has no projector\n"
    hellos = [r for r in fake.requests if isinstance(r.command, commands.Hello)]
    assert len(hellos) == 2
    assert len({r.id for r in hellos}) == 1
