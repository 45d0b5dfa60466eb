"""Lights that the sensor could not hold, drawn anew in the all-in-focus picture where that explains the slices better.

A light in focus fills a few photosites: its radiance is lost, and demosaicing makes a mess of what is left. Out of focus the same light
lies spread over a disc below the saturation: its flux is a sum there, its place a centroid, each over many pixels. What is drawn of them
is blurred again to every slice and compared with it, beside what the ordinary merge gives. Only what explains the slices clearly better
replaces the ordinary merge; so print, paper, metal and sky stay what they are in their sharpest slice.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.lights import OVER_RANGE, UNSATURATED_SHARE, Extremes, Lights, find_lights
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Patches = Float32[np.ndarray, "slices height width 3"]
Flux = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "2 2"]
Kernel = Float32[np.ndarray, "_ _"]

# Slices that tell one light's flux may differ by this share; what differs more is no single light.
LARGEST_SPREAD = 0.25
RING_PX = 3.0
# So many slices tell the largest flux of a light.
FEWEST_BRIGHTEST = 2
# In so many slices a light is seen whole.
FEWEST_SLICES = 3
# A drawn light explains its slices, to this share of the light in them, and leaves at most this share of the ordinary merge's error.
LEAST_EXPLAINED = 0.9
LARGEST_ERROR_SHARE = 0.7
# Slices to which a drawn light is blurred again: from the sharpest to the widest.
COMPARED_SLICES = 5
# Demosaicing and resampling spread what is full: in slices that lose light, what is brighter than this, and beside it, is a lower bound.
LOSING_RANGE = 0.45
# Small lights that hold less than this share of their flux in focus do not show their shape: a disc is drawn, unless another way explains
# the slices clearly better.
LARGEST_DRAWN_PX = 30.0
LARGEST_DRAWN_SHARE = 0.65
CLEARLY = 3.0
LARGEST_LIGHT_PX = 120.0
# So many pixels around lights, of all slices, are held at once: 0.4 GB.
MOST_CUT_PX = 32_000_000
# What is brighter than the light's own slice by this share of its widest disc was added by a disc.
RING_SHARE = 0.3
# Lights that hold this share of their flux in focus need no restoring.
LARGEST_HELD_SHARE = 0.9
CORE_SHARE = 0.7
# Radii of lights that are drawn as discs. A point light behind a low-pass filter covers about USUAL_RADIUS_PX; demosaicing of full pixels
# hides smaller differences, which count as much as this squared radiance per squared pixel of the radius.
RADII_PX = np.arange(0.0, 2.51, 0.125)
USUAL_RADIUS_PX = 1.0
USUAL_WEIGHT = 10.0
SUBPIXELS = 8
OPENING_SUBPIXELS = 16
MARGIN_PX = 3
# A light or the disc of a lens (a cat-eye) is an ellipse where its axes differ at least by this factor. Discs of a lens are measured within
# a circle, which cuts longer ones off (5 % of the flux at 1.8, 15 % at 3).
LEAST_ELONGATION, LARGEST_OF_LIGHTS, LARGEST_OF_LENSES = 1.2, 4.0, 1.8
LEAST_BETTER_ELLIPSE = 1.3
PIXEL_VARIANCE_PX2 = 1.0 / 12.0


@dataclass(frozen=True)
class RestoredLight:
    """A replacement for a part of the all-in-focus picture: picture (h, w, 3) where mask (h, w), at box (rows, columns).

    supported: the largest value that the light can have, all of the flux that its discs show in one pixel above what is around it.
    """

    box: tuple[slice, slice]
    mask: Mask
    picture: Rgb
    supported: float


def restored_lights(
    slices: Callable[[], Iterable[Rgb]],
    merged: Rgb,
    extremes: Extremes | None = None,
    *,
    guided: bool = False,
    opening: Aperture | None = None,
) -> tuple[Lights, list[RestoredLight]]:
    """Return the lights of registered slices that the evidence supports, and what is drawn for them in place of the merged picture.

    slices: gives a fresh pass over them, one held at a time. extremes: what an earlier pass has gathered. guided: the picture was merged
    by a depth that lights cannot mislead, so that what surrounds them stays. opening: of the lens; None for a disc, or the ellipse that the
    lights show. (Compared as discs, no light behind a mirror lens was drawn: rings are far from them.)
    """
    candidates = find_lights(slices, extremes)
    if len(candidates) == 0:
        return candidates, []
    small = [each for light in range(len(candidates)) if (each := _Place.of(candidates, light)).area_px <= LARGEST_LIGHT_PX]
    pixels = np.cumsum([each.zone.size for each in small]) * len(candidates.areas_px)
    found = {}
    for group in np.unique(pixels // MOST_CUT_PX):
        places = [each for each, number in zip(small, pixels // MOST_CUT_PX, strict=True) if number == group]
        cut = [[rgb[each.box].copy() for each in places] for rgb in slices()]
        for place, patches in zip(places, zip(*cut, strict=True), strict=True):
            areas_px = candidates.areas_px[:, place.light]
            if drawn := _restored(np.stack(patches), merged[place.box], place, areas_px, guided, opening):
                found[place.light] = drawn
    kept = np.isin(np.arange(len(candidates)), list(found))
    return candidates.only(kept), [found[light] for light in sorted(found)]


@dataclass(frozen=True)
class _Place:
    """A candidate in its box: zone and core (h, w) of this light, centre_px (x, y) of the core, area_px in its sharpest slice."""

    light: int
    box: tuple[slice, slice]
    zone: Mask
    core: Mask
    centre_px: Float[np.ndarray, "2"]
    sharpest: int
    area_px: float

    @classmethod
    def of(cls, lights: Lights, light: int) -> "_Place":
        box = lights.box(light, int(np.ceil(RING_PX)) + 1)
        zone = lights.zone[box] == light + 1
        core = lights.core[box] & zone
        rows, columns = np.nonzero(core if core.any() else zone)
        centre_px = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        sharpest = int(lights.sharpest[light])
        return cls(light, box, zone, core, centre_px, sharpest, float(lights.areas_px[sharpest, light]))


def known_opening(lens: Lens | None) -> Aperture | None:
    """Return the opening of a known lens where it has several outlines, as with a stop in its middle; one is near enough to a disc."""
    return None if lens is None or len(lens.aperture.outlines) == 1 else lens.aperture


def with_restored_lights(merged: Rgb, restored: Sequence[RestoredLight]) -> Rgb:
    """Return the all-in-focus picture with its lights."""
    result = merged.copy()
    for each in restored:
        result[each.box][each.mask] = each.picture[each.mask]
    return result


@dataclass(frozen=True)
class Discs:
    """A light in its slices: flux (slices, 3) above the surroundings, xy_px (slices, 2) its centroid in the patch, covariance_px2 (slices,
    2, 2) about it, peak (slices,), whole (slices,) whether the disc lies within the light's zone and the picture.
    """

    flux: Float[np.ndarray, "slices 3"]
    xy_px: Float[np.ndarray, "slices 2"]
    covariance_px2: Float[np.ndarray, "slices 2 2"]
    peak: Float[np.ndarray, " slices"]
    whole: Bool[np.ndarray, " slices"]

    @property
    def variance_px2(self) -> Float[np.ndarray, " slices"]:
        """Return the mean of both axes."""
        return np.trace(self.covariance_px2, axis1=1, axis2=2) / 2.0

    def blur_shape(self, sharpest: int) -> Matrix:
        """Return the shape of the lens's disc here (see `ellipse_of`): what slices in which it is whole have beyond the light itself."""
        wide = np.flatnonzero(self.believable & (np.arange(len(self.peak)) != sharpest))
        if len(wide) == 0:
            return np.eye(2)
        beyond = self.covariance_px2[wide] - self.covariance_px2[sharpest]
        weight = np.maximum(np.trace(beyond, axis1=1, axis2=2), 0.0)
        shape = (weight[:, None, None] * beyond).sum(axis=0)
        return ellipse_of(shape, LARGEST_OF_LENSES) if np.linalg.eigvalsh(shape)[0] > 0 else np.eye(2)

    @property
    def believable(self) -> Bool[np.ndarray, " slices"]:
        """Slices in which the light is whole, below the peak of the brightest, and as bright as in most of them.

        Where all of these are full, and so have lost some, the largest flux that two tell: blur adds no light.
        """
        flux = self.flux.sum(axis=1)
        good = self.whole & (self.peak < UNSATURATED_SHARE * self.peak.max()) & (flux > 0)
        if not good.any():
            return good
        alike = good & (np.abs(flux - np.median(flux[good])) < LARGEST_SPREAD * np.median(flux[good]))
        most = self.whole & (flux > (1.0 - LARGEST_SPREAD) * flux[self.whole].max())
        lost = (self.peak[alike & ~most] > OVER_RANGE).all()
        return most & good if lost and (most & good).any() and most.sum() >= FEWEST_BRIGHTEST else alike


