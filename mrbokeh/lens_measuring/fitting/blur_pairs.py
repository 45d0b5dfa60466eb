"""Blur pairs: a sharp picture with the diameters of its blur, and the picture that the lens blurred so. A fit needs no more, and no metres.

    PAIR/sharp.exr      R, G, B, linear, and coc.px: the signed diameter of the circle of confusion of each pixel, NaN where it is unknown
    PAIR/blurred.exr    R, G, B, linear, of the same size and view

Two pictures of one scene are never quite alike but for their blur: focusing shifts and enlarges (breathing), exposures differ, and shiny
surfaces mirror something else once a light or a camera has moved. A kernel would have to explain it all. So the sharp picture is blurred by
a disc of the diameters that are known, and what brings that nearest to the blurred one is solved for by Gauss and Newton's steps (Lucas and
Kanade 1981): six numbers of an affine map, the light in common and its slow change over the frame. The shape of the kernel, which is not
known yet, is not needed: a disc of the right size has the right middle.

A fit sees slices of focal stacks and pairs as StackSlices: one view after the other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import distance_transform_edt

from mrbokeh.images.camera_rgb import SliceMasks
from mrbokeh.images.exr_io import read_exr
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT
from mrbokeh.lens_measuring.fitting.stack_equations import LEAST_CONFIDENCE, SliceView, smoothed_coc, usable_pixels
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

_NO_TRUTH = ("moving", "border", "board")
Mask = Bool[np.ndarray, "height width"]

_PIXELS = 30_000
_STEPS = 5
_MOST_PX = 20.0
"""Farther than this pictures of one scene do not lie apart: what is found beyond it is no registration."""
_LEAST_PIXELS = 1000
_LEAST_SLOPE, _LEAST_SHARE = 1e-3, 1e-4  # of the light, per pixel; and of the strongest equation: less is the rounding of flat surfaces
SHARP, BLURRED, COC = "sharp.exr", "blurred.exr", "coc.px"
_LIGHT_WIDTH = 3.0  # light is compared over so many of the largest diameters: wider than what a kernel's shape changes

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Match:
    """Affine map and light between two pictures.

    sharp_from_blurred: leads from pixels of the blurred picture to those of the sharp one. gain, black: blurred = gain * (sharp, blurred
    by the lens) + black.
    """

    sharp_from_blurred: Float64[np.ndarray, "2 3"]
    gain: float = 1.0
    black: float = 0.0

    def registered(self, values: np.ndarray, nearest: bool = False) -> np.ndarray:
        """Return the sharp picture, or with `nearest` a map of it, as it lies under the blurred one."""
        flags = (cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC) | cv2.WARP_INVERSE_MAP
        opencv = self.sharp_from_blurred.copy()
        opencv[:, 2] += 0.5 * opencv[:, :2].sum(axis=1) - 0.5  # OpenCV counts from the middle of the first pixel
        size = (values.shape[1], values.shape[0])
        return np.asarray(cv2.warpAffine(values, opencv, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def blurred_by_disc(rgb: Rgb, coc_px: Plane) -> Rgb:
    """Return a picture with every pixel spread over its disc; what is hidden is not told apart, so edges of depth come out wrong."""
    values = np.concatenate([rgb, np.ones((*coc_px.shape, 1), np.float32)], axis=2)
    summed = PolygonDifferences().sum_kernels(np.ascontiguousarray(values), np.ascontiguousarray(coc_px), Aperture.disc())
    return np.asarray(summed[..., :3] / np.maximum(summed[..., 3:], 1e-3), np.float32)


def match(sharp: Rgb, coc_px: Plane, blurred: Rgb, usable: Mask, seed: int = 0) -> Match:
    """Find how a sharp picture lies under a blurred one and how their light differs. usable: pixels far from edges of depth and frame.

    With fewer than 1000 of them, or none with texture, the pictures are taken as they lie.
    """
    where = np.flatnonzero(usable)
    if where.size < _LEAST_PIXELS:
        return Match(np.eye(2, 3))
    where = np.sort(np.random.default_rng(seed).permutation(where)[:_PIXELS])
    rows, columns = np.unravel_index(where, usable.shape)
    spread = blurred_by_disc(sharp, coc_px).mean(axis=2, dtype=np.float64).astype(np.float32)
    seen = blurred.mean(axis=2, dtype=np.float64).ravel()[where]
    problem = _Problem(np.stack([spread, *reversed(np.gradient(spread))]), np.stack([columns, rows], axis=1) + 0.5, seen)
    found = problem.solved()
    light = problem.sampled(found)[0]
    if not light.std() > _LEAST_SLOPE * abs(light.mean()):
        return Match(np.eye(2, 3))
    gain, black = np.polyfit(light, seen, 1)
    return Match(found, float(gain), float(black))


@dataclass(frozen=True)
class _Problem:
    """planes: a blurred picture and its slopes along x and y. places: x, y of pixels. seen: the light there in the other picture."""

    planes: Float32[np.ndarray, "3 height width"]
    places: Float64[np.ndarray, "pixels 2"]
    seen: Float64[np.ndarray, " pixels"]

    def solved(self) -> Float64[np.ndarray, "2 3"]:
        """Return the affine map that brings the planes nearest to what is seen; the one that changes nothing where none is found."""
        height, width = self.planes.shape[1:]
        scale = 0.5 * max(width, height)
        middle = np.array([0.5 * width, 0.5 * height])
        unit = (self.places - middle) / scale
        ones = np.ones((len(unit), 1))
        affine, slow = np.hstack([ones, unit]), np.hstack([ones, unit, unit**2, unit[:, :1] * unit[:, 1:]])
        moved_px = np.zeros((2, 3))
        for _ in range(_STEPS):
            light, along_x, along_y = self.sampled(self._map(moved_px, middle, scale))[..., None]
            columns = np.hstack([along_x * affine, along_y * affine, light * slow, ones])
            size = np.maximum(np.abs(columns).mean(axis=0), _LEAST_SLOPE * np.abs(light).mean() + 1e-12)
            found = np.linalg.lstsq(columns / size, self.seen, rcond=_LEAST_SHARE)[0] / size
            moved_px = moved_px + found[:6].reshape(2, 3) / max(found[6], 1e-6)
            if not np.abs(moved_px).max() < _MOST_PX:
                return np.eye(2, 3)
        return self._map(moved_px, middle, scale)

    def sampled(self, sharp_from_blurred: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "3 pixels"]:
        """Return the planes where an affine map leads."""
        at = (self.places @ sharp_from_blurred[:, :2].T + sharp_from_blurred[:, 2] - 0.5).astype(np.float32)
        x, y = (np.ascontiguousarray(each.reshape(-1, 100)) for each in np.pad(at, ((0, -len(at) % 100), (0, 0)), mode="edge").T)
        found = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in self.planes]
        return np.stack(found).reshape(3, -1)[:, : len(at)].astype(np.float64)

    def _map(self, moved_px: Float64[np.ndarray, "2 3"], middle: Float64[np.ndarray, " 2"], scale: float) -> Float64[np.ndarray, "2 3"]:
        """Return the map that moves the middle by the first column, and grows by the others."""
        linear = np.eye(2) + moved_px[:, 1:] / scale
        return np.hstack([linear, (middle + moved_px[:, 0] - linear @ middle)[:, None]])


def even_light(seen: Rgb, expected: Rgb, usable: Mask, width_px: float) -> Plane:
    """Return by how much more light a picture has than expected, averaged over about this width; 1 where nothing is known."""

    def averaged(values: Plane) -> Plane:
        return np.asarray(cv2.GaussianBlur(np.where(usable, values, np.float32(0.0)), (0, 0), 0.5 * width_px))

    has, wants = averaged(seen.mean(axis=2)), averaged(expected.mean(axis=2))
    return np.where((wants > 1e-6) & (has > 0.0), has / np.maximum(wants, 1e-6), np.float32(1.0)).astype(np.float32)


@dataclass(frozen=True)
class BlurPair:
    """A sharp picture and a blurred one of the same view, both linear. coc_px: signed diameters, NaN where they are unknown."""

    folder: Path
    sharp: Rgb
    blurred: Rgb
    coc_px: Plane

    def __post_init__(self) -> None:
        if not np.isfinite(self.coc_px).any():
            raise InputError(f"{self.folder}: expected {COC} with the diameters of blur in pixels, found none: NaN means unknown")

    def __len__(self) -> int:
        return 1

    @property
    def lens(self) -> Lens | None:
        """Return None: nothing is stated of the lens."""
        return None

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height."""
        height, width = self.coc_px.shape
        return width, height

    @property
    def largest_px(self) -> float:
        """Return the largest diameter that is known."""
        return float(np.nanmax(np.abs(self.coc_px)))

    @cached_property
    def match(self) -> Match:
        """Find registration and light."""
        view = self._as_it_lies
        return match(view.sharp, view.coc_px, view.blurred, usable_pixels(view))

    @cached_property
    def view(self) -> SliceView:
        """Return the pair registered, its light made the same. Where diameters are unknown the nearest known one stands in the map."""
        lies, found = self._as_it_lies, self.match
        moved = [found.registered(each, nearest=True) for each in (lies.coc_px, lies.known.astype(np.float32))]
        view = replace(lies, sharp=found.registered(lies.sharp), coc_px=moved[0], known=moved[1] > 0.5)
        expected = found.gain * blurred_by_disc(view.sharp, view.coc_px)
        light = even_light(lies.blurred - found.black, expected, usable_pixels(view), _LIGHT_WIDTH * self.largest_px)
        return replace(view, blurred=(lies.blurred - found.black) / (found.gain * light[..., None]))

    @property
    def _as_it_lies(self) -> SliceView:
        known = np.isfinite(self.coc_px)
        coc_px = filled(self.coc_px, known)
        away = np.full(known.shape, np.inf) if known.all() else distance_transform_edt(known)
        return SliceView(self.sharp, self.blurred, coc_px, away > 0.5 * EXTENT * np.abs(coc_px) + 1.0)


