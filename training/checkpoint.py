"""Checkpoints: everything a training run needs to go on as if it had never stopped, in one file that is whole or absent."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrbokeh.atomic_files import atomic_path
from mrbokeh.errors import InputError

FILE_NAME = "checkpoint.pt"


@dataclass
class Progress:
    """Where a run stands; the one thing that changes while it trains.

    curve: rows of (step, elapsed seconds, smoothed loss, PSNR on held-out slices in dB or nan).
    """

    step: int = 0
    elapsed_s: float = 0.0
    smoothed_loss: float = float("nan")
    finished: bool = False
    curve: list[tuple[int, float, float, float]] = field(default_factory=list)


def save_checkpoint(
    path: Path,
    progress: Progress,
    network: torch.nn.Module,
    average: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    rng: np.random.Generator,
) -> None:
    state = {
        "progress": dict(vars(progress)),
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "batch_rng": rng.bit_generator.state,
        "torch_rng": torch.get_rng_state(),
    }
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def load_checkpoint(
    path: Path, network: torch.nn.Module, average: torch.nn.Module, optimizer: torch.optim.Optimizer, rng: np.random.Generator
) -> Progress:
    """Put everything back; raises InputError where the file is not a checkpoint of such a run."""
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        rng.bit_generator.state = state["batch_rng"]
        torch.set_rng_state(state["torch_rng"])
        return Progress(**state["progress"])
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError) as error:
        raise InputError(f"{path} is not a checkpoint of this run ({str(error)[:200]}): --overwrite starts again") from None
