"""Checkpoints: everything a training run needs to go on as if it had never stopped, in one file that is whole or absent."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from training.curve import CurvePoint
from training.learner import Learner

FILE_NAME = "checkpoint.pt"


@dataclass
class Progress:
    """State of a run; the one thing that changes while it trains.

    pictures: drawn so far, by all processes together.
    best_psnr_db, best_step: of the best look at held-out slices; looks_since_best: how many came after it.
    points_due: of the curve, so many parts of the budget have been noted.
    kept_step: of the weights that the finished network has; stopped_early: before the budget was used, for want of anything better.
    """

    step: int = 0
    pictures: int = 0
    elapsed_s: float = 0.0
    smoothed_loss: float = math.nan
    best_psnr_db: float = -math.inf
    best_step: int = 0
    looks_since_best: int = 0
    points_due: int = 0
    stopped_early: bool = False
    kept_step: int = 0
    finished: bool = False
    curve: list[CurvePoint] = field(default_factory=list)

    def took_step(self, loss: float, pictures: int) -> None:
        self.step += 1
        self.pictures += pictures
        self.smoothed_loss = loss if math.isnan(self.smoothed_loss) else 0.98 * self.smoothed_loss + 0.02 * loss

    def looked(self, psnr_db: float) -> bool:
        """Count a look at held-out slices; whether it is the best so far. nan never is."""
        if psnr_db > self.best_psnr_db:
            self.best_psnr_db, self.best_step, self.looks_since_best = psnr_db, self.step, 0
            return True
        self.looks_since_best += 1
        return False


def save_checkpoint(path: Path, progress: Progress, learner: Learner, rng: np.random.Generator) -> None:
    plain = dict(vars(progress)) | {"curve": [tuple(point) for point in progress.curve]}
    random = {"batch_rng": rng.bit_generator.state, "torch_rng": torch.get_rng_state()}
    with atomic_path(path) as temporary:
        torch.save({"progress": plain, "learner": learner.state(), **random}, temporary)


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """What `restore_checkpoint` takes; None where there is no such file."""
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, UnpicklingError) as error:
        raise _not_of_this_run(path, error) from None
    return state


def restore_checkpoint(path: Path, state: dict[str, Any], learner: Learner, rng: np.random.Generator) -> Progress:
    """Put everything back; raises InputError where this is not a checkpoint of such a run. path: for the message."""
    try:
        learner.restore(state["learner"])
        rng.bit_generator.state = state["batch_rng"]
        torch.set_rng_state(state["torch_rng"])
        values = state["progress"]
        return Progress(**values | {"curve": [CurvePoint(*point) for point in values["curve"]]})
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise _not_of_this_run(path, error) from None


def _not_of_this_run(path: Path, error: Exception) -> InputError:
    return InputError(f"{path} is not a checkpoint of this run ({str(error)[:200]}): --overwrite starts again")
