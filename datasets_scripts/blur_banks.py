"""Banks of the five PSF models of Leimkuehler et al. 2018, Table 1, in the range of blur of the sampler's scenes.

In the sampler's scenes circles of confusion reach 0.105 and motion 0.135 widths of the frame, depths 1.2 to 6.6 m.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import HEAD, missing_cells, read_bank, read_head
from mrbokeh.psf_models.base import PsfModel
from mrbokeh.psf_models.build import bank_head, build_bank
from mrbokeh.psf_models.combined import Combined
from mrbokeh.psf_models.lens_prescription_file import biconvex_lens
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.simple_lens import SimpleLens
from mrbokeh.psf_models.stylized import Stylized
from mrbokeh.psf_models.volume import Volume
from mrbokeh.renderers.kernels.spreadlets import Sparsification

COC_SHARE, MOTION_SHARE = 0.125, 0.14
NEAREST_M, FARTHEST_M = 1.2, 6.6
BICONVEX_F_NUMBER = 4.0
_WINDOW_SHARE = 0.25
_DUST = 1e-6
_RAYS = {"physical": 1 << 18, "volume": 1 << 19}
_FINER, _SEED = 4, 0

SPARSIFICATIONS: Mapping[str, Sparsification] = {
    # Points are counted by the length of a kernel's outline. A caustic within a wide halo has a short one, and the light that a medium
    # does not scatter, all in one pixel, a shorter one yet: fewer points than the thirty that hold all moments.
    "physical": Sparsification(points_per_px=4.0, lloyd_steps=0, annealing_steps=0),
    "volume": Sparsification(points_per_px=60.0, lloyd_steps=0, annealing_steps=0),
}


def _simple(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return SimpleLens(diameter_px=COC_SHARE * width_px, counts=(100 * finer,))


def _combined(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return Combined(COC_SHARE * width_px, MOTION_SHARE * width_px, cells=400 * finer)


def _physical(lens: Lens, width_px: int, finer: int) -> PsfModel:
    return PhysicalLens(
        biconvex_lens(lens.focal_length_mm, BICONVEX_F_NUMBER),
        focus_distance_m=lens.focus_distance_m,
        sensor_mm=(lens.sensor_width_mm, 0.625 * lens.sensor_width_mm),
        image_width_px=width_px,
        nearest_m=NEAREST_M,
        farthest_m=FARTHEST_M,
        counts=(60 * round(finer**0.5), 60 * round(finer**0.5)),
    )


def _volume(lens: Lens, width_px: int, finer: int) -> PsfModel:
    size_px = 2 * round(0.5 * _WINDOW_SHARE * width_px) + 1
    return Volume(focal_px=lens.focal_px(width_px), farthest_m=FARTHEST_M, size_px=size_px, counts=(60 * finer,))


def _stylized(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return Stylized(star(), diameter_px=COC_SHARE * width_px, counts=(60 * finer,))


MODELS: Mapping[str, Callable[[Lens, int, int], PsfModel]] = {
    "simple": _simple,
    "combined": _combined,
    "physical": _physical,
    "volume": _volume,
    "stylized": _stylized,
}


def bank_of(model: str, folder: Path, lens: Lens, width_px: int, *, finer: bool = False) -> PsfBank:
    """A bank, built in FOLDER unless it is there. finer: with four times the steps of the grid in all, to stand for exact kernels.

    Raises InputError where the folder holds another bank.
    """
    made, rays = MODELS[model](lens, width_px, _FINER if finer else 1), _RAYS.get(model, 0)
    head = bank_head(made, rays, _SEED)
    is_there = (folder / HEAD).is_file() and read_head(folder) == head and not missing_cells(folder, head)
    return without_dust(read_bank(folder) if is_there else build_bank(made, folder, rays, _SEED))


def without_dust(bank: PsfBank) -> PsfBank:
    """Kernels without what is less than a millionth of their peak: rounding errors, but each would cost a splat."""
    cleaned = []
    for kernel in bank.kernels:
        kept = np.where(kernel.max(axis=2, keepdims=True) > _DUST * kernel.max(), kernel, 0.0).astype(np.float64)
        cleaned.append((kept * (kernel.sum(axis=(0, 1), dtype=np.float64) / kept.sum(axis=(0, 1)))).astype(np.float32))
    return replace(bank, kernels=tuple(cleaned))


def star(size_px: int = 128) -> Float32[np.ndarray, "size size 3"]:
    """The picture of the stylised PSF: a five-pointed star in a ring."""
    place: Float64[np.ndarray, "2 size size"] = (np.indices((size_px, size_px)) + 0.5) / size_px * 2.0 - 1.0
    radius, angle = np.hypot(*place), np.arctan2(place[1], -place[0])
    fifth = np.abs((angle * 5.0 / (2.0 * np.pi)) % 1.0 - 0.5) * 2.0  # 1 at the points, 0 between them
    inside = radius < 0.3 / (1.0 - 0.62 * fifth)
    ring = (radius > 0.88) & (radius < 0.98)
    return np.repeat((inside | ring)[..., None], 3, axis=2).astype(np.float32)
