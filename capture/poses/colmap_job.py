"""The job given to COLMAP, a document that its process reads and that tells whether old results still fit, and its pictures.

The pictures are those of a folder, or the all-in-focus pictures of a scene, written with 8 bits.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.merging.metres.relative_stack import as_stated
from mrbokeh.images.color import luminance
from mrbokeh.images.image_io import write_preview
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import stated_distances_m
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

CAMERA_MODELS = ("SIMPLE_RADIAL", "RADIAL")
FEWEST_FOR_TWO_TERMS = 5
"""Pictures of one camera below which a second term of distortion fits noise: alone, it ran to -200 on sacre_coeur's facade."""

MAPPERS = ("incremental", "global")
CAMERA_CHOICES = ("auto", "shared", "separate")
JOB_NAME = "colmap_job.json"
DATABASE_NAME = "database.db"
MODEL_FOLDER = "sparse"
RECONSTRUCTION_FOLDER = "reconstruction"
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
Prior = tuple[float, float, float] | None
_MID_GREY = 0.18
_BRIGHT_QUANTILE = 0.95
_EVERY_NTH_PIXEL = 7


@dataclass(frozen=True)
class ColmapPicture:
    """One picture.

    name: of the view. file: relative to the folder of pictures. sha256: of the file. camera: number of its camera; pictures may share one.
    """

    name: str
    file: str
    sha256: str
    camera: int


@dataclass(frozen=True)
class ColmapJob:
    """Pictures, cameras and settings.

    fewest_terms: drop terms of distortion that the pictures do not support, once the poses are found.
    cameras: for each camera the prior (focal length, principal point x, y) in px of the pictures, or None to use the Exif data.
    pictures_folder: of the pictures, relative to the folder of the reconstruction or absolute.
    """

    pictures: tuple[ColmapPicture, ...]
    cameras: tuple[tuple[float, float, float] | None, ...]
    pictures_folder: str = "images"
    camera_model: str = "RADIAL"
    fewest_terms: bool = True
    mapper: str = "incremental"
    max_image_size_px: int = 1600
    seed: int = 0
    threads: int = -1

    def file_of(self, name: str) -> str:
        """Return the picture of a view, relative to the folder of pictures."""
        return next(each.file for each in self.pictures if each.name == name)

    def features_key(self) -> dict[str, Any]:
        """Return everything that features and matches depend on; if it differs, the database is useless."""
        document = job_to_json(self)
        return {key: value for key, value in document.items() if key not in ("mapper", "threads", "fewest_terms")}


def job_to_json(job: ColmapJob) -> dict[str, Any]:
    document = asdict(job)
    return document | {
        "pictures": [asdict(each) for each in job.pictures],
        "cameras": [None if prior is None else list(prior) for prior in job.cameras],
    }


def job_from_json(document: dict[str, Any]) -> ColmapJob:
    pictures = tuple(ColmapPicture(**each) for each in document["pictures"])
    cameras = tuple(None if prior is None else (prior[0], prior[1], prior[2]) for prior in document["cameras"])
    return ColmapJob(**document | {"pictures": pictures, "cameras": cameras})


def camera_model_for(cameras: Sequence[int], choice: str) -> str:
    """Resolve "auto": two terms of distortion if every camera has enough pictures, else one. cameras: the camera number of each picture."""
    if choice != "auto":
        return choice
    fewest = min(Counter(cameras).values())
    return "RADIAL" if fewest >= FEWEST_FOR_TWO_TERMS else "SIMPLE_RADIAL"


def view_name(stack: FocalStack, scene: Path) -> str:
    """Return the folder of a stack relative to the scene, with slashes."""
    return stack.folder.relative_to(scene).as_posix()


def write_stack_pictures(scene: Path, stacks: Sequence[FocalStack], images: Path) -> list[str]:
    """Write VIEW.png of every stack, all at one exposure; return the file names below `images`."""
    stops = common_exposure_stops(stacks)
    files = [f"{view_name(stack, scene)}.png" for stack in stacks]
    for stack, file in zip(track(stacks, "pictures for COLMAP"), files, strict=True):
        write_preview(images / file, stack.all_in_focus(), stops)
    return files


