"""Describe a lens by its prescription: the opening, as a lens file holds it, that is most like the light traced through its surfaces.

A description is looked up where kernels would have to be traced: it works at once, at any focus and f-number, in every renderer. What it
keeps: the rims that cut the opening to cat-eyes, the bright or soft rim of the blur on each side of the focus and its size there
(spherical aberration), the sizes of red and blue (axial colour), and the curvature of the surface in focus. What it leaves out: coma,
astigmatism, lateral colour, and that aberrations matter less the larger the blur is; kernels of the same prescription have them
(`PhysicalLens`). How much light is misplaced for that: docs/lens_library.md.

The fit. On a surface of 48 x 48 cells over the unit pupil, light is gathered at some places of the field, from a point at infinity and
from one nearer than the focus, each scaled by its thin-lens circle of confusion. Rims, weight and sizes are those for which the least
light is misplaced (half the sum of absolute differences), found by the simplex method of Nelder and Mead (1965). The sensor stands where
a point at the focus distance is smallest on the axis (mean radius of its light), as a photographer focuses.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.psf_models._lens_beam import GREEN_UM, LensBeam
from mrbokeh.psf_models.base import sobol_blocks
from mrbokeh.psf_models.lens_prescription import LensPrescription

FOCUS_IN_FOCAL_LENGTHS, NEAR = 40.0, 0.6
"""The focus for which a lens is described, 2 m for 50 mm, and how far off the nearer point lies for that."""
FIELDS = (0.0, 0.35, 0.7, 1.0)
_CELLS, _FINER, _SPAN = 48, 3, 1.5
_RAYS, _STEPS, _EVALUATIONS = 1 << 13, 109, 1500
_FOCUS_SEARCH = 0.405
"""How far from the paraxial image the sharpest place is looked for, in mm and f-numbers."""
_NEVER_CUTS = 0.01
_START = np.array([0.4, 1.05, 0.4, 1.05, 0.0, 0.0, 0.0])
_FIRST_STEPS = np.array([0.2, 0.15, 0.2, 0.15, 0.4, 0.1, 0.1])
_ALONG = (np.arange(_CELLS * _FINER) + 0.5) / (_CELLS * _FINER) * 2.0 * _SPAN - _SPAN
_X, _Y = np.meshgrid(_ALONG, _ALONG, indexing="ij")

Cells = Float64[np.ndarray, "cells cells"]
Kernel = Float64[np.ndarray, "size size"]


@dataclass(frozen=True)
class TracedLight:
    """Light of one point in units of its pupil, x away from the middle of the frame: u (rays, colours, 2) and weights (rays, colours)."""

    eccentricity: float
    coc_mm: float
    u: Float64[np.ndarray, "rays colours 2"]
    weights: Float64[np.ndarray, "rays colours"]

    @cached_property
    def cells(self) -> Cells:
        """Return the share of green light in each cell."""
        x, y, weights = self.u[:, 1, 0], self.u[:, 1, 1], self.weights[:, 1]
        both = (np.concatenate([x, x]), np.concatenate([y, -y]))
        counted, _, _ = np.histogram2d(*both, bins=_CELLS, range=[[-_SPAN, _SPAN]] * 2, weights=np.concatenate([weights, weights]))
        return np.asarray(counted / (2.0 * weights.sum()))

    @property
    def radii(self) -> Float64[np.ndarray, " colours"]:
        """Return the root mean square of the distances from the middle of the light, by colour."""
        lit = self.weights.sum(axis=0)
        middle = (self.u[..., 0] * self.weights).sum(axis=0) / lit
        squares = (self.u[..., 0] - middle) ** 2 + self.u[..., 1] ** 2
        return np.sqrt((squares * self.weights).sum(axis=0) / lit)


class Bench:
    """A lens before a sensor, focused as a photographer does: a point on the axis is as small as it gets."""

    def __init__(self, prescription: LensPrescription, focus_distance_m: float, half_diagonal_mm: float) -> None:
        self.prescription, self.half_diagonal_mm = prescription, half_diagonal_mm
        self.thin = Lens(prescription.focal_length_mm, prescription.f_number, focus_distance_m)
        paraxial_mm = prescription.paraxial_at(GREEN_UM).sensor_mm(focus_distance_m)
        shifts_mm = np.linspace(-_FOCUS_SEARCH, _FOCUS_SEARCH, _STEPS) * prescription.f_number
        ends = self._landed(LensBeam(prescription, paraxial_mm, half_diagonal_mm), focus_distance_m, 0.0)
        moved = self._landed(LensBeam(prescription, paraxial_mm + 1.0, half_diagonal_mm), focus_distance_m, 0.0)
        reach = ends[0][:, 1, :] + shifts_mm[:, None, None] * (moved[0] - ends[0])[:, 1, :]
        spots_mm = (np.hypot(reach[..., 0], reach[..., 1]) * ends[1][:, 1]).sum(axis=1) / ends[1][:, 1].sum()
        self.focus_shift_mm = float(shifts_mm[np.argmin(spots_mm)])
        self.beam = LensBeam(prescription, paraxial_mm + self.focus_shift_mm, half_diagonal_mm)

    def light(self, depth_m: float, eccentricity: float) -> TracedLight:
        """Trace the light of a point at a depth (inf is allowed) at a place of the field."""
        landings_mm, weights = self._landed(self.beam, depth_m, eccentricity)
        coc_mm = float(self.thin.coc_px(depth_m, 1)) * self.thin.sensor_width_mm
        return TracedLight(eccentricity, coc_mm, -landings_mm / (0.5 * coc_mm) if coc_mm else -landings_mm, weights)

    def _landed(self, beam: LensBeam, depth_m: float, eccentricity: float) -> tuple[np.ndarray, np.ndarray]:
        per_mm = 0.0 if np.isinf(depth_m) else 1.0 / (MM_PER_M * depth_m)
        window = beam.window(np.array([per_mm]), np.array([eccentricity]))
        (shares,) = sobol_blocks(3, _RAYS, 0)
        return beam.trace(beam.chief_rays(eccentricity, eccentricity), window, shares, np.full(_RAYS, per_mm), np.zeros(_RAYS))


@dataclass(frozen=True)
class Opening:
    """Opening that is fitted: two rims as (shift, radius), the weight over the pupil, the size of the blur of each side, the bent field.

    smaller_behind: the circle of confusion is so much smaller behind the focus and larger in front. bend_mm: added to it in a corner.
    """

    rims: tuple[tuple[float, float], tuple[float, float]]
    spherical_aberration: float = 0.0
    smaller_behind: float = 0.0
    bend_mm: float = 0.0

    @classmethod
    def of(cls, values: Float64[np.ndarray, "7"]) -> "Opening":
        front, front_radius, back, back_radius, weight, smaller, bend_mm = values.tolist()
        return cls(((front, front_radius), (-back, back_radius)), weight, smaller, bend_mm)

    def cells(self, eccentricity: float, coc_mm: float) -> Cells:
        """Return the share of light in each cell from a point of this (signed) circle of confusion."""
        side = 1.0 if coc_mm > 0 else -1.0
        size = 1.0 - side * self.smaller_behind + self.bend_mm * eccentricity**2 / coc_mm
        x, y = _X / size, _Y / size
        light = np.clip(1.0 + side * self.spherical_aberration * (2.0 * (x * x + y * y) - 1.0), 0.0, None) * _within(x, y, 1.0)
        for shift, radius in self.rims:
            light = light * _within(x + shift * eccentricity, y, radius)
        coarse = light.reshape(_CELLS, _FINER, _CELLS, _FINER).sum(axis=(1, 3))
        return np.asarray(coarse / max(float(coarse.sum()), 1e-9))

    def misplaced(self, lights: list[TracedLight]) -> float:
        """Return the share of light that lies elsewhere than the traced light does, the mean over the points."""
        return float(np.mean([0.5 * np.abs(self.cells(each.eccentricity, each.coc_mm) - each.cells).sum() for each in lights]))


DISC = Opening(((0.0, 9.0), (0.0, 9.0)))


def _within(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    return np.clip((radius - np.hypot(x, y)) / (2.0 * _SPAN / (_CELLS * _FINER)) + 0.5, 0.0, 1.0)


def fitted(lights: list[TracedLight]) -> Opening:
    """Return the opening that misplaces the least light of these points."""
    from scipy.optimize import minimize

    def misplaced(values: Float64[np.ndarray, "7"]) -> float:
        inside = np.clip(values, [0.0, 0.3, 0.0, 0.3, -1.0, -0.4, -10.0], [4.0, 4.0, 4.0, 4.0, 1.0, 0.4, 10.0])
        return Opening.of(inside).misplaced(lights) + float(np.abs(values - inside).sum())

    simplex = np.vstack([_START, _START + np.diag(_FIRST_STEPS)])
    found = minimize(
        misplaced, _START, method="Nelder-Mead", options={"maxfev": _EVALUATIONS, "xatol": 2e-3, "fatol": 1e-4, "initial_simplex": simplex}
    )
    return Opening.of(found.x)


def describe(prescription: LensPrescription, sensor_mm: tuple[float, float] = (36.0, 24.0), iris_blades: int = 0) -> Lens:
    """Return the description of a lens at its widest f-number, focused at 40 focal lengths."""
    focus_m = FOCUS_IN_FOCAL_LENGTHS * prescription.focal_length_mm / MM_PER_M
    bench = Bench(prescription, focus_m, 0.5 * float(np.hypot(*sensor_mm)))
    lights = [bench.light(depth_m, each) for depth_m in (NEAR * focus_m, np.inf) for each in FIELDS]
    opening = fitted(lights)
    rims = tuple((round(shift, 3), round(radius, 3)) for shift, radius in opening.rims if radius - abs(shift) < 1.0 - _NEVER_CUTS)
    sized = replace(
        Aperture.disc(),
        rims=rims,
        iris_blades=iris_blades,
        spherical_aberration=round(opening.spherical_aberration, 3),
        axial_chromatic=_sizes_of_colours(lights, opening.smaller_behind),
    )
    return Lens(
        focal_length_mm=round(prescription.focal_length_mm, 2),
        f_number=round(prescription.f_number, 3),
        focus_distance_m=focus_m,
        sensor_width_mm=sensor_mm[0],
        sensor_height_mm=sensor_mm[1],
        aperture=sized,
        petzval_radius_mm=_field_radius_mm(bench, opening.bend_mm),
        widest_f_number=round(prescription.f_number, 3),
    )


def _sizes_of_colours(lights: list[TracedLight], smaller_behind: float) -> tuple[float, float, float]:
    """Return `Aperture.axial_chromatic`: on the axis, half of what red and blue are larger behind the focus than in front, by green."""
    near, far = (next(each for each in lights if each.eccentricity == 0.0 and (each.coc_mm > 0) == behind) for behind in (False, True))
    shares = 0.5 * (far.radii / far.radii[1] - near.radii / near.radii[1]) - smaller_behind
    red, green, blue = np.round(shares, 3).tolist()
    return red, green, blue


def _field_radius_mm(bench: Bench, bend_mm: float) -> float:
    """Return `Lens.petzval_radius_mm` of a circle of confusion that grows by bend_mm towards a corner; see `Lens.focus_dioptres`."""
    slope = bench.half_diagonal_mm / bench.thin.image_distance_mm
    per_dioptre_mm = bench.thin.coc_px_per_dioptre(1) * bench.thin.sensor_width_mm
    if abs(bend_mm) < 0.005:
        return float("inf")
    return round(float(per_dioptre_mm * slope**2 * MM_PER_M / (2.0 * bend_mm)), 1)


_HELD_OUT_PX = 48.0
HELD_OUT_FIELDS, HELD_OUT_DEPTHS = (0.2, 0.5, 0.85), (0.75, 3.0)
"""Places in half diagonals, and depths in focus distances, that the fit does not see."""


def held_out_error(prescription: LensPrescription, lens: Lens) -> tuple[float, float]:
    """Return the share of light that a description of a prescription misplaces where it was not fitted, and that a plain disc does."""
    bench = Bench(prescription, lens.focus_distance_m, _half_diagonal_mm(lens))
    lights = [bench.light(share * lens.focus_distance_m, each) for share in HELD_OUT_DEPTHS for each in HELD_OUT_FIELDS]
    disc = Lens(lens.focal_length_mm, lens.f_number, lens.focus_distance_m, lens.sensor_width_mm)
    of_lens, of_disc = (float(np.mean([misplaced_light(each, light) for light in lights])) for each in (lens, disc))
    return of_lens, of_disc


def _half_diagonal_mm(lens: Lens) -> float:
    return 0.5 * float(np.hypot(lens.sensor_width_mm, lens.sensor_height_mm or lens.sensor_width_mm * 2.0 / 3.0))


def misplaced_light(lens: Lens, light: TracedLight) -> float:
    """Return the share of light, mean of the colours, that a description puts elsewhere than the traced light of a point lies.

    Both are kernels in which the thin-lens circle of confusion is 48 px wide, as renderers draw them.
    """
    side, place = (1 if light.coc_mm > 0 else -1), (light.eccentricity, 0.0)
    shares = []
    for channel in range(3):
        wide_px = side * _HELD_OUT_PX * (1.0 + _bend_mm(lens, light) / light.coc_mm) * lens.aperture.channel_scale(side)[channel]
        drawn = lens.aperture.seen(side, place, channel).rasterize(wide_px).kernel
        traced = _traced_px(light, channel, side)
        size = max(len(drawn), len(traced))
        shares.append(0.5 * np.abs(_padded(drawn, size) - _padded(traced, size)).sum())
    return float(np.mean(shares))


def _bend_mm(lens: Lens, light: TracedLight) -> float:
    slope = light.eccentricity * _half_diagonal_mm(lens) / lens.image_distance_mm
    per_dioptre_mm = lens.coc_px_per_dioptre(1) * lens.sensor_width_mm
    return float(per_dioptre_mm * slope**2 * MM_PER_M / (2.0 * lens.petzval_radius_mm))


def _traced_px(light: TracedLight, channel: int, side: int) -> Kernel:
    """Return a kernel (K, K) of the light of a colour, in front of the focus mirrored through the middle, as pictures show it."""
    x_px, y_px = (light.u[:, channel, :] * (0.5 * side * _HELD_OUT_PX)).T
    weights = light.weights[:, channel]
    radius = int(np.ceil(np.abs(np.stack([x_px, y_px]))[:, weights > 0.0].max() + 0.5))
    edges = np.arange(2 * radius + 2) - radius - 0.5
    rays = (np.concatenate([y_px, -y_px]), np.concatenate([x_px, x_px]))
    counted, _, _ = np.histogram2d(*rays, bins=(edges, edges), weights=np.concatenate([weights, weights]))
    return np.asarray(counted / counted.sum())


def _padded(kernel: Kernel, size: int) -> Float64[np.ndarray, "wide wide"]:
    return np.pad(kernel, (size - len(kernel)) // 2)
