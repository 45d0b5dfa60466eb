"""Lens: the thin lens that tells how large a point's blur is; the only place where millimetres meet metres."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

MM_PER_M = 1000.0
_STEEPEST_TILT_RAD = np.pi / 4
_MARKED_WITHIN = 0.05
_NEAR_IMAGE_DISTANCES = 20.0
"""Nearer than so many times the distance from lens to sensor, it shows whether a focus distance counts from the one or the other."""


@dataclass(frozen=True)
class Lens:
    """Thin lens focused at a distance, in front of a sensor; by default focused at infinity, on a sensor 36 mm wide.

    focus_distance_m: from the lens (front principal plane) to the plane in focus, along the axis of the camera (the
      normal of the sensor through the lens); inf is allowed.
    tilt_rad: (x, y), how far the lens's axis leans from the camera's to the right and downwards, as on a tilt lens or a
      view camera; the sensor stays. With (0, y > 0) what is lower in the picture is in focus nearer to the camera.
    sensor_width_mm: along the rows of the picture; sensor_height_mm: the other side, which nothing is computed from: it says which
      way up the sensor is meant, for photographs taken the other way up (`mrbokeh.stacks.photograph`), or None.
    petzval_radius_mm: radius of curvature of the surface in focus; positive bends it towards the camera away from the axis
      (as an uncorrected lens does, about 1.5 focal lengths), negative away from it, inf is flat.
    widest_f_number: the smallest f-number to which it opens, with which `stating` another one closes the opening; None: it has any
      f-number, and the opening is in proportion.
    spread_by: the bank of kernels or the network that it was read from, which spreads its light; None: any renderer, by the opening.
    """

    focal_length_mm: float
    f_number: float
    focus_distance_m: float = math.inf
    sensor_width_mm: float = 36.0
    aperture: Aperture = field(default_factory=Aperture.disc)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    petzval_radius_mm: float = float("inf")
    sensor_height_mm: float | None = None
    widest_f_number: float | None = None
    spread_by: Path | None = None

    def __post_init__(self) -> None:
        for name in ("focal_length_mm", "f_number", "sensor_width_mm"):
            if not 0.0 < (size := getattr(self, name)) < math.inf:
                raise InputError(f"{name} of a lens must be above 0 and finite, got {size:g}")
        if self.sensor_height_mm is not None and not 0.0 < self.sensor_height_mm < np.inf:
            raise InputError(f"sensor_height_mm must be a positive length or left out, got {self.sensor_height_mm}")
        if not self.focus_distance_m * MM_PER_M > self.focal_length_mm:
            raise InputError(
                f"a lens of {self.focal_length_mm} mm cannot focus at {self.focus_distance_m} m: "
                f"expected more than {self.focal_length_mm / MM_PER_M} m (is the distance in metres?)"
            )
        if self.widest_f_number is not None and not 0.0 < self.widest_f_number <= self.f_number * (1.0 + _MARKED_WITHIN):
            raise InputError(
                f"widest_f_number must be above 0 and no more than the f_number of {self.f_number:g}, got {self.widest_f_number:g}"
            )
        if len(self.tilt_rad) != 2 or not all(abs(angle) < _STEEPEST_TILT_RAD for angle in self.tilt_rad):
            raise InputError(f"a lens can be tilted by two angles of less than 45 degrees, got {self.tilt_rad} rad (are these degrees?)")
        if not self.focus_distance_m * MM_PER_M * self._lens_axis[2] > self.focal_length_mm:
            raise InputError(
                f"a lens of {self.focal_length_mm} mm tilted so far cannot focus at {self.focus_distance_m} m: focus farther off"
            )
        if not abs(self.petzval_radius_mm) > 0:
            raise InputError(f"petzval_radius_mm must be a length other than 0 (inf: a flat field), got {self.petzval_radius_mm}")

    @classmethod
    def default(cls) -> "Lens":
        """Return the lens of commands that are told nothing else: 50 mm f/1.8 with a round opening, focused at infinity."""
        return cls(50.0, 1.8)

    @property
    def has_flat_focus(self) -> bool:
        """Return whether one depth is in focus over the whole picture."""
        return not any(self.tilt_rad) and bool(np.isinf(self.petzval_radius_mm))

    @property
    def described(self) -> str:
        """Describe the lens in a few words, such as "50 mm f/1.8 focused at 1.5 m, sensor 36 mm wide"."""
        blur = f"{self.focal_length_mm:.4g} mm f/{self.f_number:.3g}"
        return f"{blur} focused at {self.focus_described}, sensor {self.sensor_width_mm:.4g} mm wide"

    @property
    def focus_described(self) -> str:
        """Say where it is focused, and from where that counts if it makes a difference: "0.36 m from the lens (0.45 m from the sensor)"."""
        if math.isinf(self.focus_distance_m):
            return "infinity"
        near = self.focus_distance_m < _NEAR_IMAGE_DISTANCES * self.image_distance_mm / MM_PER_M
        told = f" from the lens ({film_plane_m(self):.3g} m from the sensor)" if near else ""
        return f"{self.focus_distance_m:.3g} m{told}"

    @property
    def facts(self) -> dict[str, float]:
        """Return focal length, f-number, focus distance and width of the sensor by their names."""
        return {name: getattr(self, name) for name in ("focal_length_mm", "f_number", "focus_distance_m", "sensor_width_mm")}

    @property
    def aperture_diameter_mm(self) -> float:
        """Return the diameter of the entrance pupil, focal length over f-number."""
        return self.focal_length_mm / self.f_number

    @property
    def image_distance_mm(self) -> float:
        """Return the distance from lens to sensor along the camera's axis, f d_f / (d_f - f); see `focus_dioptres` for a tilt."""
        return self.focal_length_mm / (self._lens_axis[2] - self.focal_length_mm / (self.focus_distance_m * MM_PER_M))

    @property
    def _lens_axis(self) -> tuple[float, float, float]:
        """Return the unit vector along the axis of the lens in camera axes (x right, y down, z forward)."""
        if not any(self.tilt_rad):
            return 0.0, 0.0, 1.0
        x, y = np.tan(self.tilt_rad)
        length = float(np.sqrt(1.0 + x * x + y * y))
        return float(x) / length, float(y) / length, 1.0 / length

    def stating(self, facts: Mapping[str, float]) -> "Lens":
        """Return the lens with other facts, by their names; the height of its sensor keeps its proportion to the width.

        Of a lens with a widest f-number the rims stay where they are: cat-eyes shrink on a smaller sensor and behind a closed iris. Makers
        round f-numbers: a little below the widest one is fully open.
        """
        width_mm = facts.get("sensor_width_mm", self.sensor_width_mm)
        height_mm = self.sensor_height_mm and self.sensor_height_mm * width_mm / self.sensor_width_mm
        if self.widest_f_number is None:
            return replace(self, **{"sensor_height_mm": height_mm, **facts})  # type: ignore[arg-type]
        f_number, least = facts.get("f_number", self.f_number), max(self.widest_f_number, self.f_number)
        if f_number < least * (1.0 - _MARKED_WITHIN):
            opens = least == self.widest_f_number
            how = f"opens to f/{least:.3g}" if opens else f"is described as closed to f/{least:.3g}"
            raise InputError(f"the lens {how}: expected an f-number of at least that, got {f_number:g}")
        told_facts = {"sensor_height_mm": height_mm, **facts, "f_number": max(f_number, least)}
        stated = replace(self, **told_facts)  # type: ignore[arg-type]
        wider = width_mm / self.sensor_width_mm * self.focal_length_mm / stated.focal_length_mm
        return replace(stated, aperture=_stopped_down(self.aperture, stated.f_number / self.f_number, wider))

    def focused_at(self, focus_distance_m: float) -> "Lens":
        """Return the same lens focused at a distance in metres; inf is allowed."""
        return replace(self, focus_distance_m=float(focus_distance_m))

    def focused_on(self, depth_m: Float[np.ndarray, "height width"], x_px: float, y_px: float, radius_px: float = 0.0) -> "Lens":
        """Autofocus: return the lens focused on what lies at a place of the depth map (metres, of the whole picture).

        x_px, y_px: the place, with the centre of the top left pixel at (0.5, 0.5). radius_px: 0 takes the pixel there, more
        takes all pixels whose centres lie within that radius. Of their finite positive depths the median counts; of an
        even number the nearer of the two in the middle, so that the focus never lies in the air between two objects.
        """
        height_px, width_px = depth_m.shape
        if not (0.0 <= x_px < width_px and 0.0 <= y_px < height_px):
            raise InputError(f"cannot focus at pixel ({x_px // 1:g}, {y_px // 1:g}): the depth map has {width_px} x {height_px} pixels")
        rows, columns = np.mgrid[:height_px, :width_px]
        near = np.hypot(columns + 0.5 - x_px, rows + 0.5 - y_px) <= radius_px
        near[int(y_px), int(x_px)] = True
        depths_m = np.sort(depth_m[near & np.isfinite(depth_m) & (depth_m > 0)])
        if depths_m.size == 0:
            raise InputError(
                f"cannot focus at pixel ({x_px // 1:g}, {y_px // 1:g}): no depth is known there (only background); "
                f"choose a place on an object, a larger radius, or a focus distance in metres"
            )
        return self._focused_through(float(depths_m[(depths_m.size - 1) // 2]), *self._place_mm(x_px, y_px, width_px, height_px))

    def _focused_through(self, depth_m: float, x_mm: float, y_mm: float) -> "Lens":
        """Return the lens whose surface in focus passes through a depth at a place on the sensor: `focus_dioptres` solved for the axis."""
        if self.has_flat_focus:
            return self.focused_at(depth_m)
        wanted, axis = 1.0 / depth_m, self._lens_axis
        power = axis[2] * MM_PER_M / self.focal_length_mm
        slope = (axis[0] * x_mm + axis[1] * y_mm) / self.focal_length_mm
        bend = (x_mm**2 + y_mm**2) / (2.0 * MM_PER_M * self.petzval_radius_mm)
        # With D the dioptres on the axis: D + slope (power - D) + bend (power - D)^2 = wanted; the tangent is power - D times mm.
        dioptres = wanted
        for _ in range(50):
            rest = power - dioptres
            dioptres -= (dioptres + slope * rest + bend * rest**2 - wanted) / (1.0 - slope - 2.0 * bend * rest)
        if not (np.isfinite(dioptres) and 0.0 <= dioptres < power):
            raise InputError(
                f"this tilted or curved focus cannot pass through {depth_m:g} m at this place: choose another place or less tilt"
            )
        return self.focused_at(1.0 / dioptres if dioptres > 0.0 else np.inf)

    def _place_mm(self, x_px: float, y_px: float, width_px: int, height_px: int) -> tuple[float, float]:
        """Return the place on the upright sensor picture from its middle, where the camera's axis meets it."""
        mm_per_px = self.sensor_width_mm / width_px
        return (x_px - 0.5 * width_px) * mm_per_px, (y_px - 0.5 * height_px) * mm_per_px

    def focus_dioptres(self, width_px: int, height_px: int) -> Float[np.ndarray, "height width"]:
        """Return 1 / depth (per metre, along the camera's axis) of what is in focus at each pixel; below 0 is beyond infinity.

        The lens has the axis m (a unit vector) and a point P = z (t_x, t_y, 1) forms its image at -P f / (P.m - f), from
        the thin-lens equation along the tilted axis. The image lies on the sensor, d_s behind the lens, where
            1 / z = (t_x m_x + t_y m_y + m_z) / f - 1 / d_s,
        linear in the pixel's position: a plane in space. It meets the plane of the lens where the sensor's plane through
        the lens does, f / sin(tilt) beside it (Scheimpflug's rule and Merklinger's hinge rule, Focusing the View Camera,
        1993). On the axis 1 / z = 1 / focus_distance, which gives d_s. Field curvature (Petzval's third-order surface, whose
        sag in the image is h^2 / 2R, Born and Wolf 5.5) adds h^2 / (2 R d_s^2) = |t|^2 / 2R: an ellipsoid whose radius of
        curvature on the axis is R, and for a focus at 2 R the sphere that passes through the lens.
        """
        distance_mm, axis = self.image_distance_mm, self._lens_axis
        left_mm, top_mm = self._place_mm(0.5, 0.5, width_px, height_px)
        t_x = np.linspace(left_mm, -left_mm, width_px)[None, :] / distance_mm
        t_y = np.linspace(top_mm, -top_mm, height_px)[:, None] / distance_mm
        tilt = (t_x * axis[0] + t_y * axis[1]) * MM_PER_M / self.focal_length_mm
        return 1.0 / self.focus_distance_m + tilt + (t_x**2 + t_y**2) * MM_PER_M / (2.0 * self.petzval_radius_mm)

    def focal_px(self, image_width_px: int) -> float:
        """Return the pinhole focal length in pixels: the image distance, so that it breathes with the focus."""
        return self.image_distance_mm * image_width_px / self.sensor_width_mm

    def coc_px_per_dioptre(self, image_width_px: int) -> float:
        """Return how many pixels the circle of confusion grows per dioptre away from the focus plane."""
        px_per_mm = image_width_px / self.sensor_width_mm
        return px_per_mm * self.aperture_diameter_mm * self.image_distance_mm / MM_PER_M

    def coc_px(self, depth_m: Float[np.ndarray, "*batch"] | float, image_width_px: int) -> Float[np.ndarray, "*batch"]:
        """Return the signed DIAMETER of the circle of confusion: positive behind the focus plane, negative in front.

        Neural Bokeh's Eq. 1 (Mandl et al. 2024) with its sign kept and its units made equal; written in dioptres,
        so that it is linear and finite at infinity. depth_m must be positive.
        Where the lens is tilted or its field curved, what is in focus depends on the place: a depth map (H, W) is then
        taken as the whole picture, image_width_px wide; numbers and arrays of other shapes lie on the axis. (The
        foreshortening of a tilted pupil, 1 % at 8 degrees, is left out.)
        """
        if np.ndim(depth_m) == 0 and depth_m <= 0:
            raise InputError(f"expected a depth above 0 m, got {depth_m:g} m")
        if image_width_px <= 0:
            raise InputError(f"expected a picture at least 1 px wide, got {image_width_px} px")
        dioptres = 1.0 / np.asarray(depth_m)
        in_focus: float | np.ndarray = 1.0 / self.focus_distance_m
        if not self.has_flat_focus and dioptres.ndim == 2:
            height_px, width_px = dioptres.shape
            if width_px != image_width_px:
                raise InputError(
                    f"with a tilted lens or a curved field the depth map must be the whole picture: it is {width_px} px wide, "
                    f"the picture {image_width_px} px (for a part of it, cut `focus_dioptres` or the finished map)"
                )
            in_focus = self.focus_dioptres(width_px, height_px).astype(dioptres.dtype)
        return np.asarray(self.coc_px_per_dioptre(image_width_px) * (in_focus - dioptres))


@lru_cache(maxsize=64)
def _stopped_down(aperture: Aperture, ratio: float, wider: float) -> Aperture:
    """Return an opening closed by a ratio, on a sensor so many times as wide; always the same object, which keeps what was `seen` of it."""
    closed = aperture.stopped_down(ratio)
    return closed if wider == 1.0 else replace(closed, rims=tuple((shift * wider, radius) for shift, radius in closed.rims))


def lens_distance_m(film_plane_m: float, focal_length_mm: float, hiatus_mm: float = 0.0) -> float | None:
    """Return the distance d_f from the front principal plane for a distance D = d_f + h + d_s from the film plane, d_s = f d_f / (d_f - f).

    h is the hiatus, the distance between the principal planes (0 for a thin lens). d_f is the far root of
    d_f^2 - (D - h) d_f + (D - h) f = 0. None below D = 4 f + h, which no lens of that focal length reaches.
    """
    if math.isinf(film_plane_m):
        return film_plane_m
    focal_m, conjugates_m = focal_length_mm / MM_PER_M, film_plane_m - hiatus_mm / MM_PER_M
    discriminant = conjugates_m * (conjugates_m - 4.0 * focal_m)
    return 0.5 * (conjugates_m + math.sqrt(discriminant)) if conjugates_m > 0.0 and discriminant >= 0.0 else None


def film_plane_m(lens: Lens) -> float:
    """Return the focus distance as a camera's scale and metadata count it: d_f + d_s, the principal planes of a thin lens being one."""
    return lens.focus_distance_m + lens.image_distance_mm / MM_PER_M
