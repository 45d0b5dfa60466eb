"""Displacements of neighbouring slices, measured in the registered pictures themselves, and movements as registration found them.

Patches that are sharp in both slices are found again by normalised cross-correlation, which blur by an even kernel leaves in place, and
one similarity is fitted to their displacements (Cauchy's weights). Patches that are blurred in one of the two are left out: where the
opening is cut off, blurred things move with the focus, and no registration could help that.

A camera that moved sideways sees near things before another place of what is far. No one plane fits both, and what is near is sharp in
one slice only, so that nobody sees it. So both slices are made small and as blurred as that, and followed by optical flow.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from capture.merging.registration.plane_transforms import Transform, middle_of, moved, scale_of
from capture.merging.registration.registration_file import FILE_NAME
from capture.report.picture_sharpness import display_luminance
from mrbokeh.stacks.focal_stack import FocalStack

HALF_PX, SEARCH_PX = 24, 8
_BAND_PX = (0.8, 3.0)
_CELLS = (10, 15)
_LEAST_ENERGY = 0.004
"""Fine detail of a patch, display white being 1: about the noise of a photograph of 8 bits."""
_LEAST_CORRELATION = 0.6
_SHARP_IN_BOTH = 0.5
FEWEST_PATCHES = 8
_ROUNDS = 20
_LEAST_SCATTER_PX = 0.05
_SURELY = 3.0
"""Standard errors by which nothing lies apart by chance."""
_SMALL_PX, _SMALL_SIGMA_PX, _SMALL_BLOCK_PX = 320, 4.0, 20
_CONTRAST, _THERE_AND_BACK_PX, _BLOCK_SHARE = 2.0, 0.5, 0.3
"""Where flow is followed: slopes per pixel, of 255, a way that leads back, and so much of a block like that."""
_MOST_APART = 90.0
"""Percentile of the blocks' displacements: a few are of water, people and leaves."""

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Displacements = Float64[np.ndarray, "patches 2"]


@dataclass(frozen=True)
class NeighbourDisplacement:
    """Displacement of slice first + 1 against slice first.

    off_px: root mean square of the fitted displacements, in pixels of the stored pictures; None where too few patches are sharp in both.
    error_px: its standard error. place_px: x, y of the middle of the patch to look at, in pixels of the stored pictures.
    parallax_px, parallax_place_px: how far things of some size lie apart, sharp or not, and where to look.
    """

    first: int
    off_px: float | None
    error_px: float
    place_px: tuple[int, int]
    parallax_px: float = 0.0
    parallax_place_px: tuple[int, int] = (0, 0)

    def exceeds(self, limit_px: float) -> bool:
        """Return whether they lie farther apart than the limit, and not by chance."""
        return self.off_px is not None and self.off_px > max(limit_px, _SURELY * self.error_px)

    def rank(self) -> tuple[bool, float]:
        """Return what is larger for a pair that is farther apart, above all where that is no chance."""
        return self.exceeds(0.0), -1.0 if self.off_px is None else self.off_px


@dataclass
class DisplacementEvidence:
    """Evidence of the slices, taken one after the other, all at one size; two are held at a time."""

    _last: tuple[Plane, Mask, Plane] | None = None
    _sharpest: Plane | None = None
    _pairs: list["_Patches"] = field(default_factory=list)
    _small: Plane | None = None
    _parallax: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, rgb: Rgb, usable: Mask) -> None:
        luminance = display_luminance(rgb)
        fine = cv2.GaussianBlur(luminance, (0, 0), _BAND_PX[0]) - cv2.GaussianBlur(luminance, (0, 0), _BAND_PX[1])
        energy = np.sqrt(cv2.boxFilter(fine * fine, -1, (2 * HALF_PX, 2 * HALF_PX)))
        if self._last is not None:
            before, usable_before, energy_before = self._last
            allowed = _whole_patches(usable & usable_before)
            self._pairs.append(_matched(before, fine, np.where(allowed, np.minimum(energy, energy_before), 0.0)))
        small = _small_of(luminance, usable)
        if self._small is not None:
            self._parallax.append(_parallax(self._small, small, luminance.shape[1] / small.shape[1]))
        self._small = small
        self._sharpest = energy if self._sharpest is None else np.maximum(self._sharpest, energy)
        self._last = (fine, usable, energy)

    def places(self, stored_per_px: float = 1.0) -> tuple[NeighbourDisplacement, ...]:
        """Return the displacement of every pair of neighbours. stored_per_px: pixels of the stored pictures for each of those added."""
        if self._sharpest is None:
            return ()
        places = [_place(index, each, self._sharpest, stored_per_px) for index, each in enumerate(self._pairs)]
        return tuple(
            replace(each, parallax_px=apart * stored_per_px, parallax_place_px=(int(x * stored_per_px), int(y * stored_per_px)))
            for each, (apart, x, y) in zip(places, self._parallax, strict=True)
        )


