"""SparseMap: a COLMAP model as a map to find a camera in; its points in metres, each with how it looked in the pictures that saw it.

The folder is what `mrbokeh capture poses` and `scale` write (SCENE/reconstruction: sparse/, images/, scale.json), or what COLMAP
does (sparse/0/, images/) with the scale given by hand. Looking at all pictures takes a while, once: localisation.npz keeps it. Looks are
SIFT (Lowe 2004) as RootSIFT (Arandjelovic and Zisserman 2012).
"""

import hashlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from scipy.spatial import cKDTree

from mrbokeh.system.atomic_files import atomic_path, read_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError, MissingExtraError

_LENGTH = 128

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class Features:
    """Features of a picture. xy_px: the centre of the first pixel is at (0.5, 0.5). descriptors: of length 1."""

    xy_px: Float64[np.ndarray, "features 2"]
    descriptors: Float32[np.ndarray, "features 128"]


def find_features(grey: Grey, most: int) -> Features:
    """Return the strongest features."""
    keypoints, descriptors = cv2.SIFT.create(nfeatures=most).detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, _LENGTH), np.float32))
    xy_px = np.array([point.pt for point in keypoints], np.float64) + 0.5
    # Hellinger's distance: roots of descriptors whose sum is 1.
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(xy_px, roots.astype(np.float32))


CACHE_NAME = "localisation.npz"
SCALE_NAME = "scale.json"
JOB_NAME = "colmap_job.json"

_MODEL_FOLDERS = ("sparse", "sparse/0", ".")
_PICTURE_SIDE_PX = 1024
_FEATURES_PER_PICTURE = 6000
_SAME_PLACE_PX = 1.5
_LOOKS_PER_POINT = 8
_STEPS = 512.0  # of an element of a descriptor of length 1, as COLMAP stores it
_CACHE_VERSION = 1
_BYTES_PER_ENTRY = {"points3D": 43, "images": 69, "cameras": 24}
"""Number, place, colour and error of a point; number, pose, camera and name of an image; number, model and size of a camera."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SparseMap:
    """Map to find a camera in.

    points_m: map axes. descriptors: RootSIFT, sorted by point; point_of: which point each belongs to, every point has one at least.
    """

    points_m: Float64[np.ndarray, "points 3"]
    descriptors: Float32[np.ndarray, "looks 128"]
    point_of: Int64[np.ndarray, " looks"]


def read_sparse_map(folder: Path | str, metres_per_unit: float | None = None) -> SparseMap:
    """Read a map.

    metres_per_unit: of the model; None takes that of scale.json. Raises InputError where model, pictures or scale are missing.
    """
    folder = Path(folder)
    scale = _metres_per_unit(folder, metres_per_unit)
    model_folder = _model_folder(folder)
    key = _key(model_folder)
    arrays = _cached(folder / CACHE_NAME, key)
    if arrays is None:
        arrays = _looked_at(_model(model_folder), _pictures_folder(folder))
        _keep(folder / CACHE_NAME, key, arrays)
    points, codes, point_of = arrays
    return SparseMap(points * scale, codes.astype(np.float32) / np.float32(_STEPS), point_of)


def _metres_per_unit(folder: Path, given: float | None) -> float:
    if given is None:
        path = folder / SCALE_NAME
        document = read_json(path, "the scale of the map in metres (run `mrbokeh capture scale`, or give metres per unit)")
        given = document.get("metres_per_unit") if isinstance(document, dict) else None
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0.0 < given < np.inf:
        raise InputError(f"expected the metres per unit of the map {folder} to be a positive number, got {given!r}")
    return float(given)


def _model_folder(folder: Path) -> Path:
    for name in _MODEL_FOLDERS:
        if (folder / name / "points3D.bin").exists() or (folder / name / "points3D.txt").exists():
            return folder / name
    raise InputError(f"expected a COLMAP model (points3D.bin) in {folder / 'sparse'}: run `mrbokeh capture poses`, or COLMAP")


def _pictures_folder(folder: Path) -> Path:
    """Return images/ beside the model, or where the job of `capture poses` says that they lie."""
    job = folder / JOB_NAME
    stated = read_json(job, "a job for COLMAP").get("pictures_folder", "images") if job.exists() else "images"
    pictures = folder / stated
    if not pictures.is_dir():
        raise InputError(f"expected the pictures of the map at {pictures}, but there is no such folder: put them there")
    return pictures


def _model(folder: Path) -> Any:
    _require_whole(folder)
    try:
        model = require_pycolmap().Reconstruction(folder)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"cannot read the COLMAP model in {folder} ({error}): run COLMAP again") from None
    if not model.num_points3D():
        raise InputError(f"the COLMAP model in {folder} has no points: run COLMAP again with more pictures")
    return model


def _require_whole(folder: Path) -> None:
    """Refuse half a file: COLMAP believes its counts and asks for all memory there is."""
    for name, least_bytes in _BYTES_PER_ENTRY.items():
        path = folder / f"{name}.bin"
        if path.exists():
            with path.open("rb") as file:
                count = int.from_bytes(file.read(8), "little")
            if path.stat().st_size < 8 + count * least_bytes:
                raise InputError(f"{path} is cut off: copy it again, or run COLMAP again")


def _key(folder: Path) -> str:
    files = sorted(path for path in folder.iterdir() if path.stem in ("points3D", "images"))
    digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    return " ".join([str(_CACHE_VERSION), str(_PICTURE_SIDE_PX), *digests])


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points in the model's unit, descriptors as codes, which point each belongs to."""


