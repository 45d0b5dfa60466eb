"""LensDistortion: where the pixels of an undistorted pinhole lie in the picture of a real lens, and back; from JSON, COLMAP or an ST map.

ST maps are pictures that say for every pixel from where it is read, as Nuke's STMap takes them. Red is u, from 0 at the left edge of the
frame to 1 at its right; green is v, from 0 at the *bottom* edge to 1 at the top: the centre of the lower left pixel has (0.5 / width,
0.5 / height). Values below 0 and above 1 address overscan.

COLMAP's camera models (src/colmap/sensor/models.h) are read as focal lengths, principal point and distortion. As JSON a distortion is
{"model": "opencv", "k1": -0.1, ...}, values that are 0 left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrbokeh.distortion.radial import IN_LENGTHS, PARAMETERS, bent, fold_radius, unbent
from mrbokeh.images.exr_io import read_exr
from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

KINDS = ("distort", "undistort")
_NAMES = (("R", "G"), ("u", "v"), ("forward.u", "forward.v"))
_HALF_STEP = 2.0**-11
_COARSEST_PX = 0.25
_BEYOND_CELLS = 1.6
_STEPS = 40
_RESIDUAL_PX = 1e-6

Positions = Float[np.ndarray, "*batch 2"]


@dataclass(frozen=True, eq=False)
class StMap:
    """ST map: (u, v) for every pixel, the place from which it is read.

    uv: (h, w, 2) as in the file, v upwards; of any resolution.
    kind: "distort" (Nuke: redistort) gives for the plate's pixels the place in the undistorted picture: it turns renders into
    plates. "undistort" gives for undistorted pixels the place in the plate. Prefer the first: it knows every pixel of the plate,
    the second only what lies in the frame on both sides.
    """

    uv: Float[np.ndarray, "height width 2"]
    kind: str = "distort"
    path: str | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"an ST map is of the kind {' or '.join(KINDS)}, not {self.kind!r}")
        if min(self.uv.shape[:2]) < 2:
            raise InputError(f"an ST map needs at least 2x2 pixels, got {self.uv.shape[1]}x{self.uv.shape[0]}")

    def distorted_px(self, xy_px: Positions, camera: Camera) -> Positions:
        return self._looked_up(xy_px, camera)[0] if self.kind == "undistort" else self._inverse(xy_px, camera)

    def undistorted_px(self, xy_px: Positions, camera: Camera) -> Positions:
        return self._looked_up(xy_px, camera)[0] if self.kind == "distort" else self._inverse(xy_px, camera)

    def _looked_up(self, xy_px: Positions, camera: Camera) -> tuple[Positions, Float[np.ndarray, "*batch 2 2"]]:
        """Return the map's positions, from the four samples around, and their derivatives; NaN more than a pixel outside the map."""
        rows, columns = self.uv.shape[:2]
        size, cells = np.array([camera.width_px, camera.height_px]), np.array([columns, rows])
        at = xy_px / size * cells - 0.5
        inside = ((at >= -_BEYOND_CELLS) & (at <= cells - 1 + _BEYOND_CELLS)).all(axis=-1)
        at = np.where(inside[..., None], at, 0.0)
        cell = np.clip(np.floor(at), 0, cells - 2).astype(int)
        (fx, fy), (x, y) = np.moveaxis(at - cell, -1, 0)[..., None], np.moveaxis(cell, -1, 0)
        a, b, c, d = (self._position(y + down, x + right, size) for down in (0, 1) for right in (0, 1))
        top, bottom = a + fx * (b - a), c + fx * (d - c)
        per_px = cells / size
        by = np.stack([((1.0 - fy) * (b - a) + fy * (d - c)) * per_px[0], (bottom - top) * per_px[1]], axis=-1)
        return np.where(inside[..., None], top + fy * (bottom - top), np.nan), by

    def _position(self, row: np.ndarray, column: np.ndarray, size: np.ndarray) -> np.ndarray:
        u, v = np.moveaxis(self.uv[row, column].astype(np.float64), -1, 0)
        return np.stack([u, 1.0 - v], axis=-1) * size

    def _inverse(self, xy_px: Positions, camera: Camera) -> Positions:
        """Invert the map's bilinear surface by Newton's method; NaN if the map does not hold the position."""
        edge = np.array([camera.width_px, camera.height_px], np.float64)
        found = np.clip(xy_px, 0.0, edge)
        for _ in range(_STEPS):
            value, derivative = self._looked_up(found, camera)
            error = value - xy_px
            if not (np.abs(error) > _RESIDUAL_PX).any():
                break
            step = np.linalg.solve(np.where(np.isnan(derivative), np.eye(2), derivative), error[..., None])[..., 0]
            found = np.clip(found - step, -1.0, edge + 1.0)
        value, _ = self._looked_up(found, camera)
        return np.where((np.abs(value - xy_px) <= _RESIDUAL_PX).all(axis=-1, keepdims=True), found, np.nan)


