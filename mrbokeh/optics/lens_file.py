"""The lens file: a Lens as JSON, so that a lens can be kept, named and passed around.

    {"focal_length_mm": 50, "f_number": 1.8, "focus_distance_m": 2.0, "sensor_width_mm": 36,
     "tilt_deg": [0, 0], "petzval_radius_mm": null, "widest_f_number": null,
     "aperture": {"shape": "polygon", "blades": 7, "curvature": 0.3, "rotation_deg": 0, "inner": 0.6, "image": "heart.png",
                  "levels": 1, "points": [[0, 0], [1, 0], [0, 1]], "path": "M0 0 L1 0 L0 1 Z", "squeeze": 1.0, "cat_eye": 0.0,
                  "spherical_aberration": 0.0, "axial_chromatic": [0, 0, 0], "lateral_chromatic": [0, 0, 0],
                  "rims": [[0.4, 1.1]], "iris_blades": 0}}

focus_distance_m null is infinity, petzval_radius_mm null a flat field. sensor_width_mm is that of the camera held level, as data
sheets have it; where EXIF turned a photograph upright, the lens is turned with it (`mrbokeh.stacks.photograph`). "sensor_height_mm" may be
stated too: then the longer side lies along the longer side of any photograph, and 24 by 36 mm is a lens described for upright ones.
The aperture's shape is one of
    disc      round
    polygon   blades, curvature
    ring      inner
    star      blades (its points), inner
    heart
    image     image (a picture beside the lens file, light where open), levels
    outline   points or path (the d of an SVG path)
and what another shape would need is not looked at, so that the shape can be switched by one word. rotation_deg and squeeze
hold for every shape; the last six for every aperture. In place of a shape an aperture may have "outlines" and "weights",
which is what `write_lens` writes. Lenses of the library (`mrbokeh.optics.lens_library`) have a "prescription" too, which only those
who trace it look at. A key that nothing knows is an error.

Values of a JSON object by key, checked one by one; each mistake names the key and what stands there.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_library import shipped
from mrbokeh.optics.psf_bank_file import HEAD
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError, require_file


class _Missing:
    """Marker for "has no default"."""


_MISSING = _Missing()


@dataclass(frozen=True)
class Values:
    """Values of a JSON object, checked one by one; each error names the key and what stands there.

    where: names the object in messages. known, required: the keys it may and must have.
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
            raise InputError(f"{self.where} is incomplete: {', '.join(missing)} missing; compare with a file made by `mrbokeh lens new`")
        if unknown:
            raise InputError(
                f"{self.where}: nothing knows the key {', '.join(map(repr, unknown))}; the keys are {', '.join(sorted(self.known))}"
            )

    def number(self, key: str, default: float | _Missing = _MISSING, null: float | _Missing = _MISSING) -> float:
        """Return a finite number; `null` stands for a JSON null and, if it is infinite, allows the number to be infinite too."""
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
        """Return a list of `count` finite numbers, zeros if absent; of any length if count is None."""
        value = self._value(key, [0.0] * count if count else _MISSING)
        if not isinstance(value, list) or (count and len(value) != count) or not all(_is_number(v) and np.isfinite(v) for v in value):
            raise self._wrong(key, f"a list of {count} numbers" if count else "a list of numbers")
        return tuple(map(float, value))

    def three(self, key: str) -> tuple[float, float, float]:
        first, second, third = self.numbers(key, 3)
        return first, second, third

    def points(self, key: str, value: Any) -> Float64[np.ndarray, "points 2"]:
        """Return a list of [x, y] as an array."""
        if not _are_pairs(value) or len(value) < 3:
            raise InputError(f"{self.where}: expected {key} to be lists of at least 3 points [x, y], got {str(value)[:80]}")
        return np.asarray(value, np.float64)

    def pairs(self, key: str) -> list[list[float]]:
        """Return a list of pairs of numbers; without the key an empty one."""
        value = self._value(key, [])
        if not _are_pairs(value):
            raise self._wrong(key, "a list of pairs of numbers")
        return list(value)

    def _value(self, key: str, default: Any) -> Any:
        if key not in self.document and default is _MISSING:
            raise InputError(f"{self.where} is incomplete: {key} missing")
        return self.document.get(key, default)

    def _wrong(self, key: str, expected: str) -> InputError:
        return InputError(f"{self.where}: expected {key} to be {expected}, got {str(self.document.get(key))[:80]!r}")


