"""One run in memory: steps until the budget is used, with looks at held-out slices and checkpoints between them.

A run stops on request: Ctrl-C, or the SIGTERM with which batch systems announce that time is up. Its first steps tell whether a
budget in minutes is long enough for a network to learn anything.
"""

import math
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.progress import Progress as Bars

from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, warn
from training.data.batches import Batch, Drawing, draw_share, joined_by_size
from training.fitting.checkpoint import FAR_ABOVE, FAR_ABOVE_STEPS, Learner, Progress, read_checkpoint, restore_checkpoint
from training.fitting.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.fitting.distributed import Ranks
from training.fitting.objective import learning_rate_factor, loss
from training.fitting.record import Record, Task, diverged, lower_rate
from training.fitting.run_folder import build_network
from training.fitting.settings import TrainSettings

SIGNALS = (signal.SIGINT, signal.SIGTERM)
LEAST_STEPS = 200
"""The smallest networks have learnt a lens roughly after so many; with a tenth of them the result is what it began as."""
_TELLING_STEPS = 6
_LONGEST_SHARE = 0.05  # of the budget until the rate is known; at LEAST_STEPS in all that would be ten steps


class StoppedError(KeyboardInterrupt):
    """A run stopped on request. number: of the signal. left: what is kept, in words."""

    def __init__(self, number: int, left: str) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}; {left}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """Return the code that shells give: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + self.number


class Interruption:
    """A block in which the signals only leave a note, so that a step is never cut short; `asked` holds the last one.

    A signal that was ignored before stays ignored: shells start background jobs deaf to Ctrl-C.
    In a single process a second Ctrl-C stops at once, without a checkpoint (torchrun passes on what its children have got already).
    """

    def __init__(self, alone: bool = True) -> None:
        self.asked: int | None = None
        self._alone = alone
        self._before: dict[int, object] = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self._alone and self.asked == number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = number


class Run:
    """A training run; every process has one, and that of the first one writes and looks.

    The constructor restores a checkpoint if there is one, unless it begins afresh.
    """

    def __init__(self, task: Task, ranks: Ranks, afresh: bool = False) -> None:
        self.task, self.settings, self.ranks = task, task.settings, ranks
        torch.set_num_threads(self.settings.threads or max(1, (os.cpu_count() or 1) // ranks.local_count))
        self.learner = Learner(build_network(self.settings, task.facts), self.settings, ranks.device)
        self._rng = np.random.default_rng(self.settings.seed)
        self.is_restored = False
        self.progress = Progress() if afresh else self._restored()
        self._record = Record(task, self.learner, self.progress, self._rng)
        self._halo_px = math.ceil(task.facts.largest_coc_px / 2.0)
        # The rim of a crop that wide does not count; at least half of each side has to.
        self._crop_px = self.settings.crop_px and max(self.settings.crop_px, 4 * self._halo_px)
        whole = not self._crop_px and self.settings.depth_noise == 0.0
        self._on_gpu = ranks.device.type == "cuda"
        # Whole pictures that all fit stay on the GPU; where they are of one size, the kernels of a step are recorded as well.
        self._kept: dict[int, Batch] | None = {} if self._on_gpu and whole and task.pairs.all_fit else None
        self._is_recorded = False
        self._interruption = Interruption(alone=ranks.count == 1)
        self._stopped_by: int | None = None
        self._started_s = time.monotonic() - self.progress.elapsed_s
        self._saved_s = self._looked_s = self.progress.elapsed_s
        self._step_s = 0.0  # until some steps have told
        self._planned = 0

    def require_steps(self, least: int) -> None:
        """Take the first steps of a budget in minutes; nothing is written.

        Raises InputError if there is no time for `least` of them, StoppedError if any process is asked to stop.
        """
        if self.settings.minutes is None or self.progress.step:
            return
        budget_s, ends_s = 60.0 * self.settings.minutes, list[float]()
        with self._interruption, self._bars() as bars:
            bar = bars.add_task("first steps, to see how many there is time for", total=None)
            while not is_rate_known(ends_s, budget_s) and self._done() < 1.0 and self._stopped_by is None:
                self._step(learning_rate_factor(self._done(), self.settings.warm_up))
                ends_s.append(self.progress.elapsed_s)
                bars.advance(bar)
        if self._stopped_by is not None:
            raise StoppedError(self._stopped_by, f"training had not begun, and nothing was changed in {self.task.folder}")
        if steps_within(ends_s, budget_s) < least:
            raise InputError(too_few_words(ends_s, self.settings, self._halo_px, least))
        self._step_s = seconds_of_a_step(ends_s)

    def train(self) -> Progress:
        """Use the rest of the budget; raises StoppedError, with a checkpoint, if any process is asked to stop."""
        if self.progress.finished:
            return self.progress
        with self._interruption:
            self._say_plan()
            self._loop()
            if self._stopped_by is not None:
                if self.ranks.first:
                    self._record.stop()
                kept = f"the checkpoint in {self.task.folder} is kept, run the same command again (without --overwrite) to go on"
                raise StoppedError(self._stopped_by, kept)
            self.ranks.from_first(self._record.finish)
        return self.progress

    def _restored(self) -> Progress:
        path = self.task.folder / CHECKPOINT_NAME
        state = self.ranks.from_first(lambda: read_checkpoint(path))
        if state is None:
            return Progress()
        self.is_restored = True
        return restore_checkpoint(path, state, self.learner, self._rng)

    def _done(self) -> float:
        """Return the used fraction of the budget."""
        if self.settings.epochs is not None:
            return min(1.0, self.progress.pictures / (self.settings.epochs * len(self.task.pairs)))
        return min(1.0, self.progress.elapsed_s / (60.0 * (self.settings.minutes or 0.0) + 1e-9))

    def _loop(self) -> None:
        with self._bars() as bars:
            bar, ends_s = bars.add_task(**self._bar()), list[float]()
            while (done := self._done()) < 1.0 and self._stopped_by is None and not self.progress.stopped_early:
                self._step(learning_rate_factor(done, self.settings.warm_up))
                bars.update(bar, **self._bar())
                self._keep()
                if self._step_s == 0.0:
                    ends_s.append(self.progress.elapsed_s)
                    if len(ends_s) == _TELLING_STEPS:
                        self._step_s = seconds_of_a_step(ends_s)
                        self._say_plan()

    def _say_plan(self) -> None:
        """Say how long it will take, and how often pictures are seen, once the time of a step is known."""
        if self.ranks.first and self._step_s > 0.0:
            say(plan_words(self._steps(), self._step_s, self.settings, len(self.task.pairs), self.ranks.count), err=True)

    def _steps(self) -> int:
        """Return how many steps the whole budget makes; of one in minutes, at the rate so far."""
        step, done = self.progress.step, self._done()
        if self.settings.epochs is not None:
            return math.ceil(self.settings.epochs * len(self.task.pairs) / (self.settings.batch * self.ranks.count))
        if done >= 1.0 or not step:
            return step
        left_s = (1.0 - done) * 60.0 * (self.settings.minutes or 0.0)
        return step + max(1, round(left_s / (self._step_s or self.progress.elapsed_s / step)))

    def _bar(self) -> dict[str, Any]:
        """Return the progress in steps. The planned ones change little by little: each change makes rich forget how fast it goes."""
        progress, planned = self.progress, self._steps()
        if abs(planned - self._planned) > 0.02 * self._planned or self._done() >= 1.0 or self._planned <= progress.step:
            self._planned = planned
        loss_words = "" if math.isnan(progress.smoothed_loss) else f", loss {progress.smoothed_loss:.2e}"
        guessed = "" if self.settings.epochs is not None else " (total estimated)"
        return {"description": f"train{loss_words}, steps{guessed}", "completed": progress.step, "total": self._planned or None}

    def _step(self, rate_factor: float) -> None:
        """Make one update from `batch` pictures of each process: one after the other, or on a GPU those of one size together.

        One picture uses few of the network's bins, all together most of them.
        """
        self.learner.begin(rate_factor)
        batches = joined_by_size(self._draw()) if self._on_gpu else self._draw()
        mean_loss = self._agree(sum(self._learn_from(batch) for batch in batches))
        if not math.isfinite(mean_loss):
            raise diverged(self.task, self.progress.step)
        self.learner.apply(self.progress.step)
        self.progress.took_step(mean_loss, self.settings.batch * self.ranks.count)
        if self.ranks.first and self.progress.steps_above == FAR_ABOVE_STEPS:
            warn(
                f"the loss has been more than {FAR_ABOVE} times its best for {FAR_ABOVE_STEPS} steps ({self.progress.smoothed_loss:.2e}, "
                f"best {self.progress.best_loss:.2e}), which it hardly recovers from: stop it (Ctrl-C) and start again with "
                f"{lower_rate(self.settings)} --overwrite"
            )

    def _draw(self) -> Iterator[Batch]:
        """Yield the pictures of this process, one by one.

        All processes draw from one sequence and skip the pictures of the others, so that two processes see what one with twice the batch
        sees.
        """
        settings, noise = self.settings, self.settings.depth_noise
        drawing = Drawing(
            pairs=self.task.pairs,
            size=settings.batch,
            crop_px=self._crop_px,
            halo_px=self._halo_px,
            crops_per_picture=settings.crops_per_picture,
            noisy=noise > 0.0,
        )
        place, most_px = (self.ranks.number, self.ranks.count), self.task.facts.largest_coc_px
        yield from draw_share(
            drawing, self._rng, *place, depth_noise=noise, largest_coc_px=most_px, device=self.ranks.device, kept=self._kept
        )

    def _learn_from(self, batch: Batch) -> float:
        """Add the gradients of one picture, or of several of one size."""
        facts, settings = self.task.facts, self.settings
        share = len(batch.rgb) / settings.batch
        if self._kept is not None and not self._is_recorded and settings.precision == "float32" and self.task.pairs.one_size:
            self.learner.record_steps(batch)
            self._is_recorded = True
        with self.learner.autocast():
            error = loss(self.learner.network, batch, facts.radiance_scale, facts.largest_coc_px, settings) * share
        self.learner.backward(error)
        value = error.item()
        if not math.isfinite(value) and not all(bool(each.isfinite().all()) for each in (batch.rgb, batch.coc_px, batch.target)):
            raise diverged(self.task, self.progress.step, spoilt=True)
        return value

    def _agree(self, own_loss: float) -> float:
        """Average gradients and loss over all processes; all take the clock of the first, and stop when one is asked to."""
        asked, elapsed_s = self._interruption.asked, self._now_s() if self.ranks.first else 0.0
        own = (own_loss, elapsed_s, float(asked == signal.SIGINT), float(asked == signal.SIGTERM))
        losses, self.progress.elapsed_s, by_key, by_system = self.ranks.average_gradients(self.learner.network, own)
        if by_key or by_system:
            self._stopped_by = signal.SIGTERM if by_system else signal.SIGINT
        return losses / self.ranks.count

    def _now_s(self) -> float:
        return time.monotonic() - self._started_s

    def _keep(self) -> None:
        """Take looks and write checkpoints when they are due."""
        now_s = self.progress.elapsed_s
        if self.ranks.first:
            self._record.note_if_due(self._done())
        if self.settings.validate_every_s and now_s - self._looked_s >= self.settings.validate_every_s:
            # The next look is due an interval after this one ended; of a budget in minutes looks take a tenth at most.
            self.progress.stopped_early, self._looked_s = self.ranks.from_first(lambda: (self._record.look(), self._now_s()))
            if self.settings.minutes is not None:
                self._looked_s += max(0.0, 9.0 * (self._looked_s - now_s) - self.settings.validate_every_s)
        if now_s - self._saved_s >= self.settings.checkpoint_every_s:
            if self.ranks.first:
                self._record.save()
            self._saved_s = now_s

    def _bars(self) -> AbstractContextManager[Bars]:
        return progress_bars() if self.ranks.first else nullcontext(Bars(disable=True))


def is_rate_known(ends_s: Sequence[float], budget_s: float) -> bool:
    """Tell whether the steps so far determine the rate. ends_s: since training began; the first step also reads data and is ignored."""
    if not ends_s:
        return False
    if len(ends_s) == 1:
        return ends_s[0] > max(2.0 * _LONGEST_SHARE * budget_s, 10.0)
    used_s = ends_s[-1] - ends_s[0]
    return used_s > _LONGEST_SHARE * budget_s or (len(ends_s) >= _TELLING_STEPS and used_s > 0.01 * budget_s)


def seconds_of_a_step(ends_s: Sequence[float]) -> float:
    return ends_s[0] if len(ends_s) == 1 else (ends_s[-1] - ends_s[0]) / (len(ends_s) - 1)


def plan_words(steps: int, step_s: float, settings: TrainSettings, pairs: int, processes: int) -> str:
    """Return how long a run will take and how often it sees what; pairs: slices to learn from."""
    pictures = steps * settings.batch * processes
    length_s = 60.0 * settings.minutes if settings.minutes is not None else steps * step_s
    length = f"{length_s:.0f} s" if length_s < 100 else f"{length_s / 60:.0f} min" if length_s < 6000 else f"{length_s / 3600:.1f} h"
    times = f"{pictures / pairs:.0f}" if pictures >= 10 * pairs else f"{pictures / pairs:.1f}"
    crops, seen = ("crops", f"in {times} crops") if settings.crop_px else ("pictures", f"{times} times")
    looks = "" if settings.minutes is not None or not settings.validate_every_s else ", and the looks at held-out slices on top"
    return (
        f"about {steps} steps of {float(format(step_s, '.2g')):g} s: {length}{looks}; {pictures} {crops}, so that each of the {pairs} "
        f"slices to learn from is seen about {seen}"
    )


def steps_within(ends_s: Sequence[float], budget_s: float) -> int:
    """Return how many steps the whole budget makes at that rate."""
    return len(ends_s) + max(0, int((budget_s - ends_s[-1]) / max(seconds_of_a_step(ends_s), 1e-9)))


def too_few_words(ends_s: Sequence[float], settings: TrainSettings, halo_px: int, least: int) -> str:
    """Return the message for a budget with time for fewer steps than `least`. halo_px: see `training.data.batches.Drawing`."""
    minutes, step_s = settings.minutes or 0.0, seconds_of_a_step(ends_s)
    steps, enough = steps_within(ends_s, 60.0 * minutes), 1.25 * (ends_s[0] + least * step_s) / 60.0
    enough = math.ceil(enough) if enough > 5.0 else math.ceil(10.0 * enough) / 10.0
    took, plural = f"{float(format(step_s, '.2g')):g}", "" if steps == 1 else "s"
    return (
        f"{minutes:g} minutes make about {steps} step{plural} of {took} s, and a network learns no lens in fewer than {least}: "
        f"give --minutes {enough:g}, or make steps shorter with {' or '.join(_shorter_steps(settings, halo_px))}"
    )


def _shorter_steps(settings: TrainSettings, halo_px: int) -> list[str]:
    """Return advice that makes a step shorter, the most effective first."""
    ways = []
    if settings.network.form == "published":
        ways.append("--preset demo")
    elif not settings.crop_px:
        ways.append(f"--set crop_px={max(128, 4 * halo_px)}")
    elif settings.crop_px >= 8 * halo_px and settings.crop_px >= 64:
        ways.append(f"--set crop_px={settings.crop_px // 2}")
    if settings.batch > 1:
        ways.append("--set batch=1")
    return [*ways, "smaller pictures (`mrbokeh capture process --max-width`), whose blur has fewer pixels"]
