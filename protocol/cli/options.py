"""Command-line options made from msgspec structs, so that a new scan method needs no code here.

A struct's field becomes one option: its name, type, range, default and description are read with
`msgspec.inspect`; a nested struct's fields become options of their own. What a user gives is put
together again and checked by msgspec, the same check that the daemon makes.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgspec
import typer
from msgspec import inspect as shape

from protocol.errors import Code, UmbraError
from protocol.spelling import did_you_mean

T = TypeVar("T", bound=msgspec.Struct)

SHORT = {
    "points": ("--point",),
    "leakage": ("--leak",),
    "lit_fraction": ("--alpha",),
    "exposure_us": ("--exposure",),
}
"""Further names of options, by field."""


@dataclass(frozen=True)
class Option:
    """One leaf field of a struct as an option. `path` leads to the field."""

    path: tuple[str, ...]
    kind: type
    choices: tuple[str, ...] = ()
    item: type | None = None  # of a list: what the comma-separated items are
    default: Any = None
    help: str = ""
    required: bool = False
    fields: tuple[str, ...] = ()  # of a list of structs: those that each value gives, in order

    @property
    def name(self) -> str:
        """The Python name of the parameter."""
        return self.path[-1]

    @property
    def flag(self) -> str:
        """The option's first name."""
        return "--" + self.name.replace("_", "-")

    def parameter(self, help_text: str | None = None) -> inspect.Parameter:
        """The option as a parameter of a typer command; None means that it was not given."""
        names = (f"{self.flag}/--no-{self.flag[2:]}",) if self.kind is bool else (self.flag,)
        info = typer.Option(
            *names,
            *SHORT.get(self.name, ()),
            help=self.described() if help_text is None else help_text,
            metavar=self.metavar(),
            show_default=False,
            autocompletion=(lambda: list(self.choices)) if self.choices else None,
        )
        return inspect.Parameter(
            self.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if self.required else None,
            annotation=Annotated[self.kind if self.required else self.kind | None, info],
        )

    def metavar(self) -> str | None:
        """How the value is written in the help."""
        if self.kind is bool:
            return None
        if self.fields:
            return ",".join(self.fields)
        if self.item is not None:
            return ",".join([(self.item.__name__ if not self.choices else "name").upper(), "..."])
        if 1 < len(self.choices) <= 4:
            return "|".join(self.choices)
        return {int: "N", float: "X"}.get(self.kind, "TEXT")

    def described(self) -> str:
        """The help line: what it is, its choices and its default."""
        facts = [self.help] if self.help else []
        if self.choices and (self.item is not None or len(self.choices) > 4):
            facts.append("one of " + ", ".join(self.choices))
        if self.default not in (None, "", False):
            facts.append(f"default {self.default}")
        text = "; ".join(facts)
        symbol = text[1:2] == ","  # n, β: as the paper writes them
        return text if symbol else text[:1].upper() + text[1:]

    def _struct_of(self, text: str) -> dict[str, Any]:
        """[NAME=]VALUE,VALUE,... as a struct's fields. Raises UmbraError(bad_request)."""
        name, _, rest = text.rpartition("=")
        try:
            values = [float(part) for part in rest.split(",")]
            found: dict[str, Any] = dict(zip(self.fields, values, strict=True))
        except ValueError:
            wanted = ",".join(self.fields)
            raise UmbraError(
                Code.BAD_REQUEST, f"{self.flag}: {text!r} is not [NAME=]{wanted}", self.flag
            ) from None
        return found | ({"name": name} if name else {})

    def value_of(self, given: Any) -> Any:
        """A given value as msgspec expects it. Raises UmbraError(bad_request)."""
        if self.fields:
            return [self._struct_of(text) for text in given]
        if self.item is not None:
            parts = [part.strip() for part in str(given).split(",") if part.strip()]
            try:
                value: Any = [self.item(part) for part in parts]
            except ValueError:
                raise UmbraError(
                    Code.BAD_REQUEST, f"{self.flag}: {given!r} is not a list of numbers", self.flag
                ) from None
            wrong = [v for v in parts if self.choices and v not in self.choices]
        else:
            value, wrong = given, [given] if self.choices and given not in self.choices else []
        if wrong:
            raise UmbraError(
                Code.BAD_REQUEST,
                f"{self.flag}: {wrong[0]!r} is not one of {', '.join(self.choices)}"
                + did_you_mean(wrong[0], self.choices),
                self.flag,
            )
        return value


def options_of(struct: type[msgspec.Struct]) -> list[Option]:
    """The options of a struct, in the order of its fields."""
    info = shape.type_info(struct)
    assert isinstance(info, shape.StructType)
    return list(_leaves(info, ()))


def _leaves(info: shape.StructType, path: tuple[str, ...]) -> Iterable[Option]:
    fields = sorted(info.fields, key=lambda f: not f.required)
    # a method's own fields are what a reader looks for: before those of its bases
    own = set(getattr(info.cls, "__annotations__", {}))
    for field in sorted(fields, key=lambda f: f.name not in own):
        where = (*path, field.encode_name)
        kind, text = _bare(field.type)
        if isinstance(kind, shape.StructType) and kind.tag is None:
            yield from _leaves(kind, where)
            continue
        default = None if field.default is msgspec.NODEFAULT else field.default
        made = _option(where, kind, default, text, required=field.required)
        if made is not None:
            yield made


