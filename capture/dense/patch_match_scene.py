"""PatchMatch depths of a whole scene as clues for its dense depth; run once, in SCENE/reconstruction/patch_match."""

from pathlib import Path

import numpy as np

from capture.dense.clues import SparseDepths
from capture.dense.patch_match import patch_match_clue, patch_match_obstacle, read_patch_match, run_patch_match
from capture.poses.colmap import JOB_NAME, RECONSTRUCTION_FOLDER
from capture.poses.colmap_job import job_from_json
from capture.poses.sparse_model import SparseModel
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

WORKSPACE = "patch_match"
_FINISHED = "finished"


class PatchMatchScene:
    """model: in COLMAP's own unit, with its scale. Raises InputError where PatchMatch cannot run."""

    def __init__(self, scene: Path, model: SparseModel) -> None:
        obstacle = patch_match_obstacle()
        if obstacle:
            raise InputError(obstacle)
        folder = scene / RECONSTRUCTION_FOLDER
        job = job_from_json(read_json(folder / JOB_NAME, "what COLMAP was asked to do (run `mrbokeh capture poses --overwrite`)"))
        self._job, self._model, self._workspace = job, model, folder / WORKSPACE
        if not (self._workspace / _FINISHED).is_file():
            run_patch_match(folder / "sparse", folder / job.pictures_folder, self._workspace)
            (self._workspace / _FINISHED).touch()

    def depths_in(self, name: str) -> SparseDepths:
        """Every pixel of a view that PatchMatch knows, in metres."""
        view = self._model.view(name)
        depth = read_patch_match(self._workspace, self._job.file_of(name), view.camera, view.distortion)
        return patch_match_clue((depth * np.float32(self._model.metres_per_unit)).astype(np.float32))
