"""The methods compared: networks, Gaussians of the right size, the sharp picture, and this project's renderers with the slice's lens.

A network must beat a Gaussian of the right size, and light that is scattered without regard to occlusion. A trained network, as a run
or as ONNX, becomes a plain function of a pair.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import BY_NAME, WITH_BANKS, is_bank, lens_and_renderer, make_renderer, read_lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.system.errors import InputError
from training.data.batches import network_inputs
from training.data.dataset import Pair
from training.data.stacks import Seen
from training.evaluation.unseen_slice import UnseenSlice
from training.fitting.run_folder import load_run

SIGMA_STEP_PX = 0.25
Image = Float32[np.ndarray, "height width 3"]
Blur = Callable[[Pair], Image]
NETWORK, NO_BLUR, SCATTERED, GATHERED, REFERENCE = "network", "no blur", "Gaussian, scattered", "Gaussian, gathered", "scatter reference"
NEAREST, DISC = "nearest slice", "disc of the right size"
RENDERERS = ("polygon", "low-rank", "laplacian", "scatter")
"""Renderers that a table has unless it is told otherwise; `lrdm` takes minutes a picture."""


def _blurred(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return picture if sigma_px == 0.0 else gaussian_filter(picture, (sigma_px, sigma_px, 0.0), mode="nearest", truncate=4.0)


def blur_of(network: Path, device: str = "cpu") -> tuple[Blur, Seen]:
    """Return (the function, the training data) of a run folder or an .onnx file. device: of a run, cpu or cuda."""
    if network.suffix.lower() == ".onnx":
        exported = OnnxNetwork(network)

        def exported_blur(pair: Pair) -> Image:
            return exported.blur(pair.all_in_focus, pair.coc_px, pair.place, (pair.f_number, pair.focal_length_mm))

        return exported_blur, Seen(exported.facts.trained_on, exported.facts.held_out_slices)
    model, _, facts = load_run(network)
    model.to(device)

    @torch.no_grad()
    def blur(pair: Pair) -> Image:
        result = model(*(each.to(device) for each in network_inputs(pair)))
        return result[0].permute(1, 2, 0).contiguous().cpu().numpy()

    return blur, Seen(facts.trained_on, facts.held_out_slices)


@dataclass(frozen=True)
class Method:
    """A way from an all-in-focus picture to a blurred one."""

    name: str
    blur: Callable[[UnseenSlice], Image]
    kind: Literal["network", "plain", "Gaussian", "renderer"]


def network_method(name: str, blur: Blur) -> Method:
    return Method(name, lambda seen: blur(seen.pair), "network")


def network_methods(networks: Sequence[Path], device: str = "cpu") -> tuple[list[Method], list[Seen]]:
    """Return (methods, training data of each) of run folders and .onnx files."""
    found = [blur_of(path, device) for path in networks]
    methods = [network_method(name, blur) for name, (blur, _) in zip(network_names(networks), found, strict=True)]
    return methods, [seen for _, seen in found]


def network_names(networks: Sequence[Path]) -> list[str]:
    """Name networks: a single one "network", several by their files, with their folders if these are alike."""
    if len(networks) == 1:
        return [NETWORK]
    names = [each.stem if each.suffix.lower() == ".onnx" else each.resolve().name for each in networks]
    return names if len(set(names)) == len(names) else [str(each) for each in networks]


def plain_methods() -> list[Method]:
    return [
        Method(NO_BLUR, lambda seen: seen.pair.all_in_focus, "plain"),
        Method(SCATTERED, lambda seen: gaussian_scatter(*_gaussian(seen)), "Gaussian"),
        Method(GATHERED, lambda seen: gaussian_gather(*_gaussian(seen)), "Gaussian"),
    ]


def nearest_method() -> Method:
    """Return, for slices held out of one stack, the photograph of the nearest focus that was trained on, unchanged."""

    def nearest(seen: UnseenSlice) -> Image:
        assert seen.nearest is not None, "only slices held out of a stack have a nearest one"
        return seen.nearest

    return Method(NEAREST, nearest, "plain")


def renderer_methods(names: Sequence[str]) -> list[Method]:
    """Return the renderers of those names, with the lens of the slice and its depth; raises InputError for other names."""
    unknown = [name for name in names if name not in BY_NAME]
    if unknown:
        advice = "networks are named first, before the data" if any(name.endswith(".onnx") for name in unknown) else "give one of these"
        raise InputError(f"expected --renderer out of {', '.join(BY_NAME)}, got {', '.join(unknown)}: {advice}")
    return [renderer_method(name) for name in names]


def renderer_method(name: str) -> Method:
    return _renderer_method(REFERENCE if name == "scatter" else name, make_renderer(name))


def disc_method() -> Method:
    """Return the fast renderer with a plain disc of the right size, whatever the opening of the lens."""
    return _renderer_method(DISC, make_renderer("polygon"), Aperture.disc())


def lens_methods(names: Sequence[str], lens: Path | None) -> list[Method]:
    """Return the renderers with the opening of a lens file, or those that can take a bank of kernels, with it: "polygon, LENS"."""
    if lens is None:
        return []
    if lens.suffix.lower() == ".onnx":
        raise InputError(f"--lens {lens} is a network: name it first, among the networks to compare")
    known, opening = (WITH_BANKS, None) if is_bank(lens) else (tuple(BY_NAME), read_lens(lens).aperture)
    return [_renderer_method(f"{name}, {lens.stem}", lens_and_renderer(lens, name)[1], opening) for name in names if name in known]


def _renderer_method(title: str, renderer: Renderer, opening: Aperture | None = None) -> Method:
    def blur(seen: UnseenSlice) -> Image:
        lens = seen.lens if opening is None else replace(seen.lens, aperture=opening)
        return renderer.render([opaque(seen.pair.all_in_focus, seen.depth_m)], lens).rgb

    return Method(title, blur, "renderer")


def _gaussian(seen: UnseenSlice) -> tuple[Image, Float32[np.ndarray, "height width"], float]:
    return seen.pair.all_in_focus, seen.pair.coc_px, sigma_per_coc(seen.lens.aperture)


def sigma_per_coc(aperture: Aperture) -> float:
    """Return the standard deviation per axis of the aperture's blur over its circle of confusion: 1/4 for a disc, by its second moment.

    Measured on the aperture itself, so that a hexagon gets the somewhat narrower Gaussian that fits it.
    """
    diameter_px = 41.0
    kernel = aperture.rasterize(diameter_px).kernel
    offsets = np.arange(len(kernel)) - len(kernel) // 2
    squares = (kernel.sum(axis=0) + kernel.sum(axis=1)) @ offsets.astype(float) ** 2
    pixel_variance = 1.0 / 12.0
    return float(np.sqrt(squares / 2.0 - pixel_variance) / diameter_px)


def gaussian_scatter(
    rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"], sigma_over_coc: float = 0.25
) -> Float32[np.ndarray, "height width 3"]:
    """Spread the light of every pixel as a Gaussian of its own size, and divide by the weight that arrived."""
    light = np.dstack([rgb, np.ones(coc_px.shape, np.float32)])
    levels, shares = _levels(np.abs(coc_px) * sigma_over_coc)
    spread = np.zeros_like(light)
    for sigma, share in zip(levels, shares, strict=True):
        if share.any():
            spread += _blurred(light * share[..., None], sigma)
    return (spread[..., :3] / np.maximum(spread[..., 3:], 1e-6)).astype(np.float32)


def gaussian_gather(
    rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"], sigma_over_coc: float = 0.25
) -> Float32[np.ndarray, "height width 3"]:
    """Average the surroundings of every pixel under a Gaussian of its own size."""
    levels, shares = _levels(np.abs(coc_px) * sigma_over_coc)
    gathered = np.zeros_like(rgb)
    for sigma, share in zip(levels, shares, strict=True):
        if share.any():
            gathered += _blurred(rgb, sigma) * share[..., None]
    return gathered


def _levels(sigma_px: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return standard deviations in steps, and the share of each pixel in each (linear between two neighbours)."""
    position = sigma_px / SIGMA_STEP_PX
    count = int(np.ceil(position.max(initial=0.0))) + 1
    shares = [np.clip(1.0 - np.abs(position - level), 0.0, 1.0).astype(np.float32) for level in range(count)]
    return np.arange(count) * SIGMA_STEP_PX, shares