def _cached(path: Path, key: str) -> Arrays | None:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return (file["points"], file["codes"], file["point_of"]) if str(file["key"]) == key else None
    except (OSError, ValueError, KeyError, BadZipFile):
        return None


def _keep(path: Path, key: str, arrays: Arrays) -> None:
    """Keep the looks; a folder that cannot be written to costs time at every start, no more."""
    points, codes, point_of = arrays
    try:
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, key=key, points=points, codes=codes, point_of=point_of)
    except OSError as error:
        log.warning("the looks of the map's points cannot be kept in %s (%s): every start takes this long", path, error)


def _looked_at(model: Any, pictures: Path) -> Arrays:
    looks = list(_looks(model, pictures))
    numbers = np.concatenate([number for number, _ in looks]) if looks else np.zeros(0, np.int64)
    if not len(numbers):
        raise InputError(f"none of the map's points was found again in the pictures of {pictures}: are they those of the model?")
    codes = np.concatenate([code for _, code in looks])
    order = np.argsort(numbers, kind="stable")
    kept, point_of = np.unique(numbers[order], return_inverse=True)
    # The first looks of each point are as good as all of them, and matching takes as long as there are looks.
    rank = np.arange(len(order)) - np.searchsorted(point_of, point_of)
    few = rank < _LOOKS_PER_POINT
    points = np.array([model.points3D[int(number)].xyz for number in kept], np.float64)
    return points, codes[order][few], point_of[few].astype(np.int64)


def _looks(model: Any, pictures: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (numbers of the points seen, codes of what they look like) of each picture."""
    for image in track(sorted(model.images.values(), key=lambda each: each.name), "map"):
        observed = image.get_observation_points2D() if image.has_pose else []
        grey = cv2.imread(str(pictures / image.name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if grey is None:
            raise InputError(f"cannot read the picture {pictures / image.name} of the map: put it back")
        if not len(observed):
            continue
        smaller = min(1.0, _PICTURE_SIDE_PX / max(grey.shape))
        small = cv2.resize(grey, None, fx=smaller, fy=smaller, interpolation=cv2.INTER_AREA) if smaller < 1.0 else grey
        features = find_features(small, _FEATURES_PER_PICTURE)
        if not len(features.xy_px):
            continue
        places = np.array([point.xy for point in observed]) * (np.array(small.shape[::-1]) / grey.shape[::-1])
        off_px, nearest = cKDTree(features.xy_px).query(places)
        same = off_px < _SAME_PLACE_PX
        numbers = np.array([point.point3D_id for point in observed], np.int64)
        yield numbers[same], np.round(features.descriptors[nearest[same]] * _STEPS).clip(0, 255).astype(np.uint8)


def require_pycolmap() -> Any:
    """Return the package that reads COLMAP's models."""
    try:
        import pycolmap
    except ImportError:
        raise MissingExtraError("pycolmap", "capture") from None
    return pycolmap
