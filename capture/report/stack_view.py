"""View of a merged stack for the report: registered pictures at a bounded width, read one at a time, and predictions of its slices.

A slice is predicted by re-blurring: the all-in-focus picture through its circles of confusion. Where stack, depth and lens are right, the
prediction is the slice.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.second_pass import SliceOptics
from mrbokeh.images.camera_rgb import SliceMasks, read_slice
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.focal_stack import FocalStack

DEFAULT_WIDTH_PX = 960
_UNTOUCHED = 0.999
_LEAST_PX = 1e-3

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class StoredSlice:
    """Slice as its file has it: in Rec.709, in the RGB of the file, and its masks."""

    rgb: Rgb
    camera_rgb: Rgb
    masks: SliceMasks


@dataclass(frozen=True)
class StackView:
    """Pictures of a merged stack, at most `widest_px` wide. Circles of confusion shrink with the pictures.

    Colours are averaged over areas in linear light; masks keep what is untouched by what they exclude; depth is sampled, for a mean of
    two depths is neither.
    """

    stack: FocalStack
    widest_px: int = DEFAULT_WIDTH_PX

    def __len__(self) -> int:
        return len(self.stack)

    @cached_property
    def all_in_focus(self) -> Rgb:
        return self._shrunk(self.stack.all_in_focus())

    def stored(self, index: int) -> "StoredSlice":
        """Return a slice at the size of its file. The last one that was asked for is held."""
        return self._read(index)

    def slice_rgb(self, index: int) -> Rgb:
        return self._shrunk(self.stored(index).rgb)

    def usable(self, index: int) -> Mask:
        """Return where a slice has data and none of it is saturated."""
        masks = self.stored(index).masks
        return self._shrunk_mask(masks.valid & ~masks.saturated)

    def saturated(self, index: int) -> Mask:
        return ~self._shrunk_mask(~self.stored(index).masks.saturated)

    @cached_property
    def _read(self) -> Callable[[int], "StoredSlice"]:
        # Not self: a view that refers to itself would outlive its use.
        stack = self.stack

        def read(index: int) -> StoredSlice:
            camera_rgb, masks = read_slice(stack.folder / stack.slices[index].path)
            return StoredSlice(stack.to_rec709(camera_rgb), camera_rgb, masks)

        return lru_cache(maxsize=1)(read)

    @cached_property
    def confidence(self) -> Plane:
        return self._shrunk(self.stack.depth_confidence())

    @cached_property
    def focus_index(self) -> Plane:
        return self._sampled(self.stack.focus_index())

    @cached_property
    def full_size_px(self) -> tuple[int, int]:
        """Return width and height of the pictures as they are stored."""
        height, width = self.stack.depth_confidence().shape
        return width, height

    @cached_property
    def dioptres(self) -> Plane:
        """Return 1 / metres. Raises InputError if focus distances are unknown."""
        depth_m = self._sampled(self.stack.depth_m())
        return (1.0 / np.maximum(depth_m, 1e-3)).astype(np.float32)

    @cached_property
    def optics(self) -> SliceOptics:
        """Return the blur in pixels of these pictures. Raises InputError if the lens or a focus distance is unknown."""
        return SliceOptics.of_stack(self.stack, self.width_px)

    @property
    def aperture(self) -> Aperture:
        return self.optics.aperture

    def coc_px(self, index: int) -> Plane:
        """Return signed diameters, in pixels of these pictures."""
        return self.optics.coc_px(index, self.dioptres)

    @cached_property
    def width_px(self) -> int:
        return int(self.all_in_focus.shape[1])

    @property
    def is_explained(self) -> bool:
        """Return whether there is all that a prediction of the slices needs."""
        return self.stack.merged and self.stack.registered and self.stack.is_metric and self.stack.lens is not None

    def _shrunk(self, picture: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
        size = self._size(picture)
        return picture if size is None else cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)

    def _shrunk_mask(self, mask: Bool[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
        return self._shrunk(mask.astype(np.float32)) > _UNTOUCHED

    def _sampled(self, plane: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
        size = self._size(plane)
        return plane if size is None else cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST).astype(np.float32)

    def _size(self, picture: np.ndarray) -> tuple[int, int] | None:
        """Return (width, height) to shrink to, None where the picture is small enough."""
        height, width = picture.shape[:2]
        return None if width <= self.widest_px else (self.widest_px, round(height * self.widest_px / width))


@dataclass(frozen=True)
class Reblur:
    """Prediction of slices by a renderer of mrbokeh, with its occlusion and hidden background.

    name: what the user calls the renderer, which tells whether predictions that are kept would come out the same; "" for its repr.
    """

    renderer: Renderer = field(default_factory=PolygonDifferences)
    name: str = ""

    @property
    def identity(self) -> str:
        return self.name or repr(self.renderer)

    def __call__(self, all_in_focus: Rgb, coc_px: Plane, aperture: Aperture) -> Rgb:
        """Blur a picture. coc_px: signed diameters, in pixels of the picture."""
        largest_px = float(np.abs(coc_px).max(initial=0.0))
        if largest_px < _LEAST_PX:
            return all_in_focus
        lens = lens_with_growth(2.0 * largest_px, all_in_focus.shape[1], aperture)
        return self.renderer.render([opaque(all_in_focus, depth_with(coc_px, lens))], lens).rgb


def reblur_by(name: str) -> Reblur:
    """Choose a renderer by its name, or a trained network (.onnx), which is another one when it was trained further. Raises InputError."""
    from mrbokeh.renderers.choose import make_renderer

    path = Path(name)
    renderer = make_renderer(name)
    if path.suffix.lower() != ".onnx":
        return Reblur(renderer, name)
    return Reblur(renderer, f"{path.resolve()}, {path.stat().st_mtime_ns}")


def lens_with_growth(px_per_dioptre: float, width_px: int, aperture: Aperture) -> Lens:
    """Return a lens focused at 1 m whose circle of confusion grows so fast: renderers take depth and lens, and maps come without either."""
    lens = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=1.0, sensor_width_mm=36.0, aperture=aperture)
    return Lens(
        focal_length_mm=50.0,
        f_number=2.0,
        focus_distance_m=1.0,
        sensor_width_mm=36.0 * lens.coc_px_per_dioptre(width_px) / px_per_dioptre,
        aperture=aperture,
    )


def depth_with(coc_px: Plane, lens: Lens) -> Plane:
    """Return (H, W) metres at which the lens has these diameters, none of which is larger than its growth per dioptre."""
    dioptres = 1.0 / lens.focus_distance_m - coc_px.astype(np.float64) / lens.coc_px_per_dioptre(coc_px.shape[1])
    return (1.0 / dioptres).astype(np.float32)