def _are_pairs(value: Any) -> bool:
    pairs = value if isinstance(value, list) else [None]
    return all(isinstance(pair, list) and len(pair) == 2 and all(_is_number(v) and np.isfinite(v) for v in pair) for pair in pairs)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def read_transmission(path: Path) -> Float32[np.ndarray, "height width"]:
    """Read how much light every pixel of a drawn opening lets through: the mean of its stored colours times its opacity.

    A drawing of an opening is a matte: its numbers are shares of light, without a display curve.
    """
    require_file(path, "a picture of the opening")
    pixels = stored_pixels(path)
    scaled = pixels.astype(np.float32)
    if pixels.dtype.kind != "f":
        scaled /= np.float32(np.iinfo(pixels.dtype.name).max)
    if scaled.ndim == 2:
        return scaled
    opacity = scaled[..., 3] if scaled.shape[2] == 4 else np.float32(1.0)
    return scaled[..., :3].mean(axis=2) * opacity


FORMAT = "mrbokeh-lens"
VERSION = 1

_OPTIONAL = {"format", "version", "sensor_height_mm", "tilt_deg", "petzval_radius_mm", "widest_f_number", "prescription"}
_REQUIRED = {"focal_length_mm", "f_number", "focus_distance_m", "sensor_width_mm", "aperture"}
_MODIFIERS = {"cat_eye", "spherical_aberration", "axial_chromatic", "lateral_chromatic", "rims", "iris_blades"}
_OF_SHAPES = {"shape", "blades", "curvature", "rotation_deg", "inner", "image", "levels", "points", "path", "squeeze"}


def lens_to_json(lens: Lens) -> dict[str, Any]:
    """Return the document of a lens; a neutral tilt, field curvature or aperture modifier is left out."""
    opening = lens.aperture
    aperture: dict[str, Any] = {
        "outlines": [np.round(outline, 9).tolist() for outline in opening.outlines],
        "weights": list(opening.weights),
    }
    for key in ("cat_eye", "spherical_aberration"):
        if getattr(opening, key):
            aperture[key] = getattr(opening, key)
    for key in ("axial_chromatic", "lateral_chromatic"):
        if any(getattr(opening, key)):
            aperture[key] = list(getattr(opening, key))
    if opening.rims:
        aperture["rims"] = [list(rim) for rim in opening.rims]
    if opening.iris_blades:
        aperture["iris_blades"] = opening.iris_blades
    document = {
        "format": FORMAT,
        "version": VERSION,
        "focal_length_mm": lens.focal_length_mm,
        "f_number": lens.f_number,
        "focus_distance_m": None if np.isinf(lens.focus_distance_m) else lens.focus_distance_m,
        "sensor_width_mm": lens.sensor_width_mm,
    }
    if lens.sensor_height_mm is not None:
        document["sensor_height_mm"] = lens.sensor_height_mm
    if any(lens.tilt_rad):
        document["tilt_deg"] = np.degrees(lens.tilt_rad).tolist()
    if np.isfinite(lens.petzval_radius_mm):
        document["petzval_radius_mm"] = lens.petzval_radius_mm
    if lens.widest_f_number is not None:
        document["widest_f_number"] = lens.widest_f_number
    return document | {"aperture": aperture}


def lens_from_json(document: dict[str, Any], where: str = "lens", folder: Path | str = ".") -> Lens:
    """Return the lens of a document, as in the head of this module; `folder` is where the path of its image starts."""
    if not isinstance(document, dict) or (document.get("format", FORMAT), document.get("version", VERSION)) != (FORMAT, VERSION):
        raise InputError(f"{where}: expected a lens with format {FORMAT!r} and version {VERSION}; write one with `mrbokeh lens new`")
    values = Values(document, where, known=_OPTIONAL | _REQUIRED, required=_REQUIRED)
    tilt_x_deg, tilt_y_deg = values.numbers("tilt_deg", 2)
    try:
        return Lens(
            focal_length_mm=values.number("focal_length_mm"),
            f_number=values.number("f_number"),
            focus_distance_m=values.number("focus_distance_m", null=np.inf),
            sensor_width_mm=values.number("sensor_width_mm"),
            aperture=_aperture_from_json(document["aperture"], where, Path(folder)),
            tilt_rad=(float(np.radians(tilt_x_deg)), float(np.radians(tilt_y_deg))),
            petzval_radius_mm=values.number("petzval_radius_mm", default=np.inf, null=np.inf),
            sensor_height_mm=None if document.get("sensor_height_mm") is None else values.number("sensor_height_mm"),
            widest_f_number=None if document.get("widest_f_number") is None else values.number("widest_f_number"),
        )
    except InputError as error:
        raise error if str(error).startswith(where) else InputError(f"{where}: {error}") from None


