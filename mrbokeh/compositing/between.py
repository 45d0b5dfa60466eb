"""Virtual layers between the blurred layers of a photograph: behind what is near in it, before the rest.

What is near in the photograph is blurred there, so its coverage is soft and its colour mixed with what is behind. The sharp scene is
cut in two at the depth of the virtual surface (mrbokeh.compositing.near_and_far), and the near part is blurred anew by the lens,
focused as it was for the photograph. That tells how much of every pixel of the photograph is near light (a F) and how much far light
((1 - a) B). The far light alone is dimmed, by the share of it that the virtual surface hides; near light stays; the virtual light that
gets past the near things is added. So the photograph's own pixels are used, errors of blurring anew matter only at the edges of what is
hidden, and pixels that no virtual light reaches stay as they are, bit for bit.

Rays tell which part of the pupil each of the three takes (mrbokeh.compositing.pupil_shares): coverages multiplied would be right only
if near and virtual edges crossed the pupil independently, which those of one pixel do not.

Highlights are followed ray by ray: at every place of its blur a highlight is seen through one point of the pupil, which is hidden or
not. Few rays per pixel would miss it, and a blurred coverage would dim its whole disc where the truth cuts it. Only highlights whose
discs reach a pixel that is asked for are followed.

Under a user's matte, without a sharp scene, picture = alpha F + (1 - alpha) B is solved for F and B (Forte, Approximate Fast Foreground
Colour Estimation, ICIP 2021): both are local means, then the rest of the mixture is given to them; a coarse round finds the colours, a
fine one their detail. Where nothing tells how far away it is, the matte is taken as the photograph shows it, blurred already.

Rerendered is the simpler way: the all-in-focus picture with its depth and the virtual layers are blurred in one go.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from mrbokeh.compositing.edge_refinement import with_refined_edges
from mrbokeh.compositing.near_and_far import (
    NO_HIGHLIGHTS,
    TOLERANCE,
    Highlights,
    NearAndFar,
    cut_in_two,
    nearer_than,
    reach_px,
    shows_anything,
    virtual_depth_m,
    with_told_depth,
)
from mrbokeh.compositing.plate import Inserted, Plate, same_size
from mrbokeh.compositing.pupil_shares import PupilMeans, Rays
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.layering.hidden_background import continued
from mrbokeh.layering.highlights import find_highlights
from mrbokeh.optics.pupil_points import pupil_points
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

_LEAST_POINTS, _MOST_POINTS = 64, 16384
_POINTS_PER_PX = 4.0
_DISC_POINTS, _LEAST_DISC_PX, _MOST_GAIN, _LEAST_SUM = 256, 1.5, 50.0, 1e-6

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

LEAST_LIGHT = np.float32(1e-5)
"""Less coverage or light than this is rounding of the renderer, not light of a layer."""
_ALL = 1e-4
_MOST_NEAR = 0.995
_ROUND = 1e-9
_LEAST_COVERED = np.float32(0.02)
_NOISE = 0.01
"""Light below 0 that noise of a camera explains."""
_MOST_CHANGE, _LEAST_PART = 3.0, 0.02
_UNEXPLAINED = 0.5
_HARDLY_FREE = (0.02, 0.12)
Colours = Float32[np.ndarray, "places 3"]
Shares = Float32[np.ndarray, " places"]
Exact = Float64[np.ndarray, " places"]
ExactColours = Float64[np.ndarray, "places 3"]
Places = Int64[np.ndarray, " places"]


@dataclass(frozen=True)
class HighlightsThrough:
    """Light of highlights (H, W, 3) as it arrives past one layer, and past that and another."""

    one: Float32[np.ndarray, "height width 3"]
    both: Float32[np.ndarray, "height width 3"]


def put_together(plate: Plate, near: Layer, blurred: Layer, rays: Rays) -> Inserted:
    """The picture, from what near and virtual light do by themselves."""
    arrives = (blurred.alpha > LEAST_LIGHT) | (np.abs(blurred.rgb).max(axis=2) > LEAST_LIGHT)
    alone = arrives & (near.alpha <= _ALL)
    simple = alone & ((blurred.alpha >= 1.0 - _ALL) | rays.one_far_colour)
    virtual_rgb = np.where(simple[..., None], np.maximum(blurred.rgb, 0.0), np.float32(0.0))
    virtual_alpha = np.where(simple, np.maximum(blurred.alpha, 0.0), np.float32(0.0))
    hides = np.where(virtual_alpha > LEAST_LIGHT, np.minimum(virtual_alpha, 1.0), np.float32(0.0))
    photo_rgb = (np.float32(1.0) - hides)[..., None] * plate.rgb
    places = np.flatnonzero(arrives & ~simple & (_least_around(near.alpha) < 1.0 - _ALL))
    at = np.unravel_index(places, blurred.alpha.shape)
    photo_rgb[at], virtual_rgb[at], virtual_alpha[at] = _shared(plate.rgb[at], near, blurred, rays, places)
    seen = np.divide(virtual_alpha, blurred.alpha, out=np.zeros_like(virtual_alpha), where=blurred.alpha > LEAST_LIGHT)
    extra = {name: values * seen[..., None] for name, values in blurred.extra.items()}
    return Inserted(photo_rgb, Layer(virtual_rgb, virtual_alpha, blurred.depth_m, extra))


def _shared(photo_rgb: Colours, near: Layer, blurred: Layer, rays: Rays, places: Places) -> tuple[Colours, Colours, Shares]:
    """Return (photograph left, virtual light, its share of the pupil) at places that may see near, virtual and far."""
    means = rays.means(places)
    near_share = np.minimum(near.alpha.reshape(-1)[places].astype(np.float64), _MOST_NEAR)
    covered = np.clip(blurred.alpha.reshape(-1)[places].astype(np.float64), 0.0, 1.0)
    free = 1.0 - near_share
    share = np.clip(free * covered + means.f_a - means.f * means.a, np.maximum(covered - near_share, 0.0), np.minimum(covered, free))
    light = _virtual_light(blurred, rays, places, means, free)
    far, stays = _far_light(photo_rgb, near, rays, places, means, free, share)
    hidden = (share <= LEAST_LIGHT)[:, None]
    left = np.where(hidden, photo_rgb, photo_rgb - far * (1.0 - stays))
    light = np.where(hidden & (covered > LEAST_LIGHT)[:, None], 0.0, np.maximum(light, 0.0))
    return left.astype(np.float32), light.astype(np.float32), share.astype(np.float32)


def _virtual_light(blurred: Layer, rays: Rays, places: Places, means: PupilMeans, free: Exact) -> ExactColours:
    """Return the virtual light past the near things: surfaces by their part of the pupil and the covariance, highlights one by one."""
    wanted = np.zeros(blurred.alpha.shape, np.bool_)
    wanted.reshape(-1)[places] = True
    own = virtual_highlights(rays, wanted)
    alone, past = own.one.reshape(-1, 3)[places], own.both.reshape(-1, 3)[places]
    surfaces = free[:, None] * (blurred.rgb.reshape(-1, 3)[places] - alone)
    return surfaces + means.f_virtual - means.f[:, None] * means.virtual + past


def _far_light(
    photo_rgb: Colours, near: Layer, rays: Rays, places: Places, means: PupilMeans, free: Exact, share: Exact
) -> tuple[ExactColours, ExactColours]:
    """Return (far light in the photograph, the part of it that the virtual surface leaves visible)."""
    near_rgb = near.rgb.reshape(-1, 3)[places]
    surfaces = means.f_far * (free / np.maximum(means.f, _ROUND))[:, None]
    left_over = np.full_like(near.alpha, np.nan)
    left_over.reshape(-1)[places] = (photo_rgb - near_rgb - surfaces).astype(np.float32).sum(axis=1)
    bright = far_highlights(rays, left_over)
    before, after = bright.one.reshape(-1, 3)[places], bright.both.reshape(-1, 3)[places]
    stays = np.clip((1.0 - share / free)[:, None] * _colour_change(means), 0.0, 1.0)
    far = surfaces + before
    # Where hardly anything gets past the near, its share is rounding: a faint shadow would take all that the near does not explain.
    least = 1.0 - np.minimum(rays.most_covering.reshape(-1)[places], 1.0)[:, None]
    return _explained(photo_rgb, near_rgb, far, free), np.clip((surfaces * stays + after) / np.maximum(far, _ROUND), least, 1.0)


def _least_around(alpha: Plane) -> Plane:
    """The least of 3x3 pixels: beside a rim a photograph may show more of what is behind than the sharp picture says."""
    from cv2 import erode

    return np.asarray(erode(alpha, np.ones((3, 3), np.uint8)), np.float32)


def _colour_change(means: PupilMeans) -> Colours:
    """Mean far colour in the part of the pupil that looks past near and virtual, over that past the near alone."""
    change = means.past_far * means.f[:, None] / np.maximum(means.f_far * means.past[:, None], _ROUND)
    enough = (means.past > _LEAST_PART)[:, None]
    return np.where(enough, np.clip(change, 1.0 / _MOST_CHANGE, _MOST_CHANGE), np.float32(1.0))


def _explained(photo_rgb: Colours, near_rgb: Colours, far_rgb: ExactColours, free: Exact) -> ExactColours:
    """Return the far light of the photograph: what was blurred anew, and its share, by the squares of both, of what that leaves over.

    Much that is left over is far light, but hardly where next to nothing of the pupil looks past the near things: there it is theirs, as
    their sharp picture may lie beside them (letters on a post, photographed from the hand, were torn to pieces).
    """
    left_over = photo_rgb - near_rgb - far_rgb
    far_share = far_rgb**2 / np.maximum(far_rgb**2 + near_rgb**2, _ROUND)
    past = np.clip((free - _HARDLY_FREE[0]) / (_HARDLY_FREE[1] - _HARDLY_FREE[0]), 0.0, 1.0)[:, None]
    far_share = np.where(left_over > _UNEXPLAINED * (near_rgb + far_rgb), past, past * far_share)
    return np.clip(far_rgb + left_over * far_share, 0.0, np.maximum(photo_rgb, 0.0))


def far_highlights(rays: Rays, left_over: Plane) -> HighlightsThrough:
    """Follow far highlights past the near things, and past near and virtual ones, to pixels with a number in `left_over`.

    left_over: light of the photograph (r + g + b) that surfaces do not explain, NaN where unknown. A highlight that the sharp picture
    shows half hidden or clipped gets the brightness of its disc there.
    """
    first, second = (rays.scene.near.alpha, rays.coc_px[0]), (rays.virtual.alpha, rays.coc_px[1])
    bright = _arriving(rays, rays.scene.highlights, rays.coc_px[2], np.isfinite(left_over))
    dim = _followed(rays, bright, rays.coc_px[2], first, second)
    if len(bright.places) == 0:
        return dim
    brighter = _gains(rays, bright, left_over / np.maximum(dim.one.sum(axis=2), _LEAST_SUM))
    return _followed(rays, replace(bright, rgb=bright.rgb * brighter[:, None]), rays.coc_px[2], first, second)


def _arriving(rays: Rays, bright: Highlights, coc_px: Plane, wanted: Mask) -> Highlights:
    """Return the highlights whose discs reach a wanted pixel, or one beside it."""
    from cv2 import integral

    (height, width), (rows, columns) = wanted.shape, np.unravel_index(bright.places, wanted.shape)
    farthest = max((aperture.unit_radius for _, aperture in rays.cells(bright.places)), default=0.0)
    half_px = np.ceil(0.5 * farthest * np.abs(coc_px[rows, columns])).astype(int) + 1
    counts = integral(wanted.astype(np.uint8))
    top, bottom = np.maximum(rows - half_px, 0), np.minimum(rows + half_px + 1, height)
    left, right = np.maximum(columns - half_px, 0), np.minimum(columns + half_px + 1, width)
    kept = counts[bottom, right] - counts[top, right] - counts[bottom, left] + counts[top, left] > 0
    return Highlights(bright.places[kept], bright.rgb[kept], bright.depth_m[kept])


def _gains(rays: Rays, bright: Highlights, ratio: Plane) -> Float32[np.ndarray, " highlights"]:
    """Return the median, over each highlight's disc, of the ratio of the light there to the light that it gives."""
    height, width = ratio.shape
    gains = np.ones(len(bright.places), np.float32)
    for which, aperture in rays.cells(bright.places):
        xy = pupil_points(aperture, _DISC_POINTS)[:, :2]
        for index in which:
            row, column = divmod(int(bright.places[index]), width)
            centre_px, half_px = np.array([column + 0.5, row + 0.5]), 0.5 * float(rays.coc_px[2, row, column])
            x, y = np.floor(centre_px + xy * half_px).astype(int).T
            seen = ratio[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
            known = np.isfinite(seen)
            if abs(half_px) >= _LEAST_DISC_PX and known.sum() >= _DISC_POINTS // 8:
                gains[index] = np.clip(np.median(seen[known]), 1.0 / _MOST_GAIN, _MOST_GAIN)
    return gains


def virtual_highlights(rays: Rays, wanted: Mask) -> HighlightsThrough:
    """Follow the virtual layer's highlights as if nothing hid them, and past the near things, to wanted pixels."""
    places = np.flatnonzero(find_highlights(rays.virtual_rgba))
    whole, dark = (each.reshape(-1, 4)[places, :3] for each in (rays.virtual_rgba, rays.virtual_without_highlights))
    bright = _arriving(rays, Highlights(places, whole - dark, np.zeros(len(places), np.float32)), rays.coc_px[1], wanted)
    nothing = (np.zeros_like(rays.virtual.alpha), rays.coc_px[0])
    return _followed(rays, bright, rays.coc_px[1], nothing, (rays.scene.near.alpha, rays.coc_px[0]))


def _followed(rays: Rays, bright: Highlights, coc_px: Plane, first: tuple[Plane, Plane], second: tuple[Plane, Plane]) -> HighlightsThrough:
    from mrbokeh.compositing._between_numba import follow

    width = coc_px.shape[1]
    one, both = np.zeros((*coc_px.shape, 3), np.float32), np.zeros((*coc_px.shape, 3), np.float32)
    for which, aperture in rays.cells(bright.places):
        pupil = pupil_points(aperture, _MOST_POINTS)
        for place, rgb in zip(bright.places[which], bright.rgb[which], strict=True):
            row, column = divmod(int(place), width)
            light_coc_px = float(coc_px[row, column])
            count = int(np.clip(_POINTS_PER_PX * light_coc_px**2, _LEAST_POINTS, _MOST_POINTS))
            light = (row, column, light_coc_px, float(rgb[0]), float(rgb[1]), float(rgb[2]))
            follow(one, both, light, *first, *second, pupil[:count])
    return HighlightsThrough(one, both)


_ROUNDS_PX = (91, 7)
COLOURS_REACH_PX = sum(size_px // 2 for size_px in _ROUNDS_PX)
"""How far around a pixel colours count for those under a matte."""
_LEAST = np.float32(1e-5)

Picture = Float32[np.ndarray, "height width 3"]

_HALF = 0.5


@dataclass(frozen=True)
class Between:
    """Insertion between the near and far parts of the photograph; any Renderer will do.

    tolerance: share of its depth by which a photographed surface must be nearer to hide the virtual one (see occlusion_matte).
    pupil_points: rays per pixel where near and virtual edges meet. near_depth_m: distance of what a user's matte (Plate.near_alpha)
    holds, which is sharp then; without it and without depth the matte is as the photograph shows it. refine_edges: move edges of near
    things to where the photograph shows them
    (mrbokeh.compositing.edge_refinement); False if the depth is exact there. Only the kernels' shares of the pupil are taken from the
    opening of the plate's lens.
    """

    tolerance: float = TOLERANCE
    pupil_points: int = 64
    near_depth_m: float | None = None
    refine_edges: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        if not any(shows_anything(layer) for layer in layers):
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        lift = _Lift.of(plate, layers)
        return lift.taken_back(self._inserted(lift.plate(plate), [lift.layer(each) for each in layers], renderer), plate)

    def _inserted(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        sharp = flatten([replace(layer, extra={}) for layer in layers])
        depth_m = virtual_depth_m(sharp)
        blurred = renderer.render(layers, plate.lens)
        plate = with_told_depth(plate, layers)
        known, matte = plate, self._matte(plate, depth_m)
        if self.near_depth_m is None and plate.depth_m is None:
            return _under_shown_matte(plate, matte, blurred)
        if self.refine_edges:
            known, matte = with_refined_edges(plate, matte, renderer, self.tolerance)
        near_m = self._near_depth_m(known, matte)
        if plate.sharp_rgb is None:
            white = Layer(np.repeat(matte[..., None], 3, axis=2), matte, near_m)
            scene, near = _without_sharp_picture(known, white, renderer)
        else:
            scene = self._cut(known, matte, near_m)
            near = renderer.render([scene.near], plate.lens) if scene.near.alpha.any() else clear(*matte.shape)
        return put_together(plate, near, blurred, Rays.of(scene, sharp, depth_m, plate.lens, self.pupil_points))

    def cut(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> NearAndFar:
        """The sharp scene of a plate cut in two by the layers, one of which shows something."""
        depth_m = virtual_depth_m(flatten([replace(layer, extra={}) for layer in layers]))
        plate = with_told_depth(plate, layers)
        if plate.sharp_rgb is None:
            raise InputError("to cut the scene in two its all-in-focus picture is needed: give a focal stack")
        matte = self._matte(plate, depth_m)
        if self.refine_edges:
            plate, matte = with_refined_edges(plate, matte, renderer, self.tolerance)
        return self._cut(plate, matte, self._near_depth_m(plate, matte))

    def _matte(self, plate: Plate, depth_m: Plane) -> Plane:
        """Return the matte of what is near: the user's, else by depth."""
        if plate.near_alpha is not None:
            return np.nan_to_num(plate.near_alpha, nan=0.0)
        if plate.depth_m is None:
            raise InputError(
                "to put objects between the layers of a photograph it needs depth (a focal stack or --depth) or a matte of what "
                "is near: give one, or use the mode front"
            )
        return nearer_than(plate.depth_m, depth_m, self.tolerance).astype(np.float32)

    def _near_depth_m(self, plate: Plate, matte: Plane) -> Plane:
        """Depth of the near things, continued to all places."""
        if self.near_depth_m is not None:
            return np.full_like(matte, self.near_depth_m)
        if plate.depth_m is None:
            raise InputError("a matte of what is near needs its distance here: give depth, or the distance in metres (near_depth_m)")
        return continued(plate.depth_m, matte > _HALF)

    def _cut(self, plate: Plate, matte: Plane, near_m: Plane) -> NearAndFar:
        """Cut the sharp scene in two. near_m: depth of what a user's matte holds."""
        assert plate.sharp_rgb is not None
        if plate.near_alpha is None and plate.depth_m is not None:
            near = matte > _HALF
            return cut_in_two(plate.sharp_rgb, plate.depth_m, near, reach_px(plate.lens, plate.depth_m, near), self.tolerance)
        front, behind = clean_colours(plate.sharp_rgb, matte)
        far_m = None if plate.depth_m is None else continued(plate.depth_m, matte <= _HALF)
        return NearAndFar(Layer(front * matte[..., None], matte, near_m), behind, far_m, NO_HIGHLIGHTS)


@dataclass(frozen=True)
class Rerendered:
    """Insertion that blurs all anew: reached by virtual light, a pixel is taken from the new picture, else from the photograph.

    Simpler than `Between` and the same for any lens, but touched pixels show how well the picture is blurred anew, and coverages of
    near and virtual edges are multiplied. tolerance, refine_edges: see `Between`.
    """

    tolerance: float = TOLERANCE
    refine_edges: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        if plate.sharp_rgb is None or plate.depth_m is None:
            raise InputError(
                "to blur a photograph anew its all-in-focus picture and depth are needed: give a focal stack, or use the mode over"
            )
        if not any(shows_anything(layer) for layer in layers):
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        lift = _Lift.of(plate, layers)
        return lift.taken_back(self._inserted(lift.plate(plate), [lift.layer(each) for each in layers], renderer), plate)

    def _inserted(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        scene = Between(self.tolerance, refine_edges=self.refine_edges).cut(plate, layers, renderer)
        near = [scene.near] if scene.near.alpha.any() else []
        picture = renderer.render([*near, *layers, scene.far], plate.lens)
        virtual = renderer.render(layers, plate.lens)
        free = 1.0 - renderer.render(near, plate.lens).alpha if near else np.ones_like(virtual.alpha)
        seen = Layer(virtual.rgb * free[..., None], virtual.alpha * free, virtual.depth_m)
        touched = (seen.alpha > LEAST_LIGHT) | (np.abs(seen.rgb).max(axis=2) > LEAST_LIGHT)
        left = np.where(touched[..., None], np.maximum(picture.rgb - seen.rgb, 0.0), plate.rgb)
        return Inserted(left, Layer(seen.rgb * touched[..., None], seen.alpha * touched, seen.depth_m))


@dataclass(frozen=True, eq=False)
class _Lift:
    """Light (3,) that is added everywhere while colours are parted, which takes light for what is not below 0.

    Colours of a wider gamut than Rec.709 are. What covers all of a pixel has all of it, what covers a part its part, so that it leaves
    again with no trace.
    """

    rgb: Float32[np.ndarray, "3"]

    @classmethod
    def of(cls, plate: Plate, layers: Sequence[Layer]) -> "_Lift":
        pictures = [plate.rgb, *(() if plate.sharp_rgb is None else (plate.sharp_rgb,))]
        for layer in layers:
            pictures.append(layer.rgb / np.maximum(layer.alpha, _LEAST_COVERED)[..., None])
        lowest = np.min([np.where(np.isfinite(picture), picture, 0.0).min(axis=(0, 1)) for picture in pictures], axis=0)
        return cls(np.where(lowest < -_NOISE, -lowest, 0.0).astype(np.float32))

    def plate(self, plate: Plate) -> Plate:
        if not self.rgb.any():
            return plate
        return replace(plate, rgb=plate.rgb + self.rgb, sharp_rgb=None if plate.sharp_rgb is None else plate.sharp_rgb + self.rgb)

    def layer(self, layer: Layer) -> Layer:
        return replace(layer, rgb=layer.rgb + layer.alpha[..., None] * self.rgb) if self.rgb.any() else layer

    def taken_back(self, found: Inserted, plate: Plate) -> Inserted:
        if not self.rgb.any():
            return found
        alpha = found.virtual.alpha[..., None]
        left = np.where(found.photo_rgb == plate.rgb + self.rgb, plate.rgb, found.photo_rgb - (np.float32(1.0) - alpha) * self.rgb)
        return Inserted(left, replace(found.virtual, rgb=found.virtual.rgb - alpha * self.rgb))


def clean_colours(picture: Picture, alpha: Plane) -> tuple[Picture, Picture]:
    """Return (F, B): colours of what the matte (0 to 1) holds and of the rest, unpremultiplied, not below 0; both continue everywhere."""
    front, behind = picture, picture
    share = alpha[..., None]
    for size_px in _ROUNDS_PX:
        front, behind = _mean(front, alpha, size_px), _mean(behind, np.float32(1.0) - alpha, size_px)
        left_over = picture - share * front - (1.0 - share) * behind
        front, behind = np.maximum(front + share * left_over, 0.0), np.maximum(behind + (1.0 - share) * left_over, 0.0)
    return front, behind


def _mean(picture: Picture, weight: Plane, size_px: int) -> Picture:
    from cv2 import blur

    total = blur(weight, (size_px, size_px))
    return blur(picture * weight[..., None], (size_px, size_px)) / (total + _LEAST)[..., None]


def _under_shown_matte(plate: Plate, matte: Plane, blurred: Layer) -> Inserted:
    """Put blurred layers behind what a matte holds that is as soft as the photograph shows it."""
    _front, behind = clean_colours(plate.rgb, matte)
    past, covered = (np.float32(1.0) - matte)[..., None], np.clip(blurred.alpha, 0.0, 1.0)[..., None]
    # Where the matte is 0 the photograph's own numbers are all far light.
    far = np.where(past < 1.0, np.clip(past * behind, 0.0, np.maximum(plate.rgb, 0.0)), plate.rgb)
    extra = {name: values * past for name, values in blurred.extra.items()}
    virtual = Layer(blurred.rgb * past, blurred.alpha * past[..., 0], blurred.depth_m, extra)
    return Inserted(plate.rgb - far * covered, virtual)


def _without_sharp_picture(plate: Plate, white: Layer, renderer: Renderer) -> tuple[NearAndFar, Layer]:
    """Cut the scene by the photograph and a matte alone: the lens blurs the matte, and the photograph is solved for both colours under
    it.
    """
    if not white.alpha.any():
        return NearAndFar(white, plate.rgb, None, NO_HIGHLIGHTS), clear(*white.alpha.shape)
    alpha = np.clip(renderer.render([white], plate.lens).alpha, 0.0, 1.0)
    front, behind = clean_colours(plate.rgb, alpha)
    return NearAndFar(white, behind, None, NO_HIGHLIGHTS), Layer(front * alpha[..., None], alpha, white.depth_m)
