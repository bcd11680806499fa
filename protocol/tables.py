"""Structs and enums of the protocol in words: types, tables of fields, lists of members.

What is said of a field is the comment beside it in the source, so there is one place to keep true.
"""

from __future__ import annotations

import ast
import enum
import functools
import inspect
import re
import sys
from collections.abc import Iterator
from typing import Any, get_args

import msgspec
from msgspec import inspect as mi

from protocol.messages import commands, replies
from protocol.messages.events import AnyEvent
from protocol.patterns import AnyBinary, AnyPattern
from protocol.scans.anyscan import AnyScan

Struct = type[msgspec.Struct]

# ---------------------------------------------------------------- types in words


def _limits(kind: Any) -> str:
    said = []
    for name, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<")):
        if (limit := getattr(kind, name, None)) is not None:
            said.append(f"{sign} {limit:g}" if limit < 1e6 else f"{sign} {limit}")
    low, high = getattr(kind, "min_length", None), getattr(kind, "max_length", None)
    if low is not None or high is not None:
        said.append(f"{low or 0} to {'any' if high is None else high} long")
    if pattern := getattr(kind, "pattern", None):
        said.append(f"matching `{pattern}`".replace("|", "\\|"))
    return f" {', '.join(said)}" if said else ""


_PLAIN = {
    mi.BoolType: "true or false",
    mi.NoneType: "null",
    mi.AnyType: "any value",
    mi.StrType: "text",
    mi.IntType: "integer",
    mi.FloatType: "number",
}


def _type(kind: mi.Type) -> str:  # noqa: PLR0911  (one case a kind of type)
    """A type as the tables name it."""
    match kind:
        case mi.Metadata(type=inner):
            return _type(inner)
        case mi.UnionType(types=types):
            structs = [t for t in types if isinstance(t, mi.StructType)]
            if len(structs) > 1:
                return _union(structs) + (" or null" if len(types) > len(structs) else "")
            return " or ".join(map(_type, types))
        case mi.StructType(cls=cls):
            return link(cls)
        case mi.EnumType(cls=cls):
            return link(cls)
        case mi.LiteralType(values=values):
            return " or ".join(f'`"{v}"`' for v in values)
        case mi.VarTupleType(item_type=item):
            return f"list of {_type(item)}"
        case mi.TupleType(item_types=items):
            return f"list of {len(items)}: {', '.join(map(_type, items))}"
        case mi.DictType(value_type=value):
            return f"object of {_type(value)}s" if type(value) is not mi.AnyType else "object"
        case _:
            return _PLAIN[type(kind)] + _limits(kind)


_UNIONS = {
    "any command": ("commands", commands.AnyCommand),
    "any reply": ("replies", replies.AnyReply),
    "any event": ("events", AnyEvent),
    "any scan": ("scans", AnyScan),
    "any pattern": ("patterns", AnyPattern),
    "a two-valued pattern": ("patterns", AnyBinary),
}
"""By name: the section that has its members, and the union."""


def _union(structs: list[mi.StructType]) -> str:
    members = {s.cls for s in structs}
    [found] = [
        f"[{name}](#{section})"
        for name, (section, union) in _UNIONS.items()
        if set(get_args(union)) == members
    ]
    return found


def link(cls: type) -> str:
    """A link to the section of a struct or an enum, by its name."""
    return f"[{cls.__name__}](#{_anchor(_title(cls))})"


def tag_link(cls: Struct) -> str:
    """The same, by its tag: the name under which it travels."""
    return f"[`{_tag(cls)}`](#{_anchor(_title(cls))})"


def _tag(cls: type) -> str:
    config = getattr(cls, "__struct_config__", None)
    return str(config.tag) if config and config.tag else ""


def _title(cls: type) -> str:
    """A heading; the same tag may name a command and its reply, so those say which they are."""
    if not _tag(cls):
        return cls.__name__
    return f"{cls.__name__}: `{_tag(cls)}`"


def _anchor(title: str) -> str:
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


# ---------------------------------------------------------------- comments in the source


@functools.cache
def _source(module: str) -> tuple[list[str], dict[str, ast.ClassDef]]:
    """A module's lines and classes."""
    text = inspect.getsource(sys.modules[module])
    classes = {n.name: n for n in ast.parse(text).body if isinstance(n, ast.ClassDef)}
    return text.splitlines(), classes


def _remarks(cls: type) -> dict[str, str]:
    """Field or member -> the comment beside it or, with ``#:``, above it; base classes too."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("protocol"):
            continue
        lines, classes = _source(base.__module__)
        for item in classes[base.__name__].body:
            match item:
                case ast.AnnAssign(target=ast.Name(id=name)):
                    pass
                case ast.Assign(targets=[ast.Name(id=name)]):
                    pass
                case _:
                    continue
            beside = lines[(item.end_lineno or item.lineno) - 1].partition("  # ")[2]
            above = lines[item.lineno - 2].strip()
            found[name] = beside or (above[2:].strip() if above.startswith("#:") else "")
    return found


def _doc(cls: type) -> str:
    text = inspect.cleandoc(cls.__doc__ or "")
    return re.sub(r"``(.+?)``", r"`\1`", text)


# ---------------------------------------------------------------- tables


def _described(kind: mi.Type) -> str:
    """What the type itself says of the field (Meta's description)."""
    match kind:
        case mi.Metadata(type=inner, extra_json_schema=schema):
            return str((schema or {}).get("description", "")) or _described(inner)
        case mi.UnionType(types=types):
            return next(filter(None, map(_described, types)), "")
        case _:
            return ""


def _default(field: mi.Field) -> str:
    if field.required:
        return "required"
    value = field.default
    if value is msgspec.NODEFAULT:
        value = field.default_factory()
    return f"`{msgspec.json.encode(value).decode()}`"


def _field_table(cls: Struct) -> Iterator[str]:
    info = mi.type_info(cls)
    assert isinstance(info, mi.StructType)
    remarks = _remarks(cls)
    if not info.fields:
        yield "No fields."
        return
    yield "| field | type | default | |"
    yield "| --- | --- | --- | --- |"
    for field in info.fields:
        said = (_described(field.type), remarks.get(field.name, ""))
        remark = "; ".join(filter(None, said)).replace("None:", "`null`:")
        yield f"| `{field.encode_name}` | {_type(field.type)} | {_default(field)} | {remark} |"


def _members(cls: type[enum.StrEnum]) -> Iterator[str]:
    remarks = _remarks(cls)
    yield "| value | |"
    yield "| --- | --- |"
    for member in cls:
        yield f"| `{member.value}` | {remarks.get(member.name, '')} |"


def summary(cls: type) -> str:
    """The first line of what is said of a class."""
    return _doc(cls).partition("\n")[0]


def struct(cls: Struct, extra: str = "") -> Iterator[str]:
    """The section of a struct; `extra` stands before the table of its fields."""
    yield f"### {_title(cls)}"
    yield ""
    yield _doc(cls)
    if extra:
        yield ""
        yield extra
    yield ""
    yield from _field_table(cls)
    yield ""


def structs(union: Any) -> Iterator[str]:
    """The sections of a union's members."""
    for cls in get_args(union):
        yield from struct(cls)


def choices(cls: type[enum.StrEnum]) -> Iterator[str]:
    """The section of an enum; a diagram in its docstring stands as it is."""
    yield f"### {_title(cls)}"
    yield ""
    doc = _doc(cls)
    if "──>" in doc:
        first, _, rest = doc.partition("\n\n")
        yield f"{first}\n\n```\n{rest}\n```"
    else:
        yield doc
    yield ""
    yield from _members(cls)
    yield ""