def filled(coc_px: Plane, known: Bool[np.ndarray, "height width"]) -> Plane:
    """Return diameters with those of the nearest known pixel where they are unknown."""
    if known.all():
        return coc_px
    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.ascontiguousarray(coc_px[rows, columns])


def is_blur_pair(folder: Path) -> bool:
    return (folder / SHARP).is_file() and (folder / BLURRED).is_file()


def read_blur_pair(folder: Path) -> BlurPair:
    """Read a pair. Raises InputError if it lacks the diameters or its pictures differ in size."""
    part = read_exr(folder / SHARP)[0]
    if COC not in part.channels:
        raise InputError(f"{folder / SHARP}: expected a channel {COC} (signed diameters of blur in pixels), got {', '.join(part.channels)}")
    sharp, blurred = part.stacked("RGB"), read_exr(folder / BLURRED)[0].stacked("RGB")
    if sharp.shape != blurred.shape:
        raise InputError(
            f"{folder}: {SHARP} and {BLURRED} must be of one size, got {sharp.shape[:2]} and {blurred.shape[:2]} (height, width)"
        )
    return BlurPair(folder, sharp, blurred, np.asarray(part.planes([COC])[0], np.float32))


def find_blur_pairs(folder: Path) -> list[BlurPair]:
    """Read the pairs in a folder: itself, or the folders under it, by name."""
    return [read_blur_pair(path.parent) for path in sorted(Path(folder).rglob(SHARP)) if is_blur_pair(path.parent)]


