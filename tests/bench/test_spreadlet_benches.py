"""The benches that repeat the analysis and the tables of Leimkuehler et al. 2018: their parts against known answers, and tiny runs."""

from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.signal import fftconvolve
from typer.testing import CliRunner

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.renderers.kernels.laplacian_tables import Points, joined_points, taps_of
from mrbokeh.renderers.kernels.spreadlets import whole_laplacian
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from tests.bench import bench_spreadlet_scenes
from tests.bench.bench_spreadlet_kernels import analyse
from tests.bench.bench_spreadlet_scenes import Row, make_tables
from tests.bench.blur_methods import BlurMethods, GlobalLayer, composited, gathered, gathered_reference, global_layer
from tests.bench.kernel_codes import Corpus, alike, around, is_line, likeness_of, picture_of, quad_tree, quad_tree_points

DIAMETERS_PX = (3.0, 9.0, 30.0)
KERNELS = [Aperture.disc().rasterize(size).kernel for size in DIAMETERS_PX]
MARGIN_PX = 16
SIZE = (20, 36)
LENS = Lens(50.0, 1.4, 1.0, 36.0)


def taps() -> Points:
    return joined_points([taps_of(kernel) for kernel in KERNELS])


def picture(margin_px: int = MARGIN_PX, channels: int = 4) -> np.ndarray:
    size = (SIZE[0] + 2 * margin_px, SIZE[1] + 2 * margin_px, channels)
    return np.random.default_rng(0).uniform(0.0, 1.0, size).astype(np.float32)


def disc_bank() -> PsfBank:
    """Discs in steps of 4 px of diameter, each cell with the disc of its middle."""
    kernels = tuple(Aperture.disc().rasterize(size).kernel[..., None].astype(np.float32) for size in np.arange(2.0, 40.0, 4.0))
    return PsfBank("discs", (Axis("diameter_px", 0.0, 40.0),), (10,), kernels, nested=False)


def flat_layer(coc_px: float) -> Layer:
    depth_m = 1.0 / (1.0 / LENS.focus_distance_m - coc_px / LENS.coc_px_per_dioptre(SIZE[1]))
    return opaque(picture(0, 3), np.full(SIZE, depth_m, np.float32))


def test_the_filter_agrees_with_its_plain_twin() -> None:
    cells = np.random.default_rng(1).integers(0, len(KERNELS), SIZE).astype(np.int32)
    cells[:, 10:30] = 2  # runs of one kernel, too
    np.testing.assert_allclose(
        gathered(picture(), cells, taps(), MARGIN_PX), gathered_reference(picture(), cells, taps(), MARGIN_PX), atol=2e-6
    )


def test_the_filter_keeps_a_constant_whatever_the_kernels() -> None:
    """Each pixel takes a mean with weights that sum to 1."""
    cells = np.random.default_rng(1).integers(0, len(KERNELS), SIZE).astype(np.int32)
    found = gathered(np.full_like(picture(), 0.7), cells, taps(), MARGIN_PX)
    np.testing.assert_allclose(found, 0.7, rtol=1e-5)


@pytest.mark.parametrize("cell", range(len(KERNELS)))
def test_with_one_kernel_the_filter_is_a_convolution(cell: int) -> None:
    found = gathered(picture(), np.full(SIZE, cell, np.int32), taps(), MARGIN_PX)
    whole = fftconvolve(picture().astype(np.float64), KERNELS[cell][..., None], mode="same", axes=(0, 1))
    np.testing.assert_allclose(found, whole[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX], atol=2e-6)


def test_a_margin_that_is_too_narrow_is_refused() -> None:
    with pytest.raises(InputError, match="margin"):
        gathered(picture(4), np.full(SIZE, 2, np.int32), taps(), 4)


@pytest.mark.parametrize("coc_px", [6.0, -30.0])
def test_on_a_plane_of_one_blur_all_three_methods_agree(coc_px: float) -> None:
    """Splatting and gathering are one convolution there; sparse points come near (the tests of spreadlets say how near)."""
    methods, margin_px = BlurMethods(disc_bank()), 24
    layer = global_layer(flat_layer(coc_px), LENS, margin_px)
    splat, by_filter, ours = (composited([layer], run, margin_px) for run in (methods.splat, methods.filter, methods.ours))
    np.testing.assert_allclose(by_filter, splat, atol=1e-5)
    np.testing.assert_allclose(ours, splat, atol=0.02)


def test_only_the_filter_cuts_blur_off_at_what_is_sharp() -> None:
    """A bright half out of focus beside a dark one in focus: scattered light falls onto the dark half, gathered light does not."""
    methods, margin_px = BlurMethods(disc_bank()), 24
    base = global_layer(flat_layer(0.0), LENS, margin_px)
    bright = np.arange(base.coc_px.shape[1]) < base.coc_px.shape[1] // 2
    values = np.where(bright[None, :, None], 1.0, 0.0).astype(np.float32) * np.ones_like(base.values)
    values[..., 3] = 1.0
    coc_px = np.where(bright, 30.0, 0.0).astype(np.float32) * np.ones_like(base.coc_px)
    layer = GlobalLayer(values, coc_px, base.place, is_opaque=True)
    beside = SIZE[1] // 2 + 4
    # Kernels of the sharp half are those of 2 px, which reach no farther than the next pixel.
    assert composited([layer], methods.filter, margin_px)[10, beside, 0] == pytest.approx(0.0, abs=1e-6)
    assert composited([layer], methods.splat, margin_px)[10, beside, 0] > 0.1


