"""Weights of a trained gated network, bin by bin in ascending order of signed diameter, and fewer bins that approximate them.

Bins that are close together for the size of their blur are thinned out. Everything that a bin has (its kernels, its part in the
pointwise networks) is a function of the signed diameter, known at the knots. With fewer knots it is the piecewise linear function over
them with the least squared difference; gates are linear between knots as well, so a pixel between two of them is spread by the same
mixture of their kernels.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from jaxtyping import Float, Float64
from torch import nn

from training.networks.gated_network import GatedTiles

CHANNELS = 16  # ONNX Runtime convolves channel by channel in blocks of so many
_STIFFNESS = 0.3  # fewer knots are drawn to the values at their places; without it neighbours that know little swing apart
_NEGLIGIBLE = 1e-5  # part of a knot, a matter of rounding


@dataclass(frozen=True)
class GatedWeights:
    """The weights as arrays.

    knots_px: (bins,), signed diameters at which gates peak. kernels: for each bin (bases, colours, k, k), every kernel with sum 1.
    of_gates and of_coverages: (bins, hidden), with hidden_bias (hidden,) they give the hidden features of
    training/networks/gated_network.py. logits (bins, hidden) and logits_bias (bins,): the weight of a bin. shares (bins, bases, features)
    and shares_bias (bins, bases): the choice between bases; empty for a single base.
    """

    knots_px: np.ndarray
    kernels: tuple[np.ndarray, ...]
    of_gates: np.ndarray
    of_coverages: np.ndarray
    hidden_bias: np.ndarray
    logits: np.ndarray
    logits_bias: np.ndarray
    shares: np.ndarray
    shares_bias: np.ndarray

    @property
    def bases(self) -> int:
        return int(self.kernels[0].shape[0])

    @property
    def colours(self) -> int:
        return int(self.kernels[0].shape[1])

    @property
    def maps(self) -> int:
        """Return the maps of a bin with one base: the light, and the coverage of each kernel."""
        return 3 + self.colours

    @property
    def bins_at_once(self) -> int:
        """Return the fewest bins that fill blocks of channels without a rest."""
        return CHANNELS // math.gcd(CHANNELS, self.maps * self.bases)

    @property
    def radii_px(self) -> list[int]:
        return [kernel.shape[-1] // 2 for kernel in self.kernels]


def weights_of(tiles: GatedTiles) -> GatedWeights:
    """Read the weights of a network without tiles."""
    order = np.argsort(tiles.knots)
    kernels = [kernel for n in range(1, len(tiles.kernels) + 1) for kernel in _kernels(tiles, n)]
    hidden, hidden_bias = pointwise(tiles.hide_in)
    logits, logits_bias = pointwise(tiles.hide_out)
    mixing, none = tiles.mixing, np.zeros((len(order), 1, 0), np.float32)
    return GatedWeights(
        knots_px=np.asarray(tiles.knots)[order],
        kernels=tuple(kernels[each] for each in order),
        of_gates=hidden[:, : len(order)].T[order],
        of_coverages=hidden[:, len(order) :].T[order],
        hidden_bias=hidden_bias,
        logits=logits[order],
        logits_bias=logits_bias[order],
        shares=none if mixing is None else mixing.weight.detach()[0].numpy()[order],
        shares_bias=none[:, 0] if mixing is None else mixing.bias.detach()[0].numpy()[order],
    )


def pointwise(convolution: nn.Conv2d) -> tuple[np.ndarray, np.ndarray]:
    """Return (outputs, inputs) and (outputs,)."""
    assert convolution.bias is not None
    return convolution.weight.detach()[:, :, 0, 0].numpy(), convolution.bias.detach().numpy()


def _kernels(tiles: GatedTiles, n: int) -> np.ndarray:
    """Return (bins of this size, bases, colours, 2n+1, 2n+1)."""
    magnitude = tiles.kernels[n - 1].detach().abs()[0].double()
    kernels = magnitude / magnitude.sum(dim=(-2, -1), keepdim=True)
    return kernels.reshape(-1, tiles.bases, *kernels.shape[1:]).numpy()


def widened(kernels: Float[np.ndarray, "... k k"], size: int) -> Float[np.ndarray, "... size size"]:
    """Pad kernels with zeros."""
    margin = (size - kernels.shape[-1]) // 2
    return np.pad(kernels, [(0, 0)] * (kernels.ndim - 2) + [(margin, margin)] * 2)


def thinned(weights: GatedWeights, spacing: float) -> GatedWeights:
    """Thin a network out to knots at least `spacing` times their diameter apart; 0 leaves them all."""
    knots_px = fewer_knots(weights.knots_px, spacing, weights.bins_at_once)
    return weights if len(knots_px) == len(weights.knots_px) else with_knots(weights, knots_px)


def fewer_knots(knots_px: Float[np.ndarray, " bins"], spacing: float, whole: int) -> Float64[np.ndarray, " fewer"]:
    """Return knots at least `spacing` times their diameter apart, in front of the focus and behind it; the first and both ends stay.

    Each side has a multiple of `whole` of them, if there are that many: so many share a convolution.
    """
    centre = int(np.argmin(np.abs(knots_px)))
    near = _side(knots_px[centre::-1] - knots_px[centre], abs(knots_px[centre]), spacing, whole)
    far = _side(knots_px[centre:] - knots_px[centre], abs(knots_px[centre]), spacing, whole)
    return np.round(knots_px[centre] + np.concatenate([near[::-1], [0.0], far]), 6)


def _side(away_px: np.ndarray, first_px: float, spacing: float, whole: int) -> np.ndarray:
    """Thin one side. away_px: distances of its knots from the one in the middle, which is their first and is left out of the result."""
    count = int(np.ceil(_bins_up_to(away_px, first_px, spacing)[-1] / whole - 1e-9)) * whole
    if count >= len(away_px) - 1:
        return away_px[1:]
    closest = scipy.optimize.brentq(lambda each: _bins_up_to(away_px, first_px, each)[-1] - count, 0.0, spacing)
    return np.interp(np.arange(1, count + 1), _bins_up_to(away_px, first_px, closest), away_px)


def _bins_up_to(away_px: np.ndarray, first_px: float, spacing: float) -> np.ndarray:
    """Return how many bins, in fractions, lie before each knot at the lesser of the present density and that of the spacing."""
    steps = np.abs(np.diff(away_px))
    return np.concatenate([[0.0], np.cumsum(steps / np.maximum(steps, spacing * (first_px + np.abs(away_px[1:]))))])


def hats(at_px: Float[np.ndarray, " places"], knots_px: Float[np.ndarray, " knots"]) -> Float64[np.ndarray, "places knots"]:
    """Return the share of each knot at each place; rows sum to 1, the outermost hats extend to infinity."""
    return np.stack([np.interp(at_px, knots_px, row) for row in np.eye(len(knots_px))], axis=1)


def with_knots(weights: GatedWeights, knots_px: Float[np.ndarray, " fewer"]) -> GatedWeights:
    """Return weights for these knots, ascending. Kernels take the size of the largest that contributes; their sums stay 1."""
    mixture = hats(weights.knots_px, knots_px)
    fit = _fit(weights.knots_px, knots_px)

    def fitted(values: np.ndarray) -> np.ndarray:
        return np.tensordot(fit, values, axes=1).astype(values.dtype)

    names = ("of_gates", "of_coverages", "logits", "logits_bias", "shares", "shares_bias")
    rest = {name: fitted(getattr(weights, name)) for name in names}
    return replace(weights, knots_px=np.asarray(knots_px), kernels=_fitted_kernels(weights, mixture, fit), **rest)


def _fit(from_px: np.ndarray, to_px: np.ndarray) -> np.ndarray:
    sampled, mixture = hats(to_px, from_px), hats(from_px, to_px)
    missing = np.eye(len(from_px)) - mixture @ sampled
    return sampled + np.linalg.solve(mixture.T @ mixture + _STIFFNESS * np.eye(len(to_px)), mixture.T @ missing)


def _fitted_kernels(weights: GatedWeights, mixture: np.ndarray, fit: np.ndarray) -> tuple[np.ndarray, ...]:
    largest = max(weights.radii_px)
    stacked = np.stack([widened(kernel, 2 * largest + 1) for kernel in weights.kernels])
    kernels = []
    for knot, shares in enumerate(fit):
        kernel = np.tensordot(shares, stacked, axes=1)
        margin = largest - max(radius for radius, part in zip(weights.radii_px, mixture[:, knot], strict=True) if part > _NEGLIGIBLE)
        cut = kernel[..., margin : kernel.shape[-1] - margin, margin : kernel.shape[-1] - margin]
        kernels.append(cut / cut.sum(axis=(-2, -1), keepdims=True))
    return tuple(kernels)
