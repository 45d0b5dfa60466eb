"""A made-up still life for focal stacks: books, boxes, balls and fairy lights on a table before a wall, 0.6 m to 2 m away."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import ndimage

from datasets_scripts.scenes.textures import bricks, checks, mottled, page_of_text, spots, wood
from datasets_scripts.tracers.baked_lighting import bake_lighting
from datasets_scripts.tracers.thin_lens import trace_pinhole
from datasets_scripts.tracers.traced_scene import DiscLight, Quad, Scene, Sphere, Texture, Vector, box_faces, vector
from mrbokeh.optics.camera import Camera, camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

LIGHTS_PER_VIEW = 12
_TINTS = ((1.0, 0.72, 0.36), (1.0, 0.86, 0.62), (0.55, 0.75, 1.0), (1.0, 0.45, 0.3), (0.6, 1.0, 0.55))
_RADIANCE = (1.0, 2.6)
_RADIUS_M_AT_1_M = (1.8e-3, 2.6e-3)
_GAP_M = 0.008
_SMOOTH_DIOPTRES = 0.12
_LEAST_DISTANCE_SHARE = 0.05
_ATTEMPTS = 60
TABLE_Y_M = 0.24
WALL_Z_M = 1.95
NEAR_FOCUS_M = 0.65
FAR_FOCUS_M = 2.05
_SUN_TOWARDS = (-0.52, -0.72, -0.46)
_LIT_VIEWPOINTS = 3
_PITCH_RAD = np.deg2rad(10.0)


@dataclass(frozen=True)
class Viewpoint:
    """Place of a camera (world metres) and how far it is turned to the right."""

    position_m: Vector
    yaw_rad: float


VIEWPOINTS = (
    Viewpoint((0.0, 0.0, 0.0), 0.0),
    Viewpoint((0.075, -0.012, 0.015), float(np.deg2rad(-2.5))),
    Viewpoint((0.235, -0.02, -0.005), float(np.deg2rad(3.5))),
    Viewpoint((-0.09, 0.01, 0.01), float(np.deg2rad(-3.5))),
    Viewpoint((0.15, 0.015, 0.03), float(np.deg2rad(1.5))),
)


def desk_camera(index: int, width_px: int, height_px: int, lens: Lens) -> Camera:
    """Return one of the viewpoints, tilted down to the table, with the lens's focal length in pixels."""
    if not 0 <= index < len(VIEWPOINTS):
        raise InputError(f"the desk scene has {len(VIEWPOINTS)} viewpoints, but number {index} was asked for")
    return camera_at(VIEWPOINTS[index], width_px, height_px, lens)


def camera_at(view: Viewpoint, width_px: int, height_px: int, lens: Lens) -> Camera:
    """Return a camera that stands at a viewpoint, tilted down to the table."""
    cos_p, sin_p, cos_y, sin_y = np.cos(_PITCH_RAD), np.sin(_PITCH_RAD), np.cos(view.yaw_rad), np.sin(view.yaw_rad)
    pitch = np.array([[1, 0, 0], [0, cos_p, -sin_p], [0, sin_p, cos_p]])
    yaw = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = pitch @ yaw
    camera_from_world[:3, 3] = -pitch @ yaw @ np.asarray(view.position_m)
    return replace(camera_of_lens(lens, width_px, height_px), camera_from_world=camera_from_world)


def desk_scene(seed: int) -> Scene:
    """Build the still life with baked light. The seed changes textures and lights; the furniture stays."""
    rng = np.random.default_rng([seed, 0])
    scene = bake_lighting(desk_furniture(rng), seed=seed)
    cameras = [desk_camera(view, 144, 96, Lens(35.0, 2.8, NEAR_FOCUS_M, 23.5)) for view in range(_LIT_VIEWPOINTS)]
    return replace(scene, lights=tuple(fairy_lights(scene, cameras, rng)))


