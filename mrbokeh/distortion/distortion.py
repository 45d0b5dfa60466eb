"""LensDistortion: where the pixels of an undistorted pinhole lie in the picture of a real lens, and back."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrbokeh.distortion.models import IN_LENGTHS, PARAMETERS, bent
from mrbokeh.distortion.radial_inverse import fold_radius, unbent
from mrbokeh.distortion.st_map import StMap
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Positions = Float[np.ndarray, "*batch 2"]

HUGIN_UNIT = 1.0 / np.hypot(1.0, 1.5)
"""Half the shorter side of a 3:2 picture, in half diagonals."""


@dataclass(frozen=True)
class LensDistortion:
    """A model of `mrbokeh.distortion.models` with its values, or an ST map, about a camera's principal point.

    model: its name; "none" bends nothing. values: in the order of models.PARAMETERS.
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
        """A model with values by name, 0 where not given: LensDistortion.of("opencv", k1=-0.1, p2=1e-4)."""
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
        """Whether nothing is bent."""
        return self.model == "none" or (self.model not in ("fisheye", "st_map") and not any(self.values))

    def distorted_px(self, xy_px: Positions, camera: Camera) -> Positions:
        """Positions of the undistorted pinhole to positions in the plate; NaN where the lens does not see them."""
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
        """Positions in the plate to positions of the undistorted pinhole: the inverse of `distorted_px`, solved to 1e-10 of the unit.

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
