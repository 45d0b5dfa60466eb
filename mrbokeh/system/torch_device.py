"""Devices of torch: the one that a user names, and whether Triton can write kernels for it."""

from functools import cache
from importlib.util import find_spec

import torch

from mrbokeh.system.errors import InputError

TYPES = ("cpu", "cuda")


def device_named(name: str) -> torch.device:
    """Return the torch device 'cpu', 'cuda' or 'cuda:1' and so on, if it is there."""
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in TYPES:
        raise InputError(f"expected a device with double precision, 'cpu' or 'cuda' ('cuda:1' is the second), got {name!r}")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"the device {name!r} is not there: torch sees {torch.cuda.device_count()} NVIDIA GPUs; take 'cpu', or ask mrbokeh doctor"
        )
    return device


@cache
def has_triton() -> bool:
    return find_spec("triton") is not None
