"""The settings of a camera by libgphoto2's names, which differ from maker to maker: find, read, choose."""

import re
from collections.abc import Callable, Sequence
from typing import Any

from capture.tether.gphoto2_errors import explained
from mrbokeh.system.errors import InputError
from mrbokeh.system.gphoto2_library import library


class CameraConfig:
    """One camera's settings. camera: a gphoto2.Camera, already initialised."""

    def __init__(self, camera: Any) -> None:
        self._camera, self._gp = camera, library()

    def first(self, names: Sequence[str]) -> str | None:
        """The first of several names that this camera knows."""
        return next((name for name in names if self._widget(name) is not None), None)

    def value(self, name: str) -> Any:
        widget = self._widget(name)
        return None if widget is None else widget.get_value()

    def choices(self, name: str) -> list[str]:
        """The words that a setting may have; empty where it is no choice or unknown."""
        widget = self._widget(name)
        if widget is None or widget.get_type() not in (self._gp.GP_WIDGET_RADIO, self._gp.GP_WIDGET_MENU):
            return []
        return [str(widget.get_choice(index)) for index in range(widget.count_choices())]

    def is_readonly(self, name: str) -> bool:
        widget = self._widget(name)
        return widget is None or bool(widget.get_readonly())

    def set(self, name: str, value: Any) -> None:
        with explained(f"setting {name} to {value}"):
            self.set_raw(name, value)

    def set_raw(self, name: str, value: Any) -> None:
        """The same, with libgphoto2's own errors."""
        widget = self._camera.get_single_config(name)
        widget.set_value(value)
        self._camera.set_single_config(name, widget)

    def choose(self, names: Sequence[str], fits: Callable[[str], bool], what: str) -> str | None:
        """Set the first choice that fits, unless the one that is set does; the word, None where the camera has no such setting.

        Raises InputError where it has the setting, but none of its choices fits or it can only be set on the camera.
        """
        name = self.first(names)
        if name is None:
            return None
        now = str(self.value(name))
        if fits(now):
            return now
        found = next((each for each in self.choices(name) if fits(each)), None)
        if found is None or self.is_readonly(name):
            raise InputError(
                f"{what} must be set on the camera itself: its {name!r} is {now!r} (it offers {self.choices(name) or 'nothing'})"
            )
        self.set(name, found)
        return found

    def choose_nearest(self, names: Sequence[str], wanted: float, what: str, within: float = 0.05) -> str | None:
        """Set the choice whose number is nearest to `wanted`, at most a share `within` away; None where there is no such setting."""
        name = self.first(names)
        if name is None:
            return None
        numbers = {each: value for each in self.choices(name) if (value := number_in(each)) is not None}
        nearest = min(numbers, key=lambda each: abs(numbers[each] - wanted), default=None)
        if nearest is None or abs(numbers[nearest] / wanted - 1.0) > within:
            raise InputError(f"the camera has no {what} of {wanted:g}: it offers {', '.join(numbers) or 'no choice'}")
        if str(self.value(name)) != nearest:
            self.set(name, nearest)
        return nearest

    def _widget(self, name: str) -> Any:
        try:
            return self._camera.get_single_config(name)
        except self._gp.GPhoto2Error as error:
            if error.code in (self._gp.GP_ERROR_BAD_PARAMETERS, self._gp.GP_ERROR_NOT_SUPPORTED):
                return None
            with explained(f"reading the setting {name}"):
                raise


def number_in(text: str) -> float | None:
    """The number of "f/4", "0.0100s", "1/125", "ISO 200" or "30"; None for words such as Auto and Bulb."""
    found = re.search(r"(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?", text)
    if found is None:
        return None
    return float(found[1]) / float(found[2] or 1.0) if float(found[2] or 1.0) else None
