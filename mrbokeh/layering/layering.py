"""Layering: layers with depth become slices of the circle of confusion, and slices, blurred one by one, become a picture again.

Shared by all renderers that sum kernels; they differ in the `KernelSum` alone (mrbokeh.layering.psf_over_field).

Circles of confusion are diameters at which kernels are drawn (mrbokeh.optics.drawn_diameters) from here on.
1. Every layer is continued beyond the frame by the largest blur: the border of an opaque one outwards, one with holes not at all.
2. Layers are rendered one by one and laid over one another, but an opaque layer together with what is behind it, and
   layers that interleave in depth together; an opaque one is parted before and behind a single one listed before it.
3. Pixels are sorted into slices of equal steps of the signed circle of confusion, hard: a pixel shared between slices
   would let light through an opaque surface. Within a slice each pixel keeps its own circle of confusion.
4. Front to back, each slice takes what is still free of the pupil at every pixel, at most its own coverage. Slices of
   one surface share the pupil side by side, so coverage adds up and neither seams nor slanted surfaces turn
   translucent, as they would under "over". What the pinhole picture shows goes first. What hides there, real layers before filled-in
   background (mrbokeh.layering.hidden_background), gets what is left: the part of the pupil that looks past the edge of the occluder.
   But where the occluder is in front of the focus and what it hides behind it, that part of the pupil looks behind the edge, for
   kernels are mirrored at the focus: there what hides goes right before the rest of its slice.
5. What moves while the shutter is open is drawn out along its path, slice by slice, before it is spread (mrbokeh.layering.motion),
   unless the kernels hold motion themselves.
6. What is left unclaimed in the end is shared out by dividing by the coverage: everywhere if the scene is opaque, else where no ray
   gets past the outline of a layer. Coverage counts shares of the pupil as the place sees it: light that a lens or a medium loses
   darkens the colour once and leaves coverage alone (mrbokeh.layering.psf_over_field), so it is not made up for here, and what is
   behind does not shine through.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.layering.hidden_background import Mask, continued, enclosed_by, hidden_within, split_edges
from mrbokeh.layering.highlights import find_highlights
from mrbokeh.layering.padded_layers import PaddedLayer, Pixels, check_reach, coc_px_of, pad_layer
from mrbokeh.layering.psf_over_field import FIELD_CELLS, AperturePsf, Frame, KernelSum, PsfField
from mrbokeh.layering.pupil_views import Cut, Rims
from mrbokeh.layering.slices import Channels, Slicing, composited
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import ZeroedMemory, cores

_ONE_SURFACE_PX = 1.0
NOTHING_TAKEN = np.float32(1e-6)
_FULL = 1e-4
"""Less of the pupil unclaimed is rounding."""
_KEPT = ZeroedMemory(most_bytes=64 << 20)
"""From frame to frame, as long as these are not larger than about 1920x1080: fresh memory takes a tenth of a small frame's time."""


@dataclass(frozen=True)
class Layering:
    """Settings of how layers are cut and put together.

    slices: how many at most over the whole range of circles of confusion. fill: whether surfaces are continued behind what is nearer in
    their layer. field_cells: columns and rows in which the aperture is taken as the same (cat-eyes). sees_rims: whether rims are seen from
    points of the pupil (mrbokeh.layering.pupil_views).
    """

    slices: int = 16
    fill: bool = True
    field_cells: tuple[int, int] = FIELD_CELLS
    sees_rims: bool = True