def _option(
    path: tuple[str, ...], kind: shape.Type, default: Any, text: str, *, required: bool
) -> Option | None:
    """None for what a command line cannot say (a union of structs, a mapping): use a file."""
    text = "; ".join(part for part in (text, _limits(kind)) if part)
    plain: type
    choices: tuple[str, ...] = ()
    match kind:
        case shape.BoolType():
            plain = bool
        case shape.IntType():
            plain = int
        case shape.FloatType():
            plain = float
        case shape.StrType():
            plain = str
        case shape.EnumType():
            plain, choices = str, tuple(str(member.value) for member in kind.cls)
        case shape.LiteralType():
            plain, choices = str, tuple(str(v) for v in kind.values)
        case shape.VarTupleType() | shape.ListType() | shape.TupleType():
            first = kind.item_types[0] if isinstance(kind, shape.TupleType) else kind.item_type
            inner, _ = _bare(first)
            if isinstance(inner, shape.StructType) and inner.tag is None:
                fields = tuple(f.encode_name for f in inner.fields if f.required)
                return Option(path, list[str], (), None, None, text, required, fields)
            one = _option(path, inner, None, "", required=False)
            if one is None or one.item is not None:
                return None
            shown = None if not default else ",".join(str(v) for v in default)
            return Option(path, str, one.choices, one.kind, shown, text, required)
        case _:
            return None
    return Option(path, plain, choices, None, default, text, required)


def _bare(kind: shape.Type) -> tuple[shape.Type, str]:
    """A field's type without its `| None` and its metadata; and its description."""
    text = ""
    while True:
        if isinstance(kind, shape.Metadata):
            text = text or str((kind.extra_json_schema or {}).get("description", ""))
            kind = kind.type
        elif isinstance(kind, shape.UnionType):
            rest = [t for t in kind.types if not isinstance(t, shape.NoneType)]
            if len(rest) != 1:
                return kind, text
            kind = rest[0]
        else:
            return kind, text


def _limits(kind: shape.Type) -> str:
    if not isinstance(kind, shape.IntType | shape.FloatType):
        return ""
    if kind.ge is not None and kind.le is not None:
        return f"{kind.ge:g} to {kind.le:g}"
    bounds = ((">=", kind.ge), (">", kind.gt), ("<=", kind.le), ("<", kind.lt))
    return " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)


def nested(options: Iterable[Option], given: Mapping[str, Any]) -> dict[str, Any]:
    """What was given (not None), by option name, as the nested mapping that msgspec reads."""
    found: dict[str, Any] = {}
    for option in options:
        if given.get(option.name) is None:
            continue
        level = found
        for step in option.path[:-1]:
            level = level.setdefault(step, {})
        level[option.name] = option.value_of(given[option.name])
    return found


def build(struct: type[T], given: Mapping[str, Any], **fixed: Any) -> T:
    """A struct from the options given and from `fixed` fields.

    Raises UmbraError(bad_request) that names the option at fault.
    """
    options = options_of(struct)
    info = shape.type_info(struct)
    assert isinstance(info, shape.StructType)
    tag = {info.tag_field: info.tag} if info.tag_field else {}
    try:
        return msgspec.convert({**tag, **nested(options, given), **fixed}, type=struct)
    except msgspec.ValidationError as error:
        raise UmbraError(Code.BAD_REQUEST, sentence(str(error), options), "") from None


def sentence(message: str, options: Sequence[Option]) -> str:
    """msgspec's message with the option's name in place of the field's path."""
    what, _, path = message.partition(" - at `$.")
    field = path.rstrip("`").partition("[")[0]
    flag = next((o.flag for o in options if ".".join(o.path) == field), field)
    what = what[:1].lower() + what[1:].replace("`", "")
    if "matching regex" in what:
        text = next((o.help for o in options if o.flag == flag), "")
        what = f"expected {text}" if text else what
    return f"{flag}: {what}" if flag else what


SHARED = {"force", "rig", "keys", "as_json"}
"""Parameters of many commands: they come last in the help."""


def with_options(
    function: Callable[..., Any], parameters: Iterable[inspect.Parameter]
) -> Callable[..., Any]:
    """The function with its `**given` replaced by these parameters, for typer to read."""
    signature = inspect.signature(function, eval_str=True)
    kept = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    own = [p for p in kept if p.name not in SHARED]
    shared = [p for p in kept if p.name in SHARED]

    def command(**values: Any) -> Any:
        return function(**values)

    everything = [p.replace(kind=p.KEYWORD_ONLY) for p in [*own, *parameters, *shared]]
    command.__name__, command.__doc__ = function.__name__, function.__doc__
    command.__annotations__ = {p.name: p.annotation for p in everything}
    command.__dict__["__signature__"] = inspect.Signature(everything)
    return command
