"""What a run leaves in its folder while it trains: curve, sheets, checkpoints, and the network at the end."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.checkpoint import Progress, save_checkpoint
from training.curve import CurvePoint, draw_curve, write_curve
from training.dataset import PairSet
from training.held_out import HeldOutSlices
from training.learner import Learner
from training.run_folder import RunFacts, save_network
from training.settings import TrainSettings
from training.sheets import write_sheet

# Drawing takes a moment, which looks that follow one another closely do not all need.
_DRAWN_EVERY_S = 20.0
# Of the curve, over the whole budget, beside those where held-out slices are looked at.
POINTS = 200


@dataclass(frozen=True)
class Task:
    """What a run is about: where it is kept, what it learns from and what it is tested on."""

    folder: Path
    settings: TrainSettings
    facts: RunFacts
    pairs: PairSet
    held_out: HeldOutSlices


class Record:
    """Written by the first process only; progress, learner and rng are those of the run, seen as they change."""

    def __init__(self, task: Task, learner: Learner, progress: Progress, rng: np.random.Generator) -> None:
        self._task, self._learner, self._progress, self._rng = task, learner, progress, rng
        self._checkpoint = task.folder / CHECKPOINT_NAME
        self._drawn_s = -math.inf

    def note(self, psnr_db: float = math.nan) -> None:
        """A point of the curve."""
        progress = self._progress
        elapsed_s, rate = round(progress.elapsed_s, 2), self._learner.learning_rate
        progress.curve.append(CurvePoint(progress.step, elapsed_s, progress.smoothed_loss, psnr_db, rate))

    def note_if_due(self, done: float) -> None:
        """A point of the curve for every part of the budget; done: how much of it is used, in [0, 1]."""
        if done * POINTS >= self._progress.points_due:
            self._progress.points_due = math.floor(done * POINTS) + 1
            self.note()

    def look(self) -> bool:
        """At held-out slices; whether there has been nothing better for as long as patience lasts."""
        look = self._task.held_out.look(self._learner.average, self._learner.device)
        if self._progress.looked(look.psnr_db):
            self._learner.keep_best()
        self.note(look.psnr_db)
        if self._task.settings.sheets:
            write_sheet(self._task.folder, self._progress.step, look.rows)
        write_curve(self._task.folder, self._progress.curve)
        if self._progress.elapsed_s - self._drawn_s >= _DRAWN_EVERY_S:
            self._draw()
        return 0 < self._task.settings.patience <= self._progress.looks_since_best

    def save(self) -> None:
        save_checkpoint(self._checkpoint, self._progress, self._learner, self._rng)
        write_curve(self._task.folder, self._progress.curve)

    def finish(self) -> None:
        """The last look, and the network: the last weights, or with patience the best ones."""
        if not self._progress.stopped_early:
            self.look()
        self._progress.kept_step = self._progress.step
        if self._task.settings.patience and self._learner.best is not None:
            self._learner.take_best()
            self._progress.kept_step = self._progress.best_step
        save_network(self._task.folder, self._learner.average.cpu())
        self._progress.finished = True
        self.save()
        self._draw()

    def _draw(self) -> None:
        draw_curve(self._task.folder, self._progress.curve)
        self._drawn_s = self._progress.elapsed_s
