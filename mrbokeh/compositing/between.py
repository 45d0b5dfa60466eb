"""Virtual layers between the blurred layers of a photograph: behind what is near in it, before the rest.

What is near in the photograph is blurred there, so its coverage is soft and its colour mixed with what is behind. The sharp scene is
cut in two at the depth of the virtual surface (mrbokeh.compositing.near_and_far), and the near part is blurred anew by the lens,
focused as it was for the photograph. That tells how much of every pixel of the photograph is near light (a F) and how much far light
((1 - a) B). The far light alone is dimmed, by the share of it that the virtual surface hides; near light stays; the virtual light that
gets past the near things is added. So the photograph's own pixels are used, errors of blurring anew matter only at the edges of what is
hidden, and pixels that no virtual light reaches stay as they are, bit for bit.

Rays tell which part of the pupil each of the three takes (mrbokeh.compositing.pupil_shares): coverages multiplied would be right only
if near and virtual edges crossed the pupil independently, which those of one pixel do not.

Under a user's matte, without a sharp scene, picture = alpha F + (1 - alpha) B is solved for F and B (Forte, Approximate Fast Foreground
Colour Estimation, ICIP 2021): both are local means, then the rest of the mixture is given to them; a coarse round finds the colours, a
fine one their detail.

Rerendered is the simpler way: the all-in-focus picture with its depth and the virtual layers are blurred in one go.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.edge_refinement import EdgeRefinement
from mrbokeh.compositing.near_and_far import NO_HIGHLIGHTS, NearAndFar, continued, cut_in_two, nearer_than, shows_anything, virtual_depth_m
from mrbokeh.compositing.plate import Inserted, Plate, same_size
from mrbokeh.compositing.pupil_shares import Rays
from mrbokeh.compositing.three_parts import LEAST_LIGHT, put_together
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

_ROUNDS_PX = (91, 7)
_LEAST = np.float32(1e-5)

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]

Mask = Bool[np.ndarray, "height width"]
_HALF = 0.5
_NEAR_EDGE_PX, _FAR_EDGE_PX = 3, 1  # the depth of what is near has a median over 5x5 pixels


@dataclass(frozen=True)
class Between:
    """Insertion between the near and far parts of the photograph; any Renderer will do.

    tolerance: share of its depth by which a photographed surface must be nearer to hide the virtual one (see occlusion_matte).
    pupil_points: rays per pixel where near and virtual edges meet. near_depth_m: distance of what a user's matte (Plate.near_alpha)
    holds, for photographs without depth. refine_edges: move edges of near things to where the photograph shows them
    (mrbokeh.compositing.edge_refinement); False if the depth is exact there. Only the kernels' shares of the pupil are taken from the
    opening of the plate's lens.
    """

    tolerance: float = 0.03
    pupil_points: int = 64
    near_depth_m: float | None = None
    refine_edges: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        if not any(shows_anything(layer) for layer in layers):
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        sharp = flatten([replace(layer, extra={}) for layer in layers])
        depth_m = virtual_depth_m(sharp)
        blurred = renderer.render(layers, plate.lens)
        scene, near = self._scene(plate, depth_m, renderer)
        return put_together(plate, near, blurred, Rays.of(scene, sharp, depth_m, plate.lens, self.pupil_points))

    def cut(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> NearAndFar:
        """The sharp scene of a plate cut in two by the layers, one of which shows something."""
        depth_m = virtual_depth_m(flatten([replace(layer, extra={}) for layer in layers]))
        if plate.sharp_rgb is None:
            raise InputError("to cut the scene in two its all-in-focus picture is needed: give a focal stack")
        plate, matte = self._with_refined_edges(plate, self._matte(plate, depth_m), renderer)
        return self._cut(plate, matte, self._near_depth_m(plate, matte))

    def _scene(self, plate: Plate, depth_m: Plane, renderer: Renderer) -> tuple[NearAndFar, Layer]:
        """The scene cut in two, and its near part as the lens sees it."""
        plate, matte = self._with_refined_edges(plate, self._matte(plate, depth_m), renderer)
        near_m = self._near_depth_m(plate, matte)
        if plate.sharp_rgb is None:
            return _without_sharp_picture(plate, Layer(np.repeat(matte[..., None], 3, axis=2), matte, near_m), renderer)
        scene = self._cut(plate, matte, near_m)
        return scene, renderer.render([scene.near], plate.lens) if scene.near.alpha.any() else clear(*matte.shape)

    def _matte(self, plate: Plate, depth_m: Plane) -> Plane:
        """Return the sharp matte of what is near: the user's matte, else by depth."""
        if plate.near_alpha is not None:
            return plate.near_alpha
        if plate.depth_m is None:
            raise InputError(
                "to put objects between the layers of a photograph it needs depth (a focal stack or --depth) or a matte of what "
                "is near: give one, or use the mode front"
            )
        return nearer_than(plate.depth_m, depth_m, self.tolerance).astype(np.float32)

    def _with_refined_edges(self, plate: Plate, matte: Plane, renderer: Renderer) -> tuple[Plate, Plane]:
        """Plate and matte; a user's matte stays as it is."""
        if not self.refine_edges or plate.near_alpha is not None:
            return plate, matte
        better, near = EdgeRefinement(self._cut_by_depth, renderer, self.tolerance).found(plate, matte > _HALF)
        return better, matte if better is plate else near.astype(np.float32)

    def _near_depth_m(self, plate: Plate, matte: Plane) -> Plane:
        """Depth of the near things, continued to all places."""
        if self.near_depth_m is not None:
            return np.full_like(matte, self.near_depth_m)
        if plate.depth_m is None:
            raise InputError("a matte of what is near needs its distance: give depth, or the distance in metres (near_depth_m)")
        return continued(plate.depth_m, matte > _HALF)

    def _cut(self, plate: Plate, matte: Plane, near_m: Plane) -> NearAndFar:
        """Cut the sharp scene in two. near_m: depth of what a user's matte holds."""
        assert plate.sharp_rgb is not None
        if plate.near_alpha is None and plate.depth_m is not None:
            return self._cut_by_depth(plate, matte > _HALF)
        front, behind = clean_colours(plate.sharp_rgb, matte)
        far_m = None if plate.depth_m is None else continued(plate.depth_m, matte <= _HALF)
        return NearAndFar(Layer(front * matte[..., None], matte, near_m), behind, far_m, NO_HIGHLIGHTS)

    def _cut_by_depth(self, plate: Plate, is_near: Mask) -> NearAndFar:
        assert plate.sharp_rgb is not None and plate.depth_m is not None
        return cut_in_two(plate.sharp_rgb, plate.depth_m, is_near, _reach_px(plate.lens, plate.depth_m, is_near), self.tolerance)


