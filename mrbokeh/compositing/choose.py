"""Ways of inserting layers into a photograph, by name; each works only in the dirty rectangle that virtual light can reach."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.between import COLOURS_REACH_PX, Between, Rerendered
from mrbokeh.compositing.near_and_far import shows, with_told_depth
from mrbokeh.compositing.over import OverPhotograph, SmoothedMatte
from mrbokeh.compositing.plate import Inserted, Insertion, Plate, same_size
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.layering.motion import farthest_px
from mrbokeh.layering.pixel_box import NOWHERE, Box, is_same_everywhere, lit_box
from mrbokeh.layering.psf_over_field import reach_px
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.bank.bank_lens import opening_of, reach_tables
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]

_SPARE_PX = 4
_WIDEST = 2.0
"""Largest circle of confusion, in diagonals of the picture: of what has a larger one a sixth of the light at most would be seen."""

DEFAULT_MODE = "over"


@dataclass(frozen=True)
class InDirtyRectangle:
    """An Insertion that lets another one work where light of the layers can arrive, and leaves the rest of the plate as it is.

    The result is that of the whole frame, but that near things which the frame cuts off go on beyond it. Where the blur depends on
    the place in the frame (tilt, cat-eyes, kernels over more than diameters, networks) the whole frame is taken. Rays through the pupil
    take the opening that stands for a bank's kernels.
    """

    insertion: Insertion

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        layers = [without_what_touches_the_lens(layer, plate) for layer in layers]
        bank = getattr(renderer, "bank", None)
        tables = None if bank is None else reach_tables(bank)
        if bank is not None:
            plate = replace(plate, lens=replace(plate.lens, aperture=opening_of(bank)))
        lit = _lit_boxes(same_size(plate, layers))
        if not lit:
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        plate = with_told_depth(plate, layers)
        known_reach = hasattr(renderer, "layering") and (bank is None or tables is not None)
        blurs_matte = plate.near_alpha is not None and getattr(self.insertion, "near_depth_m", None) is not None
        if not (is_same_everywhere(plate.lens) and known_reach) or (plate.depth_m is None and blurs_matte):
            return self.insertion.insert(plate, layers, renderer)
        box = _dirty_rectangle(plate, lit, tables)
        found = self.insertion.insert(_cut_plate(plate, box), [box.cut_layer(layer) for layer in layers], renderer)
        photo_rgb = plate.rgb.copy()
        box.paste(found.photo_rgb, photo_rgb)
        return Inserted(photo_rgb, box.placed(found.virtual, plate.rgb.shape))


def without_what_touches_the_lens(layer: Layer, plate: Plate) -> Layer:
    """Return the layer without what is so near that its light goes everywhere: it would take any amount of memory."""
    least_px = -_WIDEST * math.hypot(layer.width_px, layer.height_px)
    nearest_m = float(np.min(layer.depth_m, initial=np.inf, where=layer.alpha > 0.0))
    if nearest_m == np.inf or plate.lens.coc_px(nearest_m, layer.width_px) >= least_px:
        return layer
    touching = (layer.alpha > 0.0) & (plate.lens.coc_px(np.where(layer.alpha > 0.0, layer.depth_m, np.inf), layer.width_px) < least_px)
    clear = np.where(touching, np.float32(0.0), np.float32(1.0))
    extra = {name: values * clear[..., None] for name, values in layer.extra.items()}
    depth_m = np.where(touching, np.float32(np.inf), layer.depth_m)
    return Layer(layer.rgb * clear[..., None], layer.alpha * clear, depth_m, extra)


def dirty_rectangle(plate: Plate, layers: Sequence[Layer]) -> Box:
    """The box of all pixels that virtual light can reach, grown to all whose light mixes with it there; NOWHERE where there is none.

    For lenses whose blur is the same everywhere (`mrbokeh.layering.pixel_box.is_same_everywhere`).
    """
    lit = _lit_boxes(layers)
    return _dirty_rectangle(plate, lit) if lit else NOWHERE


def _lit_boxes(layers: Sequence[Layer]) -> list[tuple[Layer, Box]]:
    """The layers that show something, and where."""
    boxes = [(layer, lit_box(replace(layer, extra={}))) for layer in layers]
    return [(layer, box) for layer, box in boxes if shows(layer.rgb[box.where], layer.alpha[box.where]).any()]


def _dirty_rectangle(plate: Plate, lit: Sequence[tuple[Layer, Box]], tables: BankTables | None = None) -> Box:
    """Return the box. tables: of the bank that spreads the light in place of the lens's opening."""
    reached = [_reached(layer, box, plate.lens, tables) for layer, box in lit]
    arrival = Box(min(b.top for b in reached), max(b.bottom for b in reached), min(b.left for b in reached), max(b.right for b in reached))
    if plate.depth_m is None:
        return arrival.grown(0 if plate.near_alpha is None else COLOURS_REACH_PX).within(plate.rgb.shape)
    return _with_sources(arrival, plate.depth_m, plate.lens, tables)


