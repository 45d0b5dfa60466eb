"""What is compared: networks, Gaussians of the right size, the sharp picture, and the renderers of this project with the slice's lens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import opaque
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import BY_NAME, WITH_BANKS, make_renderer
from mrbokeh.renderers.choose_bank import chosen_renderer
from mrbokeh.system.errors import InputError
from training.blur_functions import Blur, blur_of
from training.classical_blur import gaussian_gather, gaussian_scatter, sigma_per_coc
from training.evaluation.unseen_slice import UnseenSlice
from training.stacks import Seen

NETWORK, NO_BLUR, SCATTERED, GATHERED, REFERENCE = "network", "no blur", "Gaussian, scattered", "Gaussian, gathered", "scatter reference"
NEAREST = "nearest slice"
RENDERERS = ("polygon", "low-rank", "laplacian", "scatter")
"""Renderers that a table has unless it is told otherwise; `lrdm` takes minutes a picture."""

Image = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Method:
    """One way from an all-in-focus picture to a blurred one."""

    name: str
    blur: Callable[[UnseenSlice], Image]
    kind: Literal["network", "plain", "Gaussian", "renderer"]


def network_method(name: str, blur: Blur) -> Method:
    return Method(name, lambda seen: blur(seen.pair), "network")


def network_methods(networks: Sequence[Path], device: str = "cpu") -> tuple[list[Method], list[Seen]]:
    """(methods, what each was trained on) of run folders and .onnx files."""
    found = [blur_of(path, device) for path in networks]
    methods = [network_method(name, blur) for name, (blur, _) in zip(network_names(networks), found, strict=True)]
    return methods, [seen for _, seen in found]


def network_names(networks: Sequence[Path]) -> list[str]:
    """One network is "network"; more have the names of their files, with their folders where these are alike."""
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
    """Return, for slices held out of one stack, the photograph of the nearest focus that was trained on, as it is."""

    def nearest(seen: UnseenSlice) -> Image:
        assert seen.nearest is not None, "only slices held out of a stack have a nearest one"
        return seen.nearest

    return Method(NEAREST, nearest, "plain")


def renderer_methods(names: Sequence[str]) -> list[Method]:
    """The renderers of those names, with the lens of the slice and its depth; raises InputError for other names."""
    unknown = [name for name in names if name not in BY_NAME]
    if unknown:
        raise InputError(f"expected renderers among {', '.join(BY_NAME)}, got {', '.join(unknown)}: networks go before --data")
    return [renderer_method(name) for name in names]


def renderer_method(name: str) -> Method:
    return _renderer_method(REFERENCE if name == "scatter" else name, make_renderer(name))


def bank_methods(names: Sequence[str], bank: Path) -> list[Method]:
    """Return those of the renderers that can take a bank of kernels, with it; "polygon, measured" and so on."""
    return [_renderer_method(f"{name}, measured", chosen_renderer(name, bank)) for name in names if name in WITH_BANKS]


def _renderer_method(title: str, renderer: Renderer) -> Method:
    def blur(seen: UnseenSlice) -> Image:
        return renderer.render([opaque(seen.pair.all_in_focus, seen.depth_m)], seen.lens).rgb

    return Method(title, blur, "renderer")


def _gaussian(seen: UnseenSlice) -> tuple[Image, Float32[np.ndarray, "height width"], float]:
    return seen.pair.all_in_focus, seen.pair.coc_px, sigma_per_coc(seen.lens.aperture)
