"""Renderers that spread by a bank of kernels: that they agree, keep its light, its places and its colours."""

import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.renderers.bank.apertures import fit_apertures
from mrbokeh.renderers.bank.lattice import ANGLES, BankLattice
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.system.errors import InputError
from tests.support.renderer_banks import (
    CAT_RING,
    FEW,
    HIGH_PX,
    HIGHS,
    LENS,
    SIZE,
    STEPS,
    bank_of,
    depth_m,
    discs_bank,
    lone_pixel,
    renderers,
    rings_bank,
    rings_polygons,
    slanted,
)

# Measured 49.9, 58.4 and 36.6 dB; laplacian takes the nearest of 3x3 places and of diameters, where others blend them.
AGREEMENT_DB = {"polygon": 47.0, "low-rank": 55.0, "laplacian": 34.0}


@cache
def of_rings() -> dict[str, Any]:
    """With the tables that they make of the bank, which takes longer than a picture."""
    return renderers(rings_bank(), rings_polygons())


@cache
def of_discs() -> dict[str, Any]:
    return renderers(discs_bank())


def test_all_methods_agree_with_the_plain_twin() -> None:
    scene = slanted(-12.0, 14.0)
    seen = {name: each.render(scene, LENS).rgb for name, each in of_rings().items()}
    found = {name: psnr(seen[name], seen["scatter"], 2.0) for name in AGREEMENT_DB}
    assert all(found[name] > least for name, least in AGREEMENT_DB.items()), found


def test_one_aperture_for_all_kernels_is_spread_at_once() -> None:
    """The same light as when every pixel's is divided between two fitted diameters that have copies of the same polygons."""
    shared = fit_apertures(BankLattice(discs_bank()))
    one = shared.apertures[0][-1][0][0]
    alike = tuple(tuple(((one,),) for _ in of_side) for of_side in shared.diameters_px)
    copies = tuple(tuple(((replace(one),),) for _ in of_side) for of_side in shared.diameters_px)
    scene, seen = slanted(-12.0, 14.0), []
    for apertures in (alike, copies):
        polygons = replace(shared, apertures=apertures)
        assert polygons.is_one(1, 0) == (apertures is alike)
        seen.append(renderers(discs_bank(), polygons)["polygon"].render(scene, LENS).rgb)
    assert psnr(seen[0], seen[1], 2.0) > 60.0  # highlights are told from the light that is spread at once


def test_the_plain_twin_is_the_sum_of_kernels_of_the_bank() -> None:
    """At a diameter and a place that the bank has, a pixel shows its kernel, by all methods that blend and by the one that does not."""
    rings = rings_bank()
    lattice = BankLattice(rings)
    node = len(lattice.diameters_px[-1]) - 2
    coc_px = -float(lattice.diameters_px[-1][node])
    values = np.zeros((33, 33, 4), np.float32)
    values[16, 16] = 1.0
    where = np.broadcast_to(np.array([2.0 / 3.0 * HIGHS[0], 0.0], np.float32), (33, 33, 2))
    place = Place(field_xy=np.ascontiguousarray(where))
    of_bank = ScatterReference(bank=rings)._of_bank
    assert of_bank is not None
    spread = of_bank.sum_bank_kernels(values, np.full((33, 33), coc_px, np.float32), place)
    kernel = rings.kernel_at(np.array([coc_px, 2.0 / 3.0 * HIGHS[0], 0.0]))[..., 0]
    border = (33 - len(kernel)) // 2
    np.testing.assert_allclose(spread[..., 1], np.pad(kernel, border), atol=2e-6)
    nearest = LaplacianSpreadlets(rings).sum_bank_kernels(values, np.full((33, 33), coc_px, np.float32), place)
    np.testing.assert_allclose(nearest[..., 1], np.pad(kernel, border), atol=2e-6)


@pytest.mark.parametrize("coc_px", [-11.3, 0.6, 5.2, 14.9])
@pytest.mark.parametrize("method", ["scatter", "polygon", "low-rank"])
def test_light_is_conserved_wherever_a_point_lies(method: str, coc_px: float) -> None:
    """Between places and between diameters of the bank; alpha sums to the one pixel that was opaque."""
    seen = of_rings()[method].render(lone_pixel(21, 37, coc_px), LENS)
    np.testing.assert_allclose(seen.rgb.sum(axis=(0, 1), dtype=np.float64), (4.0, 2.0, 1.0), rtol=2e-5)
    assert seen.alpha.sum(dtype=np.float64) == pytest.approx(1.0, rel=2e-5)


@pytest.mark.parametrize("method", ["scatter", "polygon", "low-rank"])
def test_what_the_lens_absorbs_darkens_and_leaves_no_hole(method: str) -> None:
    """Kernels of 0.7 make an even white opaque plane 0.7, opaque still."""
    bank = bank_of(Aperture.disc(), (1, 1), light=0.7)
    white = opaque(np.ones((*SIZE, 3), np.float32), depth_m(9.0))
    seen = renderers(bank)[method].render([white], LENS)
    np.testing.assert_allclose(seen.rgb, 0.7, rtol=1e-4)
    np.testing.assert_allclose(seen.alpha, 1.0, rtol=1e-5)


