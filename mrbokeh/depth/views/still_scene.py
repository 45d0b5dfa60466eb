"""StillScene: depth of every picture of a scene at rest, from its cameras alone.

A few of the pictures (views) are swept against their neighbours, small and as pinholes; the depth of any picture is fused from the views
around it, and brought to its own pixels along its own edges. What moves by itself gets the depth of what is behind it.

What several sweeps agree on stays, what one alone has made up goes: a scene at rest has one surface along each ray. Each sweep is first
held against its neighbours (`vouched`), then all that are near are carried into the view, and of the surfaces found along a ray the nearest
is taken that has about as many votes as any (`fused`, after Merrell et al. 2007, "Real-time visibility-based fusion of depth maps"). So
depth is steady over a clip: its frames share their sweeps.

Lengths are those of the cameras, metres or not.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.depth.depth_filters import interpolate
from mrbokeh.depth.edge_votes import Guide
from mrbokeh.depth.mended_depth import filled
from mrbokeh.depth.views.dense_depth import DenseSettings, dense_depth
from mrbokeh.depth.views.depth_priors import ViewDepth, consistency
from mrbokeh.depth.views.guided_depth import near_steps, weighted_medians
from mrbokeh.depth.views.sweep_view import BRIGHTEST, SweepView, packed_view, rays_of, structure_of
from mrbokeh.depth.views.view_points import best_neighbours, common_points, dioptre_range, in_view
from mrbokeh.distortion import LensDistortion
from mrbokeh.optics.camera import Camera
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

TOLERANCE = 0.015
"""Share of the range of dioptres within which two depths are of one surface."""
_CONTRADICTED = 0.2
_VOUCHED, _ALONE = 0.5, 0.3
_LEAST = 0.15
_MOST_OF_BEST = 0.5
_SPECK_PX = 40
Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]

_SWEPT_PIXELS = 854 * 480
_MOST_CELLS = 1 << 24
"""Of the coarse level: eight times as many take 2.7 times as long and are no better."""
_NEIGHBOURS = 6
_SOURCES = 7
_FEWEST_POINTS = 50
_EDGE_CONTRAST = 0.07
_BEYOND_EDGE_PX, _BESIDE_EDGE_PX = 3, 24
_SURFACES_APART = 4.0
_SAY_OF_NEAREST, _SHARP_PX, _SMOOTH_PX, _EDGE_OF_COLOUR = np.float32(1e-3), 12.0, 40.0, 0.05


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A picture whose camera is known.

    rgb: scene-linear. camera: its pinhole, of the picture's size. distortion: from the pinhole to the picture.
    """

    rgb: Rgb
    camera: Camera
    distortion: LensDistortion = field(default_factory=LensDistortion)

    def small(self) -> "PosedPicture":
        """Return the picture as of a pinhole, no larger than what is swept."""
        camera = self.camera.resized(*_swept_size(self.camera))
        rgb = cv2.resize(self.rgb, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
        if not self.distortion.is_none:
            at = np.nan_to_num(self.distortion.distorted_px(camera.pixel_centres_px(), camera) - 0.5, nan=-10.0).astype(np.float32)
            x, y = (np.ascontiguousarray(at[..., k]) for k in (0, 1))
            rgb = cv2.remap(rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return PosedPicture(rgb, camera)

    @property
    def view(self) -> SweepView:
        return SweepView(structure_of(self.rgb), self.camera)


def _swept_size(camera: Camera) -> tuple[int, int]:
    scale = min(1.0, float(np.sqrt(_SWEPT_PIXELS / (camera.width_px * camera.height_px))))
    return max(round(camera.width_px * scale), 1), max(round(camera.height_px * scale), 1)


@dataclass(frozen=True)
class PictureDepth:
    """Depth (H, W) along the axis of a picture, everywhere; confidence (H, W) from 0 to 1, 0 where it was filled from what is around it."""

    depth: Plane
    confidence: Plane


class StillScene:
    """Sweeps of the views of a scene at rest, from which the depth of any of its pictures follows."""

    def __init__(self, small: Sequence[PosedPicture], what: str, device: str | None = None) -> None:
        """Sweep all views. small: as `PosedPicture.small` returns them. what: is told of if they do not tell depth, in an InputError.

        device: of torch, for the sweeps.
        """
        points = common_points([each.view for each in small])
        if len(points) < _FEWEST_POINTS:
            raise InputError(
                f"{what}: depth needs a camera that moves sideways before things with texture, but of its {len(small)} views only "
                f"{len(points)} points show parallax: go sideways while you film or photograph"
            )
        inside, depth = (np.array(each) for each in zip(*(in_view(each.camera, points) for each in small), strict=True))
        # Settings of sweeps are in dioptres: as if the nearest things stood at 1 m.
        self._unit = float(np.percentile(depth[inside], 1.0))
        self.points = points / self._unit
        pictures = [replace(each, camera=self._scaled(each.camera)) for each in small]
        self._cameras = [each.camera for each in pictures]
        ranges = [dioptre_range(camera, self.points) for camera in self._cameras]
        nearest, farthest = (bound([each[k] for each in ranges if each]) for bound, k in ((max, 1), (min, 0)))
        self._tolerance = TOLERANCE * (nearest - farthest)
        views, settings = [each.view for each in pictures], DenseSettings(most_cells=_MOST_CELLS, device=device)
        near = [best_neighbours(index, self._cameras, self.points, _NEIGHBOURS) for index in range(len(views))]
        swept: dict[int, ViewDepth] = {}
        for index in track(range(len(views)), "sweeps"):
            if (extent := ranges[index]) is not None and near[index]:
                found = dense_depth(pictures[index].rgb, views[index], [views[k] for k in near[index]], extent, settings=settings)
                swept[index] = ViewDepth(views[index], (1.0 / found.depth_m).astype(np.float32), found.confidence)
        self._views = {k: vouched(own, [swept[other] for other in near[k] if other in swept], self._tolerance) for k, own in swept.items()}

    def _scaled(self, camera: Camera) -> Camera:
        pose = camera.camera_from_world.copy()
        pose[:3, 3] /= self._unit
        return replace(camera, camera_from_world=pose)

    def depth_of(self, picture: PosedPicture) -> PictureDepth:
        """Return the depth of a picture of the scene, one of the views or any other."""
        small = picture.small()
        view = replace(small.view, camera=self._scaled(small.camera))
        sources = [self._views[index] for index in self._nearest(view.camera)]
        dioptre, confidence = fused(view, sources, self._tolerance)
        if not (dioptre > 0).any():
            raise InputError("a picture shows nothing whose depth the other views tell: take pictures that overlap more")
        dioptre = _without_holes(dioptre, Guide.of(small.rgb), self._tolerance)
        dioptre, confidence = (_on_picture(each, picture, view.camera) for each in (dioptre, confidence))
        return PictureDepth((self._unit / self._along_edges(dioptre, picture)).astype(np.float32), confidence)

    def _nearest(self, camera: Camera) -> list[int]:
        """Return the swept views that look at most of the same, from the least far away."""
        inside, depth = in_view(camera, self.points)
        middle = float(np.median(depth[inside])) if inside.any() else 1.0
        apart = {index: apart_in_widths(camera, self._cameras[index], middle) for index in self._views}
        return sorted(apart, key=apart.__getitem__)[:_SOURCES]

    def _along_edges(self, dioptre: Plane, picture: PosedPicture) -> Plane:
        """Move edges of depth, which are those of a smaller picture, onto those of the picture."""
        scale = picture.camera.width_px / _swept_size(picture.camera)[0]
        radius_px = round(2.0 * scale) + 1
        edges = near_steps(dioptre, radius_px, self._tolerance)
        guide = np.sqrt(np.clip(picture.rgb, 0.0, BRIGHTEST))
        return weighted_medians(dioptre, np.ones_like(dioptre), guide, edges, radius_px, _EDGE_CONTRAST)


def _without_holes(dioptre: Plane, guide: Guide, tolerance: float) -> Plane:
    """Fill what no view tells (0), and what lies close to that, by likeness of colour.

    Windows of a sweep carry near depth beyond its edge; and what is unknown beside an edge is mostly a background that other views do not
    see, so that near surfaces spread only from well inside them.
    """
    known = dioptre > 0
    sure = cv2.erode(known.astype(np.uint8), np.ones((2 * _BEYOND_EDGE_PX + 1,) * 2)).astype(bool)
    known = sure if sure.any() else known
    reach = np.ones((2 * _BESIDE_EDGE_PX + 1,) * 2)
    behind = cv2.erode(np.where(known, dioptre, np.float32(np.inf)), reach)
    seeds = known & (dioptre - behind <= _SURFACES_APART * tolerance)
    nearest = (1.0 / filled((1.0 / np.where(seeds, dioptre, 1.0)).astype(np.float32), seeds, guide)).astype(np.float32)
    # Far from all that is known, the nearest in colour is a matter of chance: there it is smoothed.
    away_px = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    sharp = np.exp(-away_px / _SHARP_PX).astype(np.float32)
    weights = np.where(seeds, np.float32(1.0), np.maximum(sharp, _SAY_OF_NEAREST))
    smooth = interpolate(nearest, weights, guide.root, _SMOOTH_PX**2, _EDGE_OF_COLOUR)
    return np.where(known, dioptre, sharp * nearest + (1.0 - sharp) * smooth).astype(np.float32)


def cameras_digest(cameras: Iterable[tuple[object, Camera, object]]) -> str:
    """Return a text that changes with the cameras that depth is found by: (name or number, camera, distortion) of each."""
    told = [(name, each.focal_px, each.principal_px, each.camera_from_world.round(9).tolist(), bent) for name, each, bent in cameras]
    return hashlib.sha256(repr(told).encode()).hexdigest()


def apart_in_widths(one: Camera, other: Camera, depth: float) -> float:
    """Return by about how many widths of the picture two cameras see a thing at this depth apart."""
    a, b = one.world_from_camera, other.world_from_camera
    turn_rad = float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return (turn_rad + float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / depth) * one.focal_px[0] / one.width_px


def _on_picture(values: Float[np.ndarray, "rows columns"], picture: PosedPicture, small: Camera) -> Plane:
    """Resample a map of the small pinhole at the pixels of the picture, without averaging over edges."""
    pinhole_px = picture.distortion.undistorted_px(picture.camera.pixel_centres_px(), picture.camera)
    scale = np.array([small.width_px / picture.camera.width_px, small.height_px / picture.camera.height_px])
    x, y = np.moveaxis(np.nan_to_num(pinhole_px * scale - 0.5, nan=0.0).astype(np.float32), -1, 0)
    return cv2.remap(
        values.astype(np.float32), np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )


def vouched(own: ViewDepth, neighbours: Sequence[ViewDepth], tolerance: float) -> ViewDepth:
    """Return the depth with the confidence that neighbours leave it: more where they have the same surface, less where they see through."""
    seen = consistency(own.view, own.dioptre, neighbours, tolerance)
    supported = 1.0 - (1.0 - own.confidence) * (1.0 - _VOUCHED) ** np.minimum(seen.supports, 2)
    trust = np.where(seen.supports > 0, supported, _ALONE * own.confidence)
    trust = np.where(seen.contradictions > seen.supports, _CONTRADICTED * trust, trust)
    return replace(own, confidence=trust.astype(np.float32))


def fused(view: SweepView, sources: Sequence[ViewDepth], tolerance: float) -> tuple[Plane, Plane]:
    """Return (dioptre, confidence) of a view, 0 where no source tells. tolerance: in dioptres, of one surface."""
    carried = [_carried(view, each) for each in sources]
    dioptres = np.stack([each[0] for each in carried])
    votes = np.stack([each[1] for each in carried])
    support = np.stack([(votes * (np.abs(dioptres - one) <= tolerance)).sum(axis=0) * (one > 0) for one in dioptres])
    best = support.max(axis=0)
    taken = np.where(support >= np.maximum(_MOST_OF_BEST * best, _LEAST), dioptres, 0.0).max(axis=0)
    agreeing = votes * ((np.abs(dioptres - taken) <= tolerance) & (taken > 0))
    weight = agreeing.sum(axis=0)
    mean = (agreeing * dioptres).sum(axis=0) / np.maximum(weight, 1e-9)
    trust = np.where(weight > 0, 1.0 - np.prod(1.0 - agreeing, axis=0), 0.0)
    dioptre = _without_specks(np.where(weight > 0, mean, 0.0).astype(np.float32), tolerance)
    return dioptre, np.where(dioptre > 0, trust, 0.0).astype(np.float32)


def _carried(view: SweepView, source: ViewDepth) -> tuple[Plane, Plane]:
    """Return (dioptre, confidence) of a source's trusted pixels in the view, the nearest where several fall into one; 0 where none."""
    from mrbokeh.depth.views._views_numba import carry

    dioptre, confidence = (np.zeros(view.structure.shape, np.float32) for _ in range(2))
    carry(rays_of(source.view), source.dioptre, source.confidence, packed_view(source.view, view), np.float32(_LEAST), dioptre, confidence)
    return dioptre, confidence


def _without_specks(dioptre: Plane, tolerance: float) -> Plane:
    """Return the map without islands of a few pixels that no neighbour shares."""
    # Unknown pixels (level 0) lie far from the farthest surface, or specks beside them would count as parts of them.
    levels = np.where(dioptre > 0, np.clip(100.0 + np.round(dioptre * (8.0 / tolerance)), 100.0, 32000.0), 0.0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, _SPECK_PX, 12)
    return np.where(levels > 0, dioptre, np.float32(0.0))