def measured_discs(patches: Patches, zone: Mask, centre_px: Float[np.ndarray, "2"], areas_px: Float[np.ndarray, " slices"]) -> Discs:
    """Measure one light in all slices. zone: what is this light's; centre_px: (x, y) of its core, in the patch."""
    rows = [_measured(patch, zone, centre_px, _radius_px(area)) for patch, area in zip(patches, areas_px, strict=True)]
    table = np.array(rows, np.float64)
    return Discs(
        flux=table[:, 0:3],
        xy_px=table[:, 3:5],
        covariance_px2=table[:, [5, 6, 6, 7]].reshape(-1, 2, 2),
        peak=table[:, 8],
        whole=table[:, 9] > 0,
    )


def ellipse_of(covariance_px2: Matrix, largest: float) -> Matrix:
    """Return the symmetric matrix that turns a disc into the ellipse of this shape and the same area; the identity if it is about round.

    largest: ratio of the axes. A shape without any width has it.
    """
    variances, axes = np.linalg.eigh(covariance_px2)
    ratio = float(np.sqrt(variances[1] / variances[0])) if variances[0] > 0 else np.inf
    if ratio < LEAST_ELONGATION or variances[1] <= 0:
        return np.eye(2)
    stretch = np.sqrt(min(ratio, largest))
    return np.asarray(axes @ np.diag([1.0 / stretch, stretch]) @ axes.T)


