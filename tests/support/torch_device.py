"""The device of torch that tests run on: the processor, unless MRBOKEH_TEST_DEVICE names another ("cuda")."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

VARIABLE = "MRBOKEH_TEST_DEVICE"
NAME = os.environ.get(VARIABLE, "cpu")
DEVICE = torch.device(NAME)
KERNELS_ON = ["cpu", *([NAME] if DEVICE.type == "cuda" else [])]
"""Where kernels for GPUs are tried: interpreted on the processor, and on the device of the tests if it is a GPU."""


_NO_NUMBER = "only 0-dimensional arrays can be converted to Python scalars"


def here(array: np.ndarray) -> torch.Tensor:
    """Return the array on the device of the tests; on the processor it shares the array's memory."""
    return torch.from_numpy(array).to(DEVICE)


def printed_with_kernels(code: str, device: str = "") -> str:
    """Return what a program prints that gets the name of the device. For the processor kernels are interpreted, which has to be said before
    they are imported: hence the process of its own.
    """
    interpreted = {"TRITON_INTERPRET": "1"} if device == "cpu" else {}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **interpreted}
    done = subprocess.run([sys.executable, "-c", code, device], capture_output=True, text=True, env=environment)
    if interpreted and done.returncode and _NO_NUMBER in done.stderr:
        pytest.skip("this triton's interpreter takes no numbers from this numpy")
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout
