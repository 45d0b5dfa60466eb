"""Blur pairs: a sharp picture with the diameters of its blur, and the picture that the lens blurred so. A fit needs no more, and no metres.

    PAIR/sharp.exr      R, G, B, linear, and coc.px: the signed diameter of the circle of confusion of each pixel, NaN where it is unknown
    PAIR/blurred.exr    R, G, B, linear, of the same size and view

The two may lie apart by some pixels and differ in light: see `pair_matching`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import distance_transform_edt

from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.lens_measuring.fitting.pair_matching import Match, blurred_by_disc, even_light, match
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT
from mrbokeh.lens_measuring.fitting.stack_equations import SliceView, usable_pixels
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

SHARP, BLURRED, COC = "sharp.exr", "blurred.exr", "coc.px"
_LIGHT_WIDTH = 3.0  # light is compared over so many of the largest diameters: wider than what a kernel's shape changes

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


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


def write_blur_pair(pair: BlurPair) -> None:
    """Write both files into the pair's folder, in float32."""
    pair.folder.mkdir(parents=True, exist_ok=True)
    planes = {name: np.ascontiguousarray(pair.sharp[..., i]) for i, name in enumerate("RGB")}
    write_exr(pair.folder / SHARP, ExrPart(planes | {COC: pair.coc_px}))
    write_exr(pair.folder / BLURRED, ExrPart({name: np.ascontiguousarray(pair.blurred[..., i]) for i, name in enumerate("RGB")}))


def find_blur_pairs(folder: Path) -> list[BlurPair]:
    """Read the pairs in a folder: itself, or the folders under it, by name."""
    return [read_blur_pair(path.parent) for path in sorted(Path(folder).rglob(SHARP)) if is_blur_pair(path.parent)]
