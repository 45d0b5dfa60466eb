"""COLMAP itself, run as `python -m capture.poses.colmap_worker FOLDER`, so that its crashes end this process only.

FOLDER/colmap_job.json is the job (`colmap_job`). Finished stages in FOLDER/database.db are continued; the largest model goes to
FOLDER/sparse/, and as a SparseModel to FOLDER (poses.json, points.npz). Progress is one JSON object a line on standard output:
{"stage", "done", "total"}, at the end {"failure": {...}} if no model was found.

The last bundle adjustment is robust and keeps only those terms of distortion that the pictures support.
"""

import copy
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

from capture.poses.cauchy_loss import CAUCHY_95, MEDIAN_OF_RAYLEIGH
from capture.poses.colmap_job import DATABASE_NAME, JOB_NAME, MODEL_FOLDER, ColmapJob, ColmapPicture, job_from_json
from capture.poses.colmap_matches import match_statistics
from capture.poses.sparse_model import SparseModel, SparseView, write_sparse_model
from mrbokeh.distortion.radial import Distortion
from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import read_json

_LEAST_LOSS_SCALE_PX = 0.05
_LEAST_COST_PX2 = 1e-12
_MODEL_OF_TERMS = (pycolmap.CameraModelId.SIMPLE_PINHOLE, pycolmap.CameraModelId.SIMPLE_RADIAL, pycolmap.CameraModelId.RADIAL)
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
    """Find the missing SIFT features, camera by camera, so that the pictures of a camera share its entry in the database."""
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
    """Return (files without features in the database, the camera of those with features)."""
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image for image in opened.read_all_images() if opened.exists_keypoints(image.image_id)}
    cameras = [known[file].camera_id for file in files if file in known]
    return [file for file in files if file not in known], cameras[0] if cameras else None


def match_features(folder: Path, job: ColmapJob) -> None:
    """Match every picture with every other, in batches of pairs so that an interruption loses little."""
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
    """Run structure from motion on one thread, because sums over several threads are not reproducible."""
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


def adjusted(model: Any, fewest_terms: bool) -> Any:
    """Return the pycolmap.Reconstruction after the adjustment. fewest_terms: drop terms of distortion that explain no more than noise.

    A superfluous term still takes part in the fit, and moves the focal length and the depth with it: on three traced scenes without
    distortion, the metres of camera centres and of a board disagreed by 0.09, 0.07 and 0.06 % with the terms and by 0.02 % without,
    where the noise of the matches alone leaves 0.04 and 0.02 %.
    """
    loss_px = _loss_scale_px(model)
    refine_robustly(model, loss_px)
    while fewest_terms and _terms(model):
        simpler = _with_one_term_less(model)
        refine_robustly(simpler, loss_px)
        if _criterion(simpler, loss_px) >= _criterion(model, loss_px):
            break
        model = simpler
    return model


def refine_robustly(model: Any, loss_px: float) -> None:
    """Run a bundle adjustment with Cauchy's loss, 95 % efficient for normal errors: 2.385 sigma (Holland and Welsch 1977).

    COLMAP's own last adjustment is least squares over all matches within 4 px, in which a few wrong ones outweigh thousands of
    good ones at 0.06 px: it left the focal length of a traced scene 0.25 % off; this adjustment leaves 0.05 %.
    """
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, 300, 1e-7
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _loss_scale_px(model: Any) -> float:
    sigma_px = float(np.median([point.error for point in model.points3D.values()])) / MEDIAN_OF_RAYLEIGH
    return max(CAUCHY_95 * sigma_px, _LEAST_LOSS_SCALE_PX)


def _terms(model: Any) -> int:
    """Return the number of terms of radial distortion that every camera of the model has."""
    return min(_MODEL_OF_TERMS.index(camera.model) for camera in model.cameras.values())


def _with_one_term_less(model: Any) -> Any:
    simpler = copy.deepcopy(model)
    for camera in simpler.cameras.values():
        parameters = camera.params[:-1]
        camera.model = _MODEL_OF_TERMS[_MODEL_OF_TERMS.index(camera.model) - 1]
        camera.params = parameters
    return simpler


def _criterion(model: Any, loss_px: float) -> float:
    """Return Schwarz's criterion (1978), n ln(cost) + terms ln(n), lower is better; n: residuals less the coordinates of the points.

    The logarithm of the cost replaces the cost over an assumed variance, since real residuals have longer tails than normal ones.
    """
    residuals_px = _residuals_px(model)
    cost = float(np.sum(loss_px**2 * np.log1p(np.sum(residuals_px**2, axis=1) / loss_px**2)))
    freedom = max(residuals_px.size - 3 * len(model.points3D), 1)
    return freedom * float(np.log(max(cost, _LEAST_COST_PX2))) + _terms(model) * len(model.cameras) * float(np.log(freedom))


def _residuals_px(model: Any) -> Float[np.ndarray, "seen 2"]:
    """Return the reprojection errors of all observations."""
    residuals = [np.zeros((0, 2))]
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        if image.has_pose and seen:
            world = np.array([model.points3D[point.point3D_id].xyz for point in seen])
            there = image.cam_from_world() * world
            residuals.append(image.camera.img_from_cam(there) - np.array([point.xy for point in seen]))
    return np.concatenate(residuals)


def sparse_model_of(reconstruction: Any, pictures: Sequence[ColmapPicture]) -> SparseModel:
    """Convert a reconstruction to a SparseModel with views in the order of the pictures; pictures without a pose are left_out."""
    images = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    placed = [each for each in pictures if each.file in images]
    views = tuple(_view(each.name, images[each.file]) for each in placed)
    index_of_image = {images[each.file].image_id: index for index, each in enumerate(placed)}
    points = [reconstruction.points3D[key] for key in sorted(reconstruction.points3D)]
    observations, xy_px = [], []
    for index, point in enumerate(points):
        for element in point.track.elements:
            observations.append((index_of_image[element.image_id], index))
            xy_px.append(reconstruction.images[element.image_id].points2D[element.point2D_idx].xy)
    return SparseModel(
        views,
        points=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        errors_px=np.array([point.error for point in points], np.float64),
        observations=np.array(observations, np.int64).reshape(-1, 2),
        observed_xy_px=np.array(xy_px, np.float64).reshape(-1, 2),
        left_out=tuple(each.name for each in pictures if each.file not in images),
    )


def _view(name: str, image: Any) -> SparseView:
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    camera, distortion = _camera(image.camera, pose)
    return SparseView(name, camera, distortion)


def _camera(camera: Any, pose: np.ndarray) -> tuple[Camera, Distortion]:
    """Convert SIMPLE_PINHOLE (f, cx, cy), SIMPLE_RADIAL (and k) or RADIAL (and k1, k2). COLMAP's pixel centres lie where ours do."""
    focal, cx, cy, *terms = (float(value) for value in camera.params)
    k1, k2 = (*terms, 0.0, 0.0)[:2]
    return Camera(width_px=camera.width, height_px=camera.height, focal_px=(focal, focal), principal_px=(cx, cy), camera_from_world=pose), (
        k1,
        k2,
    )


if __name__ == "__main__":
    run_job(Path(sys.argv[1]))
