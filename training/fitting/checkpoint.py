"""Checkpoints: everything that a training run needs to continue as if it had never stopped, in one file that is whole or absent.

That is the learner (weights, their average, the best so far, the optimizer) and the progress with its curve, which is also written as
a table and a picture.
"""

import copy
import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from training.data.batches import Batch
from training.fitting.settings import TrainSettings
from training.networks.network import BlurNetwork, split

TABLE_NAME = "curve.csv"
PICTURE_NAME = "curve.png"
_HALVES = {"bfloat16": torch.bfloat16, "float16": torch.float16}
FILE_NAME = "checkpoint.pt"


_SETTLED_STEPS, _DARK_START = 10, 7.0  # the first pictures may be dark ones, with so many times less loss than others
FAR_ABOVE, FAR_ABOVE_STEPS = 1.5, 200
"""A loss that is so many times its best for so many steps does not come back.

On traced stacks the smoothed loss of sound runs stayed within 1.1 of its best, and so did that of the demo with 30 times its learning rate,
which ended 0.6 dB lower; with 300 times it was above 1.5 from its 25th step to its end.
"""


class CurvePoint(NamedTuple):
    """A point of the curve.

    loss: smoothed, of training. held_out_psnr_db: nan between the looks at held-out slices. learning_rate: of the step before.
    """

    step: int
    elapsed_s: float
    loss: float
    held_out_psnr_db: float
    learning_rate: float


def write_curve(folder: Path, curve: Sequence[CurvePoint]) -> None:
    """Write curve.csv; the PSNR is empty between looks."""
    with atomic_path(folder / TABLE_NAME) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(CurvePoint._fields)
        rows.writerows(["" if isinstance(value, float) and math.isnan(value) else value for value in point] for point in curve)