def render_layers(layers: Sequence[Layer], lens: Lens, kernel_sum: KernelSum | PsfField, layering: Layering) -> Layer:
    """Return the layers, front first, as the lens sees them; see Renderer. The depth returned is the sharp one, front first.

    kernel_sum: how kernels of the lens's aperture are summed, or a PsfField that takes the aperture's place.
    """
    _check(layers)
    psf = kernel_sum if isinstance(kernel_sum, PsfField) else AperturePsf.of(layers, lens.aperture, kernel_sum, layering.field_cells)
    coc_px = [psf.drawn_px(coc_px_of(layer, lens)) for layer in layers]
    margin = psf.margin_px(layers, coc_px)
    check_reach(layers, coc_px, margin)
    frame = Frame(layers[0].width_px, layers[0].height_px, -margin, -margin)
    with ThreadPoolExecutor(cores()) as pool:
        slicing = Slicing(psf=psf, slices=layering.slices, frame=frame, pool=pool, memory=_KEPT)
        groups = _groups([pad_layer(layer, each, margin, pool) for layer, each in zip(layers, coc_px, strict=True)])
        cuts = [cut for group in groups for cut in _cuts(group, layering, pool)]
        rims = _rims(cuts, psf, frame) if layering.sees_rims and layering.fill else None
        lights = rims.take_lights() if rims and isinstance(psf, AperturePsf) else []  # a bank has kernels of its own
        found: tuple[Channels, Channels] | None = None
        for cut in reversed(cuts):
            front = composited(cut.surfaces, slicing, by_depth=not cut.is_opaque)
            front = _shared_out(*front) if any(layer.is_opaque for layer in cut.layers) else _shared_out_inside(*front, cut.layers, slicing)
            found = front if found is None else _over(*front, *found)
        if rims and found is not None:
            rims.correct(found[0], pool)
            rims.put_lights(found[0], lights, pool)
    assert found is not None, "there is a layer"
    return _as_layer(*found, layers)


def _cuts(group: Sequence[PaddedLayer], layering: Layering, pool: Executor) -> Iterator[Cut]:
    """Yield what is laid over one another of layers that must be rendered together, front first."""
    lights = [find_highlights(layer.values) for layer in group] if layering.sees_rims else []
    if layering.fill and group[0].is_opaque:
        yield Cut(group, _with_hidden(group, pool), lights)
    elif layering.fill and layering.sees_rims and len(group) == 2 and group[1].is_opaque:
        yield from _parted(group, lights, pool)
    else:
        hidden = [each for layer in group if layering.fill for each in hidden_within(layer, pool)]
        yield Cut(group, [*(Pixels.covered(layer) for layer in group), *hidden], lights)


def _parted(group: Sequence[PaddedLayer], lights: Sequence[Mask], pool: Executor) -> Iterator[Cut]:
    """Yield what of an opaque picture is nearer than a layer listed before it, that layer, and the rest of the picture."""
    before, picture = group
    covered = before.values[..., 3] > 0
    virtual_px = continued(before.coc_px, covered)
    front, behind = split_edges(picture, pool)
    values, coc_px = front.values.reshape(picture.values.shape), front.coc_px.reshape(picture.coc_px.shape)
    is_near = coc_px < virtual_px - _ONE_SURFACE_PX
    if is_near.any():
        near = PaddedLayer(np.where(is_near[..., None], values, np.float32(0.0)), coc_px, False)
        behind_is_near = behind.coc_px < virtual_px.reshape(-1)[behind.places] - _ONE_SURFACE_PX
        yield Cut([near], [Pixels.covered(near), behind.only(behind_is_near)], [lights[-1] & is_near])
        behind = behind.only(~behind_is_near)
    yield Cut([before], [Pixels.covered(before), *hidden_within(before, pool)], lights[:1])
    far = PaddedLayer(np.where(is_near[..., None], np.float32(0.0), values), coc_px, True)
    yield Cut([far], [Pixels.of(far), behind], [lights[-1] & ~is_near])


def _rims(cuts: Sequence[Cut], psf: PsfField, frame: Frame) -> Rims | None:
    """Return the rims of a scene without holes, if it has any and rays through the lens can be followed."""
    opening = psf.opening
    if opening is None or not cuts[-1].is_opaque:
        return None
    rims = Rims.of(cuts, opening, frame)
    return rims if rims.tiles.any() else None


def _check(layers: Sequence[Layer]) -> None:
    if not layers:
        raise InputError("nothing to render: expected at least one layer, got none")
    sizes = {layer.alpha.shape for layer in layers}
    if len(sizes) > 1:
        raise InputError(f"layers must be of one size, but came as {sorted((w, h) for h, w in sizes)} (width, height): resize them")
    names = {tuple((name, values.shape[2]) for name, values in layer.extra.items()) for layer in layers}
    if len(names) > 1:
        raise InputError(f"layers must have the same extra channels in the same order, but came with {sorted(names)}")


def _groups(layers: Sequence[PaddedLayer]) -> list[list[PaddedLayer]]:
    """Return the layers that must be rendered together, front first."""
    groups = [[layers[0]]]
    for layer in layers[1:]:
        if any(front.is_opaque or _interleave(front, layer) for front in groups[-1]):
            groups[-1].append(layer)
        else:
            groups.append([layer])
    return groups


