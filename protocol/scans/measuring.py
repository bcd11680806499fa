"""Runs that end in figures and plots; of them the one that advises on a scan."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from protocol.scans.spec import Spec


class Measuring(Spec, frozen=True, kw_only=True):
    """A run that measures the rig, or how well it separates: it ends in figures and plots."""


PatchSizes = Annotated[
    tuple[Annotated[int, Meta(ge=1, le=256)], ...],
    Meta(min_length=2, max_length=64, description="sides in projector px"),
]


class Advise(Measuring, frozen=True, kw_only=True, tag="advise"):
    """A short sweep of checker sizes that says which pattern, how many images and what exposure
    this scene needs for a wanted error, and what limits it (Appendix A)."""

    error: Annotated[
        float, Meta(gt=0, le=0.5, description="wanted in direct and global, of full scale")
    ] = 0.01
    sizes: PatchSizes = (2, 3, 4, 6, 8, 12, 16, 24)
    average: Annotated[int, Meta(ge=2, le=1000, description="frames averaged a pattern")] = 2
