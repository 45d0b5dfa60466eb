"""The device that a user names."""

import torch

from mrbokeh.errors import InputError

TYPES = ("cpu", "cuda")


def device_named(name: str) -> torch.device:
    """'cpu', 'cuda' or 'cuda:1' and so on, as torch knows it, if it is there."""
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in TYPES:
        raise InputError(f"spreadlets need a device with double precision, 'cpu' or 'cuda' ('cuda:1' is the second), got {name!r}")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"the device {name!r} is not there: torch sees {torch.cuda.device_count()} NVIDIA GPUs; take 'cpu', or ask mrbokeh doctor"
        )
    return device