def _reached(layer: Layer, box: Box, lens: Lens, tables: BankTables | None) -> Box:
    depth_m = box.of(layer.depth_m)[shows(box.of(layer.rgb), box.of(layer.alpha))]
    ends_px = _coc_ends_px(lens, depth_m, layer.width_px)
    reach = reach_px(lens.aperture, float(np.abs(ends_px).max())) if tables is None else tables.farthest_px(ends_px)
    return box.grown(reach + farthest_px([layer]) + _SPARE_PX)


def _coc_ends_px(lens: Lens, depth_m: np.ndarray, width_px: int) -> Float32[np.ndarray, "2"]:
    """The circles of confusion of the nearest and the farthest depth: all others lie between."""
    return np.asarray(lens.coc_px(np.array([depth_m.min(), depth_m.max()]), width_px), np.float32)


def _with_sources(arrival: Box, depth_m: Plane, lens: Lens, tables: BankTables | None) -> Box:
    """Grown to every photographed pixel whose own blur reaches into the box; beyond the frame as far as those reach."""
    height, width = depth_m.shape
    half, ends_px = 0.5 * lens.aperture.unit_radius, _coc_ends_px(lens, depth_m, width)
    most = int(half * float(np.abs(ends_px).max())) if tables is None else tables.farthest_px(ends_px)
    near_by = arrival.grown(most + 2 * _SPARE_PX).within(depth_m.shape)
    coc_px = np.asarray(lens.coc_px(near_by.of(depth_m), width), np.float32)
    half_px = half * np.abs(coc_px) if tables is None else tables.reaches_px[tables.cells(coc_px, Place())].astype(np.float32)
    half_px += np.float32(_SPARE_PX)
    rows, columns = np.arange(near_by.top, near_by.bottom), np.arange(near_by.left, near_by.right)
    down = np.maximum(np.maximum(arrival.top - rows, rows - arrival.bottom + 1), 0).astype(np.float32)
    along = np.maximum(np.maximum(arrival.left - columns, columns - arrival.right + 1), 0).astype(np.float32)
    sends = (half_px >= down[:, None]) & (half_px >= along[None, :])
    y, x = np.flatnonzero(sends.any(axis=1)), np.flatnonzero(sends.any(axis=0))
    if len(y) == 0:
        return arrival
    top, bottom = min(arrival.top, int(rows[y[0]])), max(arrival.bottom, int(rows[y[-1]]) + 1)
    left, right = min(arrival.left, int(columns[x[0]])), max(arrival.right, int(columns[x[-1]]) + 1)
    beyond = arrival.grown(int(np.ceil(half_px.max(initial=0.0, where=sends))))
    return Box(
        beyond.top if beyond.top < 0 else top,
        beyond.bottom if beyond.bottom > height else bottom,
        beyond.left if beyond.left < 0 else left,
        beyond.right if beyond.right > width else right,
    )


def _cut_plate(plate: Plate, box: Box) -> Plate:
    known = {"depth_m": plate.depth_m, "sharp_rgb": plate.sharp_rgb, "near_alpha": plate.near_alpha}
    cut = {name: box.cut(plane, "edge") for name, plane in known.items() if plane is not None}
    lens, camera = box.lens_of(plate.lens, plate.rgb.shape[1]), box.camera_of(plate.camera)
    return Plate(
        rgb=box.cut(plate.rgb, "edge"),
        depth_m=cut.get("depth_m"),
        lens=lens,
        camera=camera,
        sharp_rgb=cut.get("sharp_rgb"),
        near_alpha=cut.get("near_alpha"),
    )


MODES: dict[str, Insertion] = {
    "front": InDirtyRectangle(OverPhotograph(by_depth=False)),
    "over": InDirtyRectangle(OverPhotograph()),
    "matte": InDirtyRectangle(SmoothedMatte()),
    "between": InDirtyRectangle(Between()),
    "rerender": InDirtyRectangle(Rerendered()),
}
"""front: over everything. over: the sharp layers lose what the depth of the photograph hides, then they are blurred. matte: the same
with the paper's smoothed matte. between: behind the blurred near things of the photograph, before the rest. rerender: all-in-focus
picture and layers blurred together."""


def insertion_of(mode: str, near_m: float | None = None, *, exact_depth: bool = False) -> Insertion:
    """Return the insertion of a mode. Raises InputError if there is no mode of that name.

    near_m: distance of what a user's matte shows, for the mode between. exact_depth: edges stay where the depth has them.
    """
    if mode not in MODES:
        raise InputError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
    if near_m is not None and mode != "between":
        raise InputError(f"the distance of what the matte shows is for the mode between, got the mode {mode}: leave it out")
    if mode == "between":
        return InDirtyRectangle(Between(near_depth_m=near_m, refine_edges=not exact_depth))
    return InDirtyRectangle(Rerendered(refine_edges=not exact_depth)) if mode == "rerender" else MODES[mode]


def best_mode(plate: Plate) -> str:
    """Return the best mode that the known data of the plate allow."""
    return "front" if plate.near_alpha is None and plate.depth_m is None else "between"
