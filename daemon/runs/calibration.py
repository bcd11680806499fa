"""What the rig's calibration runs say about it now: found in the store, judged, ready to apply.

A calibration is the result of a run like any other (`calibration.json`). The newest finished one
of each kind that was made with the same devices, with the settings that matter to it, and not too
long ago, is applied to every later run; run.json records which, and what was left out and why.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from typing import Any

import msgspec

from daemon.storage.runfolder import RunFolder
from daemon.storage.store import Store
from protocol.errors import UmbraError
from protocol.messages.runs import RunState
from protocol.scans.calibrations import Calibration

PRODUCT = "calibration"
"""The name of the product that has the figures; what applies is under its key `values`."""

MATTERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "dark": (("camera",), ("gain", "pixel_format")),
    "noise": (("camera",), ("gain", "pixel_format")),
    "leak": (("projector",), ()),
    "tone": (("projector",), ()),
    "latency": (("projector", "camera"), ()),
}
"""Of each kind: the devices that it is of, and the camera settings that it holds for."""

SHOWN_WITH = {"tone": ("tone", "gamma"), "latency": ("latency_s",)}
"""Kinds that are applied when patterns are shown and exposed, and their values."""

_IDENTITY = ("driver", "model", "serial")


class Calibrations:
    """The calibrations of one data folder. `max_age_days`: older ones are not applied."""

    def __init__(self, store: Store, max_age_days: float) -> None:
        self._store = store
        self._max_age_days = max_age_days

    def of(
        self, rig: Mapping[str, Any], settings: Mapping[str, Any], spec: object = None
    ) -> dict[str, Any]:
        """What applies to a rig (`Rig.snapshot`) with these camera settings, as run.json keeps it:

        `values` by name (black, leakage, tone ...); `sources`: by kind the run, when it was made
        and its age in days; `ignored`: the newest of each kind of which none can be applied, and
        why. What a calibration run (`spec`) is about to measure is not applied to itself.
        """
        now = {**rig, "settings": settings}
        values: dict[str, Any] = {}
        sources: dict[str, Any] = {}
        ignored: list[dict[str, str]] = []
        own = spec.kind if isinstance(spec, Calibration) else ""
        found = self._newest_first()
        for kind in (kind for kind in MATTERS if kind != own):
            reasons = []
            for run in (run for run, its in found if its == kind):
                why = self._against(kind, run, now)
                applied = None if why else _values(run)
                if applied is not None:
                    values |= applied
                    sources[kind] = {
                        "run": run.id,
                        "made": run.file.ended[:19],
                        "age_days": round(self._age_days(run), 2),
                    }
                    break
                reasons.append({"kind": kind, "run": run.id, "why": why or "it cannot be read"})
            else:
                ignored += reasons[:1]
        if own != "latency" and "latency_s" not in values:
            ignored += self._assumed_latency(rig, values)
        return {"values": values, "sources": sources, "ignored": ignored}

    def anew(
        self, then: Mapping[str, Any], rig: Mapping[str, Any], settings: Mapping[str, Any]
    ) -> dict[str, Any]:
        """What applies today to frames that were taken with the calibration `then`, for `of`'s rig
        and settings: of what was applied when the frames were exposed that time's values stay."""
        today = self.of(rig, settings)
        shown = {name for names in SHOWN_WITH.values() for name in names}

        def mixed(part: str, names: Collection[str]) -> dict[str, Any]:
            found = {name: value for name, value in today[part].items() if name not in names}
            return found | {n: value for n, value in then.get(part, {}).items() if n in names}

        return {
            "values": mixed("values", shown),
            "sources": mixed("sources", SHOWN_WITH),
            "ignored": [
                *(one for one in then.get("ignored", ()) if one["kind"] in SHOWN_WITH),
                *(one for one in today["ignored"] if one["kind"] not in SHOWN_WITH),
            ],
        }

    def _assumed_latency(
        self, rig: Mapping[str, Any], values: dict[str, Any]
    ) -> list[dict[str, str]]:
        """What a projector whose latency nobody has measured asks to be waited for, put into
        `values`."""
        assumed = rig.get("projector", {}).get("facts", {}).get("assumed_latency_s")
        if not assumed:
            return []
        values["latency_s"] = assumed
        why = f"never measured; {assumed * 1e3:.0f} ms are waited for after each flip"
        return [{"kind": "latency", "run": "", "why": why}]

    def _newest_first(self) -> list[tuple[RunFolder, str]]:
        return [
            (run, run.file.spec.kind)
            for run in self._store.runs()
            if isinstance(run.file.spec, Calibration)
            and run.file.state is RunState.DONE
            and any(product.name == PRODUCT for product in run.file.products)
        ]

    def _age_days(self, run: RunFolder) -> float:
        made = datetime.fromisoformat(run.file.ended)
        return (datetime.now(UTC) - made).total_seconds() / 86_400

    def _against(self, kind: str, run: RunFolder, now: Mapping[str, Any]) -> str:
        """Why a calibration does not apply to the rig as it is now; "" if it does."""
        devices, settings = MATTERS[kind]
        then = run.file.rig
        for device in devices:
            if device not in now:
                return f"this rig has no {device}"
            if _named(then.get(device), _IDENTITY) != _named(now[device], _IDENTITY):
                was = then.get(device) or {}
                return f"it was made with another {device}: {was.get('model')} {was.get('serial')}"
        for name in settings:
            was, value = (rig.get("settings", {}).get(name) for rig in (then, now))
            if was != value:
                return f"it was made with {name.replace('_', ' ')} {was}, not {value}"
        age = self._age_days(run)
        if age > self._max_age_days:
            return f"it is {age:.1f} days old (calibration.max_age_days: {self._max_age_days:g})"
        return ""


def _named(device: Mapping[str, Any] | None, keys: Iterable[str]) -> tuple[Any, ...]:
    return tuple((device or {}).get(key) for key in keys)


def _values(run: RunFolder) -> dict[str, Any] | None:
    try:
        facts = msgspec.json.decode(run.product(PRODUCT).read_bytes(), type=dict[str, Any])
    except (OSError, UmbraError, msgspec.DecodeError):
        return None  # reported as ignored: it cannot be read
    values = facts.get("values")
    return values if isinstance(values, dict) else None