# Measured 55.4, 60.7, 55.5 and 41.6 dB. Scatter and low-rank blend the diameters of the bank, which softens rims; polygons are drawn at
# the pixel's own diameter.
DISC_DB = {"scatter": 52.0, "polygon": 57.0, "low-rank": 52.0, "laplacian": 39.0}


@pytest.mark.parametrize("method", DISC_DB)
def test_a_bank_of_discs_is_the_disc(method: str) -> None:
    scene = slanted(-12.0, 14.0)
    expected = ScatterReference(FEW).render(scene, LENS).rgb
    assert psnr(of_discs()[method].render(scene, LENS).rgb, expected, 2.0) > DISC_DB[method]


def test_colours_of_a_bank_take_their_own_kernels() -> None:
    """A bank whose red is a point and whose blue is a disc."""
    discs = discs_bank()
    kernels = []
    for kernel in discs.kernels:
        point = np.zeros_like(kernel[..., 0])
        point[len(kernel) // 2, len(kernel) // 2] = 1.0
        kernels.append(np.stack([point, kernel[..., 0], kernel[..., 0]], axis=2))
    coloured = replace(discs, kernels=tuple(kernels))
    scene = slanted(6.0, 12.0)
    seen = ScatterReference(FEW, bank=coloured).render(scene, LENS).rgb
    np.testing.assert_allclose(seen[..., 0], scene[0].rgb[..., 0], atol=1e-5)
    np.testing.assert_allclose(seen[..., 2], ScatterReference(FEW, bank=discs).render(scene, LENS).rgb[..., 2], atol=1e-5)
    low_rank = LowRankFilter(bank=coloured, layering=FEW).render(scene, LENS).rgb
    assert psnr(low_rank, seen, 2.0) > 50.0


@pytest.fixture(scope="module", name="symmetric")
def fixture_symmetric() -> PsfBank:
    """A ring clipped as a cat's eye, by eccentricity, turned with the field."""
    axes = (Axis("diameter_px", -HIGH_PX, HIGH_PX, 1.5), Axis("eccentricity", 0.0, 1.0))
    counts = (STEPS, 3)
    kernels = []
    for diameter_px, eccentricity in physical_boxes(axes, NestedGrid(counts, nested=False)).mean(axis=2):
        seen = CAT_RING.seen(1 if diameter_px > 0 else -1, (float(eccentricity), 0.0))
        kernels.append(seen.rasterize(float(diameter_px)).kernel[..., None].astype(np.float32))
    return PsfBank("measured", axes, counts, tuple(kernels), "field", nested=False)


def test_a_symmetric_bank_is_turned_with_the_field(symmetric: PsfBank) -> None:
    """Below the middle the kernel is the one to its right, turned by a quarter; polygons and low-rank terms turn with it."""
    lattice = BankLattice(symmetric)
    assert lattice.anchors == 3 * ANGLES
    down = np.zeros((33, 33, 2), np.float32)
    down[..., 1] = 0.5  # the middle ring of three
    coc_px = np.full((33, 33), float(lattice.diameters_px[1][-2]), np.float32)
    values = np.zeros((33, 33, 4), np.float32)
    values[16, 16] = 1.0
    expected = np.rot90(symmetric.kernel_at(np.array([coc_px[0, 0], 0.5]))[..., 0], -1)
    for name, least in (("scatter", 90.0), ("polygon", 34.0), ("low-rank", 38.0)):
        of_bank = renderers(symmetric)[name]._of_bank
        seen = of_bank.sum_bank_kernels(values, coc_px, Place(field_xy=down))[..., 1]
        assert psnr(seen / expected.max(), np.pad(expected, (33 - len(expected)) // 2) / expected.max()) > least, name


def test_a_bank_travels_without_its_tables_and_those_of_motion_and_depth_are_refused() -> None:
    """What it was made with travels, and nothing that rendering left in it; the copy makes the same picture to the bit."""
    bank, scene = discs_bank(), slanted(-12.0, 14.0)
    made: dict[str, Any] = {"layering": FEW, "threads": 1, "integration": "pyramid", "sparsification": None, "dense_up_to_px": 8.0}
    ScatterReference(FEW, bank=bank).render(scene, LENS)  # the bank itself remembers a few numbers, which travel with it
    renderer = LaplacianSpreadlets(bank, **made)
    sent = pickle.dumps(renderer)
    picture = renderer.render(scene, LENS)
    assert pickle.dumps(renderer) == sent
    copy = pickle.loads(sent)
    assert type(copy) is LaplacianSpreadlets and {name: getattr(copy, name) for name in made} == made
    np.testing.assert_array_equal(copy.render(scene, LENS).rgb, picture.rgb)
    axes = (Axis("diameter_px", 0.0, 10.0), Axis("motion_px", 0.0, 4.0))
    moving = PsfBank("combined", axes, (1, 1), (np.ones((1, 1, 1), np.float32),), "motion")
    with pytest.raises(InputError, match="laplacian takes every bank"):
        ScatterReference(bank=moving).render(slanted(0.0, 4.0), LENS)
    with pytest.raises(InputError, match="at least 8 px"):
        fit_apertures(BankLattice(PsfBank("small", axes[:1], (2,), (np.ones((1, 1, 1), np.float32),) * 2)))
