"""The documentation is true: links lead somewhere, examples parse, commands and keys exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.main import get_command

from daemon import config
from daemon.separation.estimator import Quality
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFile
from drivers import registry
from protocol.cli.app import app

REPOSITORY = Path(__file__).parents[1]
PAGES = sorted([*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md")])
GENERATED = {"protocol.md"}  # has a test of its own
DECISIONS = REPOSITORY / "docs/decisions"

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]+\]\(([^)\s]+)\)")  # of pictures too


def name(page: Path) -> str:
    return str(page.relative_to(REPOSITORY))


def fences(page: Path, language: str) -> Iterator[str]:
    return (text for found, text in _FENCE.findall(page.read_text()) if found == language)


def anchors(page: Path) -> set[str]:
    """The names that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.+)$", _FENCE.sub("", page.read_text()), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in _LINK.findall(_FENCE.sub("", page.read_text())):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{name(page)} links to {target}"
        if anchor:
            assert anchor in anchors(there), f"{name(page)} links to {target}"


def test_each_page_can_be_found_from_the_index() -> None:
    linked = {
        (page.parent / target.partition("#")[0]).resolve()
        for page in (
            REPOSITORY / "docs/README.md",
            REPOSITORY / "README.md",
            DECISIONS / "README.md",
        )
        for target in _LINK.findall(page.read_text())
    }
    pages = {page for page in PAGES if page.name != "README.md"}
    assert {name(page) for page in pages - linked} == set()


def test_decisions_are_numbered_without_gaps_and_have_their_parts() -> None:
    records = sorted(DECISIONS.glob("[0-9]*.md"))
    assert [int(r.name[:4]) for r in records] == list(range(1, len(records) + 1))
    for record in records:
        text = record.read_text()
        assert text.startswith(f"# {record.name[:4]}: ")
        assert re.findall(r"^## (.+)$", text, re.MULTILINE) == [
            "Context", "Decision", "Consequences",
        ]  # fmt: skip


@pytest.mark.parametrize("page", [p for p in PAGES if any(fences(p, "toml"))], ids=name)
def test_examples_of_rig_toml_are_accepted(page: Path) -> None:
    missing = ""
    for text in fences(page, "toml"):
        try:
            config.parse(text, name(page))
        except config.ConfigError as error:
            if "pip install" not in str(error):
                raise
            missing = str(error)  # a driver's extra: the other examples are tried all the same
    if missing:
        pytest.skip(missing)


def test_the_installed_example_is_accepted() -> None:
    rig = config.load(REPOSITORY / "systemd/rig.toml")
    assert {device.kind for device in rig.devices} >= {"camera", "projector"}


def commands(page: Path) -> Iterator[list[str]]:
    """The `umbra` command lines in the shell examples of a page, as words."""
    for text in fences(page, "sh"):
        for line in text.replace("\\\n", "").splitlines():
            words = shlex.split(line, comments=True)
            words = list(takewhile(lambda word: word not in {"|", "||", "&&", "&"}, words))
            if words[:1] == ["sudo"]:
                words = words[1:]
            if words and Path(words[0]).name == "umbra":
                yield words[1:]


def options(command: Any) -> dict[str, bool]:
    """The options of a command: name -> whether a value follows."""
    found = {n: not p.is_flag for p in command.params for n in p.opts if n.startswith("-")}
    return found | {"--help": False}


@pytest.mark.parametrize("page", [p for p in PAGES if any(commands(p))], ids=name)
def test_commands_exist(page: Path) -> None:
    for words in commands(page):
        where = f"{name(page)}: umbra {shlex.join(words)}"
        command = get_command(app)
        known = options(command)
        rest = iter(words)
        for word in rest:
            if word.startswith("-"):
                assert word in known, where
                if known[word]:
                    next(rest)
            elif hasattr(command, "get_command") and not word.isupper():
                command = command.get_command(None, word)
                assert command is not None, where
                known |= options(command)


def keys(struct: type[msgspec.Struct]) -> set[str]:
    return {field.encode_name for field in msgspec.structs.fields(struct)}


def documented(heading: str) -> set[str]:
    """The keys in the table under a heading of docs/configuration.md."""
    text = (REPOSITORY / "docs/configuration.md").read_text()
    section = re.split(r"^#+ ", text.split(f"# {heading}\n", 1)[1], flags=re.MULTILINE)[0]
    return set(re.findall(r"^\| `(\w+)`", section, re.MULTILINE))


@pytest.mark.parametrize(
    ("heading", "section"),
    [
        ("[rig]", config.RigSection),
        ("[network]", config.NetworkSection),
        ("[storage]", config.StorageSection),
        ("[hooks]", config.HooksSection),
        ("[sequencer]", config.SequencerSection),
        ("[calibration]", config.CalibrationSection),
    ],
)
def test_each_key_is_documented(heading: str, section: type[msgspec.Struct]) -> None:
    assert documented(heading) == keys(section)


@pytest.mark.parametrize(
    ("kind", "driver"),
    [(kind, driver) for kind in ("camera", "projector", "stage", "light")
     for driver in registry.names(kind)],
)  # fmt: skip
def test_each_key_of_each_driver_is_documented(kind: str, driver: str) -> None:
    try:
        options = keys(registry.load(kind, driver).options_type)
    except registry.UnknownDriver as missing:
        pytest.skip(str(missing))
    if driver in {"virtual", "replay"}:
        common = {"serial", "faults"} if driver == "virtual" else set()
        assert documented(f"{kind}: `{driver}`") == options - common
    else:
        text = "".join(page.read_text() for page in REPOSITORY.glob("docs/*.md"))
        assert {
            key for key in options if not re.search(rf"`{key}\b|^ *{key} = ", text, re.M)
        } == set()


@pytest.mark.parametrize(
    ("heading", "record"), [("run.json", RunFile), ("frames.jsonl", FrameRecord)]
)
def test_each_field_of_a_run_is_documented(heading: str, record: type[msgspec.Struct]) -> None:
    text = (REPOSITORY / "docs/runs.md").read_text().split(f"## {heading}\n", 1)[1]
    rows = re.findall(r"^\| (`.*?) \|", text.split("\n## ")[0], re.MULTILINE)
    assert sorted(key for row in rows for key in re.findall(r"`(\w+)`", row)) == sorted(
        keys(record)
    )


def test_each_quality_bit_is_documented() -> None:
    text = (REPOSITORY / "docs/runs.md").read_text()
    rows = {
        (int(bit), bit_name)
        for bit, bit_name in re.findall(r"^\| (\d+) \| ([\w ]+) \|", text, re.M)
    }
    assert rows == {(q.value, (q.name or "").lower().replace("_", " ")) for q in Quality}
