"""CompositeRecipe: virtual layers in each frame of a clip, blurred by its lens as it is focused in that frame.

Only the dirty rectangle that virtual light can reach is computed, and results are reused while their inputs stay the same. The simple
modes (front, over) blur the layers alone, so their blur is the same in every frame in which neither the layers nor the focus nor the
depth of the photograph change. Other modes look at the picture itself and run for every frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.choose import DEFAULT_MODE, InDirtyRectangle, dirty_rectangle, insertion_of
from mrbokeh.compositing.over import OverPhotograph, behind, covered_by, occlusion_matte
from mrbokeh.compositing.plate import Inserted, Insertion, Plate, plate_of, same_size
from mrbokeh.depth.mended_depth import mended
from mrbokeh.images.alpha_io import coverage_with
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.layering.pixel_box import NOWHERE, Box, is_same_everywhere
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import BY_NAME, DEFAULT, files_of, lens_and_renderer, read_lens, spreads_light
from mrbokeh.shots.inputs import CameraSource, DepthSource, Description, Finisher, FocusSource, Kept, LayerSource, MatteSource, Moment
from mrbokeh.shots.shot import Picture, Rgba
from mrbokeh.stacks.photograph import SensorOrientation, lens_for_orientation
from mrbokeh.system.messages import say

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

_LOCAL = ("polygon", "scatter")
"""Renderers that light leaves no farther than its circle of confusion."""


@dataclass(frozen=True)
class Part:
    """Insertion in one part of a frame; box None is the whole."""

    box: Box | None
    inserted: Inserted

    def over(self, rgb: Rgb) -> Rgb:
        """Return the frame with the part; other pixels stay bit for bit."""
        if self.box is None:
            return self.inserted.rgb
        result = rgb.copy()
        self.box.paste(self.inserted.rgb, result)
        return result

    def covered(self, alpha: Plane) -> Plane:
        """Return the frame's own alpha with the part; other pixels stay bit for bit."""
        if self.box is None:
            return coverage_with(alpha, self.inserted.virtual.alpha)
        result = alpha.copy()
        self.box.paste(coverage_with(self.box.cut(alpha, "edge"), self.inserted.virtual.alpha), result)
        return result

    def whole(self, rgb: Rgb) -> Inserted:
        """Return the insertion in the whole frame."""
        if self.box is None:
            return self.inserted
        photo_rgb = rgb.copy()
        self.box.paste(self.inserted.photo_rgb, photo_rgb)
        return Inserted(photo_rgb, self.box.placed(replace(self.inserted.virtual, extra={}), rgb.shape))


class BoxedInsertion:
    """Insertion that returns a Part. Give it the very same layers, depth and lens as long as they do not change."""

    def __init__(self, insertion: Insertion, renderer: Renderer, *, local: bool) -> None:
        """Set up an insertion. local: whether the renderer spreads light no farther than the circle of confusion."""
        self._insertion, self._renderer = insertion, renderer
        plain = insertion.insertion if isinstance(insertion, InDirtyRectangle) else insertion
        self._keeps = local and isinstance(plain, OverPhotograph)
        self._by_depth = isinstance(plain, OverPhotograph) and plain.by_depth
        self._box, self._cut = Kept(_reached_box), Kept(_cut_layers)
        self._hidden, self._blurred = Kept(_hidden_layers), Kept(self._blur)

    def insert(self, plate: Plate, layers: Sequence[Layer]) -> Part:
        if not (self._keeps and is_same_everywhere(plate.lens) and plate.near_alpha is None):
            return Part(None, self._insertion.insert(plate, layers, self._renderer))
        box = self._box(same_size(plate, layers), plate.lens)
        if box.is_empty:
            return Part(box, Inserted(plate.rgb[:0, :0], clear(0, 0)))
        visible = self._cut(layers, box)
        if self._by_depth and plate.depth_m is not None:
            visible = self._hidden(visible, plate.depth_m, box)
        virtual = self._blurred(visible, plate.lens, plate.rgb.shape[1])
        return Part(box, Inserted(behind(box.cut(plate.rgb, "edge"), virtual), virtual))

    def _blur(self, layers: Sequence[Layer], lens: Lens, frame_width_px: int) -> Layer:
        """Blur layers with the part of the sensor that sees the box, so that circles of confusion keep their size."""
        if not any(layer.alpha.any() or layer.rgb.any() for layer in layers):
            return flatten(layers)
        box = Box(0, layers[0].height_px, 0, layers[0].width_px)
        return self._renderer.render(layers, box.lens_of(lens, frame_width_px))


def _reached_box(layers: Sequence[Layer], lens: Lens) -> Box:
    """Return the box that light reaches within the frame, for the photograph is not blurred again."""
    if not layers:
        return NOWHERE
    blank = np.broadcast_to(np.float32(0.0), (*layers[0].alpha.shape, 3))
    return dirty_rectangle(plate_of(blank, lens), layers)


def _cut_layers(layers: Sequence[Layer], box: Box) -> list[Layer]:
    return [box.cut_layer(each) for each in layers]


def _hidden_layers(layers: Sequence[Layer], photo_depth_m: Plane, box: Box) -> list[Layer]:
    cut_m = box.cut(photo_depth_m, "edge")
    return [covered_by(layer, occlusion_matte(layer.depth_m, cut_m)) for layer in layers]


