import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from daemon.products.report import separation as report
from daemon.separation.estimator import Observation
from daemon.storage.frames import FrameRecord
from daemon.storage.runfolder import RunFile
from protocol.messages.runs import Product, RunState
from protocol.scans.anyscan import AnyScan
from protocol.scans.occluded import Mesh, Stick
from protocol.scans.projected import Checkerboard, TwoImage

EVIL = """<script>alert("1")</script>'"&$id${note}"""


class Page(HTMLParser):
    VOID = frozenset({"meta", "img", "input", "line", "rect", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def bits(**shares: float) -> dict[str, Any]:
    return {"quality": {name: {"pixels": 1, "fraction": s} for name, s in shares.items()}}


def subject(spec: AnyScan | None = None, **changes: Any) -> report.Subject:
    grey = np.full((30, 40, 3), 128, np.uint8)
    file = RunFile(
        id="20261122-013045-checkerboard-k3f9",
        state=RunState.FINISHING,
        spec=spec or Checkerboard(),
        submitted="2026-11-22T01:30:45.000000+00:00",
        planned=25,
        recorded=25,
        **changes.pop("file", {}),
    )
    pictures = dict.fromkeys(("frame", "direct", "global", "quality"), grey)
    facts = changes.pop("facts", bits())
    return report.Subject(
        file=file,
        facts=facts,
        pictures=pictures,
        **{"white": 200.0, "full_scale": 255.0, **changes},
    )


def record(index: int, **fields: Any) -> FrameRecord:
    fields.setdefault("observation", Observation())
    return FrameRecord(index=index, step=index, start_ns=10**9 + index * 40_000_000, **fields)


def test_one_file_that_loads_nothing() -> None:
    text = report.render(
        subject(products=(Product(name="direct", kind="image", file="direct.tiff"),))
    )
    page = Page(text)
    images = [attrs["src"] or "" for tag, attrs in page.seen if tag == "img"]
    assert len(images) == 4
    assert all(re.match(r"data:image/jpeg;base64,[A-Za-z0-9+/=]+$", src) for src in images)
    for tag, attrs in page.seen:
        assert tag not in {"link", "iframe", "object", "base"}
        for name in ("src", "href", "srcset", "action"):
            value = attrs.get(name) or ""
            assert value.startswith("data:") or ":" not in value, f"{tag} loads {value[:60]}"
    assert "http" not in re.sub(r"data:[^\"]*|http-equiv", "", text)
    assert "@import" not in text
    assert "url(" not in text


def test_everything_that_a_user_wrote_is_escaped() -> None:
    text = report.render(
        subject(
            Checkerboard(note=EVIL),
            file={"by": EVIL, "rig": {EVIL: {"model": EVIL}}, "versions": {EVIL: EVIL}},
            facts=bits() | {"estimator": EVIL, EVIL: [EVIL]},
            records=[
                record(0, missing=EVIL),
                record(1, observation=Observation(used=False, reason=EVIL)),
            ],
            products=(Product(name="x", kind="image", file=EVIL, unit=EVIL),),
            timings={EVIL: 1.0},
        )
    )
    page = Page(text)
    assert sum(tag == "script" for tag, _ in page.seen) == 1, "our own, and no other"
    assert EVIL in page.text


def test_figures_and_advice_of_a_troubled_run() -> None:
    troubled = subject(
        file={"missing": 2, "rejected": 1},
        facts=bits(saturated=0.0312, single=0.001) | {"good": {"fraction": 0.967}},
        records=[
            *(record(i) for i in range(7)),
            *(record(i, missing="the trigger was lost") for i in (7, 8)),
            record(9, observation=Observation(used=False, reason="packets were lost")),
        ],
    )
    text = Page(report.render(troubled)).text
    assert "2 · 1" in text
    assert "96.7%" in text
    assert "Missing: the trigger was lost 2 frames 7–8" in text
    assert "Not used: packets were lost 1 frame 9" in text
    assert "never lit" in text.partition("On no pixel:")[2]
    lines = report.advice(troubled)
    assert lines[0].startswith("2 frames missing")
    assert lines[-1] == "Flags of the pixels, explained under Quality: saturated 3.12%."
    assert "Expose more briefly" in text.partition("saturated 3.12% A sample")[2]


def test_advice_is_said_once() -> None:
    line = "in 30.9% of the pixels patterns disagree"
    text = report.render(subject(facts=bits(disagree=0.309, single=2e-5) | {"advice": [line]}))
    assert "<em>&lt; 0.01%</em>" in text
    words = Page(text).text
    assert words.count("patterns disagree") == 1
    assert f"I{line[1:]}." in words
    assert words.count("Patterns give different components here") == 1, "under Quality only"
    assert " %" not in words


def test_advice_for_a_dark_scene_and_for_a_good_one() -> None:
    (line,) = report.advice(subject(white=25.5))
    assert "10% of the camera's scale" in line
    assert "8 times as long" in line
    (line,) = report.advice(subject())
    assert line.startswith("Nothing to mend")


def test_an_unfinished_run_says_so() -> None:
    assert (
        "Only 25 of 40 frames"
        in report.advice(
            report.Subject(
                file=RunFile(
                    id="x",
                    state=RunState.ABORTED,
                    spec=Stick(),
                    submitted="",
                    planned=40,
                    recorded=25,
                ),
                facts={},
                pictures={},
            )
        )[0]
    )


def test_clouds_are_one_row_and_many_lost_frames_are_named() -> None:
    clouds = [
        record(k, observation=Observation(used=False, reason=f"source at {60 + k}%: cloud"))
        for k in range(4)
    ]
    lost = [record(k, missing="lost between camera and host") for k in range(4, 8)]
    sunny = subject(Mesh(hole_fraction=0.3), file={"missing": 20}, records=[*clouds, *lost])
    text = Page(report.render(sunny)).text
    assert "Not used: source at 60 to 63%: cloud 4 frames 0–3" in text
    assert text.count("cloud") == 1
    assert "20 of 45 frames were lost" in report.advice(sunny)[0]
    assert "--frame-rate-hz" in report.advice(sunny)[0]


def test_global_with_ambient_light_is_called_so() -> None:
    truth = {"rmse_direct": 0.01, "rmse_global": 0.05, "global_holds": "3.26 times ..."}
    text = Page(report.render(subject(facts=bits() | {"truth": truth}))).text
    assert "RMS error of global with ambient light" in text
    assert "RMS error of direct with" not in text


def test_truth_is_a_headline() -> None:
    truth = {"rmse_direct": 0.00992, "rmse_global": None}
    text = Page(report.render(subject(facts=bits() | {"truth": truth}))).text
    assert "0.992% of full scale: RMS error of direct" in text
    assert "unknown of full scale: RMS error of global" in text


def test_histogram_has_a_bar_for_each_filled_bin() -> None:
    histogram = {"bins": 4, "to": 255, "counts": [4, 0, 1, 16]}
    page = Page(report.render(subject(facts=bits() | {"exposure_histogram": histogram})))
    bars = [attrs for tag, attrs in page.seen if tag == "rect"]
    assert [float(b["height"] or 0) for b in bars] == [60, 30, 120]
    assert [b.get("class") for b in bars] == ["bar", "bar", "hot"]


def test_pace_is_measured_from_the_exposures() -> None:
    text = Page(report.render(subject(records=[record(i) for i in range(1000)]))).text
    assert "median 40.0 ms" in text
    assert "Pace" not in Page(report.render(subject(records=[record(0)]))).text


def test_photographs_have_no_times_nor_settings_of_a_camera() -> None:
    counts = {"software": 25}
    read = subject(
        file={"sequencing": {"mode": "recorded", "why": "a recording", "counts": counts}},
        records=[record(i) for i in range(25)],
        timings={"waited_s": 0.001, "rate_hz": 16.6, "separate_s": 2.5},
    )
    text = Page(report.render(read)).text
    assert "frames/s" in Page(report.render(subject(timings={"rate_hz": 16.6}))).text
    for word in (
        "frames/s",
        "from one frame",
        "waited",
        "a second",
        "software",
        " mode ",
        " gain ",
        "auto exp",
    ):
        assert word not in text, word
    assert "separate 2.500 s" in text


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        (Checkerboard(checker=6, shifts=4, shift=2), "6 px checkers, 4 × 4 shifts of 2 px"),
        (TwoImage(checker=6), "checkerboard of 6 px and its complement"),
        (Stick(), "occluder swept"),
    ],
)
def test_every_method_has_a_headline(spec: AnyScan, words: str) -> None:
    assert words in Page(report.render(subject(spec))).text


def test_without_a_frame_there_is_no_tab_for_it() -> None:
    bare = subject()
    pictures = {n: p for n, p in bare.pictures.items() if n != "frame"}
    text = report.render(report.Subject(file=bare.file, facts=bare.facts, pictures=pictures))
    assert 'id="v-frame"' not in text
    assert 'id="v-direct"' in text