@dataclass(frozen=True)
class Rerendered:
    """Insertion that blurs all anew: reached by virtual light, a pixel is taken from the new picture, else from the photograph.

    Simpler than `Between` and the same for any lens, but touched pixels show how well the picture is blurred anew, and coverages of
    near and virtual edges are multiplied. tolerance, refine_edges: see `Between`.
    """

    tolerance: float = 0.03
    refine_edges: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        if plate.sharp_rgb is None or plate.depth_m is None:
            raise InputError(
                "to blur a photograph anew its all-in-focus picture and depth are needed: give a focal stack, or use the mode over"
            )
        if not any(shows_anything(layer) for layer in layers):
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        scene = Between(self.tolerance, refine_edges=self.refine_edges).cut(plate, layers, renderer)
        near = [scene.near] if scene.near.alpha.any() else []
        picture = renderer.render([*near, *layers, scene.far], plate.lens)
        virtual = renderer.render(layers, plate.lens)
        free = 1.0 - renderer.render(near, plate.lens).alpha if near else np.ones_like(virtual.alpha)
        seen = Layer(virtual.rgb * free[..., None], virtual.alpha * free, virtual.depth_m)
        touched = (seen.alpha > LEAST_LIGHT) | (np.abs(seen.rgb).max(axis=2) > LEAST_LIGHT)
        left = np.where(touched[..., None], np.maximum(picture.rgb - seen.rgb, 0.0), plate.rgb)
        return Inserted(left, Layer(seen.rgb * touched[..., None], seen.alpha * touched, seen.depth_m))


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


def _reach_px(lens: Lens, depth_m: Plane, is_near: Mask) -> float:
    """Return how far the lens looks past the edges of what is near: half of the difference of the circles of confusion there, at most.

    Behind a near thing and before what is far, both continue as they are at the edge (see `continued`).
    """
    if not is_near.any() or is_near.all():
        return 0.0
    coc_px = np.asarray(lens.coc_px(depth_m, depth_m.shape[1]))
    near_px, far_px = coc_px[is_near & _within(_NEAR_EDGE_PX, ~is_near)], coc_px[~is_near & _within(_FAR_EDGE_PX, is_near)]
    return 0.5 * lens.aperture.unit_radius * float(max(far_px.max() - near_px.min(), 0.0))


def _within(distance_px: int, mask: Mask) -> Mask:
    """Return the pixels no farther from the mask than that, along rows and columns."""
    from cv2 import dilate

    return np.asarray(dilate(mask.astype(np.uint8), np.ones((2 * distance_px + 1, 2 * distance_px + 1), np.uint8)) > 0)


def _without_sharp_picture(plate: Plate, white: Layer, renderer: Renderer) -> tuple[NearAndFar, Layer]:
    """Cut the scene by the photograph and a matte alone: the lens blurs the matte, and the photograph is solved for both colours under
    it.
    """
    if not white.alpha.any():
        return NearAndFar(white, plate.rgb, None, NO_HIGHLIGHTS), clear(*white.alpha.shape)
    alpha = np.clip(renderer.render([white], plate.lens).alpha, 0.0, 1.0)
    front, behind = clean_colours(plate.rgb, alpha)
    return NearAndFar(white, behind, None, NO_HIGHLIGHTS), Layer(front * alpha[..., None], alpha, white.depth_m)