def test_a_layer_in_front_hides_what_is_behind() -> None:
    """The front is in focus and opaque on the left half: there nothing of the layer behind is seen, on the right half nothing else."""
    methods, margin_px = BlurMethods(disc_bank()), 24
    front = flat_layer(0.0)
    alpha = np.zeros(SIZE, np.float32)
    alpha[:, :18] = 1.0
    front = Layer(0.25 * np.dstack([alpha] * 3), alpha, np.where(alpha > 0, front.depth_m, np.inf).astype(np.float32))
    behind = Layer(np.full((*SIZE, 3), 0.75, np.float32), np.ones(SIZE, np.float32), flat_layer(20.0).depth_m)
    layers = [global_layer(each, LENS, margin_px) for each in (front, behind)]
    found = composited(layers, methods.splat, margin_px)
    inside = np.s_[3:-3]  # layers with holes end at the frame
    np.testing.assert_allclose(found[inside, 3:16], 0.25, atol=1e-5)
    np.testing.assert_allclose(found[inside, 20:], 0.75, atol=1e-5)


@pytest.mark.parametrize("leaves", [1, 10, 100])
def test_a_quad_tree_keeps_the_light(leaves: int) -> None:
    tree = quad_tree(KERNELS[2], leaves)
    assert leaves <= len(tree.values) <= leaves + 2
    assert tree.picture().sum() == pytest.approx(1.0, rel=1e-9)


def test_a_square_of_light_is_one_leaf() -> None:
    """8 x 8 pixels that are a quarter of a tree of 16: known without error by one value."""
    kernel = np.zeros((15, 15))
    kernel[7:, 7:] = 1.0 / 64.0
    tree = quad_tree(kernel, 4)
    assert len(tree.values) == 1 and tree.leaves.tolist() == [[8, 8, 8]]
    np.testing.assert_allclose(picture_of(tree, 15), kernel, atol=1e-12)


def test_a_quad_tree_of_all_pixels_is_the_kernel() -> None:
    kernel = KERNELS[1]
    tree = quad_tree(kernel, int(np.count_nonzero(kernel)))
    np.testing.assert_allclose(picture_of(tree, len(kernel)), kernel, atol=1e-12)


def test_points_of_a_quad_tree_keep_charge_and_fitted_ones_the_light() -> None:
    sums, fitted = (quad_tree_points(KERNELS[2], 60, fit=fit) for fit in (False, True))
    assert abs(sums.values.sum()) < 1e-12 * np.abs(sums.values).sum() + 1e-15
    x, y = fitted.points.T.astype(np.float64)
    # Green's second identity: the sum of v (x^2 + y^2) / 4 is the light.
    assert (fitted.values[:, 0] * (x * x + y * y)).sum() / 4.0 == pytest.approx(1.0, rel=1e-6)


def test_likeness_is_perfect_for_the_whole_laplacian() -> None:
    kernel = KERNELS[2]
    found = picture_of(whole_laplacian(kernel), 101)
    np.testing.assert_allclose(found, around(kernel, 101), atol=1e-10)
    assert alike(found, around(kernel, 101), len(kernel)) == pytest.approx((1.0, 1.0, 0.0), abs=1e-6)
    assert likeness_of(whole_laplacian(kernel), kernel, 101).sparsity < 0.5


def test_the_corpus_has_no_lines_and_sums_to_one() -> None:
    kernels = Corpus(24.0, 10).kernels()
    assert len(kernels) == 10
    for kernel in kernels:
        assert not is_line(kernel) and kernel.sum() == pytest.approx(1.0)


def test_tables_are_made_and_gone_on_with(tmp_path: Path) -> None:
    rows = [Row("gear", "simple"), Row("gear", "combined", "samples")]
    settings = {"width_px": 96, "height_px": 64, "reference_spp": 16, "repeats": 1}
    assert make_tables(tmp_path, rows[:1], **settings) == 1
    first = (tmp_path / "rows" / "gear_simple.json").stat().st_mtime_ns
    assert make_tables(tmp_path, rows, **settings) == 1
    assert (tmp_path / "rows" / "gear_simple.json").stat().st_mtime_ns == first
    text = (tmp_path / "tables.md").read_text()
    assert text.count("| gear |") == 2
    with pytest.raises(InputError, match="other settings"):
        make_tables(tmp_path, rows, **{**settings, "reference_spp": 8})


def test_unknown_rows_are_refused_in_one_sentence(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(bench_spreadlet_scenes.main)
    result = CliRunner().invoke(app, [str(tmp_path), "--rows", "moon_combined"])
    assert result.exit_code == 2 and "moon_combined" in result.output and not list(tmp_path.iterdir())


def test_the_analysis_is_made_and_gone_on_with(tmp_path: Path) -> None:
    assert analyse(tmp_path, ["codes", "ablation"], 24.0, 3, 0) == 2
    assert analyse(tmp_path, ["codes", "ablation"], 24.0, 3, 0) == 0
    assert read_json(tmp_path / "codes.json", "a part of the analysis")["found"]["0.5"]["spreadlets"]["mean"]["sparsity"] > 0.0
    with pytest.raises(InputError, match="parts out of"):
        analyse(tmp_path, ["moon"], 24.0, 3, 0)