def _aperture_from_json(document: Any, where: str, folder: Path) -> Aperture:
    place = f"{where}: its aperture"
    given = {"outlines", "weights"}
    written = isinstance(document, dict) and "outlines" in document
    values = Values(document, place, known=_MODIFIERS | (given if written else _OF_SHAPES), required=given if written else {"shape"})
    if written:
        weights = values.numbers("weights", None)
        plain = Aperture(tuple(values.points("outlines", part) for part in values.sequence("outlines")), weights)
    else:
        plain = _of_shape(values, folder)
    return Aperture(
        outlines=plain.outlines,
        weights=plain.weights,
        cat_eye=values.number("cat_eye", default=0.0),
        spherical_aberration=values.number("spherical_aberration", default=0.0),
        axial_chromatic=values.three("axial_chromatic"),
        lateral_chromatic=values.three("lateral_chromatic"),
        rims=tuple((float(shift), float(radius)) for shift, radius in values.pairs("rims")),
        iris_blades=values.whole("iris_blades", default=0),
    )


def _of_shape(values: Values, folder: Path) -> Aperture:
    shape = values.document["shape"]
    rotation_rad = float(np.radians(values.number("rotation_deg", default=0.0)))
    shapes: dict[str, Callable[[], Aperture]] = {
        "disc": lambda: Aperture.disc().rotated(rotation_rad),
        "polygon": lambda: Aperture.blades(values.whole("blades"), rotation_rad, values.number("curvature", default=0.0)),
        "ring": lambda: Aperture.ring(values.number("inner")).rotated(rotation_rad),
        "star": lambda: Aperture.star(values.whole("blades"), values.number("inner"), rotation_rad),
        "heart": lambda: Aperture.heart().rotated(rotation_rad),
        "image": lambda: Aperture.from_picture(read_transmission(folder / values.text("image")), values.whole("levels", default=1)).rotated(
            rotation_rad
        ),
        "outline": lambda: _from_outline(values).rotated(rotation_rad),
    }
    if not isinstance(shape, str) or shape not in shapes:
        raise InputError(f"{values.where}: expected a shape out of {', '.join(shapes)}, got {shape!r}")
    return shapes[shape]().squeezed(values.number("squeeze", default=1.0))


def _from_outline(values: Values) -> Aperture:
    if ("points" in values.document) == ("path" in values.document):
        raise InputError(f"{values.where}: the shape 'outline' needs either points [[x, y], ...] or the path of an SVG")
    return Aperture.from_outline(values.text("path") if "path" in values.document else values.points("points", values.document["points"]))


def stated_facts(lens: Lens) -> dict[str, Any]:
    """Return the document of a lens without its opening, as a bank of its kernels keeps it."""
    return {name: value for name, value in lens_to_json(lens).items() if name not in ("format", "version", "aperture")}


def read_lens(path: Path | str) -> Lens:
    """Read a lens file (LENS.json), with the opening that it names, or a lens of the library by its name.

    Raises InputError where it does not describe a lens.
    """
    path = shipped(path)
    if (path / HEAD).is_file():
        raise InputError(
            f"expected a lens file (LENS.json) at {path}, but it is a bank of PSFs: give the lens file that it was made of, or write what "
            f"{path / HEAD} states of its lens into one with `mrbokeh lens new`"
        )
    return lens_from_json(read_json(path, "a lens file (LENS.json)"), str(path), Path(path).parent)


def write_lens(path: Path | str, lens: Lens) -> None:
    """Write a lens file that `read_lens` reads."""
    write_json(path, lens_to_json(lens))
