"""Training by several processes: each has its own pictures, all have the same weights, the first one writes.

`torchrun` starts them and tells each its number. Gradients are averaged once a step, in one message that also carries the loss, the
time and stop requests, so that all processes take the same decisions. (DistributedDataParallel would send while the gradient is
still computed; it only sees calls of `forward`, and these networks are too small for that to pay.)
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch
from torch import distributed

from mrbokeh.system.errors import InputError

# Others wait while the first process reads the data, looks at held-out slices or writes.
_PATIENCE = timedelta(hours=2)

Result = TypeVar("Result")


@dataclass(frozen=True)
class Ranks:
    """This process among all: number 0 to count - 1, of local_count on this machine."""

    device: torch.device
    number: int = 0
    count: int = 1
    local_count: int = 1

    @property
    def first(self) -> bool:
        """Tell whether this process writes, validates and prints."""
        return self.number == 0

    def from_first(self, work: Callable[[], Result]) -> Result:
        """Return the first process's result in all processes; its InputError is raised in all."""
        if self.count == 1:
            return work()
        told: list[Result | InputError | None] = [None]
        if self.first:
            try:
                told = [work()]
            except InputError as error:
                told = [error]
        distributed.broadcast_object_list(told, src=0, device=self.device)
        if isinstance(told[0], InputError):
            raise told[0]
        return told[0]  # type: ignore[return-value]

    def average_gradients(self, network: torch.nn.Module, sums: Sequence[float]) -> list[float]:
        """Replace the gradients by their mean over all processes; return each of the numbers summed over all.

        A parameter without a gradient counts as 0, unless it has none anywhere: then the optimizer keeps leaving it out.
        """
        if self.count == 1:
            return list(sums)
        parameters = [each for each in network.parameters() if each.requires_grad]
        used = [float(each.grad is not None) for each in parameters]
        gradients = [torch.zeros_like(each).flatten() if each.grad is None else each.grad.flatten() for each in parameters]
        message = torch.cat([*gradients, torch.tensor([*used, *sums], dtype=torch.float32, device=self.device)])
        distributed.all_reduce(message)
        *means, numbers = message.split([each.numel() for each in parameters] + [len(used) + len(sums)])
        told: list[float] = numbers.tolist()
        for parameter, mean, users in zip(parameters, means, told, strict=False):
            parameter.grad = (mean / self.count).view_as(parameter) if users else None
        return told[len(used) :]


@contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Join the group of processes that torchrun started, or run alone. device: auto, cpu, cuda or cuda:N.

    Raises InputError if a machine has more processes than GPUs.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Ranks(_device(device))
        return
    local, local_count = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
    own = _own_device(device, local, local_count)
    if own.type == "cuda":
        torch.cuda.set_device(own)
    distributed.init_process_group("nccl" if own.type == "cuda" else "gloo", timeout=_PATIENCE)
    try:
        yield Ranks(own, distributed.get_rank(), count, local_count)
    finally:
        distributed.destroy_process_group()


def _own_device(name: str, local: int, local_count: int) -> torch.device:
    """Return the GPU of this process; each process of a machine has one of its own."""
    if _device(name).type != "cuda":
        return torch.device("cpu")
    if local_count > torch.cuda.device_count():
        raise InputError(
            f"expected a GPU for each process, got {local_count} processes on a machine with {torch.cuda.device_count()} GPUs: "
            f"give torchrun --nproc-per-node {torch.cuda.device_count()}, or --device cpu"
        )
    return torch.device("cuda", local)


def _device(name: str) -> torch.device:
    from mrbokeh.system.torch_device import device_named

    return device_named(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