def draw_curve(folder: Path, curve: Sequence[CurvePoint]) -> str:
    """Draw curve.png: loss and learning rate (both logarithmic) and the PSNR on held-out slices, over steps; return it as SVG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 6.0), layout="constrained")
    loss, psnr, rate = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1))
    steps = [point.step for point in curve]
    loss.semilogy(steps, [point.loss for point in curve], color="tab:blue")
    looks = [point for point in curve if not math.isnan(point.held_out_psnr_db)]
    psnr.plot([point.step for point in looks], [point.held_out_psnr_db for point in looks], "o-", markersize=3, color="tab:green")
    rate.semilogy(steps, [point.learning_rate for point in curve], color="tab:gray")
    for axes, label in ((loss, "training loss"), (psnr, "held-out PSNR (dB)"), (rate, "learning rate")):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    rate.set_xlabel("step")
    with atomic_path(folder / PICTURE_NAME) as temporary:
        figure.savefig(temporary, dpi=140)
    figure.set_layout_engine("none")  # it is laid out, which takes as long as all the rest
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    return drawn.getvalue()[drawn.getvalue().index("<svg") :]


class Learner:
    """A network while it learns. network: the trained weights, average: their moving average, the result; float32 whatever the precision.

    best: the averaged weights of the best look at held-out slices, or None before the first.
    """

    def __init__(self, network: BlurNetwork, settings: TrainSettings, device: torch.device) -> None:
        self.network = network.to(device)
        self.average = copy.deepcopy(self.network)
        self.best: dict[str, Tensor] | None = None
        self._settings, self.device = settings, device
        self._optimizer = torch.optim.Adam(self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99))
        # float16 ends at 6e-8: small gradients would vanish if they were not scaled up.
        self._scaler = torch.amp.GradScaler(device.type, enabled=settings.precision == "float16")

    @property
    def learning_rate(self) -> float:
        """Return the learning rate of the last step."""
        return float(self._optimizer.param_groups[0]["lr"])

    def begin_with(self, network: BlurNetwork) -> None:
        """Begin with the weights of another network. Raises InputError where it has another shape."""
        try:
            for each in (self.network, self.average):
                each.load_state_dict(network.state_dict())
        except RuntimeError:
            raise InputError(
                "the run to start from has a network of another shape: leave settings of the network out, or train afresh"
            ) from None

    def record_steps(self, batch: Batch) -> None:
        """Record the kernels of one pass for pictures of this size, forward and backward, to start them all at once (CUDA graphs)."""
        network = self.network
        with torch.no_grad():
            x = network.encode(batch.rgb, batch.coc_px, batch.place, batch.lens)
            x = x if network.grid is None else split(x, network.grid)
        network.tiles = torch.cuda.make_graphed_callables(network.tiles, (x,))  # type: ignore[assignment]

    def begin(self, rate_factor: float) -> None:
        """Start a step at this fraction of the peak learning rate, without gradients."""
        for group in self._optimizer.param_groups:
            group["lr"] = self._settings.learning_rate * rate_factor
        self._optimizer.zero_grad(set_to_none=True)

    def autocast(self) -> torch.autocast:
        """Return the context in which the network and its loss are computed in the chosen precision."""
        half = _HALVES.get(self._settings.precision)
        return torch.autocast(self.device.type, half, enabled=half is not None)

    def backward(self, loss: Tensor) -> None:
        """Add the gradients of this loss to those of the step."""
        self._scaler.scale(loss).backward()

    def apply(self, step: int) -> None:
        """Update the weights; their average follows, faster in early steps (step counts from 0)."""
        if self._settings.clip_norm > 0.0:
            self._scaler.unscale_(self._optimizer)
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self._settings.clip_norm)
        self._scaler.step(self._optimizer)
        self._scaler.update()
        decay = min(self._settings.ema_decay, (1.0 + step) / (10.0 + step))
        with torch.no_grad():
            for mean, now in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(now, 1.0 - decay)

    def is_finite(self) -> bool:
        """Tell whether all weights are numbers, those of the average too."""
        return all(bool(torch.isfinite(each).all()) for each in (*self.network.parameters(), *self.average.parameters()))

    def keep_best(self) -> None:
        self.best = {name: value.detach().cpu().clone() for name, value in self.average.state_dict().items()}

    def take_best(self) -> None:
        """Replace the average by the best so far, if there is one."""
        if self.best is not None:
            self.average.load_state_dict(self.best)

    def state(self) -> dict[str, Any]:
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "best": self.best,
            "optimizer": self._optimizer.state_dict(),
            "scaler": self._scaler.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a state. Raises RuntimeError, KeyError or ValueError if it is that of another network."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.best = state["best"]
        self._optimizer.load_state_dict(state["optimizer"])
        self._scaler.load_state_dict(state["scaler"])


@dataclass
class Progress:
    """The mutable state of a run.

    pictures: drawn so far, by all processes together.
    best_psnr_db, best_step: of the best look at held-out slices; looks_since_best: how many came after it.
    sharp_psnr_db: of the all-in-focus picture against the same slices, before any blur.
    points_due: parts of the budget noted in the curve so far.
    best_loss: the smallest smoothed one; steps_above: steps in a row that it is far above that.
    kept_step: of the finished network's weights; stopped_early: before the budget was used, for lack of improvement.
    """

    step: int = 0
    pictures: int = 0
    elapsed_s: float = 0.0
    smoothed_loss: float = math.nan
    best_psnr_db: float = -math.inf
    best_step: int = 0
    looks_since_best: int = 0
    sharp_psnr_db: float = math.nan
    points_due: int = 0
    best_loss: float = math.inf
    steps_above: int = 0
    stopped_early: bool = False
    kept_step: int = 0
    finished: bool = False
    curve: list[CurvePoint] = field(default_factory=list)

    def took_step(self, loss: float, pictures: int) -> None:
        self.step += 1
        self.pictures += pictures
        newest = max(0.02, 1.0 / self.step)  # the mean of all at first
        self.smoothed_loss = loss if self.step == 1 else (1.0 - newest) * self.smoothed_loss + newest * loss
        self.best_loss = min(self.best_loss, self.smoothed_loss * (1.0 if self.step >= _SETTLED_STEPS else _DARK_START))
        above = self.smoothed_loss > FAR_ABOVE * self.best_loss or self.steps_above >= FAR_ABOVE_STEPS  # told once
        self.steps_above = self.steps_above + 1 if above else 0

    def looked(self, psnr_db: float) -> bool:
        """Count a look at held-out slices and tell whether it is the best so far; nan never is."""
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
    """Read the state for `restore_checkpoint`; None if there is no such file."""
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, UnpicklingError) as error:
        raise _not_of_this_run(path, error) from None
    return state


def restore_checkpoint(path: Path, state: dict[str, Any], learner: Learner, rng: np.random.Generator) -> Progress:
    """Restore a checkpoint; raises InputError if it is not one of such a run. path: for the message."""
    try:
        learner.restore(state["learner"])
        rng.bit_generator.state = state["batch_rng"]
        torch.set_rng_state(state["torch_rng"])
        return _progress(state["progress"])
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise _not_of_this_run(path, error) from None


def read_progress(folder: Path) -> Progress:
    """Read how far the run in the folder is; Progress() before its first checkpoint. Raises InputError for another file."""
    state = read_checkpoint(folder / FILE_NAME)
    try:
        return Progress() if state is None else _progress(state["progress"])
    except (KeyError, TypeError) as error:
        raise _not_of_this_run(folder / FILE_NAME, error) from None


def _progress(values: dict[str, Any]) -> Progress:
    return Progress(**values | {"curve": [CurvePoint(*point) for point in values["curve"]]})


def _not_of_this_run(path: Path, error: Exception) -> InputError:
    return InputError(f"{path} is not a checkpoint of this run ({str(error)[:200]}): --overwrite starts again")