def desk_furniture(rng: np.random.Generator) -> Scene:
    """Build room, books, boxes, cards and balls under the sun; no lamps, light not baked yet."""
    sun = np.asarray(_SUN_TOWARDS) / np.linalg.norm(_SUN_TOWARDS)
    quads = (*_room(rng), *_books(rng), *_boxes(rng), *_cards(rng))
    return Scene(
        quads=quads, spheres=_balls(rng), lights=(), sun_direction=vector(sun), sun=0.46, ambient=0.3, background_rgb=(0.05, 0.05, 0.06)
    )


def _room(rng: np.random.Generator) -> tuple[Quad, ...]:
    table = wood(1024, rng, (0.16, 0.09, 0.05), (0.6, 0.41, 0.25), planks=8)
    wall = mottled(1024, rng, (0.22, 0.27, 0.3), (0.5, 0.52, 0.5), finest=5.0, slope=0.15, contrast=0.26)
    return (
        Quad(
            corner_m=(-1.5, TABLE_Y_M, WALL_Z_M),
            edge_u_m=(3.0, 0.0, 0.0),
            edge_v_m=(0.0, 0.0, 0.05 - WALL_Z_M),
            texture=table,
            repeats=(3.0, 1.9),
        ),
        Quad(
            corner_m=(-2.0, TABLE_Y_M - 1.6, WALL_Z_M), edge_u_m=(4.0, 0.0, 0.0), edge_v_m=(0.0, 1.6, 0.0), texture=wall, repeats=(2.0, 0.8)
        ),
    )


@dataclass(frozen=True, eq=False)
class _Box:
    """A box (width, height, depth) that stands on base_y_m with its middle at (x, z), turned about the vertical axis.

    skin: textures of the front and back, of the sides, and of the top; there is no bottom.
    """

    x_m: float
    z_m: float
    size_m: Vector
    yaw_rad: float
    skin: tuple[Texture, Texture, Texture]
    repeats: tuple[float, float] = (1.0, 1.0)
    base_y_m: float = TABLE_Y_M

    def quads(self) -> tuple[Quad, ...]:
        front, side, top = self.skin
        faces = zip(box_faces((self.x_m, self.base_y_m, self.z_m), self.size_m, self.yaw_rad), (front, front, side, side, top), strict=True)
        return tuple(
            Quad(corner_m=vector(start), edge_u_m=vector(u), edge_v_m=vector(v), texture=texture, repeats=self.repeats)
            for (start, u, v), texture in faces
        )


def _books(rng: np.random.Generator) -> tuple[Quad, ...]:
    """Build flat piles: (x, z, size, yaw, height of the base above the table, cover colours)."""
    pages = mottled(256, rng, (0.45, 0.42, 0.34), (0.8, 0.77, 0.68), slope=0.3, contrast=0.3)
    piles = (
        (-0.185, 1.02, (0.21, 0.045, 0.15), 0.15, 0.0, (0.5, 0.09, 0.07), (0.85, 0.74, 0.5)),
        (-0.175, 1.03, (0.18, 0.035, 0.13), -0.2, 0.045, (0.75, 0.7, 0.6), (0.08, 0.13, 0.3)),
        (0.47, 1.12, (0.2, 0.05, 0.14), -0.35, 0.0, (0.1, 0.3, 0.2), (0.85, 0.8, 0.55)),
        (0.46, 1.12, (0.16, 0.04, 0.12), 0.1, 0.05, (0.78, 0.62, 0.2), (0.2, 0.06, 0.05)),
    )
    faces: list[Quad] = []
    for x_m, z_m, size_m, yaw_rad, base_m, cover, letters in piles:
        spine = page_of_text(96, 448, rng, letters, cover, cell=5, headline=False)
        front = page_of_text(288, 400, rng, letters, cover, cell=6)
        faces += _Box(x_m=x_m, z_m=z_m, size_m=size_m, yaw_rad=yaw_rad, skin=(spine, pages, front), base_y_m=TABLE_Y_M - base_m).quads()
    return tuple(faces)