def _measured(patch: Rgb, zone: Mask, centre_px: Float[np.ndarray, "2"], radius_px: float) -> tuple[float, ...]:
    """Return (flux r, g, b, x, y, covariance xx, xy, yy, peak, whole) of one light in one slice."""
    y, x = np.mgrid[: patch.shape[0], : patch.shape[1]] + 0.5
    distance = np.hypot(x - centre_px[0], y - centre_px[1])
    inside = distance < radius_px
    ring = (distance >= radius_px) & (distance < radius_px + RING_PX)
    level = np.median(patch[ring], axis=0) if ring.any() else np.zeros(3)
    excess = (patch - level) * inside[..., None]
    whole = bool(zone[inside].all()) and inside.sum() > 0.97 * np.pi * radius_px**2
    weight = np.maximum(excess.sum(axis=2), 0.0)
    centre, covariance = _moments(weight, x, y)
    peak = float(patch[inside].max(initial=0.0))
    return (*excess.sum(axis=(0, 1)).tolist(), *centre, covariance[0, 0], covariance[0, 1], covariance[1, 1], peak, float(whole))


def _moments(weight: Float[np.ndarray, "height width"], x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], Matrix]:
    """Return the centroid (x, y) and the covariance of a plane of weights."""
    total = max(float(weight.sum()), 1e-9)
    mean_x, mean_y = float((weight * x).sum() / total), float((weight * y).sum() / total)
    xx, xy, yy = (float((weight * a * b).sum() / total) for a, b in (((x - mean_x),) * 2, (x - mean_x, y - mean_y), ((y - mean_y),) * 2))
    return (mean_x, mean_y), np.array([[xx, xy], [xy, yy]])


def _radius_px(area_px: float) -> float:
    """Return the radius of a disc of that area, with a margin for its soft rim."""
    return 1.15 * float(np.sqrt(area_px / np.pi)) + 2.0