@dataclass(frozen=True)
class RegistrationDrift:
    """Movements of slices against the reference.

    shift_px: (N, 2) of the picture's middle, right and down. rotation_rad, magnification: (N,).
    correlations: of each pair of neighbours, () where they are not known. width_px: of the pictures.
    residuals_px: how far a corner lies off by the worst pair that a slice was registered with; None where no pair held, () if not known.
    """

    shift_px: Float[np.ndarray, "slices 2"]
    rotation_rad: Float[np.ndarray, " slices"]
    magnification: Float[np.ndarray, " slices"]
    correlations: tuple[float, ...]
    width_px: int
    residuals_px: tuple[float | None, ...] = ()

    @property
    def largest_jump_px(self) -> float:
        """Return the largest move between neighbours that a steady drift does not explain: half the second difference of the shift."""
        if len(self.shift_px) < 3:
            return 0.0
        bends = self.shift_px[1:-1] - 0.5 * (self.shift_px[:-2] + self.shift_px[2:])
        return float(np.hypot(*bends.T).max())

    @property
    def least_correlation(self) -> float | None:
        return min(self.correlations) if self.correlations else None


def registration_drift(stack: FocalStack, width_px: int, height_px: int) -> RegistrationDrift | None:
    """Return the movements as registration found them; None where the stack is not registered or does not say how."""
    found = [each.metadata.get("reference_from_slice") for each in stack.slices]
    if not stack.registered or any(each is None for each in found):
        return None
    document = _document(stack)
    transforms = [np.asarray(each, np.float64) for each in found]
    return drift_of(transforms, width_px, height_px, _numbers(document, "correlations"), _numbers(document, "residuals_px"))


def drift_of(
    reference_from_slice: Sequence[Transform],
    width_px: int,
    height_px: int,
    correlations: Sequence[float | None] = (),
    residuals_px: Sequence[float | None] = (),
) -> RegistrationDrift:
    middle = np.array([[0.5 * width_px, 0.5 * height_px], [0.5 * width_px + 1.0, 0.5 * height_px]])
    ends = np.stack([moved(each, middle) for each in reference_from_slice])
    shift_px, along = ends[:, 0] - middle[0], ends[:, 1] - ends[:, 0]
    magnification = np.array([scale_of(each, middle_of((width_px, height_px))) for each in reference_from_slice])
    rotation_rad = np.arctan2(along[:, 1], along[:, 0])
    known = [float(each) for each in correlations if each is not None]
    all_known = tuple(known) if len(known) == len(correlations) else ()
    return RegistrationDrift(
        shift_px=shift_px,
        rotation_rad=rotation_rad,
        magnification=magnification,
        correlations=all_known,
        width_px=width_px,
        residuals_px=tuple(residuals_px),
    )


@dataclass(frozen=True)
class _Patches:
    """Patches found again. at: x, y of their middles. moved: to the right and down. energy: of the less sharp of the two slices."""

    at: Displacements
    moved: Displacements
    energy: Float64[np.ndarray, " patches"]
    size_px: tuple[int, int]

    def kept(self, chosen: Bool[np.ndarray, " patches"]) -> "_Patches":
        return _Patches(self.at[chosen], self.moved[chosen], self.energy[chosen], self.size_px)


