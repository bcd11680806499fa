"""What a separation leaves for people and programs: images, masks, figures, pictures, a report.

What a measurement leaves is in `daemon.products.measured`.

    direct.tiff, global.tiff   float32, linear counts in the input's full scale, RGB; NaN: unknown;
                               of a bracket, in counts of the run's exposure, and beyond
    PLANE.tiff                 further planes of the method
    truth_*.tiff               of a simulated camera
    quality.png                uint16 bits (`daemon.products.quality`), lossless
    quality.json               the figures
    preview.png, report.html   for eyes

All are written into a folder of their own first and then moved to the run's, so that a reader
finds a whole file or none.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.pictures.display import Picture, common_white, for_display, frame_light
from daemon.pictures.preview import side_by_side
from daemon.products import measured
from daemon.products.quality import BITS, overlay
from daemon.products.report.separation import Subject, render
from daemon.separation.envelope import block_mean
from daemon.separation.estimator import Components, Lighting, Measurement, Result
from daemon.storage.durable import Damaged
from daemon.storage.frames import FrameRecord, FrameStore, NoPixels
from daemon.storage.runfolder import RunFolder
from daemon.storage.staging import Staging, as_json, encoded, tiff
from drivers.base.pixelformat import PixelFormat
from protocol.errors import Code, UmbraError
from protocol.messages.runs import Product
from protocol.scans.spec import Scan

PREVIEW_WIDTH = 640
REPORT_WIDTH = 1440


def write(
    folder: RunFolder,
    result: Result,
    *,
    full_scale: float,
    pixel_format: PixelFormat | None = None,
    frame: Picture | None = None,
    truth: Mapping[str, NDArray[np.float32]] | None = None,
    timings: Mapping[str, float] | None = None,
    frames: Path | None = None,
) -> tuple[Product, ...]:
    """Write all products of a result, durably; earlier ones of the same names are replaced.

    `full_scale` is the camera's. The frame to be shown is read from the run when `pixel_format`
    says how, or from the run's folder `frames` that this one was made from; `frame`, an sRGB
    picture, stands in for it. `truth` are a simulated camera's `direct`
    and `global`. Raises StorageError; then the run has the products that it had.
    """
    file = folder.file
    records = _records(folder.path)
    if isinstance(result, Measurement):
        return measured.write(folder, result, records=records, timings=timings)
    components = result
    facts = quality_facts(components, full_scale, truth)
    if file.calibration:
        facts["calibration"] = file.calibration
    tone = file.spec.radiometry.tone if isinstance(file.spec, Scan) else "linear"
    # the exposures of a bracket reach beyond one frame's full scale
    scale = max(full_scale, facts.get("exposure_histogram", {}).get("to", 0.0))
    white = min(common_white(_sum(components)), scale)
    shown = _frame_light(frames or folder.path, records, pixel_format, tone)
    pictures = {
        "frame": frame if shown is None else for_display(shown, white),
        "direct": for_display(components.direct, white, width=REPORT_WIDTH),
        "global": for_display(components.global_, white, width=REPORT_WIDTH),
        "quality": overlay(_sum(components), white, components.quality, width=REPORT_WIDTH),
    }
    found = {name: picture for name, picture in pictures.items() if picture is not None}
    staging = Staging(folder.path)
    try:
        light = "linear counts"
        staging.add("direct", "image", "direct.tiff", tiff(components.direct), light)
        staging.add("global", "image", "global.tiff", tiff(components.global_), light)
        for name, plane in components.planes.items():
            staging.add(name, "image", f"{name}.tiff", tiff(plane))
        for name, plane in (truth or {}).items():
            staging.add(f"truth_{name}", "image", f"truth_{name}.tiff", tiff(plane), light)
        staging.add("quality", "mask", "quality.png", encoded(".png", components.quality), "bits")
        staging.add("facts", "facts", "quality.json", as_json(facts))
        preview = side_by_side({name: for_preview(picture) for name, picture in found.items()})
        staging.add("preview", "picture", "preview.png", encoded(".png", preview[..., ::-1]))
        page = render(
            Subject(
                file=file,
                facts=facts,
                pictures=found,
                records=records,
                products=tuple(staging.products),
                white=white,
                full_scale=full_scale,
                timings=dict(timings or {}),
            )
        )
        staging.add("report", "report", "report.html", page.encode())
        staging.publish()
    finally:
        staging.clear()
    return tuple(staging.products)


def read(folder: RunFolder) -> tuple[Components, dict[str, Any]]:
    """The components of a run that has ended, without further planes, and quality.json.

    Raises UmbraError(no_result) for a run that made none, Damaged for a file that is no longer
    what was written.
    """
    names = {product.name for product in folder.file.products}
    if not {"direct", "global", "quality", "facts"} <= names:
        raise UmbraError(
            Code.NO_RESULT,
            f"{folder.id} ({folder.file.state}) has made no separation; "
            "resume it if it was interrupted, or scan again",
        )
    direct, indirect = (_decoded(folder.product(name)) for name in ("direct", "global"))
    quality = _decoded(folder.product("quality"))
    path = folder.product("facts")
    try:
        facts = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise _spoilt(path) from error
    return Components(direct, indirect, quality, {}, facts), facts


def quality_facts(
    components: Components,
    full_scale: float,
    truth: Mapping[str, NDArray[np.float32]] | None = None,
) -> dict[str, Any]:
    """What quality.json says: the estimator's facts, each bit's pixels and share, units, truth."""
    quality = components.quality
    bits = {}
    for bit in sorted(BITS, key=lambda bit: bit.flag):
        pixels = int(np.count_nonzero(quality & np.uint16(bit.flag)))
        bits[bit.name] = {
            "bit": int(bit.flag),
            "pixels": pixels,
            "fraction": round(pixels / quality.size, 6),
        }
    good = int(np.count_nonzero(quality == 0))
    facts = {
        **components.facts,
        "full_scale": full_scale,
        "size": [quality.shape[1], quality.shape[0]],
        "pixels": quality.size,
        "good": {"pixels": good, "fraction": round(good / quality.size, 6)},
        "quality": bits,
        "units": {
            "direct": "linear counts, black and ambient removed; NaN: not measured",
            "global": "linear counts, black and ambient removed; NaN: not measured",
            "quality": "sum of the bits that apply; 0 is a good pixel",
            "fraction": "of all pixels",
        },
    }
    if truth:
        facts["truth"] = compare(components, truth, full_scale)
    return facts


def compare(
    components: Components, truth: Mapping[str, NDArray[np.float32]], full_scale: float
) -> dict[str, Any]:
    """Root-mean-square differences from the truth as fractions of full scale.

    Over the pixels without any quality bit, and over all (`..._all`); samples that are NaN in
    either are left out of both. None where no sample is left. A truth of a multiple of the size is
    averaged over squares. Raises ValueError for one of another shape.
    """
    good = components.quality == 0
    found: dict[str, Any] = {
        "unit": "fraction of full scale",
        "over": "pixels with no quality bit; *_all: all pixels; NaN left out",
    }
    if times := components.facts.get("ambient_in_global"):
        found["global_holds"] = f"{times:.3g} times the ambient light, which the truth has none of"
    for name, plane in (("direct", components.direct), ("global", components.global_)):
        true = truth[name]
        if true.shape[0] > plane.shape[0]:  # a method of lower resolution
            true = block_mean(true, true.shape[0] // plane.shape[0])
        if true.shape != plane.shape:
            raise ValueError(f"true {name} has shape {truth[name].shape}, not {plane.shape}")
        difference = (plane - true) / np.float32(full_scale)
        found[f"rmse_{name}"] = _rms(difference[good])
        found[f"rmse_{name}_all"] = _rms(difference)
    return found


def for_preview(picture: Picture) -> Picture:
    """A picture at the preview's size."""
    return _shrunk(picture, PREVIEW_WIDTH)


