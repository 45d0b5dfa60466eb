"""The plane sweep by torch, on a GPU or for tests on the CPU: the same costs as `plane_sweep` up to rounding."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from mrbokeh.depth.views.plane_sweep import UNSEEN, WORST_COST, Costs, Matching
from mrbokeh.depth.views.sweep_view import Plane, SweepView, packed_view, rays_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named

Picture = Float32[Tensor, "height width"]


def plane_sweep_on(
    device: str,
    reference: SweepView,
    neighbours: Sequence[SweepView],
    offsets: Float[np.ndarray, " planes"],
    matching: Matching | None = None,
    base_dioptre: Plane | None = None,
) -> Costs:
    """Return the costs of `plane_sweep`. device: 'cuda', 'cuda:1', 'cpu'. Device memory: about 60 bytes a pixel and a byte per cell."""
    if not neighbours:
        raise InputError("a plane sweep needs at least one neighbouring view, got none: photograph from more places")
    place, rules = device_named(device), matching or Matching()
    structure = torch.from_numpy(np.ascontiguousarray(reference.structure)).to(place)
    rays = torch.from_numpy(rays_of(reference)).to(place)
    base = torch.zeros_like(structure) if base_dioptre is None else torch.from_numpy(base_dioptre).to(place)
    pictures = [torch.from_numpy(np.ascontiguousarray(each.structure)).to(place) for each in neighbours]
    views = [[float(number) for number in packed_view(reference, each)] for each in neighbours]
    costs = torch.empty((*structure.shape, len(offsets)), dtype=torch.uint8, device=place)
    window = _Windows(structure, rules)
    for plane, offset in enumerate(np.asarray(offsets, np.float32)):
        dioptre = base + float(offset)
        scores = [window.correlated(*_warped(picture, rays, dioptre, view)) for picture, view in zip(pictures, views, strict=True)]
        costs[..., plane] = _costs(_mean_of_best(torch.stack(scores), rules.best_of(len(scores))))
    return costs.cpu().numpy()


def _warped(
    picture: Float32[Tensor, "rows columns"], rays: Float32[Tensor, "height width 2"], dioptre: Picture, view: list[float]
) -> tuple[Picture, Tensor]:
    """Return (bilinear samples of the neighbour, whether it sees the point)."""
    a, b = rays.unbind(-1)
    x, y, z = (view[3 * row] * a + view[3 * row + 1] * b + view[3 * row + 2] + view[9 + row] * dioptre for row in range(3))
    z = z.clamp_min(1e-6)
    p, q = x / z, y / z
    rr = p * p + q * q
    bend = 1.0 + rr * (view[16] + rr * view[17])
    u, v = p * bend * view[12] + view[14], q * bend * view[13] + view[15]
    rows, columns = picture.shape
    seen = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
    grid = torch.stack([2.0 * u / (columns - 1) - 1.0, 2.0 * v / (rows - 1) - 1.0], dim=-1)
    samples = F.grid_sample(picture[None, None], grid[None], mode="bilinear", padding_mode="border", align_corners=True)
    return samples[0, 0], seen


class _Windows:
    """Correlation in windows around each pixel of the reference; sums in double precision, since their differences are small."""

    def __init__(self, structure: Picture, matching: Matching) -> None:
        self._radius, self._noise = matching.radius_px, matching.noise**2
        self._structure = structure.double()
        self._mean = self._average(self._structure)
        self._variance = (self._average(self._structure**2) - self._mean**2).clamp_min(0.0)

    def correlated(self, samples: Picture, seen: Tensor) -> Picture:
        w = samples.double()
        mean = self._average(w)
        variance = (self._average(w * w) - mean**2).clamp_min(0.0)
        covariance = self._average(w * self._structure) - mean * self._mean
        score = covariance / torch.sqrt((self._variance + self._noise) * (variance + self._noise))
        return torch.where(seen, score, UNSEEN).float()

    def _average(self, values: Float64[Tensor, "height width"]) -> Float64[Tensor, "height width"]:
        size = 2 * self._radius + 1
        return F.avg_pool2d(values[None], size, stride=1, padding=self._radius, count_include_pad=False)[0]


def _mean_of_best(scores: Float32[Tensor, "views height width"], best: int) -> Picture:
    kept = scores.topk(best, dim=0).values
    seen = kept > UNSEEN
    total = torch.where(seen, kept, 0.0).sum(dim=0)
    return torch.where(seen.any(dim=0), total / seen.sum(dim=0).clamp_min(1), UNSEEN)


def _costs(score: Picture) -> Tensor:
    return (WORST_COST * (1.0 - score.clamp(0.0, 1.0)) + 0.5).to(torch.uint8)
