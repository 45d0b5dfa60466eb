"""What training strives for, and how fast it steps."""

import math

from torch import Tensor

from training.batches import Batch
from training.settings import TrainSettings


def mean_square_error(result: Tensor, batch: Batch, radiance_scale: float, settings: TrainSettings) -> Tensor:
    """Eq. 3 over the reassembled pictures, in the units of the network, [-1, 1]; pixels without weight do not count."""
    weight, target = batch.weight.expand_as(batch.target), batch.target
    if settings.loss_weighting == "relative":
        weight = weight / target.amax(dim=1, keepdim=True).clamp(min=1.0).square()
    if settings.sensor_white is not None:
        result, target = result.clamp(max=settings.sensor_white), target.clamp(max=settings.sensor_white)
    error = (result - target) * (2.0 / radiance_scale)
    return (weight * error.square()).sum() / weight.sum().clamp(min=1e-6)


def learning_rate_factor(done: float, warm_up: float) -> float:
    """Of the peak, after this fraction of the budget: a linear rise, then half a cosine to zero."""
    if done < warm_up:
        return max(done / warm_up, 0.02)
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, (done - warm_up) / (1.0 - warm_up))))