def _restored(
    patches: Patches, ordinary: Rgb, place: _Place, areas_px: Float[np.ndarray, " slices"], guided: bool, opening: Aperture | None
) -> RestoredLight | None:
    """Return what explains the slices around a light clearly better than the ordinary merge, None where nothing does."""
    zone, core, sharpest = place.zone, place.core, place.sharpest
    discs = measured_discs(patches, zone, place.centre_px, areas_px)
    if not discs.believable.any() or discs.whole.sum() < FEWEST_SLICES:
        return None
    spread = _without_rings(ordinary, patches[sharpest], zone, discs, areas_px)
    # In the light's own slice nothing of it lies on its surroundings. Another base has to be clearly better.
    bases, lost = [(spread, CLEARLY if guided else 1.0), (ordinary, 1.0 if guided else CLEARLY)], _mostly_lost(discs, areas_px, sharpest)
    if np.array_equal(spread, ordinary):
        bases = [(ordinary, 1.0)]
    compare, ways = _Comparison.of(patches, zone, discs, areas_px, sharpest, opening), []
    for base, handicap in bases:
        drawn = _drawn(base, discs, areas_px[sharpest])
        for picture in (drawn, _raised(base, core, discs, sharpest), base):
            error = compare.error(picture)
            ways.append((error * handicap * (CLEARLY if lost and picture is not drawn else 1.0), error, picture))
    _, error, picture = min(ways, key=lambda way: way[0])
    limit = min(LARGEST_ERROR_SHARE * compare.error(ordinary), (1.0 - LEAST_EXPLAINED) * compare.light)
    supported = float(np.median(discs.flux[discs.believable], axis=0).max()) + float(ordinary[zone & ~core].max(initial=0.0))
    return RestoredLight(place.box, (picture != ordinary).any(axis=2), picture, supported) if error < limit else None


