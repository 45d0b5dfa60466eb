"""Values of a JSON object by key, checked one by one; each mistake names the key and what stands there."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.system.errors import InputError


class _Missing:
    """Stands for "has no default"."""


_MISSING = _Missing()


@dataclass(frozen=True)
class Values:
    """A JSON object with the keys it may and must have.

    where: names the object in messages.
    """

    document: Any
    where: str
    known: Collection[str]
    required: Collection[str]

    def __post_init__(self) -> None:
        if not isinstance(self.document, dict):
            raise InputError(f"{self.where}: expected an object {{...}}, got {self.document!r}")
        missing, unknown = sorted(set(self.required) - set(self.document)), sorted(set(self.document) - set(self.known))
        if missing:
            raise InputError(f"{self.where} is incomplete: {', '.join(missing)} missing; compare with one of `mrbokeh lens new`")
        if unknown:
            raise InputError(
                f"{self.where}: nothing knows the key {', '.join(map(repr, unknown))}; the keys are {', '.join(sorted(self.known))}"
            )

    def number(self, key: str, default: float | _Missing = _MISSING, null: float | _Missing = _MISSING) -> float:
        """A finite number; `null` stands for a JSON null and, being infinite, lets the number be infinite too."""
        value = self._value(key, default)
        if value is None and not isinstance(null, _Missing):
            return float(null)
        if not _is_number(value) or not (np.isfinite(value) or value in (null, default)):
            raise self._wrong(key, "a number")
        return float(value)

    def whole(self, key: str, default: int | _Missing = _MISSING) -> int:
        value = self._value(key, default)
        if not _is_number(value) or not np.isfinite(value) or value != int(value):
            raise self._wrong(key, "a whole number")
        return int(value)

    def text(self, key: str) -> str:
        value = self._value(key, _MISSING)
        if not isinstance(value, str) or not value:
            raise self._wrong(key, "a text")
        return value

    def sequence(self, key: str) -> list[Any]:
        value = self._value(key, _MISSING)
        if not isinstance(value, list) or not value:
            raise self._wrong(key, "a list")
        return value

    def numbers(self, key: str, count: int | None) -> tuple[float, ...]:
        """A list of `count` finite numbers, zeros where it is absent; of any length where count is None."""
        value = self._value(key, [0.0] * count if count else _MISSING)
        if not isinstance(value, list) or (count and len(value) != count) or not all(_is_number(v) and np.isfinite(v) for v in value):
            raise self._wrong(key, f"a list of {count} numbers" if count else "a list of numbers")
        return tuple(map(float, value))

    def three(self, key: str) -> tuple[float, float, float]:
        first, second, third = self.numbers(key, 3)
        return first, second, third

    def points(self, key: str, value: Any) -> Float64[np.ndarray, "points 2"]:
        """A list of [x, y]."""
        pairs = value if isinstance(value, list) else []
        fine = all(isinstance(pair, list) and len(pair) == 2 and all(_is_number(v) and np.isfinite(v) for v in pair) for pair in pairs)
        if len(pairs) < 3 or not fine:
            raise InputError(f"{self.where}: expected {key} to be lists of at least 3 points [x, y], got {str(value)[:80]}")
        return np.asarray(pairs, np.float64)

    def _value(self, key: str, default: Any) -> Any:
        if key not in self.document and default is _MISSING:
            raise InputError(f"{self.where} is incomplete: {key} missing")
        return self.document.get(key, default)

    def _wrong(self, key: str, expected: str) -> InputError:
        return InputError(f"{self.where}: expected {key} to be {expected}, got {str(self.document.get(key))[:80]!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def read_transmission(path: Path) -> Float32[np.ndarray, "height width"]:
    """How much light every pixel of a drawn opening lets through: the mean of its colours as stored, times its opacity.

    A drawing of an opening is a matte: its numbers mean shares of light, without a display curve.
    """
    if not path.is_file():
        raise InputError(f"expected a picture of the opening at {path}, but there is no such file")
    pixels = stored_pixels(path)
    scaled = pixels.astype(np.float32)
    if pixels.dtype.kind != "f":
        scaled /= np.float32(np.iinfo(pixels.dtype.name).max)
    if scaled.ndim == 2:
        return scaled
    opacity = scaled[..., 3] if scaled.shape[2] == 4 else np.float32(1.0)
    return scaled[..., :3].mean(axis=2) * opacity
