"""A network while it learns: its weights, their average, the best so far, and the optimizer."""

import copy
from typing import Any

import torch
from torch import Tensor

from training.network import BlurNetwork
from training.settings import TrainSettings

_HALVES = {"bfloat16": torch.bfloat16, "float16": torch.float16}


class Learner:
    """network: what is trained, average: the moving average that becomes the result; both in float32 whatever the precision.

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
        """The learning rate of the last step."""
        return float(self._optimizer.param_groups[0]["lr"])

    def begin(self, rate_factor: float) -> None:
        """Start a step at this part of the peak learning rate, without gradients."""
        for group in self._optimizer.param_groups:
            group["lr"] = self._settings.learning_rate * rate_factor
        self._optimizer.zero_grad(set_to_none=True)

    def autocast(self) -> torch.autocast:
        """The block in which the network and its loss are computed in the chosen precision."""
        half = _HALVES.get(self._settings.precision)
        return torch.autocast(self.device.type, half, enabled=half is not None)

    def backward(self, loss: Tensor) -> None:
        """Add the gradients of this loss to those of the step."""
        self._scaler.scale(loss).backward()

    def apply(self, step: int) -> None:
        """Update the weights; their average follows, faster while it is young (step counts from 0)."""
        if self._settings.clip_norm > 0.0:
            self._scaler.unscale_(self._optimizer)
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self._settings.clip_norm)
        self._scaler.step(self._optimizer)
        self._scaler.update()
        decay = min(self._settings.ema_decay, (1.0 + step) / (10.0 + step))
        with torch.no_grad():
            for mean, now in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(now, 1.0 - decay)

    def keep_best(self) -> None:
        self.best = {name: value.detach().cpu().clone() for name, value in self.average.state_dict().items()}

    def take_best(self) -> None:
        """The average becomes the best so far, if there is one."""
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
        """Raises RuntimeError, KeyError or ValueError where the state is that of another network."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.best = state["best"]
        self._optimizer.load_state_dict(state["optimizer"])
        self._scaler.load_state_dict(state["scaler"])
