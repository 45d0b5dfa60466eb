"""Deep pictures among flat layers: what was rendered apart hides one another by depth, in whatever order it is given.

Samples of several deep pictures are merged. A flat layer stays whole, for it holds one surface; the deep samples of every pixel are
shared out to what lies before it and what lies behind it. Beside the layer its depth goes on as at its outline, so that a twig that
reaches out from before it stays in one piece.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.images.layer import Layer, clear
from mrbokeh.stacks.exr_layers.deep_layers import APART, SURFACES, DeepSamples, merged, peeled
from mrbokeh.stacks.exr_layers.flat_render import nearest_depth
from mrbokeh.system.errors import InputError

_THIN = 1e-30


def interleaved(deep: Sequence[DeepSamples], flat: Sequence[Layer]) -> list[Layer]:
    """Return sharp layers, front first. flat: front first where they are in one place.

    Raises InputError where sizes differ, or there is no deep picture.
    """
    if not deep:
        raise InputError("expected a deep picture to be put among layers, got none")
    samples = merged(deep)
    for layer in flat:
        if layer.alpha.shape != (samples.height_px, samples.width_px):
            raise InputError(
                f"the layer is {layer.width_px}x{layer.height_px} px but the deep picture is {samples.width_px}x{samples.height_px} px: "
                f"render both in one size"
            )
    planes_m = [_plane_m(layer) for layer in flat]
    for plane_m in planes_m:
        samples = cut_at(samples, plane_m)
    behind = _behind(samples, planes_m)
    layers = []
    for number in range(len(flat) + 1):
        found = peeled(_only(samples, behind == number), SURFACES, APART)
        layers += [layer for layer in found if (layer.alpha != 0).any() or (layer.rgb != 0).any()]
        layers += flat[number : number + 1]
    return layers or [clear(samples.height_px, samples.width_px)]


def cut_at(samples: DeepSamples, plane_m: Float64[np.ndarray, " pixels"]) -> DeepSamples:
    """Cut volumes that reach through a depth, which each pixel has its own of, in two there."""
    at_m = np.repeat(plane_m, samples.counts)
    through = (samples.front_m < at_m) & (at_m < samples.back_m)
    if not through.any():
        return samples
    share = np.ones_like(samples.front_m)
    share[through] = (at_m - samples.front_m)[through] / (samples.back_m - samples.front_m)[through]
    front = replace(_part(samples, share), back_m=np.where(through, at_m, samples.back_m))
    rest = replace(_part(samples, 1.0 - share), front_m=np.where(through, at_m, samples.front_m))
    return merged([front, _only(rest, through)])


def _plane_m(layer: Layer) -> Float64[np.ndarray, " pixels"]:
    """Return the layer's depth, continued beyond its outline; infinite if it has none at all."""
    there = ((layer.alpha > 0) | (layer.rgb != 0).any(axis=2)) & np.isfinite(layer.depth_m)
    if not there.any():
        return np.full(there.size, np.inf)
    return nearest_depth(layer.depth_m, there)[0].astype(np.float64).ravel()


def _behind(samples: DeepSamples, planes_m: Sequence[Float64[np.ndarray, " pixels"]]) -> Int64[np.ndarray, " samples"]:
    """Return per sample how many of the layers lie before it: up to the last one that does."""
    behind, middle_m = np.zeros(len(samples.alpha), np.int64), 0.5 * (samples.front_m + samples.back_m)
    for number, plane_m in enumerate(planes_m):
        behind[middle_m > np.repeat(plane_m, samples.counts)] = number + 1
    return behind


def _part(samples: DeepSamples, share: Float64[np.ndarray, " samples"]) -> DeepSamples:
    """Return a share of each sample's length: 1 - (1 - alpha)^share, and colour in that proportion; opaque samples stay opaque."""
    alpha = samples.alpha.astype(np.float64)
    thin = -np.expm1(share * np.log1p(-np.minimum(alpha, 1.0 - 1e-12)))
    cut = np.where(alpha >= 1.0, alpha, np.where(alpha <= _THIN, alpha * share, thin))
    scale = np.divide(cut, alpha, out=share.copy(), where=alpha > _THIN)
    return replace(samples, alpha=cut.astype(np.float32), rgb=(samples.rgb * scale[:, None]).astype(np.float32))


def _only(samples: DeepSamples, which: Bool[np.ndarray, " samples"]) -> DeepSamples:
    counts = np.add.reduceat(np.append(which, False).astype(np.int64), samples.starts[:-1]) * (samples.counts > 0)
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    kept = {name: getattr(samples, name)[which] for name in ("rgb", "alpha", "front_m", "back_m")}
    return replace(samples, starts=starts, **kept)
