"""Stochastic samples of a moving scene through a thin lens, their converged mean, and the sharp picture in the middle of the exposure.

A ray leaves film point xy through lens point (u, v) of the unit pupil and meets, in the focus plane, what a pinhole in the
middle of the lens sees through xy (Cook et al., Distributed Ray Tracing, SIGGRAPH 1984), with all bodies where they are at
its time. So what it hits at depth Z is displaced in the picture by coc(Z) / 2 * (u, v), coc as `Lens.coc_px` gives it.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from os import cpu_count

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from datasets_scripts.tracers import _moving_bodies_numba as layout
from datasets_scripts.tracers._moving_bodies_numba import DIMENSIONS, LAMP, RADIANCE, LensTable, PackedBodies
from datasets_scripts.tracers._samples_numba import TILE_PX, Pinhole, follow_lamp, gather_rows, mean_rows, sample_rows, sharp_rows
from datasets_scripts.tracers.sobol import mirrored_sobol
from datasets_scripts.tracers.traced_scene import Mover, MovingScene, Quad, Sphere, plain_texture
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import net_area
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_NEAREST_M = 1e-3
_LEAST_GATHERED_PX = 6.0
_BLACK = plain_texture((0.0, 0.0, 0.0))
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_SCANLINES = 1 << 13
_BANDS = 1 << 12
_NEGATIVE = -1e-9
WIDEST_PX = 1 << 11
_STREAMS_PER_SEED = 64
_SAMPLES, _REFERENCE, _LAMPS, _SHARP = 0, 1, 2, 3
_GATHERED_SHARE = 4
_FOLLOWED_RAYS = 1024
Advance = Callable[[], object]


def _silent() -> None:
    pass


@dataclass(frozen=True)
class SampleArrays:
    """Samples as (H, W, spp, ...) float32: the fields of LightFieldSamples before they are put in a row.

    depth_m: along the optical axis at the sample's time, inf where nothing was hit. motion_px: pixels per shutter of the hit
    point in the pinhole picture, averaged from the sample's time to the middle of the exposure (the derivative, exact to first
    order; for what keeps its depth they are the same), so that xy - coc(depth) / 2 * uv - motion * (time - 0.5) is exact.
    """

    xy_px: Float32[np.ndarray, "height width spp 2"]
    lens_uv: Float32[np.ndarray, "height width spp 2"]
    time: Float32[np.ndarray, "height width spp"]
    rgb: Float32[np.ndarray, "height width spp 3"]
    depth_m: Float32[np.ndarray, "height width spp"]
    motion_px: Float32[np.ndarray, "height width spp 2"]


@dataclass(frozen=True)
class SampleTracer:
    """A moving scene seen by a lens; equal seeds give equal bits for any number of threads (0: all cores).

    seed: of the sampling alone; the samples and the reference draw independent numbers.
    """

    scene: MovingScene
    lens: Lens
    width_px: int
    height_px: int
    seed: int = 0
    threads: int = 0

    def __post_init__(self) -> None:
        if not (1 <= self.width_px <= WIDEST_PX and 1 <= self.height_px <= WIDEST_PX):
            raise InputError(f"expected a picture of 1 to {WIDEST_PX} px a side, got {self.width_px}x{self.height_px}")
        if not self.lens.has_flat_focus:
            raise InputError("the stochastic sampler takes lenses with a flat focus: leave tilt and field curvature out")

    @property
    def steps(self) -> int:
        """Number of times that `samples`, `mean` and `sharp` call `advance`."""
        return -(-self.height_px // TILE_PX)

    def samples(self, spp: int, advance: Advance = _silent) -> SampleArrays:
        """Trace spp rays per pixel; lamps are seen by the rays that happen to hit them, as in a path tracer's frame."""
        size = (self.height_px, self.width_px, spp)
        out = SampleArrays(*(np.empty((*size, *more), np.float32) for more in ((2,), (2,), (), (3,), (), (2,))))
        arrays = (out.xy_px, out.lens_uv, out.time, out.rgb, out.depth_m, out.motion_px)
        packed, table, points = self._packed(), lens_table(self.lens.aperture), mirrored_sobol(spp)
        self._run(lambda top: sample_rows(packed, self._view, table, points, self._stream(_SAMPLES), top, arrays), advance)
        return out

    def mean(self, spp: int, advance: Advance = _silent) -> Float32[np.ndarray, "height width 3"]:
        """Return the mean over spp rays per pixel (box filter); lamps are sampled on themselves and much better than that."""
        rgb = np.empty((self.height_px, self.width_px, 3))
        packed, table, points = self._packed(), lens_table(self.lens.aperture), mirrored_sobol(spp)
        self._run(lambda top: mean_rows(packed, self._view, table, points, self._stream(_REFERENCE), top, rgb), advance)
        self._add_lamps(packed, spp, rgb)
        return rgb.astype(np.float32)

    def sharp(self, spp: int, advance: Advance = _silent) -> Layer:
        """Return the pinhole picture at (u, v, t) = (0, 0, 0.5) with motion as the extra channels forward.u (right)
        and forward.v (up, as renderers count).

        Colour and coverage are means over the pixel; depth and motion are those of one surface, met nearest to the pixel's
        centre, or of the lamps where they give over half of the light. Motion is premultiplied by coverage, as extras are.
        """
        size, view = (self.height_px, self.width_px), self._view._replace(pupil_radius=0.0)
        rgba, depth_m, motion_px = np.zeros((*size, 4)), np.empty(size, np.float32), np.empty((*size, 2), np.float32)
        packed, points = pack(self.scene, view, 0.0), mirrored_sobol(spp)
        self._run(lambda top: sharp_rows(packed, view, points, self._stream(_SHARP), top, rgba, depth_m, motion_px), advance)
        extra = {"forward.u": motion_px[..., :1], "forward.v": -motion_px[..., 1:]}
        return Layer(rgba[..., :3].astype(np.float32), np.minimum(rgba[..., 3], 1.0).astype(np.float32), depth_m, extra)

    @property
    def _view(self) -> Pinhole:
        return pinhole_of(self.lens, self.width_px, self.height_px)

    def _packed(self) -> PackedBodies:
        return pack(self.scene, self._view, self.lens.aperture.unit_radius)

    def _stream(self, use: int) -> int:
        return self.seed * _STREAMS_PER_SEED + use * DIMENSIONS

    def _run(self, rows: Callable[[int], None], advance: Advance = _silent) -> None:
        with _executor(self.threads) as pool:
            for _ in pool.map(rows, range(0, self.height_px, TILE_PX)):
                advance()

    def _add_lamps(self, packed: PackedBodies, spp: int, rgb: Float[np.ndarray, "height width 3"]) -> None:
        """Add much blurred lamps from spp / 4 points on each per pixel, the others from 1024 spp rays of each lamp."""
        outlines, area, view, stream = self.lens.aperture.packed(), light_through(self.lens.aperture), self._view, self._stream(_LAMPS)
        gathered = gathered_lamps(packed, view, area)
        followed = np.flatnonzero((packed.kind == LAMP) & ~gathered)
        points = mirrored_sobol(max(spp // _GATHERED_SHARE, 16))
        if gathered.any():
            self._run(lambda top: gather_rows(packed, view, outlines, area, gathered, points, stream, top, rgb))
        if len(followed):
            table, points = lens_table(self.lens.aperture), mirrored_sobol(spp * _FOLLOWED_RAYS)

            def follow(lamp: int) -> tuple[slice, slice, np.ndarray]:
                left, top, right, bottom = packed.bounds_px[lamp].clip(0, (self.width_px, self.height_px) * 2).astype(int).tolist()
                light = np.zeros((min(bottom + 1, self.height_px) - top, min(right + 1, self.width_px) - left))
                follow_lamp(packed, view, table, lamp, points, stream, left, top, light)
                return slice(top, top + len(light)), slice(left, left + light.shape[1]), light

            with _executor(self.threads) as pool:
                for lamp, (rows, columns, light) in zip(followed, pool.map(follow, followed.tolist()), strict=True):
                    rgb[rows, columns] += light[..., None] * packed.table[lamp, RADIANCE : RADIANCE + 3]


@contextmanager
def _executor(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Yield threads that stop early when the block is left by an exception."""
    pool = ThreadPoolExecutor(threads or cpu_count() or 1)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def pinhole_of(lens: Lens, width_px: int, height_px: int) -> Pinhole:
    pupil_radius_m = 0.5e-3 * lens.aperture_diameter_mm
    return Pinhole(
        width=width_px,
        height=height_px,
        focal=lens.focal_px(width_px),
        pupil_radius=pupil_radius_m,
        inverse_focus=1.0 / lens.focus_distance_m,
    )


def pack(scene: MovingScene, view: Pinhole, unit_radius: float) -> PackedBodies:
    """Turn a moving scene into arrays. unit_radius: how far the pupil reaches, in radii of the unit pupil (`Aperture.unit_radius`)."""
    rows = np.array([_row(mover, scene) for mover in scene.movers]).reshape(-1, layout.COLUMNS)
    worn = [_BLACK if not isinstance(mover.body, Quad | Sphere) else mover.body.texture for mover in scene.movers]
    distinct = list({id(texture): texture for texture in (_BLACK, *worn)}.values())
    starts = np.concatenate([[0], np.cumsum([texture.shape[0] * texture.shape[1] for texture in distinct])])
    place = {id(texture): (start, *texture.shape[:2]) for texture, start in zip(distinct, starts[:-1], strict=True)}
    return PackedBodies(
        table=rows,
        kind=np.array([_kind(mover) for mover in scene.movers], np.int64),
        bounds_px=_bounds_px(rows, view, unit_radius),
        texture=np.array([place[id(texture)] for texture in worn], np.int64).reshape(-1, 3),
        texels=np.concatenate([texture.reshape(-1, 3) for texture in distinct]).astype(np.float64),
        light=np.array([*scene.sun_direction, scene.sun, scene.ambient, *scene.background_rgb]),
    )


def gathered_lamps(packed: PackedBodies, view: Pinhole, pupil_area: float) -> Bool[np.ndarray, " bodies"]:
    """Find the lamps whose blur is larger than they are, than their trail and than some pixels, always on one side of the focus.

    A pixel finds enough of the points on such a lamp through its pupil; others are better followed to the film.
    """
    velocity_m, depth_m = packed.table[:, layout.VELOCITY : layout.VELOCITY + 3], packed.table[:, layout.CENTRE + 2]
    off = [1.0 - (depth_m + since * velocity_m[:, 2]) * view.inverse_focus for since in (-0.5, 0.5)]
    least_blur_m = view.pupil_radius * np.minimum(abs(off[0]), abs(off[1]))
    larger = pupil_area * least_blur_m**2 > np.pi * packed.table[:, layout.RADIUS] ** 2
    longer = 2.0 * least_blur_m > np.hypot(velocity_m[:, 0], velocity_m[:, 1])
    wider = 2.0 * least_blur_m * view.focal > _LEAST_GATHERED_PX * depth_m
    return (packed.kind == layout.LAMP) & (off[0] * off[1] > 0.0) & larger & longer & wider


def _kind(mover: Mover) -> int:
    if isinstance(mover.body, Quad):
        return layout.ROUND if mover.is_round else layout.QUAD
    return layout.SPHERE if isinstance(mover.body, Sphere) else layout.LAMP


def _row(mover: Mover, scene: MovingScene) -> Float[np.ndarray, " columns"]:
    row, body = np.zeros(layout.COLUMNS), mover.body
    row[layout.VELOCITY : layout.VELOCITY + 3] = mover.velocity_m
    if isinstance(body, Quad):
        along, down = np.asarray(body.edge_u_m), np.asarray(body.edge_v_m)
        normal = np.cross(along, down)
        row[layout.CENTRE : layout.CENTRE + 3] = np.asarray(body.corner_m) + 0.5 * (along + down)
        row[layout.HALF_BOX : layout.HALF_BOX + 3] = 0.5 * (abs(along) + abs(down)) * (1.0 + 1e-9)
        row[layout.NORMAL : layout.NORMAL + 3] = body.normal
        row[layout.DUAL_U : layout.DUAL_U + 3] = np.cross(down, normal) / (normal @ normal)
        row[layout.DUAL_V : layout.DUAL_V + 3] = np.cross(normal, along) / (normal @ normal)
        # Both sides of a card are lit alike.
        row[layout.GAIN] = scene.ambient + scene.sun * abs(float(np.dot(body.normal, scene.sun_direction)))
        row[layout.REPEAT_U], row[layout.REPEAT_V] = body.repeats
        return row
    row[layout.CENTRE : layout.CENTRE + 3], row[layout.RADIUS] = body.centre_m, body.radius_m
    row[layout.HALF_BOX : layout.HALF_BOX + 3] = body.radius_m * (1.0 + 1e-9)
    if isinstance(body, Sphere):
        row[layout.REPEAT_U], row[layout.REPEAT_V] = body.repeats
    else:
        row[layout.HALF_BOX + 2], row[layout.RADIANCE : layout.RADIANCE + 3] = 0.0, body.radiance_rgb
    return row


def _bounds_px(table: Float[np.ndarray, "bodies columns"], view: Pinhole, unit_radius: float) -> Float[np.ndarray, "bodies 4"]:
    """Return x0, y0, x1, y1 of the boxes around the bodies at both ends of the exposure, widened by their blur.

    Between the ends a corner's projection runs along a line on which 1 / Z is linear, so that its blur reaches no farther than
    the larger one of both ends.
    """
    centre, velocity = table[:, layout.CENTRE : layout.CENTRE + 3], table[:, layout.VELOCITY : layout.VELOCITY + 3]
    half = table[:, layout.HALF_BOX : layout.HALF_BOX + 3]
    corners = (centre[:, None] + _CORNERS * half[:, None])[:, None] + np.array([-0.5, 0.5])[None, :, None, None] * velocity[:, None, None]
    points_m = corners.reshape(len(table), 2 * len(_CORNERS), 3)
    depth_m = np.maximum(points_m[..., 2], _NEAREST_M)
    xy_px = points_m[..., :2] / depth_m[..., None] * view.focal + 0.5 * np.array([view.width, view.height])
    reach_px = 1.0 + view.focal * view.pupil_radius * unit_radius * abs(1.0 / depth_m - view.inverse_focus)[..., None]
    bounds = np.concatenate([(xy_px - reach_px).min(axis=1), (xy_px + reach_px).max(axis=1)], axis=1)
    bounds[(points_m[..., 2] <= _NEAREST_M).any(axis=1)] = (-np.inf, -np.inf, np.inf, np.inf)
    return bounds


def lens_table(aperture: Aperture) -> LensTable:
    """Cut an aperture into bands of equal light, each so thin (1/4096 of the light) that its slanted ends do not matter.

    y: (B, 2) top and bottom; x: (B, S + 1) where the transmission changes along the middle of the band; light: (B, S + 1) share
    of the band's light to the left of there, 0 to 1. Apertures of any weights that let no negative light through anywhere
    and that are the same all over the frame (`Aperture.is_plain`).
    """
    vertices, starts, weights = aperture.packed()
    edges = np.linspace(vertices[:, 1].min(), vertices[:, 1].max(), _SCANLINES + 1)
    _, light = _light_along(vertices, starts, weights, 0.5 * (edges[1:] + edges[:-1]))
    total = np.concatenate([[0.0], np.cumsum(light[:, -1])])
    y = np.interp(np.linspace(0.0, total[-1], 2 * _BANDS + 1), total, edges)
    x, light = _light_along(vertices, starts, weights, y[1::2])
    # The middle of a band that spans a gap between openings passes nothing: it takes the spans of a neighbour.
    lit = np.flatnonzero(light[:, -1] > 0.0)
    nearest = lit[np.searchsorted(lit, np.arange(_BANDS)).clip(max=len(lit) - 1)]
    return LensTable(np.column_stack([y[:-2:2], y[2::2]]), x[nearest], light[nearest] / light[nearest, -1:])


def light_through(aperture: Aperture) -> float:
    """Return the weighted area of the outlines in units of the squared pupil radius."""
    return net_area((aperture.outlines, aperture.weights))


def _light_along(
    vertices: Float[np.ndarray, "vertices 2"], starts: Int[np.ndarray, " starts"], weights: Float[np.ndarray, " outlines"], y: np.ndarray
) -> tuple[Float[np.ndarray, "rows edges"], Float[np.ndarray, "rows edges"]]:
    """Return (x where each line y crosses an outline, sorted; the light passed to the left of there), padded with the last x."""
    columns = [_crossings(vertices[a:b], y) for a, b in pairwise(starts)]
    steps = [weight * np.where(np.arange(each.shape[1]) % 2, -1.0, 1.0) for each, weight in zip(columns, weights, strict=True)]
    crossings, step = np.concatenate(columns, axis=1), np.broadcast_to(np.concatenate(steps), (len(y), sum(map(len, steps))))
    order = np.argsort(crossings, axis=1, kind="stable")
    x, passed = np.take_along_axis(crossings, order, axis=1), np.cumsum(np.take_along_axis(step, order, axis=1), axis=1)[:, :-1]
    last = np.max(np.where(np.isfinite(x), x, -np.inf), axis=1, keepdims=True)
    x = np.where(np.isfinite(x), x, np.where(np.isfinite(last), last, 0.0))
    widths = np.diff(x, axis=1)
    if np.any((passed < _NEGATIVE) & (widths > 0.0)):
        raise InputError("this aperture takes away more light than it passes at some lens points: a stochastic sampler cannot draw from it")
    return x, np.concatenate([np.zeros((len(y), 1)), np.cumsum(np.maximum(passed, 0.0) * widths, axis=1)], axis=1)


def _crossings(outline: Float[np.ndarray, "vertices 2"], y: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows crossings"]:
    """Return sorted x at which each line crosses one outline, inf where it crosses less often than the other lines."""
    ends = np.roll(outline, -1, axis=0)
    low, high = np.minimum(outline[:, 1], ends[:, 1]), np.maximum(outline[:, 1], ends[:, 1])
    rows = [np.flatnonzero((y >= a) & (y < b)) for a, b in zip(low, high, strict=True)]
    count = np.zeros(len(y), int)
    for each in rows:
        count[each] += 1
    result, filled = np.full((len(y), max(int(count.max()), 2)), np.inf), np.zeros(len(y), int)
    for (x0, y0), (x1, y1), each in zip(outline, ends, rows, strict=True):
        if len(each):
            result[each, filled[each]] = x0 + (x1 - x0) * (y[each] - y0) / (y1 - y0)
            filled[each] += 1
    return np.sort(result, axis=1)
