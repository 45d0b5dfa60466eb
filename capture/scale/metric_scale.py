"""The metric scale of a scene's camera poses by every available method, then calibrated focus and cameras in metres."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.poses.colmap_job import JOB_NAME, RECONSTRUCTION_FOLDER, job_from_json
from capture.poses.lens_calibration import FILE_NAME as CALIBRATION_NAME
from capture.poses.lens_calibration import LensCalibration, write_calibrated, write_lens_calibration
from capture.poses.sparse_model import POSES_NAME, SCALE_NAME, SparseModel, read_sparse_model
from capture.scale.answer import ScaleAnswer, ScaleResult, distance_scale, read_scale, write_scale
from capture.scale.board import board_scale
from capture.scale.focus import FocusSample, focus_sample, focus_scale
from capture.scale.focus_calibration import StackFocus, calibrated_stack, focus_start, lens_calibrations, stack_focus, with_view
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_NAME
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack, write_focal_stack
from mrbokeh.stacks.guessed_metres import metres_facts
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard

Picture = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class ScaleRequest:
    """Options of `mrbokeh capture scale`.

    board: lies in the scene. distance: (view, view, metres) between two camera centres. calibrate: also the focus.
    """

    board: CharucoBoard | None = None
    distance: tuple[str, str, float] | None = None
    calibrate: bool = True
    overwrite: bool = False


@dataclass(frozen=True)
class ScaledScene:
    """The result of scaling.

    calibrated: the fit of each stack. uncalibrated: why others have none. calibrations: written, the scene's own first.
    """

    result: ScaleResult
    calibrated: Mapping[str, StackFocus] = field(default_factory=dict)
    uncalibrated: Mapping[str, str] = field(default_factory=dict)
    calibrations: tuple[LensCalibration, ...] = ()


def scale_scene(scene: Path | str, request: ScaleRequest) -> ScaledScene:
    """Write scale.json; for stacks also lens_calibration.json, and into stack.json the calibrated focus and the metric camera.

    An existing scale is kept. Raises InputError if no method answers, or a requested one does not.
    """
    scene = Path(scene)
    folder = reconstruction_folder(scene)
    if (folder / SCALE_NAME).exists() and not request.overwrite:
        return ScaledScene(_kept(folder, request))
    model = replace(read_sparse_model(folder), metres_per_unit=None)
    stacks = merged_stacks(scene, model)
    samples = {view: focus_sample(model, view, stack) for view, stack in stacks.items()}
    result = _answers(model, folder, samples, request)
    scaled = _calibrated(scene, model, stacks, samples, result) if request.calibrate and stacks else ScaledScene(result)
    # Last, as the sign that all is done: a run that was interrupted before starts anew.
    write_scale(folder, result)
    return scaled


def _kept(folder: Path, request: ScaleRequest) -> ScaleResult:
    """Return the existing scale. Raises InputError if it does not rest on everything that is requested."""
    kept = read_scale(folder)
    facts = {each.method: each.facts for each in kept.answers}
    if request.board is not None and "board" not in facts:
        raise InputError(f"{folder / SCALE_NAME} was found without a board: --overwrite finds the scale again with it")
    if request.distance is not None:
        *views, metres = request.distance
        if facts.get("distance") != {"views": views, "metres": metres}:
            raise InputError(f"{folder / SCALE_NAME} was found without this --distance: --overwrite finds the scale again with it")
    return kept


def reconstruction_folder(scene: Path) -> Path:
    """Return SCENE/reconstruction, or the folder itself if plain pictures were reconstructed into it."""
    return scene if (scene / POSES_NAME).exists() else scene / RECONSTRUCTION_FOLDER


def merged_stacks(scene: Path, model: SparseModel) -> dict[str, FocalStack]:
    """Return the merged stacks among the model's views."""
    folders = {view.name: scene / view.name for view in model.views}
    stacks = {name: read_focal_stack(folder) for name, folder in folders.items() if (folder / STACK_NAME).is_file()}
    return {name: stack for name, stack in stacks.items() if stack.registered and stack.merged}


def _answers(model: SparseModel, folder: Path, samples: Mapping[str, FocusSample], request: ScaleRequest) -> ScaleResult:
    """Collect the answers: requested methods must answer; the focus distances are tried in any case."""
    answers: list[ScaleAnswer] = []
    missing = {"board": "none was given (--board)", "distance": "none was given (--distance)"}
    if request.board is not None:
        answers.append(board_scale(model, request.board, view_pictures(model, folder)))
    if request.distance is not None:
        answers.append(distance_scale(model, *request.distance))
    try:
        answers.append(_focus_answer(samples))
    except InputError as error:
        missing["focus"] = str(error)
    found = {each.method for each in answers}
    return ScaleResult.of(answers, {method: why for method, why in missing.items() if method not in found})