def read_st_map(path: Path | str, kind: str = "distort") -> StMap:
    """Read an EXR file with u in red and v in green (or channels u, v). Raises InputError if it is too coarse, as half floats are."""
    for part in read_exr(path):
        for u, v in _NAMES:
            if u in part.channels and v in part.channels:
                right, up = part.channels[u], part.channels[v]
                if right.dtype == np.float16 and right.shape[1] * _HALF_STEP > _COARSEST_PX:
                    raise InputError(
                        f"{path}: expected an ST map in 32-bit float, got half floats, whose steps are "
                        f"{right.shape[1] * _HALF_STEP:.2f} px at this size: export it again in 32 bit"
                    )
                return StMap(np.stack([right, up], axis=-1).astype(np.float32), kind, str(path))
    raise InputError(f"{path}: expected an ST map with u in red and v in green, but it has no such channels: export it as RGB")


HUGIN_UNIT = 1.0 / np.hypot(1.0, 1.5)
"""Half the shorter side of a 3:2 picture, in half diagonals."""


@dataclass(frozen=True)
class LensDistortion:
    """Model of `mrbokeh.distortion.radial` with its values, or an ST map, about a camera's principal point.

    model: its name; "none" bends nothing. values: in the order of radial.PARAMETERS.
    unit_half_diagonals: for ptlens, poly3 and poly5 the radius 1 of the polynomial, in half diagonals of the camera's frame.
    st_map: in place of a model.
    Every method takes the plate's camera, of any resolution; only its frame and intrinsics count. The pinhole has the same
    focal length and principal point. Parameters describe the way from undistorted to distorted.
    """

    model: str = "none"
    values: tuple[float, ...] = ()
    unit_half_diagonals: float = HUGIN_UNIT
    st_map: StMap | None = None

    def __post_init__(self) -> None:
        names = ("none", *PARAMETERS, "st_map")
        if self.model not in names or (self.model == "st_map") != (self.st_map is not None):
            raise InputError(f"expected a distortion model out of {', '.join(names)} (the last with its map), got {self.model!r}")
        expected = PARAMETERS.get(self.model, ())
        if len(self.values) != len(expected) or not np.isfinite(self.values).all() or not self.unit_half_diagonals > 0.0:
            raise InputError(
                f"the distortion model {self.model!r} needs {len(expected)} finite values ({', '.join(expected) or 'none'}) "
                f"and a unit above 0, got {self.values} and {self.unit_half_diagonals}"
            )

    @classmethod
    def of(cls, model: str, unit_half_diagonals: float = HUGIN_UNIT, **values: float) -> "LensDistortion":
        """Return a model with values by name, 0 if not given: LensDistortion.of("opencv", k1=-0.1, p2=1e-4)."""
        names = PARAMETERS.get(model, ())
        unknown = sorted(values.keys() - set(names))
        if unknown:
            raise InputError(f"the distortion model {model!r} has the values {', '.join(names) or 'none'}, not {', '.join(unknown)}")
        return cls(model, tuple(float(values.get(name, 0.0)) for name in names), unit_half_diagonals)

    @classmethod
    def from_st_map(cls, st_map: StMap) -> "LensDistortion":
        return cls("st_map", st_map=st_map)

    @property
    def is_none(self) -> bool:
        """Return whether nothing is bent."""
        return self.model == "none" or (self.model not in ("fisheye", "st_map") and not any(self.values))

    def distorted_px(self, xy_px: Positions, camera: Camera) -> Positions:
        """Convert positions of the undistorted pinhole to positions in the plate; NaN if the lens does not see them."""
        xy_px = np.asarray(xy_px, np.float64)
        if self.is_none:
            return xy_px.copy()
        if self.st_map is not None:
            return self.st_map.distorted_px(xy_px, camera)
        points = self._in_model(xy_px, camera)
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        seen = radius <= fold_radius(self.model, self.values)
        return self._in_picture(np.where(seen, bent(self.model, self.values, points)[0], np.nan), camera)

    def undistorted_px(self, xy_px: Positions, camera: Camera) -> Positions:
        """Convert positions in the plate to positions of the undistorted pinhole: the inverse of `distorted_px`, to 1e-10 of the unit.

        NaN beyond the radius at which the model folds the picture back, for no point is seen there.
        """
        xy_px = np.asarray(xy_px, np.float64)
        if self.is_none:
            return xy_px.copy()
        if self.st_map is not None:
            return self.st_map.undistorted_px(xy_px, camera)
        return self._in_picture(unbent(self.model, self.values, self._in_model(xy_px, camera)), camera)

    def _in_model(self, xy_px: Positions, camera: Camera) -> Positions:
        return (xy_px - np.asarray(camera.principal_px)) / self._unit_px(camera)

    def _in_picture(self, points: Positions, camera: Camera) -> Positions:
        return points * self._unit_px(camera) + np.asarray(camera.principal_px)

    def _unit_px(self, camera: Camera) -> Float[np.ndarray, "2"]:
        if self.model in IN_LENGTHS:
            return np.full(2, 0.5 * np.hypot(camera.width_px, camera.height_px) * self.unit_half_diagonals)
        return np.asarray(camera.focal_px, np.float64)


