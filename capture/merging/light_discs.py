"""What every slice tells about a small light: its flux, its place and how wide it is spread.

A light in focus fills a few photosites: its radiance is lost, and demosaicing makes a mess of what is left. Out of focus the
same light lies spread over a disc below the saturation. There its flux is a sum, its place a centroid and its spread a
variance, each over many pixels. The disc's own variance grows with the square of its diameter, so that what remains at
diameter 0 is the light in focus.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.lights import Lights

Rgb = Float32[np.ndarray, "height width 3"]

# A slice is believed where its brightest pixel is well below the brightest that the light ever gets.
UNSATURATED_SHARE = 0.75
FEWEST_SLICES = 2
# Slices that tell one light's flux may differ by this share; what differs more is no single light.
LARGEST_SPREAD = 0.25
RING_PX = 3.0


@dataclass(frozen=True)
class LightDiscs:
    """Per slice and light: flux (slices, lights, 3) above the surroundings within the light's disc; zone_light: all light within the
    largest of its discs, to which texture adds the same in every slice; xy_px (slices, lights, 2) centroid, variance_px2
    (slices, lights) mean of both axes, peak (slices, lights), whole (slices, lights) whether the disc is all within the
    light's zone and the picture.
    """

    flux: Float[np.ndarray, "slices lights 3"]
    zone_light: Float[np.ndarray, "slices lights 3"]
    xy_px: Float[np.ndarray, "slices lights 2"]
    variance_px2: Float[np.ndarray, "slices lights"]
    peak: Float[np.ndarray, "slices lights"]
    whole: Bool[np.ndarray, "slices lights"]

    def believable(self, light: int) -> Bool[np.ndarray, " slices"]:
        """Slices in which the light is whole, unsaturated and about as bright as in the others; none where fewer than two agree."""
        peak, flux = self.peak[:, light], self.flux[:, light].sum(axis=1)
        good = self.whole[:, light] & (peak < UNSATURATED_SHARE * peak.max()) & (flux > 0)
        if good.any():
            good &= np.abs(flux - np.median(flux[good])) < LARGEST_SPREAD * np.median(flux[good])
        return good if good.sum() >= FEWEST_SLICES else np.zeros_like(good)


@dataclass
class DiscMeasurement:
    """The discs of all lights, measured while the slices pass by."""

    lights: Lights
    _rows: list[list[tuple[float, ...]]] = field(default_factory=list)

    def watching(self, slices: Iterable[Rgb]) -> Iterator[Rgb]:
        """The slices as they come; each is measured."""
        centres = _core_centres(self.lights)
        for index, rgb in enumerate(slices):
            self._rows.append([_measured(rgb, self.lights, light, index, centre) for light, centre in enumerate(centres)])
            yield rgb

    @property
    def discs(self) -> LightDiscs:
        table = np.array(self._rows, np.float64).reshape(len(self._rows), len(self.lights), 11)
        return LightDiscs(table[..., 0:3], table[..., 3:6], table[..., 6:8], table[..., 8], table[..., 9], table[..., 10] > 0)


def measure_discs(slices: Iterable[Rgb], lights: Lights) -> LightDiscs:
    """All lights in all slices, in a pass of its own."""
    measurement = DiscMeasurement(lights)
    for _ in measurement.watching(slices):
        pass
    return measurement.discs


def _core_centres(lights: Lights) -> Float[np.ndarray, "lights 2"]:
    """(x, y) of the middle of each light's core, or of its zone where it has none."""
    from scipy.ndimage import center_of_mass

    if len(lights) == 0:
        return np.zeros((0, 2))
    numbers = np.arange(1, len(lights) + 1)
    zones = np.array(center_of_mass(lights.zone > 0, lights.zone, numbers)).reshape(-1, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        cores = np.array(center_of_mass(lights.core, lights.zone, numbers)).reshape(-1, 2)
    return np.where(np.isfinite(cores), cores, zones)[:, ::-1] + 0.5


def _measured(rgb: Rgb, lights: Lights, light: int, index: int, centre: Float[np.ndarray, "2"]) -> tuple[float, ...]:
    """(flux r, g, b, all light r, g, b, x, y, variance, peak, whole) of one light in one slice."""
    largest_px, radius_px = (_radius_px(area) for area in (lights.areas_px[:, light].max(), lights.areas_px[index, light]))
    reach = int(np.ceil(largest_px + RING_PX))
    left, top = max(int(centre[0]) - reach, 0), max(int(centre[1]) - reach, 0)
    box = np.s_[top : int(centre[1]) + reach + 1, left : int(centre[0]) + reach + 1]
    patch, zone = rgb[box], lights.zone[box]
    y, x = np.mgrid[top : top + patch.shape[0], left : left + patch.shape[1]] + 0.5
    distance = np.hypot(x - centre[0], y - centre[1])
    inside, everywhere = distance < radius_px, distance < largest_px
    excess = patch - _level(patch, distance, radius_px)
    zone_light = (patch * everywhere[..., None]).sum(axis=(0, 1)).tolist()
    whole = bool((zone[inside] == light + 1).all()) and inside.sum() > 0.97 * np.pi * radius_px**2
    weight = np.maximum(excess.sum(axis=2), 0.0) * inside
    total = max(float(weight.sum()), 1e-9)
    mean_x, mean_y = float((weight * x).sum() / total), float((weight * y).sum() / total)
    variance = 0.5 * float((weight * ((x - mean_x) ** 2 + (y - mean_y) ** 2)).sum() / total)
    flux = (excess * inside[..., None]).sum(axis=(0, 1)).tolist()
    return (*flux, *zone_light, mean_x, mean_y, variance, float(patch[inside].max(initial=0.0)), float(whole))


def _level(patch: Rgb, distance: Float[np.ndarray, "height width"], radius_px: float) -> Float32[np.ndarray, "3"]:
    """What surrounds a disc: the median of a ring."""
    ring = (distance >= radius_px) & (distance < radius_px + RING_PX)
    return np.median(patch[ring], axis=0).astype(np.float32) if ring.any() else np.zeros(3, np.float32)


def _radius_px(area_px: float) -> float:
    """The radius of a disc of that area, with a margin for its soft rim."""
    return 1.15 * float(np.sqrt(area_px / np.pi)) + 2.0
