"""A traced scene of several viewpoints with a ChArUco board, and a focal stack of the first: what poses, scale and focus are tested on."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from datasets_scripts.scenes.textures import mottled, page_of_text, spots
from datasets_scripts.tracers.thin_lens import camera_for_lens, trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import Quad, Scene, Vector, emissive_quad
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid

WIDTH_PX, HEIGHT_PX = 400, 280
GRID = CharucoGrid((6, 5), 50.0, 37.0)
BOARD = CharucoBoard((GRID,))
BOARD_CORNER_M, BOARD_LEANS_RAD = (-0.16, 0.0, 1.0), np.deg2rad(40.0)
FOCUS_M = tuple(float(each) for each in 1.0 / np.linspace(1.0 / 0.62, 1.0 / 1.9, 8))
LENS = Lens(28.0, 2.0, FOCUS_M[0], 23.5, Aperture.disc())
POSITIONS_M = ((0.0, 0.0, 0.0), (0.13, -0.03, 0.02), (-0.12, 0.02, 0.03), (0.05, 0.1, -0.02), (-0.06, -0.11, 0.0), (0.19, 0.05, 0.05))
TURNS_RAD = ((0.0, 0.0), (-0.1, 0.02), (0.1, 0.0), (-0.03, 0.09), (0.04, -0.1), (-0.15, 0.04))


@cache
def scene() -> Scene:
    """A wall, a floor, cards at five depths and the board, all shining by themselves."""
    rng = np.random.default_rng(5)
    wall = spots(512, rng, (0.3, 0.3, 0.32), ((0.7, 0.2, 0.1), (0.1, 0.3, 0.6), (0.9, 0.9, 0.8)), 220, (4.0, 15.0))
    floor = mottled(256, rng, (0.1, 0.1, 0.12), (0.75, 0.7, 0.6), slope=0.4)
    quads = [
        emissive_quad((-1.6, -1.1, 1.8), (3.2, 0.0, 0.0), (0.0, 1.6, 0.0), wall, (2.0, 1.0)),
        emissive_quad((-1.2, 0.32, 1.8), (2.4, 0.0, 0.0), (0.0, 0.02, -1.35), floor, (6.0, 3.0)),
        _card((-0.28, -0.19, 0.7), 0.2, 0.16, 0.35, rng),
        _card((0.1, -0.28, 0.8), 0.2, 0.2, -0.3, rng),
        _card((-0.46, -0.05, 1.1), 0.3, 0.3, 0.2, rng),
        _card((0.3, -0.2, 1.25), 0.3, 0.36, -0.2, rng),
        _card((-0.12, -0.42, 1.45), 0.34, 0.3, 0.1, rng),
        _board(),
    ]
    return Scene(quads=tuple(quads))


def _card(corner_m: Vector, width_m: float, height_m: float, yaw_rad: float, rng: np.random.Generator) -> Quad:
    dark, light = rng.uniform(0.02, 0.15, 3), rng.uniform(0.5, 0.9, 3)
    ink, paper = (float(dark[0]), float(dark[1]), float(dark[2])), (float(light[0]), float(light[1]), float(light[2]))
    texture = page_of_text(int(200 * height_m / width_m), 200, rng, ink, paper, cell=4, headline=False)
    edge = (width_m * float(np.cos(yaw_rad)), 0.0, width_m * float(np.sin(yaw_rad)))
    return emissive_quad(corner_m, edge, (0.0, height_m, 0.0), texture)


def _board() -> Quad:
    """Lying on its back at half height: 48 texels for each square, black ink on white paper."""
    columns, rows = GRID.squares
    printed = BOARD.opencv_board(0).generateImage((48 * columns, 48 * rows), marginSize=0).astype(np.float32) / 255.0
    texture = np.repeat((0.03 + 0.77 * printed)[..., None], 3, axis=2)
    width_m, height_m = (side / MM_PER_M for side in BOARD.size_mm)
    down = height_m * np.array([0.0, np.cos(BOARD_LEANS_RAD), -np.sin(BOARD_LEANS_RAD)])
    return emissive_quad(BOARD_CORNER_M, (width_m, 0.0, 0.0), (0.0, float(down[1]), float(down[2])), texture)


def board_corners_m() -> np.ndarray:
    """Where the corners of the board are in the world, by id."""
    x, y, _ = BOARD.corners_m.T
    return np.stack([x, y * np.cos(BOARD_LEANS_RAD), -y * np.sin(BOARD_LEANS_RAD)], axis=1) + BOARD_CORNER_M


def true_camera(view: int) -> Camera:
    """The pinhole of a view with the focal length of the nearest focus; the world is that of view 0, in metres."""
    yaw, pitch = TURNS_RAD[view]
    turn_y = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    turn_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    pose = np.eye(4)
    pose[:3, :3] = turn_x @ turn_y
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(POSITIONS_M[view])
    camera = Camera(WIDTH_PX, HEIGHT_PX, (1.0, 1.0), (WIDTH_PX / 2.0, HEIGHT_PX / 2.0), pose)
    return camera_for_lens(camera, LENS)


@dataclass(frozen=True)
class Traced:
    """Sharp pictures of all views (linear RGB) and their true depth in metres."""

    sharp: tuple[np.ndarray, ...]
    depth_m: tuple[np.ndarray, ...]


def traced() -> Traced:
    pairs = [trace_pinhole(scene(), true_camera(view), 16, seed=view) for view in range(len(POSITIONS_M))]
    return Traced(tuple(rgb for rgb, _ in pairs), tuple(depth_m for _, depth_m in pairs))


def registered_slices() -> list[tuple[np.ndarray, float]]:
    """(linear RGB in the geometry of slice 0, how much it was enlarged) of each slice of view 0."""
    made = []
    for index, distance_m in enumerate(FOCUS_M):
        lens = LENS.focused_at(distance_m)
        camera = camera_for_lens(true_camera(0), lens)
        rgb = trace(scene(), camera, lens, 32, seed=100 + index)
        scale = LENS.focal_px(WIDTH_PX) / lens.focal_px(WIDTH_PX)
        # About the middle of the picture, which OpenCV puts half a pixel lower.
        middle = np.array([WIDTH_PX / 2.0 - 0.5, HEIGHT_PX / 2.0 - 0.5])
        matrix = np.column_stack([scale * np.eye(2), (1.0 - scale) * middle])
        made.append((cv2.warpAffine(rgb, matrix, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_CUBIC), scale))
    return made


def write_views(folder: Path, pictures: Traced, slices: list[tuple[np.ndarray, float]] | None = None) -> None:
    """FocalStack folders view_0, view_1, ...: merged; registered and with slices is only view_0, and only where they are given."""
    for view, sharp in enumerate(pictures.sharp):
        stack_folder = folder / f"view_{view}"
        write_image(stack_folder / "all_in_focus.exr", sharp)
        camera = replace(true_camera(0), camera_from_world=np.eye(4))
        listed = tuple(Slice(f"registered/{index:02d}.exr", distance_m) for index, distance_m in enumerate(FOCUS_M))
        if view == 0 and slices is not None:
            listed = tuple(replace(each, scale=scale) for each, (_, scale) in zip(listed, slices, strict=True))
            for each, (rgb, _) in zip(listed, slices, strict=True):
                write_image(stack_folder / each.path, rgb)
        write_focal_stack(FocalStack(stack_folder, listed, LENS, camera, 0, registered=view == 0 and slices is not None, merged=True))
