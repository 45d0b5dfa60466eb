"""Deep EXR: any number of samples per pixel, each with colour, alpha and a place or range of depth; and as a few layers for lens blur.

All layers laid over one another are the flat picture. Each keeps one depth per pixel, the mean in dioptres of what is seen of it, because
blur grows evenly with dioptres.

Each pixel's first surface is in the first layer, its second in the second. A surface that recedes stays whole.

A sample with thickness is fog of even density ("Interpreting OpenEXR Deep Pixels", openexr.com): a part r of its length has alpha
1 - (1 - a)^r and colour in that proportion. Two samples in one place mix, each by how much of the light it stops. An opaque one stays
opaque however it is cut.

What was rendered apart hides one another by depth, in whatever order it is given: samples of several deep pictures are merged. A flat
layer stays whole, for it holds one surface; the deep samples of every pixel are shared out to what lies before it and what lies behind it.
Beside the layer its depth goes on as at its outline, so that a twig that reaches out from before it stays in one piece.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from mrbokeh.images.exr_io import ATTRIBUTE, in_rec709
from mrbokeh.images.layer import Layer, clear
from mrbokeh.stacks.exr_layers.render_channels import nearest_depth
from mrbokeh.system.errors import InputError

_COLOURS = ("R", "G", "B")


@dataclass(frozen=True)
class DeepSamples:
    """Deep picture as flat lists of samples.

    Samples of pixel (y, x), one row after the other, are those from starts[y * width + x] up to starts[y * width + x + 1].
    rgb: premultiplied, linear Rec.709. front_m, back_m: along the axis in metres, the same for a sample without thickness.
    Pixels may have their samples in any order, and samples with thickness may overlap.
    """

    height_px: int
    width_px: int
    starts: Int64[np.ndarray, " pixels_and_end"]
    rgb: Float32[np.ndarray, "samples 3"]
    alpha: Float32[np.ndarray, " samples"]
    front_m: Float64[np.ndarray, " samples"]
    back_m: Float64[np.ndarray, " samples"]

    @cached_property
    def counts(self) -> Int64[np.ndarray, " pixels"]:
        """Return samples per pixel."""
        return np.diff(self.starts)

    @classmethod
    def read(cls, path: Path | str) -> "DeepSamples":
        """Read the only deep part. Raises InputError without R, G, B, A and Z in it."""
        import OpenEXR

        if not Path(path).is_file():
            raise InputError(f"expected a deep EXR file at {path}, but there is none")
        try:
            with OpenEXR.File(str(path), separate_channels=True) as file:
                return _from_part(Path(path), _deep_part(Path(path), file.parts))
        except (RuntimeError, OSError) as error:
            raise InputError(f"{path} cannot be read as EXR: {error}") from None


def is_deep(path: Path | str) -> bool:
    """Return whether a file has a deep part and no flat one. Raises InputError if it is no EXR file."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            return all(_is_deep_part(part) for part in file.parts)
    except (RuntimeError, OSError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None


def merged(pictures: Sequence[DeepSamples]) -> DeepSamples:
    """Merge the samples of several deep pictures of one size: things that were rendered apart hide one another."""
    sizes = {(each.width_px, each.height_px) for each in pictures}
    if len(sizes) != 1:
        raise InputError(f"deep pictures to be merged must be of one size, got {sorted(sizes)}")
    counts = np.stack([each.counts for each in pictures], axis=1)
    starts = _starts(counts.sum(axis=1))
    order = np.argsort(np.concatenate([np.repeat(np.arange(each.counts.size), each.counts) for each in pictures]), kind="stable")
    joined = [np.concatenate([getattr(each, name) for each in pictures])[order] for name in ("rgb", "alpha", "front_m", "back_m")]
    return DeepSamples(pictures[0].height_px, pictures[0].width_px, starts, *joined)


def _is_deep_part(part: Any) -> bool:
    import OpenEXR

    return part.type() in (OpenEXR.deepscanline, OpenEXR.deeptile)


def _deep_part(path: Path, parts: Sequence[Any]) -> Any:
    deep = [part for part in parts if _is_deep_part(part)]
    if len(deep) != 1:
        told = ", ".join(str(part.header.get("name", "")) for part in deep) or "flat parts only"
        raise InputError(f"{path}: expected one deep part, but it has {told}")
    return deep[0]


def _from_part(path: Path, part: Any) -> DeepSamples:
    missing = [name for name in (*_COLOURS, "A", "Z") if name not in part.channels]
    if missing:
        raise InputError(f"{path}: expected deep R, G, B, A and Z, but {', '.join(missing)} are missing; it has {', '.join(part.channels)}")
    size, rows, columns = _windows(part.header)
    values, counts = {}, np.zeros(size, np.int64)
    for name in (*_COLOURS, "A", "Z", "ZBack"):
        if name in part.channels:
            pixels = part.channels[name].pixels[rows[1], columns[1]]
            values[name] = _listed(pixels)
    counts[rows[0], columns[0]] = np.frompyfunc(lambda each: 0 if each is None else len(each), 1, 1)(pixels).astype(np.int64)
    rgb = np.stack([values[name] for name in _COLOURS], axis=1).astype(np.float32)
    front_m = values["Z"].astype(np.float64)
    back_m = np.maximum(values["ZBack"].astype(np.float64), front_m) if "ZBack" in values else front_m
    alpha = values["A"].astype(np.float32)
    _check(path, np.isfinite(rgb).all(axis=1) & np.isfinite(alpha) & (front_m > 0) & ~np.isnan(back_m))
    return DeepSamples(
        height_px=size[0],
        width_px=size[1],
        starts=_starts(counts.ravel()),
        rgb=in_rec709(rgb, part.header.get(ATTRIBUTE), path),
        alpha=alpha,
        front_m=front_m,
        back_m=back_m,
    )


def _windows(header: Any) -> tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]:
    """Return the display window's size; for rows and columns, where the data window lies in it and which part of the data lies in it."""
    (left, top), (right, bottom) = (each.tolist() for each in header["dataWindow"])
    (x, y), (x_end, y_end) = (each.tolist() for each in header["displayWindow"])
    first = (max(top, y), max(left, x))
    last = (max(min(bottom, y_end) + 1, first[0]), max(min(right, x_end) + 1, first[1]))
    placed = [slice(first[i] - (y, x)[i], last[i] - (y, x)[i]) for i in range(2)]
    cut = [slice(first[i] - (top, left)[i], last[i] - (top, left)[i]) for i in range(2)]
    return (y_end - y + 1, x_end - x + 1), (placed[0], cut[0]), (placed[1], cut[1])


