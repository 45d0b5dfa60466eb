"""A stack of two things seen in one place: bright threads, as of a web, before a textured wall; each has its own slice."""

from pathlib import Path

import cv2
import numpy as np

from capture.merging.registration.registration_file import Registration, write_registration
from capture.stacks.ingest import ingest
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import FocalStack
from tests.support.made_photographs import only_stack

SIZE = (144, 192)
SLICES, NEAR, FAR = 7, 1, 5
THREAD = 0.9
STEP_PX = 1.6
"""Standard deviation of the blur by which neighbouring slices differ."""
SPACING_PX, WIDTH_PX = 48, 3
DISTANCES_M = (10.0, 11.0, 12.0, 14.0, 16.0, 19.0, 24.0)


def wall() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 1, (*SIZE, 3)).astype(np.float32)
    return np.clip(0.25 + 1.2 * (cv2.GaussianBlur(noise, (0, 0), 0.8) - 0.5), 0.02, 0.6)


def threads() -> np.ndarray:
    """(H, W) 1 on the threads, which run from the top to the bottom."""
    columns = np.arange(SIZE[1]) % SPACING_PX
    return np.tile((np.abs(columns - SPACING_PX // 2) <= WIDTH_PX // 2).astype(np.float32), (SIZE[0], 1))


def crossing_slices(has_threads: bool = True) -> list[np.ndarray]:
    """Threads let the wall through as the lens sees past them: coverage is blurred as light is. Without them the wall is alone."""
    covered = threads() if has_threads else np.zeros(SIZE, np.float32)
    slices = []
    for index in range(SLICES):
        coverage = blurred(covered, index - NEAR)[..., None]
        slices.append((1.0 - coverage) * blurred(wall(), index - FAR) + THREAD * coverage)
    return slices


def unmoved(folder: Path) -> Path:
    """A registration of slices that lie on one another as they are."""
    path = folder / "unmoved.json"
    identity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    write_registration(path, Registration(0, (identity,) * SLICES, (1.0,) * (SLICES - 1), (0.0,) * SLICES))
    return path


def blurred(plane: np.ndarray, steps: int) -> np.ndarray:
    return plane if steps == 0 else cv2.GaussianBlur(plane, (0, 0), STEP_PX * abs(steps), borderType=cv2.BORDER_REFLECT_101)


def crossing_stack(folder: Path, has_threads: bool = True, orientation: int = 1) -> FocalStack:
    """Ingested, not merged. orientation: what EXIF says of all slices."""
    import pyexiv2

    for index, rgb in enumerate(crossing_slices(has_threads)):
        path = folder / "shoot" / f"{index}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, rgb)
        with pyexiv2.Image(str(path)) as image:
            image.modify_exif({"Exif.Image.Orientation": str(orientation)})
    facts = f"focal_length_mm = 10.0\nf_number = 2.8\nsensor_width_mm = 6.2\nfocus_distances_m = {list(DISTANCES_M)}\n"
    (folder / "shoot" / "lens.toml").write_text(facts)
    return only_stack(ingest([folder / "shoot"], folder / "scene"))