def known_pixels(confidence: Plane, masks: SliceMasks, exclusions: Mapping[str, Mask]) -> Mask:
    """Return the pixels with a trusted depth whose light was measured."""
    known = (confidence >= LEAST_CONFIDENCE) & masks.valid & ~masks.saturated
    for reason in (*_NO_TRUTH, "low_confidence"):
        known &= ~exclusions.get(reason, np.zeros_like(known))
    return np.asarray(known)


@dataclass
class StackSlices:
    """Slices of all stacks, one after the other; pictures that a stack's slices share are kept while it is read. A pair is one slice."""

    stacks: tuple[FocalStack | BlurPair, ...]
    longest: int
    _of_stack: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, stacks: Sequence[FocalStack | BlurPair]) -> "StackSlices":
        """Open stacks and pairs. Raises InputError if a stack is not registered, merged and metric."""
        for stack in stacks:
            if not isinstance(stack, FocalStack):
                continue
            if not stack.registered:
                raise InputError(
                    f"{stack.folder} is not registered, so its slices do not lie on its depth: run `mrbokeh capture merge` on it"
                )
            stack.depth_m()
            stack.stated_lens_of(0)
        return cls(tuple(stacks), max((len(stack) for stack in stacks), default=1))

    def __len__(self) -> int:
        return sum(len(stack) for stack in self.stacks)

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height of the first stack."""
        first = self.stacks[0]
        if not isinstance(first, FocalStack):
            return first.size
        height, width = first.depth_m().shape
        return width, height

    def place(self, number: int) -> tuple[FocalStack | BlurPair, int]:
        """Return the stack and slice of a number."""
        for stack in self.stacks:
            if number < len(stack):
                return stack, number
            number -= len(stack)
        raise IndexError(number)

    def view(self, number: int) -> SliceView:
        stack, index = self.place(number)
        if not isinstance(stack, FocalStack):
            return stack.view
        if id(stack) not in self._of_stack:
            self._of_stack = {id(stack): (stack.all_in_focus(), stack.depth_m(), stack.depth_confidence())}
        sharp, depth_m, confidence = self._of_stack[id(stack)]
        known = known_pixels(confidence, stack.slice_masks(index), stack.exclusions()) & (depth_m > 0.0)
        return SliceView(sharp, stack.slice_rgb(index), smoothed_coc(stack.coc_px(index, depth_m), confidence), known)


def largest_diameter_px(stacks: Sequence[FocalStack | BlurPair]) -> float:
    """Return the largest circle of confusion of any slice; 0 without stacks."""
    return max((_largest_px(stack) for stack in stacks), default=0.0)


def _largest_px(stack: FocalStack | BlurPair) -> float:
    if not isinstance(stack, FocalStack):
        return stack.largest_px
    depth_m = stack.depth_m()
    return max(float(np.abs(stack.coc_px(index, depth_m)).max()) for index in range(len(stack)))
