"""Camera poses of many viewpoints by COLMAP (Schoenberger and Frahm 2016; global: Pan et al. 2024): SIFT, matches, mapping."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.poses.colmap_job import CAMERA_MODELS, MAPPERS, ColmapJob, camera_model_for, job_from_json, job_to_json
from capture.poses.colmap_matches import failure_message, weak_model_message
from capture.poses.colmap_pictures import (
    CAMERA_CHOICES,
    described,
    picture_cameras,
    pictures_in,
    stack_cameras,
    view_name,
    write_stack_pictures,
)
from capture.poses.colmap_process import DATABASE_NAME, run_colmap
from capture.poses.sparse_model import SparseModel
from capture.poses.sparse_model_file import POSES_NAME, SCALE_NAME, read_sparse_model
from mrbokeh.stacks.focal_stack import find_focal_stacks
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

RECONSTRUCTION_FOLDER = "reconstruction"
IMAGES_FOLDER = "images"
JOB_NAME = "colmap_job.json"


@dataclass(frozen=True)
class PoseSettings:
    """cameras: auto, shared or separate. threads: -1 takes all cores; only 1 repeats to the last digits. seed: of COLMAP's draws."""

    mapper: str = "incremental"
    camera_model: str = "auto"
    cameras: str = "auto"
    max_image_size_px: int = 1600
    seed: int = 0
    threads: int = -1
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("mapper", self.mapper, MAPPERS),
            ("camera-model", self.camera_model, ("auto", *CAMERA_MODELS)),
            ("cameras", self.cameras, CAMERA_CHOICES),
        ):
            if value not in choices:
                raise InputError(f"--{name} must be one of {', '.join(choices)}, got {value!r}")


def find_scene_poses(scene: Path | str, settings: PoseSettings | None = None) -> SparseModel:
    """Poses of all merged stacks of a scene, in SCENE/reconstruction; what is there already is kept or gone on with."""
    scene, settings = Path(scene), settings or PoseSettings()
    folder = scene / RECONSTRUCTION_FOLDER
    if _kept(folder, settings):
        return read_sparse_model(folder)
    stacks = find_focal_stacks(scene)
    if len(stacks) < 2:
        raise InputError(f"{scene} has one stack: camera poses need at least 2 viewpoints, better 5; ingest and merge more")
    names = [view_name(stack, scene) for stack in stacks]
    files = write_stack_pictures(scene, stacks, folder / IMAGES_FOLDER)
    numbers, priors = stack_cameras(stacks, settings.cameras)
    pictures = described(names, files, numbers, folder / IMAGES_FOLDER)
    return _solve(folder, ColmapJob(pictures, tuple(priors), IMAGES_FOLDER, **_common(settings, numbers)))


def find_picture_poses(images: Path | str, out: Path | str, settings: PoseSettings | None = None) -> SparseModel:
    """Poses of the pictures of a plain folder, in `out`; the views are named as the files."""
    images, out, settings = Path(images), Path(out), settings or PoseSettings()
    if _kept(out, settings):
        return read_sparse_model(out)
    files = pictures_in(images)
    numbers, priors = picture_cameras(files, settings.cameras)
    pictures = described([file.stem for file in files], [file.name for file in files], numbers, images)
    return _solve(out, ColmapJob(pictures, tuple(priors), str(images.resolve()), **_common(settings, numbers)))


def _common(settings: PoseSettings, cameras: Sequence[int]) -> dict[str, Any]:
    names = ("mapper", "max_image_size_px", "seed", "threads")
    common = {name: getattr(settings, name) for name in names}
    chosen = camera_model_for(cameras, settings.camera_model)
    return common | {"camera_model": chosen, "fewest_terms": settings.camera_model == "auto"}


def _kept(folder: Path, settings: PoseSettings) -> bool:
    """Whether finished poses stay; to overwrite clears what earlier runs left."""
    if not settings.overwrite:
        return (folder / POSES_NAME).exists()
    for name in (POSES_NAME, SCALE_NAME, JOB_NAME):
        (folder / name).unlink(missing_ok=True)
    _forget_database(folder)
    return False


def _forget_database(folder: Path) -> None:
    for path in folder.glob(f"{DATABASE_NAME}*"):
        path.unlink()
    shutil.rmtree(folder / "sparse", ignore_errors=True)


def _solve(folder: Path, job: ColmapJob) -> SparseModel:
    """Go on with the database of an interrupted run where it holds the features of the same pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    if not _same_features(folder / JOB_NAME, job):
        _forget_database(folder)
    write_json(folder / JOB_NAME, job_to_json(job))
    failure = run_colmap(folder, len(job.pictures))
    if failure is not None:
        raise InputError(failure_message(failure))
    model = read_sparse_model(folder)
    weak = weak_model_message(model)
    if weak:
        (folder / POSES_NAME).unlink()
        raise InputError(weak)
    return model


def _same_features(path: Path, job: ColmapJob) -> bool:
    try:
        return job_from_json(read_json(path, "a job for COLMAP")).features_key() == job.features_key()
    except (InputError, KeyError, TypeError):
        return False
