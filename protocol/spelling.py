"""What a person may have meant: the known name that is nearest to a mistyped one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec
from msgspec import inspect as shape


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """`; did you mean "checkerboard"?` where something is near; else nothing."""
    import difflib  # noqa: PLC0415 - for a mistake only: every command starts without it

    near = difflib.get_close_matches(str(word), [*known], n=1, cutoff=0.6)
    return f'; did you mean "{near[0]}"?' if near else ""


def fields_at(struct: type[msgspec.Struct], path: str) -> list[str]:
    """The names of the fields of the struct that is at a path of msgspec's ($.rig) in `struct`;
    none where there is no struct."""
    kind: Any = shape.type_info(struct)
    for step in path.strip("`$.").split("."):
        if step:
            fields = kind.fields if isinstance(kind, shape.StructType) else ()
            kind = next((f.type for f in fields if f.encode_name == step), None)
            while isinstance(kind, shape.Metadata | shape.UnionType):
                if isinstance(kind, shape.Metadata):
                    kind = kind.type
                else:
                    kind = next((t for t in kind.types if isinstance(t, shape.StructType)), None)
    return [f.encode_name for f in kind.fields] if isinstance(kind, shape.StructType) else []
