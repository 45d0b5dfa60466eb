"""Values of a table of the scene file, checked one by one: texts, switches and files beside what mrbokeh's Values knows."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from mrbokeh.optics.lens_file_values import Values
from mrbokeh.scene.staging.scene_description import Triple
from mrbokeh.system.errors import InputError


class SceneValues(Values):
    """A TOML table; messages name the file, the table and the key."""

    @classmethod
    def of(cls, document: Any, where: str, known: Collection[str]) -> "SceneValues":
        return cls(document, where, known, ())

    def above_zero(self, key: str, default: float) -> float:
        value = self.number(key, default)
        if not value > 0:
            raise self._wrong(key, "a number above 0")
        return value

    def share(self, key: str, default: float) -> float:
        value = self.number(key, default)
        if not 0.0 <= value <= 1.0:
            raise self._wrong(key, "a number from 0 to 1")
        return value

    def switch(self, key: str, default: bool) -> bool:
        value = self.document.get(key, default)
        if not isinstance(value, bool):
            raise self._wrong(key, "true or false")
        return value

    def chosen(self, key: str, choices: Collection[str], default: str) -> str:
        value = self.document.get(key, default)
        if value not in choices:
            raise self._wrong(key, "one of " + ", ".join(sorted(choices)))
        return str(value)

    def optional_text(self, key: str) -> str | None:
        return self.text(key) if key in self.document else None

    def per_colour(self, key: str, default: float) -> Triple:
        """One number of 0 or more for all colours, or [r, g, b]."""
        value = self.document.get(key, default)
        rgb = self.three(key) if isinstance(value, list) else (self.number(key, default),) * 3
        if min(rgb) < 0:
            raise self._wrong(key, "a number of 0 or more, or three of them")
        return rgb

    def file(self, key: str, folder: Path) -> Path:
        """A file that exists, beside the scene file where its path is relative."""
        path = folder / self.text(key)
        if not path.is_file():
            raise InputError(f"{self.where}: expected {key} to be a file, but there is none at {path}")
        return path

    def optional_file(self, key: str, folder: Path) -> Path | None:
        return self.file(key, folder) if key in self.document else None
