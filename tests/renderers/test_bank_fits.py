"""Polygons and low-rank terms fitted to the kernels of a bank: how near they come, what they state, where they are kept."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from typer.testing import CliRunner

from mrbokeh.cli import app
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens_file import stated_facts
from mrbokeh.optics.psf_bank_file import write_bank
from mrbokeh.renderers.bank.apertures import _fit, fit_apertures, fit_polygons
from mrbokeh.renderers.bank.kernel_files import LOW_RANK, POLYGONS, apertures_beside, terms_beside
from mrbokeh.renderers.bank.lattice import SIDES, BankLattice
from mrbokeh.renderers.bank.renderers import decompose_bank
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter
from mrbokeh.system.errors import InputError
from tests.support.renderer_banks import BRIGHT_RIM, CAT_RING, HIGHS, LENS, bank_of, discs_bank, rings_bank, rings_polygons, slanted

# Contours stray from an outline by what a pixel smooths: a share of its area that falls as its diameter grows; a soft kernel also
# lacks what four levels cannot tell. Bounds at 12 and 30 px; measured 0.020 and 0.014 for the disc, 0.089 and 0.093 for the bright rim.
SHAPES = {
    "disc": (Aperture.disc(), 0.025, 0.02), "heptagon": (Aperture.blades(7), 0.035, 0.025),
    "ring": (Aperture.ring(0.5), 0.05, 0.03), "heart": (Aperture.heart(), 0.055, 0.035), "bright rim": (BRIGHT_RIM, 0.10, 0.11),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_polygons_come_near_to_a_known_kernel(shape: str) -> None:
    """The error stated is that of the kernel drawn; weights give all its light; the centroid of light stays."""
    aperture, at_12, at_30 = SHAPES[shape]
    for diameter_px, bound in ((12.0, at_12), (30.0, at_30)):
        kernel = aperture.rasterize(diameter_px).kernel
        fit = fit_polygons(kernel, diameter_px)
        drawn = np.pad(fit.aperture.rasterize(diameter_px).kernel, 3)
        wanted = np.pad(kernel, (len(drawn) - len(kernel)) // 2)
        assert fit.relative_error == pytest.approx(np.linalg.norm(drawn - wanted) / np.linalg.norm(kernel), rel=1e-9)
        assert fit.relative_error < bound
        away = np.arange(len(drawn)) - len(drawn) // 2
        for axis in (0, 1):
            assert drawn.sum(axis=axis) @ away == pytest.approx(wanted.sum(axis=axis) @ away, abs=0.05)


def test_more_levels_tell_more_of_a_soft_kernel_and_islands_of_noise_are_left_out() -> None:
    kernel = BRIGHT_RIM.rasterize(30.0).kernel
    errors = [fit_polygons(kernel, 30.0, levels).relative_error for levels in (1, 4, 8)]
    assert errors[0] > errors[1] > errors[2]
    # A disc whose brightness varies smoothly by 10 %, as that of a noisy measurement: fewer outlines, at most a third more error.
    kernel = Aperture.disc().rasterize(30.0).kernel
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(kernel.shape), 1.5)
    noisy = kernel * (1.0 + 0.1 * noise / noise.std())
    every = _fit(noisy / noisy.sum(), 30.0, 4, 0.5)
    assert every is not None
    fit = fit_polygons(noisy, 30.0)
    assert len(fit.aperture.outlines) <= 0.6 * len(every.aperture.outlines)  # measured 6 and 11
    assert every.relative_error < fit.relative_error < 4.0 / 3.0 * every.relative_error


def test_kernels_that_are_alike_share_an_aperture_and_points_have_none() -> None:
    """Those of a disc on both sides of the focus do; those of a ring that is clipped towards the corners do not."""
    found = fit_apertures(BankLattice(discs_bank()))
    assert all(behind[0][0] is in_front[0][0] for behind, in_front in zip(*found.apertures, strict=True))
    assert not rings_polygons().is_one(1, 0)
    with pytest.raises(InputError, match="more than 2 px"):
        fit_polygons(np.ones((1, 1)), 1.0)


def test_stated_errors_hold_for_every_kernel_and_low_rank_terms_say_what_they_miss() -> None:
    """Kernels that were not fitted are within twice the worst that was, from 8 px on."""
    rings = rings_bank()
    polygons = rings_polygons()
    lattice = BankLattice(rings)
    fitted = max(float(each.max()) for each in polygons.fit_errors)
    assert fitted < 0.08
    for side in SIDES:
        large = lattice.diameters_px[side] >= 8.0
        assert polygons.relative_errors(lattice, side)[large].max() < 2.0 * fitted
    lattice = BankLattice(bank_of(CAT_RING, (1, 1)))
    for (side, node, place, channel), terms in decompose_bank(lattice, LowRankFilter(relative_error=0.1).decomposed).items():
        kernel = lattice.kernel(side, node, place)[..., channel]
        assert np.linalg.norm(terms.dense() - kernel) / np.linalg.norm(kernel) == pytest.approx(terms.relative_error, abs=1e-9)
        assert terms.relative_error < 0.105  # the weights' correction for light costs up to 5 %


def test_shares_of_places_sum_to_one_and_are_whole_at_a_place() -> None:
    rings = rings_bank()
    lattice = BankLattice(rings)
    anywhere = np.random.default_rng(1).uniform(-1.2, 1.2, (40, 50, 2))
    np.testing.assert_allclose(lattice.field_shares(anywhere)[1].sum(axis=-1), 1.0, atol=1e-6)
    middle, shares = lattice.field_shares(np.zeros((1, 1, 2)))
    assert shares[middle == 4].sum() == pytest.approx(1.0), "the fifth of 3x3 places is the middle one"


@pytest.mark.parametrize("side", SIDES)
def test_kernels_of_a_lattice_are_those_of_the_aperture_seen_from_behind(side: int) -> None:
    rings = rings_bank()
    lattice = BankLattice(rings)
    node, place = len(lattice.diameters_px[side]) - 1, 2
    seen = CAT_RING.seen(side, (2.0 / 3.0 * HIGHS[0], -2.0 / 3.0 * HIGHS[1]))
    expected = seen.rasterize(float(lattice.diameters_px[side][node])).kernel
    np.testing.assert_allclose(lattice.kernel(side, node, place)[..., 0], expected, atol=1e-7)


def test_fits_are_kept_beside_a_bank_until_its_kernels_change(tmp_path: Path) -> None:
    discs = discs_bank()
    lattice, filters = BankLattice(discs), LowRankFilter()
    made = apertures_beside(tmp_path, lattice), terms_beside(tmp_path, lattice, filters.decomposed, [0.1, 16])
    written = {name: (tmp_path / name).stat().st_mtime_ns for name in (POLYGONS, LOW_RANK)}
    read = apertures_beside(tmp_path, lattice), terms_beside(tmp_path, lattice, filters.decomposed, [0.1, 16])
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in written} == written
    assert read[0].diameters_px == made[0].diameters_px
    assert read[0].is_one(1, 0) == made[0].is_one(1, 0)
    for side in SIDES:
        np.testing.assert_array_equal(read[0].kernel(side, 12.0, 0, 0), made[0].kernel(side, 12.0, 0, 0))
    assert list(read[1]) == list(made[1])
    for key, kernel in made[1].items():
        np.testing.assert_array_equal(read[1][key].dense(), kernel.dense())
        assert read[1][key].relative_error == kernel.relative_error
    other = BankLattice(replace(discs, kernels=tuple(kernel * np.float32(0.9) for kernel in discs.kernels)))
    apertures_beside(tmp_path, other)
    assert (tmp_path / POLYGONS).stat().st_mtime_ns != written[POLYGONS]


@pytest.mark.slow
def test_the_command_takes_a_bank_for_every_method_that_spreads(tmp_path: Path) -> None:
    discs = discs_bank()
    write_bank(tmp_path / "bank", replace(discs, settings={"lens": stated_facts(LENS)}))
    layer = slanted(-9.0, 12.0)[0]
    write_exr(tmp_path / "aif.exr", ExrPart({name: layer.rgb[..., i] for i, name in enumerate("RGB")}))
    write_exr(tmp_path / "z.exr", ExrPart({"Z": layer.depth_m}))
    words = ["--rgb", tmp_path / "aif.exr", "--depth", tmp_path / "z.exr", "--lens", tmp_path / "bank"]
    seen = {}
    for method in ("scatter", "polygon", "low-rank", "laplacian"):
        out = tmp_path / f"{method}.exr"
        result = CliRunner().invoke(app, ["render", *map(str, words), "--renderer", method, "--slices", "4", "--out", str(out)])
        assert result.exit_code == 0, result.output
        seen[method] = read_image(out)
        assert psnr(seen[method], seen["scatter"], 2.0) > 35.0, method
    assert (tmp_path / "bank" / POLYGONS).is_file() and (tmp_path / "bank" / LOW_RANK).is_file()