_MODELS: dict[str, tuple[int, str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, "none", ()),
    "PINHOLE": (2, "none", ()),
    "SIMPLE_RADIAL": (1, "opencv", ("k1",)),
    "RADIAL": (1, "opencv", ("k1", "k2")),
    "OPENCV": (2, "opencv", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, "opencv", PARAMETERS["opencv"]),
    "OPENCV_FISHEYE": (2, "fisheye", PARAMETERS["fisheye"]),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", ("k1",)),
    "RADIAL_FISHEYE": (1, "fisheye", ("k1", "k2")),
}
"""Number of focal lengths of a COLMAP model, our model, and the names of its values."""

Pair = tuple[float, float]


def colmap_distortion(model: str, parameters: Sequence[float]) -> tuple[Pair, Pair, LensDistortion]:
    """Return (focal_px, principal_px, distortion) of a model by COLMAP's name with all its parameters, in COLMAP's order.

    Pixel centres lie at halves in COLMAP as here, so nothing is shifted.
    """
    if model not in _MODELS:
        raise InputError(
            f"expected one of COLMAP's camera models {', '.join(_MODELS)}, got {model!r}: fit the camera again with one of them"
        )
    focals, ours, names = _MODELS[model]
    if len(parameters) != focals + 2 + len(names):
        raise InputError(f"COLMAP's model {model} has {focals + 2 + len(names)} parameters, got {len(parameters)}")
    focal, (cx, cy), rest = parameters[:focals], parameters[focals : focals + 2], parameters[focals + 2 :]
    distortion = LensDistortion.of(ours, **dict(zip(names, map(float, rest), strict=True)))
    return (float(focal[0]), float(focal[-1])), (float(cx), float(cy)), distortion


def distortion_from_json(document: dict[str, Any], where: str = "distortion", folder: Path | str = ".") -> LensDistortion:
    """Read {"model": "opencv", "k1": -0.1, ...}; an ST map's path is relative to `folder`.

    Values without a model are OpenCV's, as camera tracks have them: {"k1": -0.1}.
    COLMAP's names are understood too: {"model": "RADIAL", "values": [k1, k2]}, without focal length and principal point.
    """
    try:
        values = dict(document)
        model = values.pop("model", "opencv") if values else values.pop("model")
        if model == "st_map":
            return LensDistortion.from_st_map(read_st_map(Path(folder) / values["path"], values.get("kind", "distort")))
        if model.isupper():
            return _of_colmap(model, values["values"])
        unit = float(values.pop("unit_half_diagonals", HUGIN_UNIT))
        return LensDistortion.of(model, unit, **{name: float(value) for name, value in values.items()})
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{where}: expected the name of a model and its values as numbers ({error!r})") from None


def read_distortion(path: Path | None) -> LensDistortion:
    """Read a distortion from a JSON file; None bends nothing."""
    if path is None:
        return LensDistortion()
    return distortion_from_json(read_json(path, "a lens distortion (JSON)"), str(path), path.parent)


def _of_colmap(model: str, values: list[float]) -> LensDistortion:
    focals = [1.0] if model.startswith(("SIMPLE", "RADIAL")) else [1.0, 1.0]
    return colmap_distortion(model, [*focals, 0.0, 0.0, *map(float, values)])[2]
