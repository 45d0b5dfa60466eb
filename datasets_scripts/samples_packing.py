"""From a moving scene and a lens to the arrays that the compiled sampler takes."""

import numpy as np
from jaxtyping import Bool, Float

from datasets_scripts import _samples_bodies_numba as layout
from datasets_scripts._samples_bodies_numba import PackedBodies
from datasets_scripts._samples_numba import Pinhole
from datasets_scripts.samples_scene import Mover, MovingScene
from datasets_scripts.traced_scene import Quad, Sphere, plain_texture
from mrbokeh.optics.lens import Lens

_NEAREST_M = 1e-3
_LEAST_GATHERED_PX = 6.0
_BLACK = plain_texture((0.0, 0.0, 0.0))
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def pinhole_of(lens: Lens, width_px: int, height_px: int) -> Pinhole:
    pupil_radius_m = 0.5e-3 * lens.aperture_diameter_mm
    return Pinhole(width_px, height_px, lens.focal_px(width_px), pupil_radius_m, 1.0 / lens.focus_distance_m)


def pack(scene: MovingScene, view: Pinhole, unit_radius: float) -> PackedBodies:
    """unit_radius: how far the pupil reaches, in radii of the unit pupil (`Aperture.unit_radius`)."""
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
    """Lamps whose blur is larger than they are, than their trail and than some pixels, all the time on one side of the focus.

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
    """x0, y0, x1, y1 of the boxes around the bodies at both ends of the exposure, widened by their blur.

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