@dataclass(frozen=True)
class CompositeRecipe:
    """A MakerRecipe. first_number: what frame 0 of the clip is called by in sequences, tracks and focus pulls.

    lens: any, None is `Lens.default`; facts: by name, in place of the lens's own. focus: None leaves the lens as that has it.
    renderer: None is what the lens calls for (`mrbokeh.renderers.choose`).
    holding: of the camera, by which the lens is turned; None leaves it.
    near_m: how far what the matte shows is, where there is no depth. virtual_only: the blurred virtual layer alone, not the picture.
    """

    lens: Path | None
    layers: tuple[Description[LayerSource], ...]
    renderer: str | None = None
    mode: str = DEFAULT_MODE
    camera: Description[CameraSource] | None = None
    focus: Description[FocusSource] | None = None
    depth: Description[DepthSource] | None = None
    exact_depth: bool = False
    matte: Description[MatteSource] | None = None
    near_m: float | None = None
    look: Description[Finisher] | None = None
    first_number: int = 0
    virtual_only: bool = False
    holding: SensorOrientation | None = None
    facts: tuple[tuple[str, float], ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        described = (*self.layers, self.camera, self.focus, self.depth, self.matte, self.look)
        spread_by = [] if self.renderer is None or self.renderer in BY_NAME else [Path(self.renderer)]
        optics = [file for path in (self.lens, *spread_by) if path is not None for file in files_of(path)]
        return (*optics, *(path for each in described if each is not None for path in each.files))

    @property
    def stated_lens(self) -> Lens:
        """Lens of the file, or the default one, with the facts that were stated."""
        return (Lens.default() if self.lens is None else read_lens(self.lens)).stating(dict(self.facts))

    def build(self, threads: int) -> "CompositeMaker":
        return CompositeMaker(self, threads)


class CompositeMaker:
    """A FrameMaker. What did not change since the last frame is not made again: reading, rendering, cutting, blur."""

    def __init__(self, recipe: CompositeRecipe, threads: int) -> None:
        lens, self._told = recipe.stated_lens, False
        self._recipe, self._lens = recipe, lens if recipe.holding is None else lens_for_orientation(lens, recipe.holding)
        self._sources = [each.opened(threads) for each in recipe.layers]
        self._camera = None if recipe.camera is None else recipe.camera.opened(threads)
        self._focus = None if recipe.focus is None else recipe.focus.opened(threads)
        self._depth = None if recipe.depth is None else recipe.depth.opened(threads)
        self._matte = None if recipe.matte is None else recipe.matte.opened(threads)
        self._finisher = None if recipe.look is None else recipe.look.opened(threads)
        _, renderer = lens_and_renderer(recipe.lens, recipe.renderer, threads=threads)
        is_local = (recipe.renderer or DEFAULT) in _LOCAL and not spreads_light(recipe.lens)
        self._boxed = BoxedInsertion(insertion_of(recipe.mode, recipe.near_m, exact_depth=recipe.exact_depth), renderer, local=is_local)

    def make(self, index: int, rgb: Rgb, time_s: float, alpha: Plane | None = None) -> Picture:
        height, width = rgb.shape[:2]
        moment = Moment(self._recipe.first_number + index, time_s, (width, height))
        camera = None if self._camera is None else self._camera.camera_at(moment)
        plate = replace(self._plate(moment, rgb, camera), alpha=alpha)
        part = self._boxed.insert(plate, self._layers(moment))
        if self._finisher is None and not self._recipe.virtual_only:
            return part.over(rgb) if alpha is None else Rgba(part.over(rgb), part.covered(alpha))
        inserted = part.whole(rgb)
        if self._finisher is not None:
            inserted = self._finisher.finished(inserted, plate, moment.number)
        if self._recipe.virtual_only:
            return inserted.virtual
        return inserted.rgb if alpha is None else Rgba(inserted.rgb, coverage_with(alpha, inserted.virtual.alpha))

    def _layers(self, moment: Moment) -> Sequence[Layer]:
        return [layer for source in self._sources for layer in source.layers_at(moment, self._camera)]

    def _plate(self, moment: Moment, rgb: Rgb, camera: Camera | None) -> Plate:
        depth_m = None if self._depth is None else self._mended(self._depth.depth_m_at(moment), rgb)
        lens = self._lens_at(moment.number)
        plate = plate_of(rgb, lens, depth_m) if camera is None else Plate(rgb, depth_m, lens, camera)
        return plate if self._matte is None else replace(plate, near_alpha=self._matte.near_alpha_at(moment))

    def _mended(self, depth_m: Plane, rgb: Rgb) -> Plane:
        if self._recipe.exact_depth:
            return depth_m
        found = mended(depth_m, rgb)
        if found.told and not self._told:
            say(f"depth is mended by the picture, as in the first frame: {found.told} (--exact-depth leaves it as it is)", err=True)
        self._told = self._told or bool(found.told)
        return found.depth_m

    def _lens_at(self, number: int) -> Lens:
        """The very same lens as long as the focus stays."""
        focus_m = self._lens.focus_distance_m if self._focus is None else self._focus.at(number)
        if focus_m != self._lens.focus_distance_m:
            self._lens = self._lens.focused_at(focus_m)
        return self._lens
