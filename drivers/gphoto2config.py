"""A camera's settings as libgphoto2 tells them: text, from lists, by names that makers choose."""

from __future__ import annotations

import re
from typing import Any

import gphoto2 as gp


class Config:
    """The settings of one open camera. Raises GPhoto2Error."""

    def __init__(self, camera: Any) -> None:
        self._camera = camera

    def has(self, name: str) -> bool:
        """Whether it has this setting."""
        try:
            self._camera.get_single_config(name)
        except gp.GPhoto2Error as error:
            if error.code == gp.GP_ERROR_BAD_PARAMETERS:
                return False
            raise
        return True

    def first(self, names: tuple[str, ...]) -> str:
        """The first of these settings that it has; "" if none."""
        return next((name for name in names if self.has(name)), "")

    def text(self, name: str) -> str:
        """A setting's value; "" if it has no such setting."""
        return str(self._camera.get_single_config(name).get_value()) if self.has(name) else ""

    def number(self, names: tuple[str, ...]) -> float | None:
        """The value of the first of these settings that it has, as a number."""
        name = self.first(names)
        return number(self.text(name)) if name else None

    def choices(self, name: str) -> list[str]:
        """What a setting can be; [] if it has no list."""
        widget = self._camera.get_single_config(name)
        if widget.get_type() not in {gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU}:
            return []
        return [str(widget.get_choice(i)) for i in range(widget.count_choices())]

    def numbers(self, name: str) -> dict[str, float]:
        """The choices of a setting that are numbers."""
        return {c: n for c in self.choices(name) if (n := number(c)) is not None}

    def set(self, name: str, value: str) -> None:
        """Give a setting a value, unless it has it."""
        widget = self._camera.get_single_config(name)
        if widget.get_value() != value:
            widget.set_value(value)
            self._camera.set_single_config(name, widget)


def number(text: str) -> float | None:
    """A shutter time in seconds or an ISO speed, as cameras write them: 1/125, 0.0100s, 2", 400;
    None for Bulb, Auto and the like."""
    found = re.fullmatch(r"\s*([0-9.]+)(?:/([0-9.]+))?\s*(?:s|sec|\")?\s*", text)
    if found is None:
        return None
    try:
        value = float(found[1]) / float(found[2] or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return value if value > 0 else None
