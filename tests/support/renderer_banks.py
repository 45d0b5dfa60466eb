"""Banks of exact kernels, scenes and the renderers that spread by them: what the tests of banks share."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import stated_facts
from mrbokeh.optics.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.psf_models.build import build_bank
from mrbokeh.psf_models.simple_lens import SimpleLens
from mrbokeh.renderers.bank.apertures import BankApertures, fit_apertures
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets

HEIGHT, WIDTH = SIZE = (64, 96)
HALF_DIAGONAL_PX = 0.5 * float(np.hypot(*SIZE))
LENS = Lens(focal_length_mm=50.0, f_number=0.7, focus_distance_m=0.5, sensor_width_mm=22.0)
HIGHS = (0.5 * WIDTH / HALF_DIAGONAL_PX, 0.5 * HEIGHT / HALF_DIAGONAL_PX)
HIGH_PX, STEPS = 16.0, 49
CAT_RING = replace(Aperture.ring(0.4), cat_eye=0.5)
BRIGHT_RIM = replace(Aperture.disc(), spherical_aberration=0.6).seen(1)
FEW = Layering(slices=4)


def bank_of(aperture: Aperture, fields: tuple[int, int] = (3, 3), light: float = 1.0) -> PsfBank:
    """Exact kernels of an aperture on a regular grid of signed diameters and places, as a measurement without noise has it."""
    axes = (Axis("diameter_px", -HIGH_PX, HIGH_PX, 1.5), Axis("field_x", -HIGHS[0], HIGHS[0]), Axis("field_y", -HIGHS[1], HIGHS[1]))
    counts = (STEPS, *fields)
    kernels = []
    for diameter_px, x, y in physical_boxes(axes, NestedGrid(counts, nested=False)).mean(axis=2):
        seen = aperture.seen(1 if diameter_px > 0 else -1, (float(x), float(y)))
        kernels.append((light * seen.rasterize(float(diameter_px)).kernel[..., None]).astype(np.float32))
    return PsfBank("measured", axes, counts, tuple(kernels), nested=False)


def depth_m(coc_px: np.ndarray | float) -> np.ndarray:
    dioptres = 1.0 / LENS.focus_distance_m - np.broadcast_to(coc_px, SIZE) / LENS.coc_px_per_dioptre(WIDTH)
    return (1.0 / dioptres).astype(np.float32)


def slanted(low_px: float, high_px: float) -> list[Layer]:
    """Noise up to 2 with a lamp of 50 on one surface, its diameters from low on the left to high on the right."""
    rgb = np.random.default_rng(3).uniform(0.0, 2.0, (*SIZE, 3)).astype(np.float32)
    rgb[20, 30] = 50.0
    return [opaque(rgb, depth_m(np.linspace(low_px, high_px, WIDTH)))]


def lone_pixel(row: int, column: int, coc_px: float) -> list[Layer]:
    rgb, alpha = np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32)
    rgb[row, column], alpha[row, column] = (4.0, 2.0, 1.0), 1.0
    return [Layer(rgb, alpha, depth_m(coc_px))]


def bank_folder(folder: Path, lens: Lens, largest_px: float = 24.0, counts: int = 64, *, says_lens: bool = True) -> Path:
    """Build a bank of a lens's opening, which says what it was made for; return the folder."""
    model = SimpleLens(lens.aperture, largest_px, (counts,), lens=stated_facts(lens) if says_lens else None)
    build_bank(model, folder, progress=False)
    return folder


@cache
def discs_bank() -> PsfBank:
    return bank_of(Aperture.disc(), (1, 1))


@cache
def rings_bank() -> PsfBank:
    return bank_of(CAT_RING)


@cache
def rings_polygons() -> BankApertures:
    return fit_apertures(BankLattice(rings_bank()))


def renderers(bank: PsfBank, polygons: BankApertures | None = None) -> dict[str, Any]:
    return {
        "scatter": ScatterReference(FEW, bank=bank),
        "polygon": PolygonDifferences(bank=bank, apertures=polygons, layering=FEW),
        "low-rank": LowRankFilter(bank=bank, layering=FEW),
        "laplacian": LaplacianSpreadlets(bank, FEW),
    }
