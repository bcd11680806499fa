import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.pictures.display import UNMEASURED, common_white, for_display, thumbnail
from daemon.products import separated
from daemon.products.quality import BITS, overlay
from daemon.separation.estimator import Components, Observation, Quality
from daemon.storage import staging
from daemon.storage.durable import Damaged, StorageError
from daemon.storage.frames import FrameRecord, FrameStore
from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from drivers.base.pixelformat import PixelFormat
from protocol.errors import Code, UmbraError
from protocol.scans.projected import Checkerboard

SIZE = (24, 32)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunFolder]:
    with Store(tmp_path) as store:
        yield store.create(Checkerboard(), {})


def components(colour: bool = True) -> Components:
    shape = (*SIZE, 3) if colour else SIZE
    rng = np.random.default_rng(1)
    direct = rng.uniform(0, 600, shape).astype(np.float32)
    indirect = rng.uniform(0, 300, shape).astype(np.float32)
    quality = np.zeros(SIZE, np.uint16)
    direct[:4, :4] = np.nan
    quality[:4, :4] |= np.uint16(Quality.NEVER_LIT)
    quality[0, 0] |= np.uint16(Quality.SATURATED)
    quality[20, 20] |= np.uint16(Quality.SINGLE)
    planes: dict[str, NDArray[Any]] = {"coverage": np.full(SIZE, 7, np.uint16)}
    return Components(direct, indirect, quality, planes, {"patterns": np.int64(25), "odd": np.nan})


def write(run: RunFolder, made: Components, **more: Any) -> dict[str, Path]:
    written = separated.write(run, made, full_scale=1023, **more)
    run.add_products(written)
    for product in written:
        assert (run.path / product.file).stat().st_size == product.bytes > 0
    return {product.name: run.path / product.file for product in written}


