"""Renderers that spread by a bank of kernels: polygons and low-rank terms fitted to it, its light, its places, its files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.aperture import Aperture
from mrbokeh.bank_apertures import BankApertures, fit_apertures
from mrbokeh.bank_fits_file import LOW_RANK, POLYGONS, apertures_beside, terms_beside
from mrbokeh.bank_lattice import ANGLES, SIDES, BankLattice
from mrbokeh.bank_low_rank import decompose_bank
from mrbokeh.cli import app
from mrbokeh.errors import InputError
from mrbokeh.exr_io import ExrPart, write_exr
from mrbokeh.image_io import read_image
from mrbokeh.image_metrics import psnr
from mrbokeh.layer import Layer, opaque
from mrbokeh.layering import Layering
from mrbokeh.lens import Lens
from mrbokeh.lens_file import write_lens
from mrbokeh.nested_grid import NestedGrid
from mrbokeh.polygon_fit import fit_polygons
from mrbokeh.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.psf_bank_file import write_bank
from mrbokeh.renderers._laplacian_bank import Place
from mrbokeh.renderers.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.renderers.low_rank_filter import LowRankFilter
from mrbokeh.renderers.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference

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


@pytest.fixture(scope="module", name="discs")
def fixture_discs() -> PsfBank:
    return bank_of(Aperture.disc(), (1, 1))


@pytest.fixture(scope="module", name="rings")
def fixture_rings() -> PsfBank:
    return bank_of(CAT_RING)


@pytest.fixture(scope="module", name="polygons")
def fixture_polygons(rings: PsfBank) -> BankApertures:
    return fit_apertures(BankLattice(rings))


# Contours stray from an outline by what a pixel smooths: a share of its area that falls as its diameter grows; a soft kernel also
# lacks what four levels cannot tell. Bounds at 12 and 30 px; measured 0.020 and 0.014 for the disc, 0.089 and 0.093 for the bright rim.
SHAPES = {
    "disc": (Aperture.disc(), 0.025, 0.02),
    "heptagon": (Aperture.blades(7), 0.035, 0.025),
    "ring": (Aperture.ring(0.5), 0.05, 0.03),
    "heart": (Aperture.heart(), 0.055, 0.035),
    "bright rim": (BRIGHT_RIM, 0.10, 0.11),
}


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


def test_more_levels_tell_more_of_a_soft_kernel() -> None:
    kernel = BRIGHT_RIM.rasterize(30.0).kernel
    errors = [fit_polygons(kernel, 30.0, levels).relative_error for levels in (1, 4, 8)]
    assert errors[0] > errors[1] > errors[2]


def test_a_kernel_that_is_a_point_has_no_polygons() -> None:
    with pytest.raises(InputError, match="more than 2 px"):
        fit_polygons(np.ones((1, 1)), 1.0)


def test_the_stated_errors_of_a_bank_hold_for_every_kernel(rings: PsfBank, polygons: BankApertures) -> None:
    """Kernels that were not fitted are within twice the worst that was, from 8 px on."""
    lattice = BankLattice(rings)
    fitted = max(float(each.max()) for each in polygons.fit_errors)
    assert fitted < 0.08
    for side in SIDES:
        large = lattice.diameters_px[side] >= 8.0
        assert polygons.relative_errors(lattice, side)[large].max() < 2.0 * fitted


def test_shares_of_places_sum_to_one_and_are_whole_at_a_place(rings: PsfBank) -> None:
    lattice = BankLattice(rings)
    anywhere = np.random.default_rng(1).uniform(-1.2, 1.2, (40, 50, 2))
    np.testing.assert_allclose(lattice.field_shares(anywhere)[1].sum(axis=-1), 1.0, atol=1e-6)
    middle, shares = lattice.field_shares(np.zeros((1, 1, 2)))
    assert shares[middle == 4].sum() == pytest.approx(1.0), "the fifth of 3x3 places is the middle one"


@pytest.mark.parametrize("side", SIDES)
def test_kernels_of_a_lattice_are_those_of_the_aperture_seen_from_behind(rings: PsfBank, side: int) -> None:
    lattice = BankLattice(rings)
    node, place = len(lattice.diameters_px[side]) - 1, 2
    seen = CAT_RING.seen(side, (2.0 / 3.0 * HIGHS[0], -2.0 / 3.0 * HIGHS[1]))
    expected = seen.rasterize(float(lattice.diameters_px[side][node])).kernel
    np.testing.assert_allclose(lattice.kernel(side, node, place)[..., 0], expected, atol=1e-7)


def renderers(bank: PsfBank, polygons: BankApertures | None = None) -> dict[str, Any]:
    return {
        "scatter": ScatterReference(FEW, bank=bank),
        "polygon": PolygonDifferences(bank=bank, apertures=polygons, layering=FEW),
        "low-rank": LowRankFilter(bank=bank, layering=FEW),
        "laplacian": LaplacianSpreadlets(bank, FEW),
    }


# Measured 49.9, 58.4 and 36.6 dB; laplacian takes the nearest of 3x3 places and of diameters, where others blend them.
AGREEMENT_DB = {"polygon": 47.0, "low-rank": 55.0, "laplacian": 34.0}


def test_all_methods_agree_with_the_plain_twin(rings: PsfBank, polygons: BankApertures) -> None:
    scene = slanted(-12.0, 14.0)
    seen = {name: each.render(scene, LENS).rgb for name, each in renderers(rings, polygons).items()}
    found = {name: psnr(seen[name], seen["scatter"], 2.0) for name in AGREEMENT_DB}
    assert all(found[name] > least for name, least in AGREEMENT_DB.items()), found


def test_the_plain_twin_is_the_sum_of_kernels_of_the_bank(rings: PsfBank) -> None:
    """At a diameter and a place that the bank has, a pixel shows its kernel, by all methods that blend and by the one that does not."""
    lattice = BankLattice(rings)
    node = len(lattice.diameters_px[-1]) - 2
    coc_px = -float(lattice.diameters_px[-1][node])
    values = np.zeros((33, 33, 4), np.float32)
    values[16, 16] = 1.0
    where = np.broadcast_to(np.array([2.0 / 3.0 * HIGHS[0], 0.0], np.float32), (33, 33, 2))
    place = Place(field_xy=np.ascontiguousarray(where))
    of_bank = ScatterReference(bank=rings)._of_bank
    assert of_bank is not None
    spread = of_bank.spread(values, np.full((33, 33), coc_px, np.float32), place)
    kernel = rings.kernel_at(np.array([coc_px, 2.0 / 3.0 * HIGHS[0], 0.0]))[..., 0]
    border = (33 - len(kernel)) // 2
    np.testing.assert_allclose(spread[..., 1], np.pad(kernel, border), atol=2e-6)
    nearest = LaplacianSpreadlets(rings).spread_bank(values, np.full((33, 33), coc_px, np.float32), place)
    np.testing.assert_allclose(nearest[..., 1], np.pad(kernel, border), atol=2e-6)


@pytest.mark.parametrize("coc_px", [-11.3, 0.6, 5.2, 14.9])
@pytest.mark.parametrize("method", ["scatter", "polygon", "low-rank"])
def test_light_is_conserved_wherever_a_point_lies(rings: PsfBank, polygons: BankApertures, method: str, coc_px: float) -> None:
    """Between places and between diameters of the bank; alpha sums to the one pixel that was opaque."""
    seen = renderers(rings, polygons)[method].render(lone_pixel(21, 37, coc_px), LENS)
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
def test_a_bank_of_discs_is_the_disc(discs: PsfBank, method: str) -> None:
    scene = slanted(-12.0, 14.0)
    expected = ScatterReference(FEW).render(scene, LENS).rgb
    assert psnr(renderers(discs)[method].render(scene, LENS).rgb, expected, 2.0) > DISC_DB[method]


def test_colours_of_a_bank_take_their_own_kernels(discs: PsfBank) -> None:
    """A bank whose red is a point and whose blue is a disc."""
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
        seen = of_bank.spread(values, coc_px, Place(field_xy=down))[..., 1]
        assert psnr(seen / expected.max(), np.pad(expected, (33 - len(expected)) // 2) / expected.max()) > least, name


def test_banks_of_motion_and_depth_are_refused_with_one_sentence() -> None:
    axes = (Axis("diameter_px", 0.0, 10.0), Axis("motion_px", 0.0, 4.0))
    moving = PsfBank("combined", axes, (1, 1), (np.ones((1, 1, 1), np.float32),), "motion")
    with pytest.raises(InputError, match="laplacian takes every bank"):
        ScatterReference(bank=moving).render(slanted(0.0, 4.0), LENS)
    with pytest.raises(InputError, match="at least 8 px"):
        fit_apertures(BankLattice(PsfBank("small", axes[:1], (2,), (np.ones((1, 1, 1), np.float32),) * 2)))


def test_fits_are_kept_beside_a_bank_until_its_kernels_change(tmp_path: Path, discs: PsfBank) -> None:
    lattice, filters = BankLattice(discs), LowRankFilter()
    made = apertures_beside(tmp_path, lattice), terms_beside(tmp_path, lattice, filters.decomposed, [0.1, 16])
    written = {name: (tmp_path / name).stat().st_mtime_ns for name in (POLYGONS, LOW_RANK)}
    read = apertures_beside(tmp_path, lattice), terms_beside(tmp_path, lattice, filters.decomposed, [0.1, 16])
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in written} == written
    assert read[0].diameters_px == made[0].diameters_px
    for side in SIDES:
        np.testing.assert_array_equal(read[0].kernel(side, 12.0, 0, 0), made[0].kernel(side, 12.0, 0, 0))
    assert list(read[1]) == list(made[1])
    for key, kernel in made[1].items():
        np.testing.assert_array_equal(read[1][key].dense(), kernel.dense())
        assert read[1][key].relative_error == kernel.relative_error
    other = BankLattice(replace(discs, kernels=tuple(kernel * np.float32(0.9) for kernel in discs.kernels)))
    apertures_beside(tmp_path, other)
    assert (tmp_path / POLYGONS).stat().st_mtime_ns != written[POLYGONS]


def test_low_rank_terms_state_what_they_miss() -> None:
    lattice = BankLattice(bank_of(CAT_RING, (1, 1)))
    for (side, node, place, channel), terms in decompose_bank(lattice, LowRankFilter(relative_error=0.1).decomposed).items():
        kernel = lattice.kernel(side, node, place)[..., channel]
        assert np.linalg.norm(terms.dense() - kernel) / np.linalg.norm(kernel) == pytest.approx(terms.relative_error, abs=1e-9)
        assert terms.relative_error < 0.105  # the weights' correction for light costs up to 5 %


def test_the_command_takes_a_bank_for_every_method_that_spreads(tmp_path: Path, discs: PsfBank) -> None:
    write_bank(tmp_path / "bank", discs)
    write_lens(tmp_path / "lens.json", LENS)
    layer = slanted(-9.0, 12.0)[0]
    write_exr(tmp_path / "aif.exr", ExrPart({name: layer.rgb[..., i] for i, name in enumerate("RGB")}))
    write_exr(tmp_path / "z.exr", ExrPart({"Z": layer.depth_m}))
    words = ["--rgb", tmp_path / "aif.exr", "--depth", tmp_path / "z.exr", "--lens", tmp_path / "lens.json", "--psf", tmp_path / "bank"]
    seen = {}
    for method in ("scatter", "polygon", "low-rank", "laplacian"):
        out = tmp_path / f"{method}.exr"
        result = CliRunner().invoke(app, ["render", *map(str, words), "--method", method, "--slices", "4", "--out", str(out)])
        assert result.exit_code == 0, result.output
        seen[method] = read_image(out)
        assert psnr(seen[method], seen["scatter"], 2.0) > 35.0, method
    assert (tmp_path / "bank" / POLYGONS).is_file() and (tmp_path / "bank" / LOW_RANK).is_file()
