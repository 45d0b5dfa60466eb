"""Fit a network to focal stacks. Reads top to bottom; every choice is in settings.py."""

import copy
import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mrbokeh.focal_stack import FocalStack
from mrbokeh.progress import progress_bars
from training.batches import draw_batch
from training.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.checkpoint import Progress, load_checkpoint, save_checkpoint
from training.dataset import PairSet
from training.held_out import HeldOutSlices
from training.objective import learning_rate_factor, mean_square_error
from training.resuming import require_same_data, require_same_settings
from training.run_folder import RunFacts, build_network, save_network, source_commit, write_curve, write_facts
from training.settings import TrainSettings, write_settings
from training.stacks import stack_name
from training.training_data import TrainingData
from training.weights import Counting


def fit(data: TrainingData, run_folder: Path, settings: TrainSettings, held_out: Sequence[str] = ()) -> Progress:
    """Train, or go on training, into run_folder; a finished run is left as it is. held_out: see `TrainingData.split`.

    Interrupting (KeyboardInterrupt) leaves a checkpoint, and the same call goes on from it.
    """
    require_same_settings(run_folder, settings)
    train_stacks, test_stacks = data.split(held_out, settings.test_fraction, settings.seed)
    pairs = PairSet(train_stacks, _counting(settings), settings.cache_mib)
    facts = _facts_of(data, pairs, test_stacks, settings)
    require_same_data(run_folder, facts)
    write_settings(run_folder, settings)
    write_facts(run_folder, facts)
    return _Run(run_folder, settings, pairs, HeldOutSlices(test_stacks), facts).train()


def _counting(settings: TrainSettings) -> Counting:
    return Counting(settings.least_confidence, settings.saturation, saturated=settings.sensor_white is not None)


def _facts_of(data: TrainingData, pairs: PairSet, test_stacks: Sequence[FocalStack], settings: TrainSettings) -> RunFacts:
    found = data.facts(pairs)
    return RunFacts(
        lens=found.lens,
        width_px=found.width_px,
        height_px=found.height_px,
        largest_coc_px=found.largest_coc_px,
        radiance_scale=settings.radiance_scale or found.radiance_scale,
        trained_on=tuple(stack_name(stack) for stack in pairs.stacks),
        held_out=tuple(stack_name(stack) for stack in test_stacks),
        commit=source_commit(),
    )


class _Run:
    """One run in memory. The constructor restores a checkpoint where there is one."""

    def __init__(self, folder: Path, settings: TrainSettings, pairs: PairSet, validation: HeldOutSlices, facts: RunFacts) -> None:
        self.folder, self.settings, self.pairs, self.validation, self.facts = folder, settings, pairs, validation, facts
        self.device = _device(settings.device)
        torch.set_num_threads(settings.threads or os.cpu_count() or 1)
        self.network = build_network(settings, facts).to(self.device)
        self.average = copy.deepcopy(self.network)
        self.optimizer = torch.optim.Adam(self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99))
        self.rng = np.random.default_rng(settings.seed)
        self.progress = Progress()
        if self._checkpoint.exists():
            self.progress = load_checkpoint(self._checkpoint, self.network, self.average, self.optimizer, self.rng)
        self._started_s = time.monotonic() - self.progress.elapsed_s

    @property
    def _checkpoint(self) -> Path:
        return self.folder / CHECKPOINT_NAME

    @property
    def _steps(self) -> int | None:
        """The budget in steps, where it is given in epochs."""
        return None if self.settings.epochs is None else math.ceil(self.settings.epochs * len(self.pairs) / self.settings.batch)

    def _done(self) -> float:
        """How much of the budget is used, in [0, 1]."""
        if self._steps is not None:
            return min(1.0, self.progress.step / max(self._steps, 1))
        return min(1.0, self.progress.elapsed_s / (60.0 * (self.settings.minutes or 0.0) + 1e-9))

    def train(self) -> Progress:
        if self.progress.finished:
            return self.progress
        try:
            self._loop()
        except KeyboardInterrupt:
            self._save()
            raise
        self._finish()
        return self.progress

    def _loop(self) -> None:
        last_saved_s = last_checked_s = self.progress.elapsed_s
        with progress_bars() as bars:
            bar = bars.add_task("train", total=1000)
            while (done := self._done()) < 1.0:
                self._step(learning_rate_factor(done, self.settings.warm_up))
                self.progress.elapsed_s = time.monotonic() - self._started_s
                bars.update(bar, completed=1000 * self._done(), description=f"train, loss {self.progress.smoothed_loss:.2e}")
                if self.settings.validate_every_s and self.progress.elapsed_s - last_checked_s >= self.settings.validate_every_s:
                    self._note_curve()
                    last_checked_s = self.progress.elapsed_s
                if self.progress.elapsed_s - last_saved_s >= self.settings.checkpoint_every_s:
                    self._save()
                    last_saved_s = self.progress.elapsed_s

    def _step(self, rate_factor: float) -> None:
        """One update from `batch` pictures, one after the other: a picture uses few of the network's bins, all together most of them."""
        settings = self.settings
        halo_px = math.ceil(self.facts.largest_coc_px / 2.0)
        for group in self.optimizer.param_groups:
            group["lr"] = settings.learning_rate * rate_factor
        self.optimizer.zero_grad(set_to_none=True)
        mean_loss = 0.0
        for _ in range(settings.batch):
            batch = draw_batch(self.pairs, 1, settings.crop_px, halo_px, self.rng).to(self.device)
            loss = mean_square_error(self.network(batch.rgb, batch.coc_px), batch, self.facts.radiance_scale, settings) / settings.batch
            loss.backward()
            mean_loss += loss.item()
        self.optimizer.step()
        self._follow()
        self.progress.step += 1
        before = self.progress.smoothed_loss
        self.progress.smoothed_loss = mean_loss if math.isnan(before) else 0.98 * before + 0.02 * mean_loss

    @torch.no_grad()
    def _follow(self) -> None:
        """The averaged weights follow the trained ones, faster while they are young."""
        decay = min(self.settings.ema_decay, (1.0 + self.progress.step) / (10.0 + self.progress.step))
        for mean, now in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(now, 1.0 - decay)

    def _note_curve(self) -> None:
        psnr_db = self.validation.psnr_db(self.average, self.device)
        self.progress.curve.append((self.progress.step, round(self.progress.elapsed_s, 2), self.progress.smoothed_loss, psnr_db))

    def _save(self) -> None:
        save_checkpoint(self._checkpoint, self.progress, self.network, self.average, self.optimizer, self.rng)
        write_curve(self.folder, self.progress.curve)

    def _finish(self) -> None:
        self._note_curve()
        save_network(self.folder, self.average.cpu())
        self.progress = replace(self.progress, finished=True)
        self._save()


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)