def _whole_patches(usable: Mask) -> Mask:
    """Return middles of patches that lie within the picture with room to search, and on usable pixels alone."""
    reach = HALF_PX + SEARCH_PX
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return cv2.erode(usable.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def _matched(before: Plane, after: Plane, energy: Plane) -> _Patches:
    """Find the patch with the most energy of each cell of the picture again."""
    at, moved, energies = [], [], []
    rows, columns = (np.linspace(0, size, cells + 1).astype(int) for size, cells in zip(energy.shape, _CELLS, strict=True))
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            cell = energy[top:bottom, left:right]
            if not cell.size or cell.max() < _LEAST_ENERGY:
                continue
            row, column = divmod(int(cell.argmax()), cell.shape[1])
            x, y = int(left) + column, int(top) + row
            found = _displacement(before, after, x, y)
            if found is not None:
                at.append((x + 0.5, y + 0.5))
                moved.append(found)
                energies.append(float(energy[y, x]))
    return _Patches(_pairs_of(at), _pairs_of(moved), np.array(energies, np.float64), energy.shape[::-1])


def _pairs_of(values: Sequence[tuple[float, float]]) -> Displacements:
    return np.array(values, np.float64).reshape(-1, 2)


def _displacement(before: Plane, after: Plane, x: int, y: int) -> tuple[float, float] | None:
    """Return by how much the patch around a pixel went right and down; None where it is not found within SEARCH_PX."""
    patch = before[y - HALF_PX : y + HALF_PX, x - HALF_PX : x + HALF_PX]
    reach = HALF_PX + SEARCH_PX
    likeness = cv2.matchTemplate(after[y - reach : y + reach, x - reach : x + reach], patch, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(likeness)
    inside = 0 < column < 2 * SEARCH_PX and 0 < row < 2 * SEARCH_PX
    if best < _LEAST_CORRELATION or not inside:
        return None
    across, down = likeness[row, column - 1 : column + 2], likeness[row - 1 : row + 2, column]
    return column - SEARCH_PX + _peak(across), row - SEARCH_PX + _peak(down)


def _peak(three: Float32[np.ndarray, "3"]) -> float:
    """Return where a parabola through three values has its peak, counted from the middle one."""
    left, middle, right = (float(each) for each in three)
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def _place(first: int, patches: _Patches, sharpest: Plane, stored_per_px: float) -> NeighbourDisplacement:
    x, y = patches.at.astype(int).T
    sharp = patches.kept(patches.energy >= _SHARP_IN_BOTH * sharpest[y, x]) if len(x) else patches
    if len(sharp.at) < FEWEST_PATCHES:
        return NeighbourDisplacement(first, None, float("inf"), _best_place(sharp if len(sharp.at) else patches, stored_per_px))
    fitted, error_px = _fitted(sharp)
    sizes = np.hypot(*fitted.T)
    off_px = float(np.sqrt(np.mean(sizes**2)))
    farthest = sharp.at[int(sizes.argmax())]
    return NeighbourDisplacement(first, off_px * stored_per_px, error_px * stored_per_px, _stored(farthest, stored_per_px))


def _best_place(patches: _Patches, stored_per_px: float) -> tuple[int, int]:
    """Return the middle of the patch that can be seen best, or of the picture where there is none."""
    at = patches.at[int(patches.energy.argmax())] if len(patches.at) else 0.5 * np.array(patches.size_px)
    return _stored(at, stored_per_px)


def _stored(at: Float64[np.ndarray, "2"], stored_per_px: float) -> tuple[int, int]:
    return int(at[0] * stored_per_px), int(at[1] * stored_per_px)


def _fitted(patches: _Patches) -> tuple[Displacements, float]:
    """Return the displacements of the similarity that fits the patches best, and the standard error of their root mean square."""
    count = len(patches.at)
    x, y = ((patches.at - 0.5 * np.array(patches.size_px)) / (0.5 * np.hypot(*patches.size_px))).T
    one, none = np.ones(count), np.zeros(count)
    columns = np.concatenate([np.stack([one, none, x, -y], axis=1), np.stack([none, one, y, x], axis=1)])
    side, weight, scatter_px = patches.moved.T.ravel(), np.ones(2 * count), 0.0
    ridge = 1e-6 * np.eye(4)
    for _ in range(_ROUNDS):
        weighted = columns.T * weight
        change = np.linalg.solve(weighted @ columns + ridge, weighted @ side)
        off = np.hypot(*(side - columns @ change).reshape(2, count))
        # The median length of a vector whose two parts have the deviation 1 is 1.18.
        scatter_px = max(float(np.median(off)) / 1.18, _LEAST_SCATTER_PX)
        weight = np.tile(1.0 / (1.0 + (off / scatter_px) ** 2), 2)
    covariance = np.linalg.inv((columns.T * weight) @ columns + ridge) * scatter_px**2
    variance = np.einsum("ik,kl,il->i", columns, covariance, columns)
    return (columns @ change).reshape(2, count).T, float(np.sqrt(2.0 * variance.mean()))


def _small_of(luminance: Plane, usable: Mask) -> Float32[np.ndarray, "rows columns"]:
    """Return a small, blurred picture; NaN where it shows what is not usable."""
    height, width = luminance.shape
    size = (min(_SMALL_PX, width), max(1, round(height * min(_SMALL_PX, width) / width)))
    small = cv2.GaussianBlur(cv2.resize(luminance, size, interpolation=cv2.INTER_AREA), (0, 0), _SMALL_SIGMA_PX)
    known = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    return np.where(known, small, np.float32(np.nan))


def _parallax(before: Plane, after: Plane, px: float) -> tuple[float, float, float]:
    """Return how far blocks of two small pictures lie apart, and x and y of the farthest. px: pixels of the pictures for each small one."""
    known = np.isfinite(before) & np.isfinite(after)
    if min(before.shape) < 2 * _SMALL_BLOCK_PX or not known.any():
        return 0.0, 0.0, 0.0
    low, high = np.percentile(before[known], (1.0, 99.0))
    scaled = (255.0 * (np.nan_to_num(each) - low) / max(high - low, 1e-6) for each in (before, after))
    first, second = (np.clip(each, 0, 255).astype(np.uint8) for each in scaled)
    follower, still = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM), np.zeros((*first.shape, 2), np.float32)
    follower.setFinestScale(0)
    forth, back = (np.asarray(follower.calc(*each, still.copy())) for each in ((first, second), (second, first)))
    y, x = np.indices(first.shape, np.float32)
    returned = forth + cv2.remap(back, x + forth[..., 0], y + forth[..., 1], cv2.INTER_LINEAR)
    slope = np.hypot(*(cv2.Sobel(first, cv2.CV_32F, *each) / 8.0 for each in ((1, 0), (0, 1))))
    followed = known & (np.hypot(*returned.transpose(2, 0, 1)) < _THERE_AND_BACK_PX) & (slope > _CONTRAST)
    apart, found = np.hypot(*forth.transpose(2, 0, 1)), []
    for top in range(0, first.shape[0] - _SMALL_BLOCK_PX + 1, _SMALL_BLOCK_PX):
        for left in range(0, first.shape[1] - _SMALL_BLOCK_PX + 1, _SMALL_BLOCK_PX):
            block = np.s_[top : top + _SMALL_BLOCK_PX, left : left + _SMALL_BLOCK_PX]
            if followed[block].mean() > _BLOCK_SHARE:
                middle = px * (np.array([left, top]) + 0.5 * _SMALL_BLOCK_PX)
                found.append((px * float(np.median(apart[block][followed[block]])), float(middle[0]), float(middle[1])))
    if not found:
        return 0.0, 0.0, 0.0
    return float(np.percentile([each for each, *_ in found], _MOST_APART)), *max(found)[1:]


def _document(stack: FocalStack) -> dict[str, Any]:
    try:
        document = json.loads((stack.folder / FILE_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _numbers(document: dict[str, Any], name: str) -> list[float | None]:
    """Return a list of numbers or null; empty where the document has none."""
    values = document.get(name)
    if not isinstance(values, list) or not all(each is None or isinstance(each, int | float) for each in values):
        return []
    return [None if each is None else float(each) for each in values]