@pytest.mark.parametrize("colour", [True, False])
def test_components_come_back_bit_by_bit(run: RunFolder, colour: bool) -> None:
    made = components(colour)
    files = write(run, made)
    assert set(files) == {
        "direct", "global", "coverage", "quality", "facts", "preview", "report",
    }  # fmt: skip
    again, facts = separated.read(run)
    np.testing.assert_array_equal(again.direct, made.direct)
    np.testing.assert_array_equal(again.global_, made.global_)
    np.testing.assert_array_equal(again.quality, made.quality)
    assert again.direct.dtype == np.float32
    assert again.quality.dtype == np.uint16
    assert facts["patterns"] == 25
    assert facts["odd"] is None
    coverage = cv2.imread(str(files["coverage"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(coverage, made.planes["coverage"])


def test_files_are_rgb_to_a_reader(run: RunFolder) -> None:
    """The first sample of the first pixel in the file is red: TIFF's RGB, no compression."""
    made = components()
    made.direct[...] = (1.0, 2.0, 3.0)
    data = write(run, made)["direct"].read_bytes()
    pixel = np.array([1, 2, 3], "<f4").tobytes()
    assert pixel * 4 in data


def test_facts_count_bits(run: RunFolder) -> None:
    facts = json.loads(write(run, components())["facts"].read_text())
    assert facts["quality"]["never_lit"] == {"bit": 8, "pixels": 16, "fraction": 0.020833}
    assert facts["quality"]["saturated"]["pixels"] == 1
    assert facts["quality"]["moved"]["pixels"] == 0
    assert set(facts["quality"]) == {(flag.name or "").lower() for flag in Quality}
    assert facts["good"]["pixels"] == 24 * 32 - 17
    assert facts["size"] == [32, 24]


def test_truth_is_compared_over_good_and_over_all_pixels(run: RunFolder) -> None:
    made = components()
    truth = {"direct": made.direct + 10.23, "global": made.global_.copy()}
    truth["global"][20, 20] += 102.3  # flagged
    files = write(run, made, truth=truth)
    assert {"truth_direct", "truth_global"} <= set(files)
    found = json.loads(files["facts"].read_text())["truth"]
    assert found["unit"] == "fraction of full scale"
    assert found["rmse_direct"] == pytest.approx(0.01, rel=1e-4)
    assert found["rmse_global"] == 0
    assert found["rmse_global_all"] == pytest.approx(0.1 / np.sqrt(24 * 32), rel=1e-4)
    with pytest.raises(ValueError, match="true direct has shape"):
        separated.compare(made, {"direct": made.direct[:5], "global": made.global_}, 1023)


def test_truth_with_no_comparable_pixel_is_none() -> None:
    made = components()
    made.quality[...] |= np.uint16(Quality.MOVED)
    truth = {"direct": made.direct, "global": made.global_}
    found = separated.compare(made, truth, 1023)
    assert found["rmse_direct"] is None
    assert found["rmse_direct_all"] == 0


def test_a_failed_write_leaves_the_earlier_products(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = components()
    before = {n: p.read_bytes() for n, p in write(run, first).items()}

    def full(path: Path) -> None:
        if path.name == "preview.png":
            raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(staging, "fsync_file", full)
    second = components()
    second.direct[...] = 1
    with pytest.raises(StorageError) as caught:
        separated.write(run, second, full_scale=1023)
    assert caught.value.code is Code.STORAGE_FULL
    assert {n: run.product(n).read_bytes() for n in before} == before
    assert not list(run.path.glob(".products-*"))


def test_what_a_crash_left_is_swept_up(run: RunFolder) -> None:
    left = run.path / ".products-dead"
    left.mkdir()
    (left / "direct.tiff").write_bytes(b"half")
    write(run, components())
    assert not left.exists()


def test_reading_names_what_is_missing_or_spoilt(run: RunFolder) -> None:
    with pytest.raises(UmbraError, match="has made no separation") as caught:
        separated.read(run)
    assert caught.value.code is Code.NO_RESULT
    files = write(run, components())
    files["global"].write_bytes(b"II*\0")
    with pytest.raises(Damaged, match=r"global\.tiff"):
        separated.read(run)


def test_the_preview_shows_the_white_frame_that_was_recorded(run: RunFolder) -> None:
    frames = FrameStore.create(run.path, SIZE, "uint16")
    for i, level in enumerate((0, 500)):
        observation = Observation(used=level > 0)
        record = FrameRecord(index=i, step=i, observation=observation)
        frames.append(np.full(SIZE, level, "uint16"), record)
    frames.commit()
    made = components()
    with_frame = write(run, made, pixel_format=PixelFormat.MONO10)["preview"]
    picture = cv2.imread(str(with_frame))
    assert picture is not None
    height, width = SIZE
    assert picture.shape[1] == 4 * width + 5 * 12
    tile = picture[-12 - height : -12, 12 : 12 + width]
    assert tile.min() == tile.max()
    assert 150 < tile.mean() < 255
    without = cv2.imread(str(write(run, made)["preview"]))
    assert without is not None
    assert without.shape[1] == 3 * width + 4 * 12


def test_a_picture_stands_in_for_a_frame_that_was_not_kept(run: RunFolder) -> None:
    frames = FrameStore.create(run.path, SIZE, "uint16", pixels=False)
    record = FrameRecord(index=0, step=0, observation=Observation())
    frames.append(np.zeros(SIZE, "uint16"), record)
    frames.commit()
    stand_in = np.full((12, 16, 3), (200, 20, 20), np.uint8)
    files = write(run, components(), pixel_format=PixelFormat.MONO10, frame=stand_in)
    picture = cv2.imread(str(files["preview"]))
    assert picture is not None
    assert picture[-20, 20].tolist() == [20, 20, 200]


# ---------------------------------------------------------------- for eyes


def test_display_is_srgb_and_clips() -> None:
    light = np.array([[0.0, 0.2140, 1.0, 5.0, -1.0]], np.float32)
    assert for_display(light, 1.0)[0, :, 0].tolist() == [0, 127, 255, 255, 0]
    assert for_display((light[:, :3] * 255).astype(np.uint8), 255)[0, :, 1].tolist() == [
        0,
        127,
        255,
    ]


def test_display_averages_areas_in_linear_light() -> None:
    checker = np.indices((64, 64)).sum(axis=0) % 2 * 255
    small = for_display(checker.astype(np.uint8), 255, width=16)
    assert small.shape == (16, 16, 3)
    assert abs(int(small[3, 3, 0]) - 188) <= 1  # half the light, not half the code


def test_unmeasured_pixels_are_hatched_and_left_out_of_averages() -> None:
    light = np.full((32, 32), 0.5, np.float32)
    light[:, 16:] = np.nan
    light[0, 0] = np.nan
    picture = for_display(light, 1.0, width=16)
    assert len(np.unique(picture[:, :8])) == 1, "one NaN among four does not show"
    colours = {tuple(int(v) for v in c) for c in picture[:, 8:].reshape(-1, 3)}
    assert colours == {UNMEASURED, (70, 0, 55)}


@pytest.mark.parametrize("order", ["RG", "GR", "GB", "BG"])
def test_a_mosaic_is_shown_in_its_colours(order: str) -> None:
    below = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[order]
    level = {"R": 1023, "G": 300, "B": 0}
    cell = np.array([[level[c] for c in row] for row in (order, below)], np.uint16)
    picture = thumbnail(np.tile(cell, (8, 8)), PixelFormat(f"Bayer{order}10"), 640)
    assert picture.shape == (8, 8, 3)
    red, green, blue = picture[4, 4].tolist()
    assert (red, blue) == (255, 0)
    assert 140 < green < 160


def test_an_encoded_frame_is_shown_as_it_was_encoded() -> None:
    ramp = np.arange(256, dtype=np.uint8)[None]
    shown = thumbnail(ramp, PixelFormat.MONO8, 256, tone="srgb")[0, :, 0].astype(int)
    assert np.abs(shown - ramp[0]).max() <= 1


def test_common_white_ignores_nan_and_specks() -> None:
    plane = np.full((100, 100), 10.0, np.float32)
    plane[0, :30] = 1e6
    plane[50] = np.nan
    assert common_white(plane) == 10.0
    assert common_white(np.zeros((4, 4), np.float32)) == 1.0


def test_every_bit_is_explained_in_a_colour_of_its_own() -> None:
    assert {bit.flag for bit in BITS} == set(Quality)
    assert len({bit.colour for bit in BITS}) == len(BITS)


def test_a_lone_flag_still_shows_in_a_small_overlay() -> None:
    quality = np.zeros((80, 80), np.uint16)
    quality[40, 40] = np.uint16(Quality.SATURATED)
    picture = overlay(np.full((80, 80), 0.5, np.float32), 1.0, quality, width=20)
    assert picture.shape == (20, 20, 3)
    grey = picture[0, 0].astype(int)
    assert grey[0] == grey[1] == grey[2]
    red, green, _ = picture[10, 10].astype(int)
    assert red > grey[0] + 15
    assert red > green > 0
