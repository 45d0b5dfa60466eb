"""COLMAP itself, run as `python -m capture.poses.colmap_worker FOLDER`: what it cannot survive ends this process and no other.

FOLDER/colmap_job.json says what to do (`colmap_job`). Finished stages in FOLDER/database.db are gone on with; the largest model
goes to FOLDER/sparse/, and as a SparseModel to FOLDER (poses.json, points.npz). Progress is one JSON object a line on standard
output: {"stage", "done", "total"}, at the end {"failure": {...}} where no model was found.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pycolmap

from capture.poses.colmap_job import ColmapJob, job_from_json
from capture.poses.colmap_matches import match_statistics
from capture.poses.colmap_model import sparse_model_of
from capture.poses.robust_adjustment import adjusted
from capture.poses.sparse_model_file import write_sparse_model
from mrbokeh.system.atomic_files import read_json

DATABASE_NAME = "database.db"
JOB_NAME = "colmap_job.json"
MODEL_FOLDER = "sparse"

_FEWEST_VIEWS = 2
_PAIRS_AT_ONCE = 40


def run_job(folder: Path) -> None:
    job = job_from_json(read_json(folder / JOB_NAME, "a job for COLMAP"))
    pycolmap.logging.set_log_destination(pycolmap.logging.INFO, "")
    pycolmap.set_random_seed(job.seed)
    find_features(folder, job)
    match_features(folder, job)
    models = find_models(folder, job)
    if not models:
        _tell(failure=match_statistics(folder / DATABASE_NAME))
        return
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    largest = adjusted(largest, job.fewest_terms)
    largest.write(str(folder / MODEL_FOLDER))
    write_sparse_model(folder, sparse_model_of(largest, job.pictures))
    _tell(stage="done", done=largest.num_reg_images(), total=len(job.pictures))


def find_features(folder: Path, job: ColmapJob) -> None:
    """SIFT of what has none yet, one camera after the other, so that the pictures of a camera share its entry in the database."""
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=job.max_image_size_px, num_threads=job.threads, use_gpu=False)
    for number, prior in enumerate(job.cameras):
        files = [each.file for each in job.pictures if each.camera == number]
        waiting, camera_id = _without_features(folder / DATABASE_NAME, files)
        if not waiting:
            continue
        reader = pycolmap.ImageReaderOptions(camera_model=job.camera_model)
        if camera_id is not None:
            reader.existing_camera_id = camera_id
        elif prior is not None:
            terms = (*prior, 0.0, 0.0) if job.camera_model == "RADIAL" else (*prior, 0.0)
            reader.camera_params = ",".join(f"{value:.9g}" for value in terms)
        pycolmap.extract_features(
            folder / DATABASE_NAME,
            folder / job.pictures_folder,
            image_names=waiting,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
        )


def _without_features(database: Path, files: Sequence[str]) -> tuple[list[str], int | None]:
    """(files that the database does not know yet, its camera for those it knows)."""
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image for image in opened.read_all_images() if opened.exists_keypoints(image.image_id)}
    cameras = [known[file].camera_id for file in files if file in known]
    return [file for file in files if file not in known], cameras[0] if cameras else None


def match_features(folder: Path, job: ColmapJob) -> None:
    """Every picture with every other, some pairs at a time so that an interruption loses little."""
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    verification.ransac.random_seed = job.seed
    waiting, total = _unmatched_pairs(folder / DATABASE_NAME)
    list_path = folder / "pairs.txt"
    for first in range(0, len(waiting), _PAIRS_AT_ONCE):
        _tell(stage="matches", done=total - len(waiting) + first, total=total)
        list_path.write_text("".join(f"{a} {b}\n" for a, b in waiting[first : first + _PAIRS_AT_ONCE]), encoding="utf-8")
        pycolmap.match_image_pairs(
            folder / DATABASE_NAME,
            matching_options=matching,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_path),
            verification_options=verification,
        )
    list_path.unlink(missing_ok=True)
    _tell(stage="matches", done=total, total=total)


def _unmatched_pairs(database: Path) -> tuple[list[tuple[str, str]], int]:
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        pairs = [(a, b) for index, b in enumerate(images) for a in images[:index]]
        waiting = [(a.name, b.name) for a, b in pairs if not opened.exists_matches(a.image_id, b.image_id)]
    return waiting, len(pairs)


def find_models(folder: Path, job: ColmapJob) -> dict[int, Any]:
    """Structure from motion; one thread, because sums of several do not come out the same twice."""
    output = folder / MODEL_FOLDER
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    common: dict[str, Any] = {"num_threads": 1, "random_seed": job.seed, "min_model_size": _FEWEST_VIEWS}
    arguments = (folder / DATABASE_NAME, folder / job.pictures_folder, output)
    total, placed = len(job.pictures), 2

    def placed_one_more() -> None:
        nonlocal placed
        placed += 1
        _tell(stage="poses", done=min(placed, total), total=total)

    _tell(stage="poses", done=0, total=total)
    if job.mapper == "global":
        models = pycolmap.global_mapping(*arguments, pycolmap.GlobalPipelineOptions(**common))
    else:
        options = pycolmap.IncrementalPipelineOptions(**common)
        models = pycolmap.incremental_mapping(*arguments, options, next_image_callback=placed_one_more)
    shutil.rmtree(output)
    output.mkdir()
    return dict(models)


def _tell(**message: Any) -> None:
    print(json.dumps(message), flush=True)


if __name__ == "__main__":
    run_job(Path(sys.argv[1]))
