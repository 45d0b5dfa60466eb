"""Reference for deep pixels: samples of one pixel sorted, none overlapping another ("Interpreting OpenEXR Deep Pixels", openexr.com).

It says plainly, one pixel at a time, what the compiled `flatten_layers` does at once for a whole picture.

A sample with thickness is fog of even density: a part r of its length has alpha 1 - (1 - a)^r and colour in that proportion. Two samples
in one place mix, each by how much of the light it stops. An opaque one stays opaque however it is cut.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_THIN = 1e-30


class DeepSample(NamedTuple):
    """Premultiplied colour and alpha from front_m to back_m; both the same for a sample without thickness."""

    rgb: tuple[float, float, float]
    alpha: float
    front_m: float
    back_m: float


def tidied(samples: Sequence[DeepSample], cuts_m: Sequence[float] = ()) -> list[DeepSample]:
    """Sorted samples that do not overlap and look the same; cut at cuts_m too."""
    marks = sorted({each for sample in samples for each in (sample.front_m, sample.back_m)} | set(cuts_m))
    places: dict[tuple[float, float], list[DeepSample]] = {}
    for piece in (piece for sample in samples for piece in _pieces(sample, marks)):
        places.setdefault((piece.front_m, piece.back_m), []).append(piece)
    return [merged(places[place]) for place in sorted(places)]


def merged(samples: Sequence[DeepSample]) -> DeepSample:
    """Samples of one place as one. Of opaque ones the mean, for none hides the other."""
    opaque = [sample for sample in samples if sample.alpha >= 1.0]
    if opaque:
        return opaque[0]._replace(rgb=_rgb(sum(sample.rgb[i] for sample in opaque) / len(opaque) for i in range(3)))
    result = samples[0]
    for sample in samples[1:]:
        result = _both(result, sample)
    return result


def split(sample: DeepSample, at_m: float) -> tuple[DeepSample, DeepSample]:
    """A sample with thickness cut at a depth within it."""
    share = (at_m - sample.front_m) / (sample.back_m - sample.front_m)
    front, back = _part(sample, share), _part(sample, 1.0 - share)
    return front._replace(back_m=at_m), back._replace(front_m=at_m)


def flattened(samples: Sequence[DeepSample]) -> tuple[tuple[float, float, float], float]:
    """Colour and alpha of tidy samples, laid over one another."""
    rgb, alpha = (0.0, 0.0, 0.0), 0.0
    for sample in samples:
        rgb = _rgb(rgb[i] + (1.0 - alpha) * sample.rgb[i] for i in range(3))
        alpha += (1.0 - alpha) * sample.alpha
    return rgb, alpha


def _pieces(sample: DeepSample, marks: Iterable[float]) -> list[DeepSample]:
    pieces, rest = [], sample
    for mark in marks:
        if rest.front_m < mark < rest.back_m:
            piece, rest = split(rest, mark)
            pieces.append(piece)
    return [*pieces, rest]


def _part(sample: DeepSample, share: float) -> DeepSample:
    """A part of a sample's length."""
    if sample.alpha >= 1.0:
        return sample
    if sample.alpha <= _THIN:
        return sample._replace(alpha=sample.alpha * share, rgb=_rgb(each * share for each in sample.rgb))
    alpha = -math.expm1(share * math.log1p(-sample.alpha))
    return sample._replace(alpha=alpha, rgb=_rgb(each * alpha / sample.alpha for each in sample.rgb))


def _both(one: DeepSample, other: DeepSample) -> DeepSample:
    """Two samples of one place, neither opaque."""
    alpha = one.alpha + other.alpha - one.alpha * other.alpha
    (depth, scale), (other_depth, other_scale) = (_optical_depth(sample.alpha) for sample in (one, other))
    total = depth + other_depth
    weight = alpha / total if total > _THIN else 1.0
    rgb = ((scale * one.rgb[i] + other_scale * other.rgb[i]) * weight for i in range(3))
    return one._replace(alpha=alpha, rgb=_rgb(rgb))


def _optical_depth(alpha: float) -> tuple[float, float]:
    """-log(1 - alpha), and that over alpha."""
    depth = -math.log1p(-alpha)
    return depth, depth / alpha if alpha > _THIN else 1.0


def _rgb(values: Iterable[float]) -> tuple[float, float, float]:
    r, g, b = values
    return r, g, b
