"""f-number and focal length as a network sees them: in stops and octaves, over the range it was trained on."""

import math

import torch
from torch import Tensor, nn

LensRanges = tuple[tuple[float, float], tuple[float, float]]
"""((lowest, highest f-number), (lowest, highest focal length in mm))."""

LEAST_RATIO = 2.0


class LensScale(nn.Module):
    """(B, 2) f-number and focal length in mm to (B, 2) in [-1, 1]: the logarithm of each, its trained range from -1 to 1.

    Logarithms, because blur follows ratios of both. A range narrower than a factor of 2 counts as that wide about its middle, so
    that what hardly varied in training is hardly amplified. The ranges belong to the run, not to the weights: they are not saved with them.
    """

    middle: Tensor
    half_width: Tensor

    def __init__(self, ranges: LensRanges) -> None:
        super().__init__()
        logs = torch.tensor([[math.log(low), math.log(high)] for low, high in ranges])
        half_width = 0.5 * (logs[:, 1] - logs[:, 0]).clamp(min=math.log(LEAST_RATIO))
        self.register_buffer("middle", logs.mean(dim=1), persistent=False)
        self.register_buffer("half_width", half_width, persistent=False)

    def forward(self, lens: Tensor) -> Tensor:
        return (torch.log(lens) - self.middle) / self.half_width