def _interleave(front: PaddedLayer, behind: PaddedLayer) -> bool:
    """Return whether a layer listed before another lies behind it anywhere."""
    both = (front.values[..., 3] > 0) & (behind.values[..., 3] > 0)
    return bool((both & (front.coc_px > behind.coc_px + _ONE_SURFACE_PX)).any())


def _with_hidden(group: Sequence[PaddedLayer], pool: Executor) -> list[Pixels]:
    """Return an opaque layer with its edges split, what is known to lie behind it, and last the fill where nothing is known."""
    known = [Pixels.covered(layer, layer.coc_px > group[0].coc_px + _ONE_SURFACE_PX) for layer in group[1:]]
    front, behind = split_edges(group[0], pool)
    if not known:
        return [front, behind]
    of_rim = front.values[behind.places, 3] < 1.0
    rest, filled = behind.only(of_rim), behind.only(~of_rim)
    free = np.ones(front.coc_px.size, np.float32)
    for layer in known:
        free[layer.places] *= 1.0 - layer.values[:, 3]
    return [front, rest, *known, replace(filled, values=filled.values * free[filled.places, None])]


def _shared_out(colour: Channels, taken: Channels) -> tuple[Channels, Channels]:
    """Return the colour of a scene without holes: the unclaimed pupil belongs to those who claimed."""
    from mrbokeh.layering._slices_numba import share_out

    share_out(colour, taken, NOTHING_TAKEN)
    return colour, taken


def _shared_out_inside(colour: Channels, taken: Channels, layers: Sequence[PaddedLayer], slicing: Slicing) -> tuple[Channels, Channels]:
    """Return the colour of layers with holes: where nothing gets past their outlines, the unclaimed pupil belongs to those who claimed.

    Steps of depth too small to be edges, and specks, would be lines and dots of what is behind.
    """
    frame = slicing.frame
    inside = np.s_[-frame.top_px : frame.height_px - frame.top_px, -frame.left_px : frame.width_px - frame.left_px]
    is_open = taken.min(axis=2) < 1.0 - _FULL
    wholes = [(layer.values[..., 3] >= 1.0, layer.coc_px) for layer in layers]
    wholes = [(whole, coc_px) for whole, coc_px in wholes if (whole[inside] & is_open).any()]
    if not wholes:
        return colour, taken
    # A bank tells how far light travels from the pixels themselves; none of them sends it farther than the margin.
    reach_px = partial(slicing.psf.reach_px, (), frame=frame) if isinstance(slicing.psf, AperturePsf) else lambda _: -frame.top_px
    # By one of them alone: the outline of one that another hides is still an outline.
    enclosed = np.flatnonzero(is_open & np.logical_or.reduce([enclosed_by(*each, reach_px)[inside] for each in wholes]))
    flat, shares = colour.reshape(-1, colour.shape[2]), taken.reshape(-1, taken.shape[2])
    claimed = np.maximum(shares[enclosed], NOTHING_TAKEN)
    flat[enclosed] /= claimed[:, _kinds(colour, taken)]
    shares[enclosed] = np.where(shares[enclosed] > NOTHING_TAKEN, np.float32(1.0), shares[enclosed])
    return colour, taken


def _over(front: Channels, front_taken: Channels, behind: Channels, behind_taken: Channels) -> tuple[Channels, Channels]:
    free = 1.0 - front_taken
    return front + free[..., _kinds(front, front_taken)] * behind, front_taken + free * behind_taken


def _kinds(colour: Channels, taken: Channels) -> list[int]:
    """Return the channel of `taken` that goes with each channel of colour: its own, or green's for extra channels."""
    kinds = taken.shape[2]
    return [min(c, kinds - 1) if c < 3 else kinds // 2 for c in range(colour.shape[2])]


def _as_layer(colour: Channels, taken: Channels, layers: Sequence[Layer]) -> Layer:
    depth_m = layers[-1].depth_m
    for layer in reversed(layers[:-1]):
        depth_m = np.where(layer.alpha > 0, layer.depth_m, depth_m)
    alpha = taken[..., 0] if taken.shape[2] == 1 else taken.mean(axis=2)
    extra, start = {}, 3
    for name, values in layers[0].extra.items():
        extra[name] = np.ascontiguousarray(colour[..., start : start + values.shape[2]])
        start += values.shape[2]
    return Layer(np.ascontiguousarray(colour[..., :3]), np.ascontiguousarray(alpha), depth_m, extra)