def _boxes(rng: np.random.Generator) -> tuple[Quad, ...]:
    brick = bricks(512, rng, rows=10, columns=4)
    check = checks(384, rng, (0.06, 0.12, 0.28), (0.68, 0.66, 0.58), count=6)
    dots = spots(512, rng, (0.62, 0.55, 0.2), ((0.62, 0.2, 0.14), (0.2, 0.32, 0.45), (0.8, 0.77, 0.66)), 60, (9.0, 26.0))
    stone = mottled(512, rng, (0.2, 0.21, 0.2), (0.62, 0.6, 0.55), slope=0.4)
    crate = wood(512, rng, (0.22, 0.13, 0.06), (0.68, 0.5, 0.3), planks=5)
    boxes = (
        _Box(x_m=-0.4, z_m=1.58, size_m=(0.24, 0.27, 0.16), yaw_rad=0.3, skin=(brick, brick, stone)),
        _Box(x_m=0.27, z_m=0.98, size_m=(0.11, 0.12, 0.1), yaw_rad=-0.45, skin=(check, check, check)),
        _Box(x_m=0.13, z_m=1.5, size_m=(0.2, 0.2, 0.15), yaw_rad=0.2, skin=(dots, dots, stone), repeats=(0.6, 0.6)),
        _Box(x_m=-0.09, z_m=1.36, size_m=(0.13, 0.15, 0.12), yaw_rad=-0.3, skin=(crate, crate, crate)),
        _Box(x_m=0.72, z_m=1.45, size_m=(0.2, 0.24, 0.16), yaw_rad=-0.2, skin=(stone, brick, crate)),
        _Box(x_m=0.27, z_m=0.98, size_m=(0.07, 0.06, 0.07), yaw_rad=0.2, skin=(stone, crate, crate), base_y_m=TABLE_Y_M - 0.12),
    )
    return tuple(quad for box in boxes for quad in box.quads())


def _cards(rng: np.random.Generator) -> tuple[Quad, ...]:
    """Build upright printed cards and a poster leaning on the wall: (x, z, width, height, yaw, lean)."""
    places = (
        (0.085, 0.76, 0.1, 0.062, 0.35, 0.12),
        (0.33, 0.75, 0.09, 0.07, -0.3, 0.15),
        (-0.3, 0.86, 0.08, 0.1, 0.5, 0.1),
        (0.5, 1.72, 0.34, 0.3, 0.05, 0.18),
        (-0.02, 1.88, 0.3, 0.26, 0.0, 0.12),
    )
    inks: tuple[tuple[Vector, Vector], ...] = (
        ((0.06, 0.06, 0.08), (0.8, 0.79, 0.74)),
        ((0.35, 0.05, 0.05), (0.8, 0.72, 0.55)),
        ((0.75, 0.72, 0.6), (0.09, 0.22, 0.25)),
        ((0.08, 0.1, 0.25), (0.72, 0.66, 0.5)),
        ((0.72, 0.65, 0.4), (0.3, 0.08, 0.1)),
    )
    cards = []
    for (x_m, z_m, width, height, yaw, lean), (ink, paper) in zip(places, inks, strict=True):
        right = np.array([np.cos(yaw), 0.0, np.sin(yaw)])
        back = np.array([-np.sin(yaw), 0.0, np.cos(yaw)])
        down = height * (np.cos(lean) * np.array([0.0, 1.0, 0.0]) - np.sin(lean) * back)
        corner = np.array([x_m, TABLE_Y_M, z_m]) - down - 0.5 * width * right
        texture = page_of_text(int(420 * height / width), 420, rng, ink, paper, cell=6)
        cards.append(Quad(vector(corner), vector(width * right), vector(down), texture))
    return tuple(cards)


def _balls(rng: np.random.Generator) -> tuple[Sphere, ...]:
    """Build balls that lie on the table, the last one on a book: (x, z, radius, height of the base)."""
    places = (
        (-0.115, 0.735, 0.032, 0.0),
        (0.05, 1.06, 0.05, 0.0),
        (0.43, 0.86, 0.04, 0.0),
        (0.36, 1.35, 0.075, 0.0),
        (-0.2, 1.03, 0.04, 0.08),
    )
    skins = (
        bricks(512, rng, 10, 8, (0.12, 0.36, 0.38), (0.55, 0.6, 0.56)),
        spots(512, rng, (0.75, 0.3, 0.1), ((0.9, 0.85, 0.7), (0.3, 0.1, 0.08)), 60, (10.0, 26.0)),
        mottled(512, rng, (0.1, 0.2, 0.42), (0.6, 0.68, 0.75)),
        checks(512, rng, (0.12, 0.3, 0.12), (0.8, 0.76, 0.5), 16),
        wood(512, rng, (0.3, 0.15, 0.06), (0.75, 0.5, 0.28), 8),
    )
    return tuple(
        Sphere((x_m, TABLE_Y_M - base_m - radius_m, z_m), radius_m, skin, (2.0, 1.0))
        for (x_m, z_m, radius_m, base_m), skin in zip(places, skins, strict=True)
    )