def _listed(pixels: np.ndarray) -> np.ndarray:
    """Return the samples of all pixels in a row; a pixel without any is None."""
    return np.concatenate([each for each in pixels.ravel() if each is not None] or [np.zeros(0, np.float32)])


def _starts(counts: Int64[np.ndarray, " pixels"]) -> Int64[np.ndarray, " pixels_and_end"]:
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])


def _check(path: Path, is_good: Bool[np.ndarray, " samples"]) -> None:
    if not is_good.all():
        raise InputError(f"{path}: {int((~is_good).sum())} deep samples have NaN, infinite colour or a depth not above 0: render it again")


SURFACES = 4
"""Layers at most; the last one takes all that is left."""
APART = 0.02
"""Samples belong to one surface as long as their depth exceeds that of its first by no more than this part of it."""


class DeepSurfaces:
    """Reader of a deep EXR as layers of what is first, second and so on at each pixel."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Return layers, front first, without empty ones, or an empty one if none holds anything."""
        layers = peeled(DeepSamples.read(path), SURFACES, APART)
        return [layer for layer in layers if (layer.alpha != 0).any() or (layer.rgb != 0).any()] or [clear(*layers[0].alpha.shape)]


def peeled(samples: DeepSamples, surfaces: int, apart: float) -> list[Layer]:
    """Return one layer for the first, second, ... surface of every pixel, front first, also if it is empty; see SURFACES and APART."""
    from mrbokeh.stacks.exr_layers._exr_numba import flatten_layers

    size = (samples.height_px, samples.width_px)
    out, dioptres = np.zeros((surfaces, size[0] * size[1], 4)), np.zeros((surfaces, size[0] * size[1]))
    rgba = np.column_stack([samples.rgb, samples.alpha]).astype(np.float64)
    marks = np.empty(2 * int(samples.counts.max(initial=0)))
    flatten_layers(samples.starts, rgba, samples.front_m, samples.back_m, apart, marks, out, dioptres)
    return [_layer(rgba_of, dioptres_of, size) for rgba_of, dioptres_of in zip(out, dioptres, strict=True)]


def _layer(rgba: Float64[np.ndarray, "pixels 4"], dioptres: Float64[np.ndarray, " pixels"], size: Sequence[int]) -> Layer:
    depth_m = np.divide(1.0, dioptres, out=np.full_like(dioptres, np.inf), where=dioptres > 0)
    picture = rgba.astype(np.float32).reshape(*size, 4)
    return Layer(np.ascontiguousarray(picture[..., :3]), np.ascontiguousarray(picture[..., 3]), depth_m.astype(np.float32).reshape(*size))


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
