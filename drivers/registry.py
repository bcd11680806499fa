"""Name -> driver, through the entry-point group "umbra.drivers": others can add theirs.

An entry point is named ``kind.name`` (``camera.virtual``) and gives a subclass of that kind. A
package of somebody's own registers drivers in the same group; Umbra finds them once installed.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any

import msgspec

from drivers.base.device import Context, Device

GROUP = "umbra.drivers"


class UnknownDriver(LookupError):
    """No such driver is installed; the message lists those that are."""


def names(kind: str) -> tuple[str, ...]:
    """The installed drivers of a kind, sorted."""
    prefix = f"{kind}."
    found = metadata.entry_points(group=GROUP)
    return tuple(sorted({e.name.removeprefix(prefix) for e in found if e.name.startswith(prefix)}))


def install(extra: str) -> str:
    """How an extra is installed: what works before there is a release on an index, too."""
    return f"in a checkout `pip install '.[{extra}]'`, or `pip install 'umbra-rig[{extra}]'`"


def load(kind: str, driver: str) -> type[Device]:
    """A driver's class. Raises UnknownDriver, also when the package that it needs is missing."""
    for entry in metadata.entry_points(group=GROUP, name=f"{kind}.{driver}"):
        try:
            cls = entry.load()
        except ImportError as error:
            raise UnknownDriver(
                f"{kind} driver {driver!r} needs {error.name}, which is not installed: "
                f"{install(driver)}"
            ) from error
        if not (isinstance(cls, type) and issubclass(cls, Device) and cls.kind == kind):
            raise UnknownDriver(f"{entry.value} is not a {kind} driver")
        return cls
    raise UnknownDriver(
        f"no {kind} driver {driver!r}: there are {', '.join(names(kind)) or 'none'}"
    )


def build(kind: str, driver: str, name: str, options: dict[str, Any], context: Context) -> Device:
    """A device that has touched nothing yet.

    Raises UnknownDriver, or msgspec.ValidationError with the path of the offending key.
    """
    cls = load(kind, driver)
    return cls(name, msgspec.convert(options, cls.options_type), context)
