"""Light field samples on a device, and the device that a user names."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mrbokeh.layering.light_field_samples import LightFieldSamples


@dataclass(frozen=True)
class DeviceSamples:
    """N samples of one picture in any order, all of it on one device; see LightFieldSamples for what they are.

    values: (N, C) what is reconstructed, linear colour or more. coc_px: (N,) signed diameters of the circle of confusion.
    """

    width_px: int
    height_px: int
    xy_px: Float32[Tensor, "samples 2"]
    lens_uv: Float32[Tensor, "samples 2"]
    time: Float32[Tensor, " samples"]
    values: Float32[Tensor, "samples channels"]
    coc_px: Float32[Tensor, " samples"]
    depth_m: Float32[Tensor, " samples"]
    motion_px: Float32[Tensor, "samples 2"]

    @classmethod
    def of(
        cls,
        samples: LightFieldSamples,
        values: Float32[np.ndarray, "samples channels"],
        coc_px: Float32[np.ndarray, " samples"],
        device: torch.device,
    ) -> "DeviceSamples":
        """Samples of the host, copied; their own colour or other values."""
        arrays = samples.xy_px, samples.lens_uv, samples.time, values, coc_px, samples.depth_m, samples.motion_px
        return cls(samples.width_px, samples.height_px, *(torch.from_numpy(np.ascontiguousarray(each)).to(device) for each in arrays))

    @property
    def per_pixel(self) -> float:
        return len(self.time) / (self.width_px * self.height_px)
