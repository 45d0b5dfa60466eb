"""SparseModel: cameras of many viewpoints and the points they have in common, as structure from motion finds them, and its files.

Cameras have radial lens distortion (`mrbokeh.distortion.radial`). Positions are converted between the undistorted pinhole and the picture;
pictures are never resampled.

A SparseModel on disk is poses.json (views), points.npz (points and observations) and scale.json (metres, see `capture.scale.answer`).

poses.json: {"format": "mrbokeh-poses", "version": 1, "views": [{"name", "camera": {...}, "distortion": [k1, k2]}], "left_out": [names]}
camera_from_world of a view is in the model's own unit; scale.json, if present, states its metres.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Int

from mrbokeh.distortion.radial import Distortion, distorted_px, undistorted_px
from mrbokeh.optics.camera import Camera, camera_from_json, camera_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-poses"
VERSION = 1
POSES_NAME = "poses.json"
POINTS_NAME = "points.npz"
SCALE_NAME = "scale.json"
_ARRAYS = ("points", "errors_px", "observations", "observed_xy_px")


@dataclass(frozen=True)
class SparseView:
    """One viewpoint.

    name: of its stack (folder below the scene).
    camera: the pinhole part; the translation of camera_from_world is in the model's unit.
    distortion: radial k1, k2; 0, 0 is a pinhole.
    """

    name: str
    camera: Camera
    distortion: Distortion = (0.0, 0.0)

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Return the camera's centre (entrance pupil) in the world, in the model's unit."""
        return self.camera.world_from_camera[:3, 3]

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Project world points to (positions in the picture, depth along the axis in the model's unit)."""
        xy_px, depth = self.camera.project(points)
        return distorted_px(self.camera, self.distortion, xy_px), depth

    def unproject(self, xy_px: Float[np.ndarray, "*batch 2"], depth: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Convert positions in the picture at a depth to world points: the inverse of `project`."""
        return self.camera.unproject(undistorted_px(self.camera, self.distortion, xy_px), depth)


@dataclass(frozen=True)
class SparseModel:
    """Views, points and their observations. All lengths are in the model's own unit.

    errors_px: mean reprojection error of each point.
    observations: (M, 2) index of the view, index of the point; observed_xy_px: (M, 2) position in the picture.
    metres_per_unit: None until the scale is known; 1 if lengths are metres.
    left_out: names of views that could not be placed.
    """

    views: tuple[SparseView, ...]
    points: Float[np.ndarray, "points 3"]
    errors_px: Float[np.ndarray, " points"]
    observations: Int[np.ndarray, "observations 2"]
    observed_xy_px: Float[np.ndarray, "observations 2"]
    metres_per_unit: float | None = None
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.observations) and not (
            self.observations.min() >= 0
            and self.observations[:, 0].max() < len(self.views)
            and self.observations[:, 1].max() < len(self.points)
        ):
            raise InputError(
                f"the observations of a sparse model must name one of its {len(self.views)} views and {len(self.points)} points: "
                f"they do not, so run `mrbokeh capture poses --overwrite`"
            )

    def view(self, name: str) -> SparseView:
        return self.views[self.index_of(name)]

    def index_of(self, name: str) -> int:
        for index, each in enumerate(self.views):
            if each.name == name:
                return index
        why = " (it was left out, see poses.json)" if name in self.left_out else ""
        raise InputError(f"expected a view of the sparse model, got {name!r}{why}: choose one of {', '.join(v.name for v in self.views)}")

    def scaled(self) -> "SparseModel":
        """Return the model in metres. Raises InputError if the scale is not known."""
        if self.metres_per_unit is None:
            raise InputError("the poses have no scale in metres yet: run `mrbokeh capture scale` on the scene")
        return self.times(self.metres_per_unit)

    def times(self, metres_per_unit: float) -> "SparseModel":
        """Return the model with all lengths multiplied by a trial scale; the result counts as metres."""
        views = []
        for each in self.views:
            pose = each.camera.camera_from_world.copy()
            pose[:3, 3] *= metres_per_unit
            views.append(replace(each, camera=replace(each.camera, camera_from_world=pose)))
        return replace(self, views=tuple(views), points=self.points * metres_per_unit, metres_per_unit=1.0)

    def moved(self, there_from_world: Float[np.ndarray, "4 4"]) -> "SparseModel":
        """Return the model in another world: a rotation and a shift in the model's unit."""
        back = np.linalg.inv(there_from_world)
        views = tuple(
            replace(each, camera=replace(each.camera, camera_from_world=each.camera.camera_from_world @ back)) for each in self.views
        )
        return replace(self, views=views, points=self.points @ there_from_world[:3, :3].T + there_from_world[:3, 3])

    def points_of(self, view: SparseView | str) -> Int[np.ndarray, " seen"]:
        """Return the indices of the points that a view observes, in the order of `depths_in`."""
        return self.observations[self._of_view(view), 1]

    def depths_in(self, view: SparseView | str) -> tuple[Float[np.ndarray, "seen 2"], Float[np.ndarray, " seen"]]:
        """Return (positions in the picture (K, 2), depth along the axis (K,) in the model's unit) of the points that a view observes."""
        seen = self.view(view) if isinstance(view, str) else view
        _, depth = seen.camera.project(self.points[self.points_of(view)])
        return self.observed_xy_px[self._of_view(view)], depth

    def _of_view(self, view: SparseView | str) -> Int[np.ndarray, " seen"]:
        name = view if isinstance(view, str) else view.name
        return np.flatnonzero(self.observations[:, 0] == self.index_of(name))


def write_sparse_model(folder: Path | str, model: SparseModel) -> None:
    """Write the model, poses.json last as the sign that it is whole; the scale of an earlier model is deleted."""
    folder = Path(folder)
    for stale in (POSES_NAME, SCALE_NAME):
        (folder / stale).unlink(missing_ok=True)
    with atomic_path(folder / POINTS_NAME) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: getattr(model, name) for name in _ARRAYS})
    write_json(folder / POSES_NAME, _document(model))


def read_sparse_model(folder: Path | str) -> SparseModel:
    """Read the model of SCENE/reconstruction; metres_per_unit is that of scale.json, None if there is none yet."""
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