def _without_rings(ordinary: Rgb, sharp: Rgb, zone: Mask, discs: Discs, areas_px: Float[np.ndarray, " slices"]) -> Rgb:
    """Return the ordinary merge with what discs have added to it taken from the light's own slice, over which none of it is spread."""
    disc = np.median(discs.flux[discs.believable], axis=0).mean() / areas_px.max()
    added = zone & (_grey(ordinary) - _grey(sharp) > RING_SHARE * disc)
    grown = cv2.dilate(added.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where((grown & zone)[..., None], sharp, ordinary)


def _mostly_lost(discs: Discs, areas_px: Float[np.ndarray, " slices"], sharpest: int) -> bool:
    """Return whether a light is small and holds so little of its flux in focus that it does not show its shape either."""
    flux = np.median(discs.flux[discs.believable].sum(axis=1))
    return bool(areas_px[sharpest] < LARGEST_DRAWN_PX and discs.flux[sharpest].sum() < LARGEST_DRAWN_SHARE * flux)


@dataclass(frozen=True)
class _Comparison:
    """The slices around a light, against which proposals are held.

    looks: slice, where it tells only a lower bound, and its blur twice: of a point, and of a light as large as in its sharpest slice.
    light: all that these slices hold of it, squared.
    """

    zone: Mask
    looks: tuple[tuple[Rgb, Mask, tuple[Kernel, Kernel]], ...]
    light: float

    @classmethod
    def of(
        cls, patches: Patches, zone: Mask, discs: Discs, areas_px: Float[np.ndarray, " slices"], sharpest: int, opening: Aperture | None
    ) -> "_Comparison":
        """Choose slices in which the disc is whole, evenly from the sharpest to the widest."""
        whole = np.flatnonzero(discs.whole)
        by_area = whole[np.argsort(areas_px[whole])]
        chosen = by_area[np.unique(np.linspace(0, len(by_area) - 1, COMPARED_SLICES).round().astype(int))].tolist()
        flux, shape = np.median(discs.flux[discs.believable].sum(axis=1)), discs.blur_shape(sharpest)
        open_share = 1.0 if opening is None else _open_share(opening)

        def kernel(index: int, own_area_px: float) -> Kernel:
            area_px = 0.0 if index == sharpest else max(areas_px[index] - own_area_px, 0.0)
            radius_px = float(np.sqrt(area_px / open_share / np.pi))
            return _disc_kernel(radius_px, shape) if opening is None else opening_kernel(opening, radius_px)

        looks, light = [], 0.0
        for index in chosen:
            full = LOSING_RANGE if discs.flux[index].sum() < LARGEST_HELD_SHARE * flux else OVER_RANGE
            least = cv2.dilate((patches[index].max(axis=2) > full).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            looks.append((patches[index], least, (kernel(index, 0.0), kernel(index, areas_px[sharpest]))))
            around = np.median(patches[index][~zone] if (~zone).any() else patches[index].reshape(-1, 3), axis=0)
            light += float(((patches[index] - around) ** 2)[zone].sum() / 3.0)
        return cls(zone, tuple(looks), light)

    def error(self, picture: Rgb) -> float:
        """Return the squared difference, in the light's zone, between the slices and a picture blurred in the better of both ways."""
        errors = [[self._missed(seen, least, kernel, picture) for kernel in kernels] for seen, least, kernels in self.looks]
        return float(np.min(np.sum(errors, axis=0)))

    def _missed(self, seen: Rgb, least: Mask, kernel: Kernel, picture: Rgb) -> float:
        blurred = cv2.merge([cv2.filter2D(each, -1, kernel) for each in cv2.split(picture)])
        too_dark = np.minimum(np.minimum(blurred, OVER_RANGE) - np.minimum(seen, OVER_RANGE), 0.0)
        return float((np.where(least[..., None], too_dark, blurred - seen)[self.zone] ** 2).sum() / 3.0)


def _grey(rgb: Rgb) -> Plane:
    return rgb.mean(axis=2)


def _disc_kernel(radius_px: float, shape: Matrix) -> Kernel:
    """Return a disc or ellipse of sum 1 with soft pixels at its rim."""
    reach = int(np.ceil(radius_px * float(np.linalg.norm(shape, 2)) + 0.5))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.clip(radius_px + 0.5 - _distance(x, y, shape), 0.0, 1.0).astype(np.float32)
    return kernel / kernel.sum()


def opening_kernel(opening: Aperture, radius_px: float) -> Kernel:
    """Return what an opening makes of a point, of sum 1, at that radius of the pupil; drawn by OpenCV, so that nothing compiles."""
    if radius_px < 1.0:
        return _disc_kernel(radius_px, np.eye(2))
    reach = int(np.ceil(radius_px * opening.unit_radius + 0.5))
    side = 2 * reach + 1
    fine = np.zeros((side * OPENING_SUBPIXELS,) * 2, np.float32)
    for outline, weight in zip(opening.outlines, opening.weights, strict=True):
        corners = np.round((np.asarray(outline) * radius_px + reach + 0.5) * OPENING_SUBPIXELS - 0.5).astype(np.int32)
        fine += np.float32(weight) * cv2.fillPoly(np.zeros(fine.shape, np.uint8), [corners], 1)
    kernel = np.maximum(cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA), 0.0)
    return kernel / kernel.sum()


def _open_share(opening: Aperture) -> float:
    """Return the area of what an opening shows as even light, over that of the pupil."""
    kernel = opening_kernel(opening, 32.0)
    return float(1.0 / (kernel**2).sum()) / (np.pi * 32.0**2)


def _distance(x: np.ndarray, y: np.ndarray, shape: Matrix) -> Float[np.ndarray, "..."]:
    """Return the distance from the middle in a frame in which the ellipse is a disc."""
    inverse = np.linalg.inv(shape)
    return np.hypot(inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y)


def _drawn(blank: Rgb, discs: Discs, sharp_area_px: float) -> Rgb:
    """Return the patch with a disc of the light's flux in place of what is left of it, without its stray light."""
    use = discs.believable
    certainty = 1.0 / np.maximum(discs.variance_px2[use], 0.5)
    xy_px, flux = (np.average(each[use], axis=0, weights=certainty) for each in (discs.xy_px, discs.flux))
    clear_px = _radius_px(sharp_area_px)
    y, x = np.mgrid[: blank.shape[0], : blank.shape[1]] + 0.5
    distance = np.hypot(x - xy_px[0], y - xy_px[1])
    around = (distance > clear_px) & (distance <= clear_px + MARGIN_PX)
    picture = blank.copy()
    if not around.any():
        return picture
    surroundings = np.median(picture[around], axis=0)
    drawn = _fitting_disc(blank, xy_px, distance, clear_px, surroundings, flux)
    lowest, highest = picture[around].min(axis=0), picture[around].max(axis=0)
    stray = (distance <= clear_px) & ((picture > highest) | (picture < lowest)).any(axis=2)
    picture[stray] = surroundings
    cover = (drawn / drawn.max())[..., None]
    return ((1.0 - cover) * picture + drawn[..., None] * flux).astype(np.float32)


def disc_picture(
    xy_px: Float[np.ndarray, "2"], radius_px: float, size: tuple[int, ...], shape: Matrix | None = None
) -> Float[np.ndarray, "height width"]:
    """Return the share of a light in each pixel of a picture (h, w); shape: of an ellipse. Below the grid of subpixels it is a point."""
    reach_px = radius_px * (1.0 if shape is None else float(np.linalg.norm(shape, 2)))
    left, top = (max(int(each - reach_px) - 1, 0) for each in xy_px)
    right, bottom = min(int(xy_px[0] + reach_px) + 2, size[1]), min(int(xy_px[1] + reach_px) + 2, size[0])
    y, x = (np.mgrid[: (bottom - top) * SUBPIXELS, : (right - left) * SUBPIXELS] + 0.5) / SUBPIXELS
    squared = _distance(x + left - xy_px[0], y + top - xy_px[1], np.eye(2) if shape is None else shape) ** 2
    inside = squared <= max(radius_px**2, float(squared.min()))
    shares = inside.reshape(bottom - top, SUBPIXELS, right - left, SUBPIXELS).sum(axis=(1, 3)) / inside.sum()
    result = np.zeros(size)
    result[top:bottom, left:right] = shares
    return result


def _fitting_disc(
    seen: Rgb, xy_px: Float[np.ndarray, "2"], distance: Float[np.ndarray, "height width"], reach_px: float, surroundings: Flux, flux: Flux
) -> Float[np.ndarray, "height width"]:
    """Return the disc that explains what is seen of a light where nothing is full; an ellipse where that does it clearly better."""
    near = distance <= reach_px + MARGIN_PX
    unsaturated = np.minimum(seen, OVER_RANGE)
    light = np.where(near, np.maximum(unsaturated - surroundings, 0.0).sum(axis=2), 0.0)
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]] + 0.5
    _, covariance = _moments(np.where(light > 0.5 * light.max(), light, 0.0), x, y)
    elongated = ellipse_of(covariance - PIXEL_VARIANCE_PX2 * np.eye(2), LARGEST_OF_LIGHTS)

    def miss(drawn: Float[np.ndarray, "height width"], radius_px: float) -> float:
        expected = np.minimum(surroundings + drawn[near][:, None] * flux, OVER_RANGE)
        return float(((expected - unsaturated[near]) ** 2).sum() + USUAL_WEIGHT * (radius_px - USUAL_RADIUS_PX) ** 2)

    def best(shape: Matrix) -> tuple[float, Float[np.ndarray, "height width"]]:
        discs = [(radius_px, disc_picture(xy_px, float(radius_px), seen.shape[:2], shape)) for radius_px in RADII_PX]
        return min(((miss(drawn, float(radius_px)), drawn) for radius_px, drawn in discs), key=lambda pair: pair[0])

    round_miss, round_disc = best(np.eye(2))
    if np.array_equal(elongated, np.eye(2)):
        return round_disc
    ellipse_miss, ellipse = best(elongated)
    return ellipse if ellipse_miss * LEAST_BETTER_ELLIPSE < round_miss else round_disc


def _raised(blank: Rgb, core: Mask, discs: Discs, sharpest: int) -> Rgb:
    """Return the patch with the light's brightest pixels raised to its flux: larger lamps show their own shape and keep it.

    Channels fill one by one: a lamp that has lost a third of its red may hold all of its blue.
    """
    picture = blank.copy()
    if not core.any():
        return picture
    brightness = picture.max(axis=2)
    brightest = core & (brightness >= CORE_SHARE * brightness[core].max())
    flux, held = np.median(discs.flux[discs.believable], axis=0), discs.flux[sharpest]
    missing = np.where(held < LARGEST_HELD_SHARE * flux, np.maximum(flux - held, 0.0), 0.0)
    picture[brightest] += (missing / np.count_nonzero(brightest)).astype(np.float32)
    return picture