@dataclass(frozen=True)
class _View:
    """A viewpoint at low resolution, with the places where its lamps may be hung."""

    camera: Camera
    depth_m: Float32[np.ndarray, "height width"]

    @property
    def candidates(self) -> Int[np.ndarray, "pixels 2"]:
        """Return (row, column) of pixels away from depth edges and from the border."""
        dioptres = 1.0 / self.depth_m
        span = ndimage.maximum_filter(dioptres, 5) - ndimage.minimum_filter(dioptres, 5)
        inner = np.zeros(dioptres.shape, bool)
        inner[6:-6, 6:-6] = True
        return np.argwhere(inner & (span < _SMOOTH_DIOPTRES))

    def point_before_m(self, row: int, column: int) -> Float[np.ndarray, "3"]:
        """Return a point just before the surface under a pixel: a lamp far from what it is seen against could not be merged with it."""
        xy_px = np.array([column + 0.5, row + 0.5])
        point_m = self.camera.unproject(xy_px, np.array(float(self.depth_m[row, column])))
        towards = self.camera.world_from_camera[:3, 3] - point_m
        return point_m + _GAP_M * towards / np.linalg.norm(towards)


def fairy_lights(scene: Scene, cameras: Sequence[Camera], rng: np.random.Generator) -> Iterator[DiscLight]:
    """Hang LIGHTS_PER_VIEW small lamps in the sight of each camera, spread evenly over its dioptres.

    A lamp that would come within 5 % of the picture's width of another in any view is hung elsewhere.
    """
    views = [_View(camera, trace_pinhole(scene, camera, 1)[1]) for camera in cameras]
    hung_m: list[Float[np.ndarray, "3"]] = []
    for number, view in enumerate(views):
        for index, members in enumerate(_ranges_of_depth(view)):
            for row, column in members[rng.permutation(len(members))[:_ATTEMPTS]]:
                point_m = view.point_before_m(int(row), int(column))
                if all(_apart(point_m, hung_m, each.camera) for each in views):
                    hung_m.append(point_m)
                    tint = np.asarray(_TINTS[(index + number) % len(_TINTS)])
                    radius_m = rng.uniform(*_RADIUS_M_AT_1_M) * max(float(view.depth_m[row, column]), 0.8)
                    yield DiscLight(vector(point_m), float(radius_m), vector(tint * rng.uniform(*_RADIANCE)))
                    break


def _ranges_of_depth(view: _View) -> Iterator[Int[np.ndarray, "pixels 2"]]:
    """Return the candidates in LIGHTS_PER_VIEW equal ranges of dioptres."""
    pixels = view.candidates
    dioptres = 1.0 / view.depth_m[pixels[:, 0], pixels[:, 1]]
    number = np.floor((dioptres - dioptres.min()) / (np.ptp(dioptres) * (1 + 1e-6)) * LIGHTS_PER_VIEW).astype(int)
    return (pixels[number == each] for each in range(LIGHTS_PER_VIEW))


def _apart(point_m: Float[np.ndarray, "3"], others_m: Sequence[Float[np.ndarray, "3"]], camera: Camera) -> bool:
    """Return whether no other lamp is near in this camera's picture."""
    if not others_m:
        return True
    xy_px, _ = camera.project(np.stack([point_m, *others_m]))
    return bool(np.hypot(*(xy_px[1:] - xy_px[0]).T).min() >= _LEAST_DISTANCE_SHARE * camera.width_px)
