"""A ray-traced board clip as a virtual camera, one shining card that stands on it, and where that card must be in each picture."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import cv2
import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import read_display_frames
from tests.support.stage_scenes import card
from tests.support.traced_board_clip import BOARD, clip_of
from tests.support.video_files import filmed
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import CharucoTracker

FPS = 30
GREEN = {"emissiveFactor": [0.0, 0.6, 0.0], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "doubleSided": True}
CARD_M, STANDS_AT_M = 0.04, (0.092, 0.12, 0.0)
SCENE = f'[[object]]\nname = "card"\nglb = "card.glb"\nposition_m = {list(STANDS_AT_M)}\nheight_m = {CARD_M}\n'
_GREENER = 24.0
"""By so many codes a pixel is greener than the board and the table ever are."""


@dataclass(frozen=True, eq=False)
class LiveClip:
    """path: the clip; plates: its pictures as a source gives them; cameras: the exact ones. The last leads back to the first."""

    path: Path
    scene: Path
    plates: Sequence[np.ndarray]
    cameras: Sequence[Camera]

    def plate(self, sequence: int) -> np.ndarray:
        return self.plates[sequence % len(self.plates)]

    def camera(self, sequence: int) -> Camera:
        """Of the capture of that number of a source that leaves none out."""
        return self.cameras[sequence % len(self.cameras)]


def write_live_clip(folder: Path, width_px: int, height_px: int, frames: int, suffix: str = ".mkv") -> LiveClip:
    """So many traced pictures, there and back again; lossless as .mkv. Beside it the scene with the card."""
    traced = clip_of(width_px, height_px, frames)
    pictures = list(traced.pictures())
    order = [*range(frames), *range(frames - 2, 0, -1)]
    path = filmed(folder / f"board{suffix}", (pictures[frame] for frame in order), FPS)
    plates = [frame.bgr for frame in read_display_frames(path, width_px, height_px)]
    card(folder, material=GREEN)
    scene = folder / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    return LiveClip(path, scene, plates, [traced.camera(frame) for frame in order])


def board_tracker() -> CharucoTracker:
    return CharucoTracker(BOARD)


class ClipCamera:
    """A FrameSource that gives the clip ("board"), a grey table, nothing (and says why), or up ("dead"): whatever `gives` says."""

    transfer = "bt709"
    AWAY, DEAD = "the made camera is away: plug it in", "the made camera is broken"

    def __init__(self, clip: LiveClip, fps: float = FPS) -> None:
        self.name, self.gives, self._fps = "made camera", "board", fps
        self._clip, self._table = clip, np.full_like(clip.plates[0], 90)

    @property
    def status(self) -> str | None:
        return self.AWAY if self.gives == "nothing" else None

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        sequence = 0
        while not stopping.wait(1 / self._fps):
            if self.gives == "dead":
                raise InputError(self.DEAD)
            if self.gives != "nothing":
                bgr = self._clip.plate(sequence) if self.gives == "board" else self._table
                yield CameraFrame(bgr, time.monotonic(), sequence)
            sequence += 1


def card_corners_m(moved_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """(4, 3), in the world of the board, whose up is -z; moved_m: right, and away from the viewer (-y of the board)."""
    x, y, z = np.add(STANDS_AT_M, (moved_m[0], -moved_m[1], 0.0))
    half = CARD_M / 2
    return np.array([[x - half, y, z], [x + half, y, z], [x + half, y, z - CARD_M], [x - half, y, z - CARD_M]])


def true_centroid_px(camera: Camera, moved_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Of the area of the card in the picture: of the quadrilateral of its projected corners."""
    corners_px = camera.project(card_corners_m(moved_m))[0]
    moments = cv2.moments(corners_px.astype(np.float32))
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]


def seen_centroid_px(bgr: np.ndarray, plate: np.ndarray) -> np.ndarray | None:
    """Of what is greener than in the plate, weighted by how much; None where fewer than 20 pixels are."""
    greener = _greenness(bgr) - _greenness(plate)
    greener[greener < _GREENER] = 0.0
    if np.count_nonzero(greener) < 20:
        return None
    y, x = np.indices(greener.shape) + 0.5
    return np.array([(greener * x).sum(), (greener * y).sum()]) / greener.sum()


def _greenness(bgr: np.ndarray) -> np.ndarray:
    codes = bgr.astype(np.float32)
    return codes[..., 1] - np.maximum(codes[..., 0], codes[..., 2])


def away_from_card(camera: Camera, margin_px: int = 24) -> np.ndarray:
    """(H, W) bool: pixels farther from the card's box than the codec carries anything."""
    low, high = (edge(camera.project(card_corners_m())[0], axis=0) for edge in (np.min, np.max))
    y, x = np.indices((camera.height_px, camera.width_px))
    inside = (x > low[0] - margin_px) & (x < high[0] + margin_px) & (y > low[1] - margin_px) & (y < high[1] + margin_px)
    return ~inside


def middle_of_card(bgr: np.ndarray, camera: Camera) -> np.ndarray:
    """(3,) mean codes of 8x8 pixels."""
    x, y = true_centroid_px(camera).astype(int)
    return bgr[y - 4 : y + 4, x - 4 : x + 4].reshape(-1, 3).mean(axis=0)


def psnr_db(one: np.ndarray, other: np.ndarray, where: np.ndarray | None = None) -> float:
    """Of 8-bit codes (H, W, 3), at the pixels of `where`."""
    error = np.square(one.astype(np.float32) - other)
    return float(10 * np.log10(255.0**2 / max(float(np.mean(error if where is None else error[where])), 1e-6)))
