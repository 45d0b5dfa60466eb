"""Make a clip of a printed board on a table, ray-traced through a lens and held by hand, with the exact pose of every frame.

    mrbokeh viewfinder board --out board.pdf                      # also writes board.json
    python -m datasets_scripts.charuco_clip board.json clip.mp4   # and clip.json: the camera of each frame

Any board will do: of board.json only black_mm is read, rectangles of x, y, width, height in millimetres. Every edge of the print is
exact, not a texture. The sheet lies in the plane z = 0, x right, y down, z into the table (board axes of OpenCV); a camera above it has
z < 0. A ray leaves a pixel through a point of the round pupil and the focus plane (Cook et al. 1984), as in `tracers.thin_lens`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from datasets_scripts.made_sets.set_files import Overwrite, mistakes_told
from datasets_scripts.scenes.textures import mottled
from datasets_scripts.tracers._sheet_numba import PackedLens, PackedTable, shade
from mrbokeh.optics.camera import Camera, camera_of_lens, camera_to_json
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.atomic_files import read_json, refuse_existing, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.video.writer import VideoWriter

# Sines of unrelated periods: (Hz, share). Breathing and swaying below 1 Hz, tremor of the hand at 6 to 11 Hz.
_SWAY = ((0.23, 1.0), (0.41, 0.5), (0.87, 0.25))
_TREMOR = ((6.1, 1.0), (8.3, 0.7), (10.9, 0.4))
_FOCAL_LENGTH_MM, _SENSOR_WIDTH_MM = 22.0, 24.0
_TABLE_TEXELS = 256


@dataclass(frozen=True)
class Sheet:
    """A printed sheet. black_mm: (N, 4) x, y, width, height, without overlap. margin_mm: white paper around. paper, ink: reflectances."""

    black_mm: Float64[np.ndarray, "rectangles 4"]
    margin_mm: float = 12.0
    paper: float = 0.62
    ink: float = 0.03

    @property
    def middle_m(self) -> Float64[np.ndarray, "3"]:
        ends = self.black_mm[:, :2] + self.black_mm[:, 2:]
        return np.append((self.black_mm[:, :2].min(axis=0) + ends.max(axis=0)) / 2.0, 0.0) / MM_PER_M


def trace_sheet(
    table: PackedTable, camera: Camera, lens: Lens | None, samples: int, seed: int = 0
) -> Float32[np.ndarray, "height width 3"]:
    """Return scene-linear RGB. lens: None is a pinhole; else its focus and aperture blur, while the geometry is that of the camera.

    samples: rays per pixel, Sobol points that every pixel shifts by its own vector.
    """
    from scipy.stats import qmc

    rng = np.random.default_rng(seed)
    points = qmc.Sobol(4, scramble=True, rng=rng).random_base2(int(np.ceil(np.log2(samples))))[:samples]
    rgb = np.empty((camera.height_px, camera.width_px, 3), np.float32)
    radius_m, focus_m = (0.0, 1.0) if lens is None else (lens.aperture_diameter_mm / 2.0 / MM_PER_M, lens.focus_distance_m)
    intrinsics = np.array(camera.focal_px), np.array(camera.principal_px)
    shade(table, PackedLens(camera.world_from_camera, *intrinsics, radius_m, focus_m), points, rng.random((*rgb.shape[:2], 4)), rgb)
    return rgb


def with_noise(rgb: Float[np.ndarray, "height width 3"], noise: float, rng: np.random.Generator) -> Float32[np.ndarray, "height width 3"]:
    """Add noise. noise: standard deviation at radiance 1; photons make it fall with the root, read noise adds a tenth of it."""
    sigma = noise * np.sqrt(np.maximum(rgb, 0.0) + 0.01)
    return (rgb + sigma * rng.standard_normal(rgb.shape)).astype(np.float32)


@dataclass(frozen=True)
class HandHeld:
    """The path of a hand-held camera: it looks at target_m from distance_m, elevation_deg above the table, wanders and trembles.

    sway_m, sway_deg: how far position and gaze wander. tremor_m, tremor_deg: amplitudes of the trembling.
    """

    target_m: tuple[float, float, float]
    distance_m: float = 0.6
    elevation_deg: float = 50.0
    sway_m: float = 0.06
    sway_deg: float = 3.0
    tremor_m: float = 0.0006
    tremor_deg: float = 0.06
    seed: int = 0

    def camera_from_world(self, time_s: float) -> Float64[np.ndarray, "4 4"]:
        rng = np.random.default_rng(self.seed)
        moved_m = self.sway_m * _wander(_SWAY, time_s, rng) + self.tremor_m * _wander(_TREMOR, time_s, rng)
        turned_deg = self.sway_deg * _wander(_SWAY, time_s, rng) + self.tremor_deg * _wander(_TREMOR, time_s, rng)
        up = np.deg2rad(self.elevation_deg)
        # Below the sheet's lower edge (+y) and above the table (-z), looking at the target; x stays to the right.
        base = Rotation.from_euler("x", up - np.pi / 2).as_matrix()
        centre = np.asarray(self.target_m) + self.distance_m * np.array([0.0, np.cos(up), -np.sin(up)]) + moved_m
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(turned_deg, degrees=True).as_matrix() @ base
        pose[:3, 3] = -pose[:3, :3] @ centre
        return pose


def _wander(sines: tuple[tuple[float, float], ...], time_s: float, rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    phases = rng.uniform(0, 2 * np.pi, (len(sines), 3))
    return np.sum([share * np.sin(2 * np.pi * rate * time_s + phase) for (rate, share), phase in zip(sines, phases, strict=True)], axis=0)


def pack_table(sheet: Sheet, seed: int = 0) -> PackedTable:
    """Turn the print into a grid of uneven cells, each black or not: a point is looked up exactly, by two searches."""
    # Neighbours share edges but for rounding, which must not open gaps.
    begin, end = sheet.black_mm[:, :2].round(6), (sheet.black_mm[:, :2] + sheet.black_mm[:, 2:]).round(6)
    edges = [_merged(np.concatenate([begin[:, axis], end[:, axis]])) for axis in (0, 1)]
    black = np.zeros((len(edges[1]) - 1, len(edges[0]) - 1), bool)
    for low, high in zip(begin, end, strict=True):
        (left, right), (top, bottom) = (
            (np.abs(edges[axis] - low[axis]).argmin(), np.abs(edges[axis] - high[axis]).argmin()) for axis in (0, 1)
        )
        black[top:bottom, left:right] = True
    outline = np.concatenate([begin.min(axis=0) - sheet.margin_mm, end.max(axis=0) + sheet.margin_mm])
    table = mottled(_TABLE_TEXELS, np.random.default_rng(seed), (0.10, 0.07, 0.05), (0.34, 0.25, 0.18)).astype(np.float64)
    white, ink = np.full(3, sheet.paper), np.full(3, sheet.ink)
    return PackedTable(
        edges_x=edges[0] / MM_PER_M, edges_y=edges[1] / MM_PER_M, black=black, sheet=outline / MM_PER_M, paper=white, ink=ink, table=table
    )


def _merged(edges_mm: Float64[np.ndarray, " edges"]) -> Float64[np.ndarray, " merged"]:
    unique = np.unique(edges_mm)
    return unique[np.append(True, np.diff(unique) > 1e-4)]


@dataclass(frozen=True)
class BoardClip:
    """A clip to make. lens: blurs and gives the angle of view; its focus is where the clip is sharp. samples: rays per pixel."""

    sheet: Sheet
    motion: HandHeld
    lens: Lens
    width_px: int = 1280
    height_px: int = 720
    frames: int = 90
    fps: int = 30
    noise: float = 0.01
    samples: int = 16

    def camera(self, frame: int) -> Camera:
        ahead = camera_of_lens(self.lens, self.width_px, self.height_px)
        return replace(ahead, camera_from_world=self.motion.camera_from_world(frame / self.fps))

    def pictures(self) -> Iterator[Float32[np.ndarray, "height width 3"]]:
        """Yield scene-linear RGB, frame by frame; the same numbers at every call."""
        table = pack_table(self.sheet, self.motion.seed)
        for frame in range(self.frames):
            rgb = trace_sheet(table, self.camera(frame), self.lens, self.samples, seed=frame)
            yield with_noise(rgb, self.noise, np.random.default_rng([self.motion.seed, frame]))


def write_clip(path: Path, clip: BoardClip, *, overwrite: bool = False) -> None:
    """Write the video, and beside it a .json of the same name with the camera of each frame."""
    for each in (path, path.with_suffix(".json")):
        refuse_existing(each, overwrite)
    with VideoWriter(path, clip.width_px, clip.height_px, Fraction(clip.fps)) as video:
        for number, rgb in enumerate(track(clip.pictures(), "tracing", clip.frames)):
            video.write(rgb, number / clip.fps)
    lens = {"focal_length_mm": clip.lens.focal_length_mm, "f_number": clip.lens.f_number, "focus_distance_m": clip.lens.focus_distance_m}
    cameras = [camera_to_json(clip.camera(frame)) for frame in range(clip.frames)]
    write_json(path.with_suffix(".json"), {"fps": clip.fps, "lens": lens, "cameras": cameras})


def read_sheet(path: Path) -> Sheet:
    document = read_json(path, "a board with black_mm")
    try:
        black_mm = np.asarray(document["black_mm"], np.float64).reshape(-1, 4)
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: expected black_mm, a list of [x, y, width, height] in millimetres") from None
    if not len(black_mm) or (black_mm[:, 2:] <= 0).any():
        raise InputError(f"{path}: expected black_mm with rectangles of positive width and height, got {len(black_mm)} of them")
    return Sheet(black_mm)


def main(
    board: Annotated[Path, typer.Argument(help="JSON with black_mm, as `mrbokeh viewfinder board` writes it.")],
    out: Annotated[Path, typer.Argument(help="Clip to write: .mp4 (H.264) or .mkv (lossless).")],
    frames: Annotated[int, typer.Option(min=1)] = 90,
    width: Annotated[int, typer.Option(min=16)] = 1280,
    height: Annotated[int, typer.Option(min=16)] = 720,
    fps: Annotated[int, typer.Option(min=1)] = 30,
    distance_m: Annotated[float, typer.Option(help="From the middle of the board.")] = 0.6,
    elevation_deg: Annotated[float, typer.Option(help="Of the camera above the table.")] = 50.0,
    focus_m: Annotated[float, typer.Option(help="Focus distance.")] = 0.6,
    f_number: Annotated[float, typer.Option(help="Of a 22 mm lens on a sensor 24 mm wide.")] = 8.0,
    noise: Annotated[float, typer.Option(help="Standard deviation of the light at white.")] = 0.01,
    samples: Annotated[int, typer.Option(help="Rays per pixel.", min=1)] = 16,
    seed: Annotated[int, typer.Option(help="Motion, table and noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Trace a hand-held clip of a board, with exact poses."""
    with mistakes_told():
        sheet = read_sheet(board)
        middle = sheet.middle_m
        target = (float(middle[0]), float(middle[1]), 0.0)
        motion = HandHeld(target, distance_m, elevation_deg, sway_m=0.1 * distance_m, seed=seed)
        lens = Lens(_FOCAL_LENGTH_MM, f_number, focus_m, _SENSOR_WIDTH_MM)
        clip = BoardClip(
            sheet=sheet, motion=motion, lens=lens, width_px=width, height_px=height, frames=frames, fps=fps, noise=noise, samples=samples
        )
        write_clip(out, clip, overwrite=overwrite)
    typer.echo(f"{out}: {frames} frames, their cameras in {out.with_suffix('.json')}")


if __name__ == "__main__":
    typer.run(main)
