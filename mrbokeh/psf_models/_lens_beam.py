"""LensBeam: the light that a lens passes from a point to the sensor, found and traced."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from mrbokeh.psf_models import _physical_lens_numba as compiled
from mrbokeh.psf_models._physical_lens_numba import find_chief
from mrbokeh.psf_models.base import sobol_blocks
from mrbokeh.psf_models.lens_prescription import LensPrescription
from mrbokeh.system.errors import InputError

BANDS_UM = np.array([[0.6114, 0.04], [0.5491, 0.04], [0.4642, 0.04]])
"""Middle and half width of a triangular band for red, green and blue. The middles are the dominant wavelengths of the Rec.709
primaries (where lines from D65 through them meet the spectral locus of CIE 1931)."""

GREEN_UM = float(BANDS_UM[1, 0])
"""Wavelength of the chief ray and of the focus."""

_COARSE, _FINE, _LOOKS, _NODES = 48, 256, 3, 65
_AREA_RAYS = 1 << 16
_DARK = 0.01  # share of the light on the axis below which a field counts as black

Window = Float64[np.ndarray, "3"]
"""A rectangle (a from, a to, |b| to) in mm on the plane that the chief ray meets at a right angle before the lens."""


class LensBeam:
    """Light that a lens passes from a point to its sensor, found and traced; the sensor lies at z = sensor_at_mm.

    A point is given by its chief ray (green, through the middle of the stop), which is found from where it meets the
    sensor, and by 1 / distance from the front principal plane along the axis, in 1/mm (0: infinitely far).
    """

    def __init__(self, lens: LensPrescription, sensor_at_mm: float, half_diagonal_mm: float) -> None:
        self.lens, self.sensor_at_mm, self.half_diagonal_mm = lens, sensor_at_mm, half_diagonal_mm
        self.front_mm = lens.paraxial.front_principal_mm
        self.table, self._reversed = lens.optics_table(), lens.reversed_table()
        self.area_mm2 = lru_cache(maxsize=4096)(self._area_mm2)

    def chief_ray(self, eccentricity: float) -> Float64[np.ndarray, "5"]:
        """Return x on the sensor, then x and z on the first surface and direction x and z (mm; x right, z towards the sensor).

        The source lies to the right (+x) in the scene, so its upside-down image lies at -x.
        """
        found, target_mm = np.empty(4), -eccentricity * self.half_diagonal_mm
        if not find_chief(self.table, self._reversed, self.lens.stop, GREEN_UM, self.sensor_at_mm, target_mm, found):
            raise InputError(f"no ray through the middle of the stop of {self.lens.name} reaches the eccentricity {eccentricity:g}")
        return np.array([target_mm, *found])

    def chief_rays(self, low: float, high: float) -> Float64[np.ndarray, "nodes 5"]:
        """Return chief rays evenly over a range of eccentricity, near enough to be interpolated between."""
        return np.stack([self.chief_ray(each) for each in np.linspace(low, high, _NODES if high > low else 1).tolist()])

    def window(self, per_mm: Float64[np.ndarray, " depths"], eccentricities: Float64[np.ndarray, " fields"]) -> Window:
        """Return the window outside of which no light comes through from any of these points, in any colour."""
        found = np.array([np.inf, -np.inf, 0.0])
        for chief in map(self.chief_ray, eccentricities.tolist()):
            for each in per_mm.tolist():
                for wavelength_um in (BANDS_UM[2] @ [1.0, -1.0], GREEN_UM, BANDS_UM[0] @ [1.0, 1.0]):
                    seen = self._look(chief[1:], each, float(wavelength_um))
                    found = np.array([min(found[0], seen[0]), *np.maximum(found[1:], seen[1:])])
        if found[2] == 0.0:
            span = f"{eccentricities.min():.3g} to {eccentricities.max():.3g}"
            raise InputError(f"no light passes {self.lens.name} at an eccentricity of {span}: choose a smaller field")
        return found

    def _look(self, chief: Float64[np.ndarray, "4"], per_mm: float, wavelength_um: float) -> Window:
        """Look coarsely over all of the front surface (finely if that finds nothing), then ever closer around what was found."""

        def lit(window: Window, steps: int) -> Window:
            around = np.array([np.inf, -np.inf, 0.0])
            compiled.open_window(self.table, chief, self.front_mm, per_mm, wavelength_um, self.sensor_at_mm, window, steps, around)
            return around

        reach_mm = self.lens.surfaces[0].diameter_mm
        everywhere = np.array([-reach_mm, reach_mm, reach_mm])
        found = lit(everywhere, _COARSE)
        if found[2] == 0.0:
            found = lit(everywhere, _FINE)
        for _ in range(_LOOKS if found[2] else 0):
            margin_mm = 0.25 * (found[1] - found[0])
            found = lit(np.array([found[0] - margin_mm, found[1] + margin_mm, 1.5 * found[2]]), _COARSE)
        return found

    def trace(
        self,
        chiefs: Float64[np.ndarray, "nodes 5"],
        window: Window,
        shares: Float64[np.ndarray, "rays 3"],
        per_mm: Float64[np.ndarray, " rays"],
        field: Float64[np.ndarray, " rays"],
        bands_um: Float64[np.ndarray, "colours 2"] = BANDS_UM,
    ) -> tuple[Float64[np.ndarray, "rays colours 2"], Float64[np.ndarray, "rays colours"]]:
        """Return where rays land, in mm on the sensor from their chief ray's place, and their weights, 0 if they do not land.

        The mean weight times the area of the whole window is the cross-section of the beam that gets through, measured
        across the axis. shares: of the window (a, |b|) and of the band. field: place in `chiefs`, 0 to nodes - 1.
        """
        landings, weights = np.empty((len(shares), len(bands_um), 2)), np.empty((len(shares), len(bands_um)))
        optics = compiled.Optics(self.table, chiefs, self.front_mm, self.sensor_at_mm)
        rays = compiled.Rays(np.ascontiguousarray(shares), per_mm, field)
        compiled.trace_rays(optics, window, rays, bands_um, landings, weights)
        return landings, weights

    def open_share(self, per_mm: float, eccentricity: float) -> float:
        """Return the cross-section of the beam across the axis relative to that on the axis."""
        return self.area_mm2(per_mm, eccentricity) / self.area_mm2(per_mm, 0.0)

    def lit_up_to(self, per_mm: Float64[np.ndarray, " depths"]) -> float:
        """Return 1, or the eccentricity beyond which less than 1 % of the light on the axis comes through from one of these depths."""

        def is_lit(eccentricity: float) -> bool:
            try:
                return all(self.open_share(each, eccentricity) > _DARK for each in per_mm.tolist())
            except InputError:
                return False

        low, high = 0.0, 1.0
        if is_lit(high):
            return high
        for _ in range(10):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if is_lit(middle) else (low, middle)
        return low

    def _area_mm2(self, per_mm: float, eccentricity: float) -> float:
        """Return the cross-section across the axis of the beam that gets through from one point, mean of the colours."""
        window = self.window(np.array([per_mm]), np.array([eccentricity]))
        (shares,) = sobol_blocks(3, _AREA_RAYS, 0)
        _, weights = self.trace(
            self.chief_rays(eccentricity, eccentricity), window, shares, np.full(_AREA_RAYS, per_mm), np.zeros(_AREA_RAYS)
        )
        return float(weights.mean()) * area_of(window)


def area_of(window: Window) -> float:
    return float(2.0 * (window[1] - window[0]) * window[2])