def _shrunk(picture: Picture, width: int) -> Picture:
    if picture.shape[1] <= width:
        return picture
    size = (width, max(1, round(picture.shape[0] * width / picture.shape[1])))
    shrunk = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, dtype=np.uint8)


def _records(folder: Path) -> list[FrameRecord]:
    if not (folder / "frames.jsonl").exists():
        return []
    return FrameStore.open(folder, readonly=True).records()


def _frame_light(
    folder: Path, records: list[FrameRecord], pixel_format: PixelFormat | None, tone: str
) -> NDArray[np.float32] | None:
    """The frame to be shown: the white one if there is, else the first of the patterns; of a
    bracket the one that was exposed most like the run's own exposure."""
    wanted = [
        r
        for lighting in (Lighting.WHITE, Lighting.PATTERN)
        for r in sorted(records, key=lambda r: abs(np.log(r.observation.exposure)))
        if r.observation.lighting is lighting and r.observation.used and not r.missing
    ]
    if pixel_format is None or not wanted:
        return None
    try:
        pixels = FrameStore.open(folder, readonly=True).read(wanted[0].index)
    except (NoPixels, Damaged):  # the products must not depend on one frame's file
        return None
    light = frame_light(pixels, pixel_format, REPORT_WIDTH, tone)
    return light * np.float32(1.0 / wanted[0].observation.exposure)


def _sum(components: Components) -> NDArray[np.float32]:
    """The scene under full light; where only one component is known, that one."""
    direct, indirect = components.direct, components.global_
    both = direct + indirect
    return np.where(np.isnan(both), np.where(np.isnan(direct), indirect, direct), both)


def _rms(difference: NDArray[np.float32]) -> float | None:
    finite = difference[np.isfinite(difference)].astype(np.float64)
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def _decoded(path: Path) -> NDArray[Any]:
    """A plane as `tiff` or quality.png has it, RGB."""
    plane = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if plane is None:
        raise _spoilt(path)
    return np.ascontiguousarray(plane[..., ::-1]) if plane.ndim == 3 else np.asarray(plane)


def _spoilt(path: Path) -> Damaged:
    return Damaged(f"{path} cannot be read; the run's frames are kept: separate them again")
