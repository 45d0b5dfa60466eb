"""Camera poses of many viewpoints by COLMAP (Schoenberger and Frahm 2016; global: Pan et al. 2024): SIFT, matches, mapping.

COLMAP runs in a process of its own: some of its errors abort the interpreter, and the user must still get a one-line error.
"""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any

from rich.progress import Progress

import capture
from capture.poses.colmap_job import (
    CAMERA_CHOICES,
    CAMERA_MODELS,
    DATABASE_NAME,
    JOB_NAME,
    MAPPERS,
    MODEL_FOLDER,
    RECONSTRUCTION_FOLDER,
    ColmapJob,
    camera_model_for,
    described,
    job_from_json,
    job_to_json,
    picture_cameras,
    pictures_in,
    stack_cameras,
    view_name,
    write_stack_pictures,
)
from capture.poses.colmap_matches import failure_message, weak_model_message
from capture.poses.sparse_model import POSES_NAME, SCALE_NAME, SparseModel, read_sparse_model
from mrbokeh.stacks.focal_stack import find_focal_stacks
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError, MissingExtraError

LOG_NAME = "colmap.log"

_WORKER = "capture.poses.colmap_worker"
_STAGES = ("features", "matches", "poses")
_LOOK_EVERY_S = 0.5
IMAGES_FOLDER = "images"


@dataclass(frozen=True)
class PoseSettings:
    """Settings of COLMAP.

    cameras: auto, shared or separate. threads: -1 takes all cores; only 1 is reproducible to the last digit. seed: of COLMAP's draws.
    """

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
    """Find the poses of all merged stacks of a scene, in SCENE/reconstruction; existing results are kept or continued."""
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
    """Find the poses of the pictures in a plain folder and write them to `out`; views are named after the files."""
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
    """Tell whether finished poses are kept; with overwrite, delete the results of earlier runs."""
    if not settings.overwrite:
        return (folder / POSES_NAME).exists()
    for name in (POSES_NAME, SCALE_NAME, JOB_NAME):
        (folder / name).unlink(missing_ok=True)
    _forget_database(folder)
    return False


def _forget_database(folder: Path) -> None:
    for path in folder.glob(f"{DATABASE_NAME}*"):
        path.unlink()
    shutil.rmtree(folder / MODEL_FOLDER, ignore_errors=True)


def _solve(folder: Path, job: ColmapJob) -> SparseModel:
    """Run COLMAP, continuing with the database of an interrupted run if it holds the features of the same pictures."""
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


def run_colmap(folder: Path, pictures: int) -> dict[str, Any] | None:
    """Run the job in `folder`; return None, or match statistics if no model was found.

    Raises MissingExtraError without pycolmap, InputError if the process dies; its output is in colmap.log.
    """
    if find_spec("pycolmap") is None:
        raise MissingExtraError("pycolmap", "capture")
    with (folder / LOG_NAME).open("w", encoding="utf-8") as log, progress_bars() as bars, _worker(folder, log) as process:
        with _features_shown(folder, pictures, bars):
            last = _follow(process, bars)
        status = process.wait()
    if status != 0 or not last:
        raise InputError(_death(folder, status, last))
    failure: dict[str, Any] | None = last.get("failure")
    return failure


@contextmanager
def _worker(folder: Path, log: IO[str]) -> Iterator["subprocess.Popen[str]"]:
    """Start the process and terminate it when the block ends."""
    root = str(Path(capture.__file__).parent.parent)
    path = os.pathsep.join(each for each in (root, os.environ.get("PYTHONPATH", "")) if each)
    command = [sys.executable, "-m", _WORKER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=os.environ | {"PYTHONPATH": path}) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()


def _follow(process: "subprocess.Popen[str]", bars: Progress) -> dict[str, Any]:
    """Show the worker's progress; return its last message."""
    tasks, last = {}, {}
    assert process.stdout is not None
    for line in process.stdout:
        if not line.startswith("{"):
            continue
        last = json.loads(line)
        stage = last.get("stage")
        if stage in _STAGES:
            if stage not in tasks:
                tasks[stage] = bars.add_task(f"COLMAP: {stage}", total=last["total"])
            bars.update(tasks[stage], completed=last["done"], total=last["total"])
    return last


@contextmanager
def _features_shown(folder: Path, pictures: int, bars: Progress) -> Iterator[None]:
    """Show the progress of the features by polling COLMAP's database, since COLMAP does not report it."""
    if bars.disable:
        yield
        return
    task, over = bars.add_task("COLMAP: features", total=pictures), Event()

    def look() -> None:
        while not over.wait(_LOOK_EVERY_S):
            bars.update(task, completed=_count_features(folder / DATABASE_NAME))

    watcher = Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _count_features(database: Path) -> int:
    try:
        with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.2)) as connection:
            return int(connection.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0])
    except sqlite3.Error:
        return 0


def _death(folder: Path, status: int, last: dict[str, Any]) -> str:
    how = signal.Signals(-status).name if status < 0 else f"status {status}"
    during = {"matches": "matching", "poses": "finding poses"}.get(str(last.get("stage")), "finding features")
    lines = [line for line in (folder / LOG_NAME).read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if line[:1] in "EF" and line[1:9].isdigit()] or lines
    told = f" ({errors[-1].strip()[:200]})" if errors else ""
    return (
        f"COLMAP stopped with {how} while {during}{told}: see {folder / LOG_NAME}; give --overwrite to start from the pictures, "
        f"--max-image-size to use less memory"
    )
