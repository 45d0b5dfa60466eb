"""Gates of a whole scene: viewpoints placed, points consistent, and two scales that agree."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.poses.sparse_model import POSES_NAME, SCALE_NAME, SparseModel, read_sparse_model
from capture.report.gates import Gate, Rule
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json

FOLDER = "reconstruction"
LARGEST_REPROJECTION_PX = 1.0
LARGEST_DISAGREEMENT = 0.01
WHERE = "scene"

MERGED = Rule(
    "all stacks merged",
    "all-in-focus picture and depth of every stack",
    "Nothing else can be judged before.",
    "Run `mrbokeh capture merge` on the scene.",
)
PLACED = Rule(
    "all viewpoints placed",
    "none left out",
    "A viewpoint without a pose has no depth but that from focus.",
    "Photograph viewpoints that overlap more; see poses.json for the names.",
)
REPROJECTION = Rule(
    "points lie where they are seen",
    f"median below {LARGEST_REPROJECTION_PX:g} px",
    "Poses that do not fit the pictures give depth that does not fit them.",
    "Check that all stacks have one lens and reference focus; run `mrbokeh capture poses --overwrite`.",
)
SCALES = Rule(
    "scales agree",
    f"within {LARGEST_DISAGREEMENT:.0%}",
    "Metres from a board or a known distance, and metres from the focus distances, are two answers to one question. Re-blurring cannot see "
    "an error of all focus distances by one dioptre offset; this can.",
    "If they disagree, trust the board and calibrate the lens against it (`mrbokeh capture scale`, then `depth`).",
)
SCENE_RULES = (MERGED, PLACED, REPROJECTION, SCALES)


@dataclass(frozen=True)
class Reconstruction:
    """Camera poses of a scene; model and scales are None where they are not there. scales: metres per unit by method."""

    model: SparseModel | None
    scales: dict[str, float] | None

    @property
    def disagreement(self) -> float | None:
        """Return the largest ratio of two scales, minus 1; None where there are not two."""
        if self.scales is None or len(self.scales) < 2:
            return None
        return max(self.scales.values()) / min(self.scales.values()) - 1.0


def read_reconstruction(scene: Path) -> Reconstruction:
    folder = scene / FOLDER
    model = read_sparse_model(folder) if (folder / POSES_NAME).is_file() else None
    path = folder / SCALE_NAME
    return Reconstruction(model, scales_in(read_json(path, "the metric scale")) if path.is_file() else None)


def scales_in(document: dict[str, Any]) -> dict[str, float]:
    """Return every method's answer, or the one that is used."""
    answers = document.get("answers", [])
    entries = answers.values() if isinstance(answers, dict) else answers
    found = {str(each["method"]): float(each["metres_per_unit"]) for each in entries if isinstance(each, dict)}
    return found or {str(document.get("method", "used")): float(document["metres_per_unit"])}


def merged_gate(stacks: Sequence[FocalStack]) -> Gate:
    waiting = [stack.folder.name for stack in stacks if not stack.merged]
    named = f" (waiting: {', '.join(waiting)})" if waiting else ""
    return MERGED.judge(WHERE, float(len(waiting)), f"{len(stacks) - len(waiting)} of {len(stacks)}{named}", not waiting)


def scene_gates(reconstruction: Reconstruction) -> list[Gate]:
    model = reconstruction.model
    if model is None:
        no_poses = "no reconstruction: run `mrbokeh capture poses` (needs two viewpoints or more)"
        return [PLACED.absent(WHERE, no_poses), REPROJECTION.absent(WHERE, no_poses), SCALES.absent(WHERE, no_poses)]
    out, total = len(model.left_out), len(model.left_out) + len(model.views)
    left_out = f" (left out: {', '.join(model.left_out)})" if out else ""
    placed = PLACED.judge(WHERE, float(out), f"{total - out} of {total}{left_out}", out == 0)
    return [placed, _reprojection(model), _scales(reconstruction)]


def _reprojection(model: SparseModel) -> Gate:
    if not len(model.errors_px):
        return REPROJECTION.absent(WHERE, "the reconstruction has no points")
    median_px = float(np.median(model.errors_px))
    return REPROJECTION.judge(WHERE, median_px, f"{median_px:.2f} px over {len(model.points)} points", median_px < LARGEST_REPROJECTION_PX)


def _scales(reconstruction: Reconstruction) -> Gate:
    disagreement = reconstruction.disagreement
    if disagreement is None:
        known = "none" if not reconstruction.scales else f"only {', '.join(reconstruction.scales)}"
        return SCALES.absent(WHERE, f"two scales are needed, there is {known}: `mrbokeh capture scale` with a board or a distance")
    listed = ", ".join(f"{method} {metres:.6g} m per unit" for method, metres in (reconstruction.scales or {}).items())
    measured = f"{disagreement:.2%} apart ({listed})"
    return SCALES.judge(WHERE, disagreement, measured, disagreement <= LARGEST_DISAGREEMENT)