def common_exposure_stops(stacks: Sequence[FocalStack]) -> float:
    """Return the stops that bring the median luminance of all views to mid grey with at most 5 % of the pixels above white."""
    values = [luminance(stack.all_in_focus())[::_EVERY_NTH_PIXEL, ::_EVERY_NTH_PIXEL].ravel() for stack in stacks]
    pooled = np.concatenate(values)
    middle, bright = float(np.median(pooled)), float(np.quantile(pooled, _BRIGHT_QUANTILE))
    gain = min(_MID_GREY / max(middle, 1e-6), 1.0 / max(bright, 1e-6))
    return float(np.log2(gain))


def stack_cameras(stacks: Sequence[FocalStack], choice: str) -> tuple[list[int], list[Prior]]:
    """Return (camera number of each stack, prior of each camera): one for each size, lens and focus of the reference slice.

    The focal length in pixels breathes with the focus, so only pictures registered to the same focus share a camera. If the focus is
    unknown, stacks of one size are assumed to share it; distances guessed by merging are not used as priors.
    """
    stacks = [as_stated(stack) for stack in stacks]
    keys = [_camera_key(stack) for stack in stacks]
    priors = [None if each.camera is None else (each.camera.focal_px[0], *each.camera.principal_px) for each in stacks]
    return _numbered(keys, priors, choice)


def _camera_key(stack: FocalStack) -> tuple[object, ...]:
    if stack.camera is None or stack.lens is None:
        height_px, width_px = stack.all_in_focus().shape[:2]
        return width_px, height_px
    lens, stated_m = stack.lens, stated_distances_m(stack)[stack.reference]
    dioptres = round(1.0 / (stated_m or lens.focus_distance_m), 4)
    return stack.camera.width_px, stack.camera.height_px, round(lens.focal_length_mm, 3), dioptres


def picture_cameras(files: Sequence[Path], choice: str) -> tuple[list[int], list[Prior]]:
    """Return one camera for all pictures if they have one size, else one for each; the focal length comes from Exif."""
    sizes = [_size_px(file) for file in files]
    if choice == "auto":
        choice = "shared" if len(set(sizes)) == 1 else "separate"
    return _numbered(sizes, [None] * len(files), choice)


def _numbered(keys: Sequence[object], priors: Sequence[Prior], choice: str) -> tuple[list[int], list[Prior]]:
    if choice == "separate":
        return list(range(len(keys))), list(priors)
    if choice == "shared" and len({_size_of(key) for key in keys}) > 1:
        raise InputError("--cameras shared needs pictures of one size, but they differ: leave it at auto, or give separate")
    grouped: list[object] = ["all"] * len(keys) if choice == "shared" else list(keys)
    order = list(dict.fromkeys(grouped))
    return [order.index(key) for key in grouped], [priors[grouped.index(key)] for key in order]


def _size_of(key: object) -> object:
    return key[:2] if isinstance(key, tuple) else key


def _size_px(file: Path) -> tuple[int, int]:
    import cv2

    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise InputError(f"cannot read the picture {file}: expected one of {', '.join(PICTURE_SUFFIXES)}; take it out of the folder")
    return picture.shape[1], picture.shape[0]


def pictures_in(folder: Path) -> list[Path]:
    """List the pictures of a folder by name. Raises InputError if there are fewer than two."""
    if not folder.is_dir():
        raise InputError(f"expected a folder of pictures at {folder}, but there is none")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES)
    if len(files) < 2:
        raise InputError(f"expected at least 2 pictures ({', '.join(PICTURE_SUFFIXES)}) in {folder}, found {len(files)}")
    return files


def described(names: Sequence[str], files: Sequence[str], cameras: Sequence[int], folder: Path) -> tuple[ColmapPicture, ...]:
    """Describe the pictures with a hash of each file, so that changed pictures are noticed."""
    hashes = [hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in files]
    rows = zip(names, files, hashes, cameras, strict=True)
    return tuple(ColmapPicture(name, file, sha256, camera) for name, file, sha256, camera in rows)
