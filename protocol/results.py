"""What a client's commands come back with, made of replies and their arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from protocol.connection import Answer, expect
from protocol.errors import Code, UmbraError
from protocol.messages import replies
from protocol.messages.runs import Product, RunInfo

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Picture:
    """A frame or a preview: the array, or the bytes of a PNG file, and what is known of it."""

    pixels: NDArray[Any]
    facts: dict[str, Any]
    saturated: NDArray[np.uint8] | None = None  # of a preview: 1 where it is over-exposed

    def _repr_html_(self) -> str:
        shown = ", ".join(f"{k} {v}" for k, v in self.facts.items() if isinstance(v, int | float))
        return f"<code>{'×'.join(map(str, self.pixels.shape))} {self.pixels.dtype}</code> {shown}"


@dataclass(frozen=True, eq=False)
class Separation:
    """Direct and global light: float32, H x W or H x W x 3 (RGB), linear camera counts.

    The arrays are read-only views of the message that was received; copy one to change it.
    `quality` is a mask of named bits (uint16), or None. `final` is False while the run goes on.
    Python has taken the name `global`: `global_` it is here, or ``getattr(result, "global")``.
    """

    direct: NDArray[np.float32]
    global_: NDArray[np.float32]
    quality: NDArray[np.uint16] | None
    run: RunInfo
    facts: dict[str, Any]
    final: bool

    def __getattr__(self, name: str) -> Any:
        if name == "global":
            return self.global_
        raise AttributeError(name)

    def __repr__(self) -> str:
        size = "×".join(map(str, self.direct.shape))
        kind = "final" if self.final else f"so far ({self.run.recorded} frames)"
        return f"<Separation of {self.run.id}: direct, global_ {size} float32, {kind}>"


def separation_of(answer: Answer) -> Separation:
    """Of a result. Raises UmbraError(no_result) for a run that measures and separates nothing."""
    reply = expect(answer.reply, replies.Result)
    if not answer.arrays:
        raise UmbraError(
            Code.NO_RESULT,
            f"run {reply.run.id} measures: it has figures (facts), not direct and global",
        )
    return Separation(
        direct=answer.array("direct", "float32"),
        global_=answer.array("global", "float32"),
        quality=answer.array("quality", "uint16") if "quality" in answer.arrays else None,
        run=reply.run,
        facts=reply.facts,
        final=reply.final,
    )


def facts_of(answer: Answer) -> dict[str, Any]:
    """The figures of a result, whatever it is."""
    return expect(answer.reply, replies.Result).facts


def picture_of(*names: str) -> Callable[[Answer], Picture]:
    """Of a preview or a snap, whose array has one of these names."""

    def made(answer: Answer) -> Picture:
        reply = expect(answer.reply, replies.Picture)
        name = next((n for n in names if n in answer.arrays), names[0])
        return Picture(answer.array(name), reply.facts, answer.arrays.get("saturated"))

    return made


def run_of(answer: Answer) -> RunInfo:
    """Of an answer about one run."""
    return expect(answer.reply, replies.Run).run


def runs_of(answer: Answer) -> tuple[RunInfo, ...]:
    """Of an answer about several runs."""
    return expect(answer.reply, replies.Runs).runs


def stage_of(answer: Answer) -> replies.StageStatus:
    """Of an answer about the stage."""
    return expect(answer.reply, replies.StageStatus)


def message_of(answer: Answer) -> str:
    """What the daemon says where there is nothing more to say."""
    return expect(answer.reply, replies.Done).message


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a product's file."""

    product: Product
    offset: int
    size: int
    data: memoryview


def part_of(answer: Answer) -> Part:
    """Of a part of a product."""
    reply = expect(answer.reply, replies.ProductPart)
    return Part(reply.product, reply.offset, reply.size, answer.array("data", "uint8").data)
