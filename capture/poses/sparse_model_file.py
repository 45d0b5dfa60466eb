"""A SparseModel on disk: poses.json (views), points.npz (points and observations) and scale.json (metres, see `scale_file`).

poses.json: {"format": "mrbokeh-poses", "version": 1, "views": [{"name", "camera": {...}, "distortion": [k1, k2]}], "left_out": [names]}
camera_from_world of a view is in the model's own unit; scale.json, where it is there, says how many metres that is.
"""

from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.optics.camera import camera_from_json, camera_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-poses"
VERSION = 1
POSES_NAME = "poses.json"
POINTS_NAME = "points.npz"
SCALE_NAME = "scale.json"

_ARRAYS = ("points", "errors_px", "observations", "observed_xy_px")


def write_sparse_model(folder: Path | str, model: SparseModel) -> None:
    """poses.json is written last and is the sign that the model is whole; the scale of an earlier model goes with that model."""
    folder = Path(folder)
    for stale in (POSES_NAME, SCALE_NAME):
        (folder / stale).unlink(missing_ok=True)
    with atomic_path(folder / POINTS_NAME) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: getattr(model, name) for name in _ARRAYS})
    write_json(folder / POSES_NAME, _document(model))


def read_sparse_model(folder: Path | str) -> SparseModel:
    """The model of SCENE/reconstruction; metres_per_unit is that of scale.json, None where there is none yet."""
    folder = Path(folder)
    document = read_json(folder / POSES_NAME, "camera poses (run `mrbokeh capture poses` on the scene)")
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(
            f"{folder / POSES_NAME}: expected format {FORMAT!r} version {VERSION}, got {document.get('format')!r} version "
            f"{document.get('version')!r}; run `mrbokeh capture poses --overwrite` on the scene"
        )
    try:
        views = tuple(_view(each, str(folder / POSES_NAME)) for each in document["views"])
        return SparseModel(views, **_arrays(folder / POINTS_NAME), metres_per_unit=_scale(folder), left_out=tuple(document["left_out"]))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        message = f"{folder / POSES_NAME} is incomplete ({error!r}): run `mrbokeh capture poses --overwrite` on the scene"
        raise InputError(message) from None


def _document(model: SparseModel) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "views": [{"name": each.name, "camera": camera_to_json(each.camera), "distortion": list(each.distortion)} for each in model.views],
        "left_out": list(model.left_out),
    }


def _view(document: dict[str, Any], where: str) -> SparseView:
    k1, k2 = document["distortion"]
    return SparseView(str(document["name"]), camera_from_json(document["camera"], where), (float(k1), float(k2)))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in _ARRAYS}
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise InputError(
            f"expected the points of a sparse model at {path}, but cannot read them ({error}): run `mrbokeh capture poses --overwrite`"
        ) from None


def _scale(folder: Path) -> float | None:
    path = folder / SCALE_NAME
    if not path.exists():
        return None
    scale = read_json(path, "the metric scale").get("metres_per_unit")
    if not (isinstance(scale, int | float) and 0 < scale < float("inf")):
        raise InputError(f"{path}: expected a positive metres_per_unit, got {scale!r}; run `mrbokeh capture scale --overwrite`")
    return float(scale)