def _focus_answer(samples: Mapping[str, FocusSample]) -> ScaleAnswer:
    if not samples:
        raise InputError("the scene has no merged stacks whose focus distances could tell")
    if not any(np.isfinite(sample.focus_dioptres).all() for sample in samples.values()):
        raise InputError("the focus distances of the stacks are unknown")
    return focus_scale(list(samples.values()))


def view_pictures(model: SparseModel, folder: Path) -> Iterator[Picture]:
    """Yield the 8-bit pictures that the poses were found with, in the order of the views."""
    job = job_from_json(read_json(folder / JOB_NAME, "what COLMAP was asked to do (run `mrbokeh capture poses --overwrite`)"))
    for view in model.views:
        path = folder / job.pictures_folder / job.file_of(view.name)
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise InputError(f"cannot read {path}: run `mrbokeh capture poses --overwrite`")
        yield np.ascontiguousarray(picture[..., ::-1])


def _calibrated(
    scene: Path, model: SparseModel, stacks: Mapping[str, FocalStack], samples: Mapping[str, FocusSample], result: ScaleResult
) -> ScaledScene:
    """Write the camera into stack.json of every stack; a stack whose focus cannot be calibrated keeps its stated distances."""
    metric = model.times(result.used.metres_per_unit)
    offset_m = offset_of(result)
    calibrated, uncalibrated = {}, {}
    for name, stack in stacks.items():
        width_px = metric.view(name).camera.width_px
        try:
            start = focus_start(stack, samples[name], result.used.metres_per_unit, offset_m, width_px)
            calibrated[name] = stack_focus(metric, name, stack, start)
        except InputError as error:
            uncalibrated[name] = str(error)
    calibrations = tuple(lens_calibrations(calibrated, offset_m))
    for number, calibration in enumerate(calibrations):
        write_lens_calibration(scene / numbered(CALIBRATION_NAME, number), calibration)
    for name, stack in stacks.items():
        view = metric.view(name)
        changed = calibrated_stack(calibrated[name], view) if name in calibrated else with_view(stack, view)
        if name in calibrated and metres_facts(changed):
            write_calibrated(stack, changed)
        else:
            write_focal_stack(changed)
    return ScaledScene(result, calibrated, uncalibrated, calibrations)


def numbered(name: str, number: int) -> str:
    """Return name.json for the first, name_2.json for the second."""
    return name if number == 0 else name.replace(".json", f"_{number + 1}.json")


def offset_of(result: ScaleResult) -> float:
    """Return the lens offset of the focus answer; 0 if there is none."""
    return next((float(each.facts["offset_m"]) for each in result.answers if each.method == "focus"), 0.0)


def scale_lines(scaled: ScaledScene) -> Iterator[str]:
    result = scaled.result
    for each in result.answers:
        difference = result.disagreement.get(each.method)
        compared = "used" if difference is None else f"{100 * difference:+.2f} % from the one used"
        yield (f"{each.method}: {each.metres_per_unit:.6g} metres per unit +- {100 * each.uncertainty:.3f} % ({compared}; {_basis(each)})")
    for method, why in result.missing.items():
        yield f"{method}: no answer, for {why}"
    for method in result.contradictions:
        yield f"warning: {method} contradicts {result.used.method}: measure the print or the distance again, or check the focus distances"
    for name, found in scaled.calibrated.items():
        fit = found.fit
        yield (
            f"{name}: focus from {1 / fit.dioptres.max():.3f} to {1 / max(fit.dioptres.min(), 1e-6):.3f} m "
            f"+- {float(np.median(fit.sigma_dioptre)):.4f} dioptres, blur {np.median(fit.px_per_dioptre):.2f} px per dioptre"
        )
    for name, why in scaled.uncalibrated.items():
        yield f"{name}: focus not calibrated ({why})"


def _basis(answer: ScaleAnswer) -> str:
    facts = answer.facts
    if answer.method == "board":
        return f"{facts['detections']} sightings of {facts['corners']} corners, residual {facts['residual_px']:.2f} px"
    if answer.method == "distance":
        return f"{facts['metres']:g} m between {' and '.join(facts['views'])}, for a ruler of 1 mm"
    offset = f"offset of the lens {1000 * facts['offset_m']:+.0f} mm"
    return f"{facts['points']} points of {facts['stacks']} stacks, {offset}, residual {facts['residual_dioptre']:.3f} dioptres"
