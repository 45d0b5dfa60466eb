"""A lens fitted to stacks and lights whose aperture is known: the kernels come out as they went in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from scipy.ndimage import convolve
from typer.testing import CliRunner

from mrbokeh.commands.lens import export, show
from mrbokeh.commands.lens_fit import fit as fit_command
from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.lens_measuring.fitting._pupil_rows_numba import gather_rows
from mrbokeh.lens_measuring.fitting.blur_pairs import StackSlices
from mrbokeh.lens_measuring.fitting.evidence import Evidence, Knots, Sharing, simplest_of
from mrbokeh.lens_measuring.fitting.fit_results import bank_of, picture_at
from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings, LensFit, fit_lens, on_simplex
from mrbokeh.lens_measuring.fitting.point_lights import PointLight, find_lights
from mrbokeh.lens_measuring.fitting.pupil_picture import PupilGrid, kernel_of
from mrbokeh.lens_measuring.fitting.stack_equations import SliceView, drawn_pixels, equations_of, smoothed_coc, usable_pixels
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.optics.psf_bank_file import read_bank
from mrbokeh.renderers.scatter_reference import ScatterReference, scatter
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from tests.support.refusals import refused

SIZE = (132, 196)
FOCI_M = (0.5, 0.68, 1.3)  # the wall lies from 0.6 m to 0.9 m
LENS = Lens(50.0, 2.0, 0.68, 22.0 * 196 / 220)
NOISE, DEPTH_NOISE = 0.01, 0.003
ONE = FitSettings(diameters_px=(12.0,), regions=(1, 1), pixels=8_000)
HEPTAGON = Aperture.blades(7, 0.3)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A slanted wall of coarse and fine squares with six lights, and a card in front of it."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    coarse = np.kron(rng.random((height // 8 + 1, width // 8 + 1, 3)), np.ones((8, 8, 1)))[:height, :width]
    rgb = (0.05 + 0.5 * coarse + 0.15 * rng.random((height, width, 3))).astype(np.float32)
    rgb[rng.integers(16, height - 16, 6), rng.integers(16, width - 16, 6)] = 20.0
    dioptres = np.broadcast_to(np.linspace(1.0 / 0.6, 1.0 / 0.9, width), SIZE).copy()
    dioptres[:20, :30] = 1.0 / 0.55
    return rgb, (1.0 / dioptres).astype(np.float32)


def make_stack(folder: Path, aperture: Aperture, seed: int = 0) -> FocalStack:
    """Photographed by the scatter reference; picture, slices and depth with the noise of the brief (shares of their values)."""
    rng, (rgb, depth_m) = np.random.default_rng(100 + seed), scene(seed)
    folder.mkdir(parents=True)
    slices = tuple(Slice(f"{i}.exr", each) for i, each in enumerate(FOCI_M))
    stack = FocalStack(folder, slices, replace(LENS, aperture=Aperture.disc()), None, 0, True, True)

    def noisy(values: np.ndarray, share: float) -> np.ndarray:
        return (values * (1.0 + share * rng.standard_normal(values.shape))).astype(np.float32)

    renderer = ScatterReference(Layering(slices=24, field_cells=(7, 5)))
    for index in range(len(stack)):
        blurred = renderer.render([opaque(rgb, depth_m)], replace(stack.lens_of(index), aperture=aperture)).rgb
        write_image(folder / f"{index}.exr", noisy(blurred, NOISE), half=False)
    known = np.ones(SIZE, np.float32)
    write_merged(folder, noisy(rgb, NOISE), np.zeros(SIZE, np.float32), known, noisy(depth_m, DEPTH_NOISE))
    write_focal_stack(stack)
    return stack


def likeness(kernel: np.ndarray, truth: np.ndarray) -> float:
    """Correlation of two kernels in pixels, the smaller one with a border of zeros."""
    size = max(kernel.shape[0], truth.shape[0])
    wide = [np.pad(each, (size - each.shape[0]) // 2).ravel() for each in (kernel, truth)]
    return float(np.corrcoef(wide[0], wide[1])[0, 1])


def kernels_are_like(fit: LensFit, aperture: Aperture, diameter_px: float, field_xy: tuple[float, float] = (0.0, 0.0)) -> list[float]:
    """For each colour."""
    side = 1 if diameter_px > 0 else -1
    field = int(fit.knots.fields_at(np.array([field_xy])[0]))
    kernel = kernel_of(fit.grid, picture_at(fit, diameter_px, field), diameter_px)
    truths = [aperture.seen(side, field_xy, c).rasterize(diameter_px * aperture.channel_scale(side)[c]).kernel for c in range(3)]
    return [likeness(kernel[..., c], truths[c]) for c in range(3)]


def test_rows_are_the_convolution_with_the_kernel() -> None:
    """Twins: what the cells see, weighted by their light, and a plain convolution with the kernel that they cast."""
    grid, rng = PupilGrid(25), np.random.default_rng(0)
    picture = rng.random((len(grid.places), 1))
    picture /= picture.sum()
    sharp, coc_px = rng.random((48, 64, 3)), np.full((48, 64), -11.3, np.float32)
    sums = np.zeros((49, 65, 3))
    sums[1:, 1:] = sharp.cumsum(axis=0).cumsum(axis=1)
    where = np.ascontiguousarray(np.argwhere(np.ones((20, 30), bool)) + np.array([14, 17]))
    rows = np.empty((len(where), 3, len(grid.places)), np.float32)
    gather_rows(rows, sums, coc_px, where, np.tile([1.0, 0.0], (len(where), 1)), grid.places, grid.cell)
    kernel = kernel_of(grid, picture, -11.3)[..., 0].astype(np.float64)
    for c in range(3):
        expected = convolve(sharp[..., c], kernel, mode="constant")[where[:, 0], where[:, 1]]
        np.testing.assert_allclose(rows[:, c] @ picture[:, 0], expected, atol=2e-6)


def test_an_aperture_is_its_picture_mirrored_in_front_and_projected_on_the_nearest_point() -> None:
    grid = PupilGrid(33)
    picture = grid.of_aperture(HEPTAGON)
    for diameter_px in (12.0, -20.0):
        kernel = kernel_of(grid, picture, diameter_px)[..., 0]
        assert likeness(kernel, HEPTAGON.rasterize(diameter_px).kernel) > 0.995
        assert kernel.sum(dtype=np.float64) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(kernel_of(grid, picture, -20.0), kernel_of(grid, picture, 20.0)[::-1, ::-1], atol=1e-7)
    assert kernel_of(grid, picture, 0.8).shape == (1, 1, 1)
    # No point of the simplex is nearer (variational inequality: (v - p).(s - p) <= 0 for all s, and so for its corners).
    values = np.random.default_rng(0).standard_normal((5, 7))
    found = on_simplex(values, 3.0)
    np.testing.assert_allclose(found.sum(axis=1), 3.0)
    assert (found >= 0.0).all()
    for corner in 3.0 * np.eye(7):
        assert (((values - found) * (corner - found)).sum(axis=1) <= 1e-9).all()


@pytest.mark.parametrize(
    ("aperture", "least"),
    [
        pytest.param(HEPTAGON, 0.99, id="heptagon", marks=pytest.mark.slow),
        pytest.param(Aperture.ring(0.5), 0.99, id="ring", marks=pytest.mark.slow),
        pytest.param(Aperture.heart(), 0.98, id="heart", marks=pytest.mark.slow),
        pytest.param(replace(Aperture.disc(), spherical_aberration=0.7), 0.985, id="bright rim", marks=pytest.mark.slow),
        pytest.param(replace(HEPTAGON, axial_chromatic=(0.08, 0.0, -0.08)), 0.99, id="colours"),
    ],
)
def test_a_stack_tells_the_kernels(aperture: Aperture, least: float, tmp_path: Path) -> None:
    """With 1 % noise in picture and slices and 0.3 % in depth, on both sides of the focus and for each colour."""
    stack = make_stack(tmp_path / "stack", aperture)
    fit = fit_lens([stack], [], ONE)
    assert (fit.pictures >= 0.0).all()
    np.testing.assert_allclose(fit.pictures.sum(axis=2), 1.0, atol=1e-6)
    for diameter_px in (11.0, -13.0):
        assert min(kernels_are_like(fit, aperture, diameter_px)) > least
    if not aperture.is_chromatic:
        assert worse_than_truth(fit, aperture, tmp_path) < 1.06  # half a dB


def worse_than_truth(fit: LensFit, aperture: Aperture, folder: Path) -> float:
    """The largest ratio of errors, by the kernels and by the true ones, on slices of a scene that the fit has not seen."""
    slices, ratios = StackSlices.of([make_stack(folder / "other", aperture, seed=5)]), []
    for index in (0, 2):
        view = slices.view(index)
        equations = equations_of(view, drawn_pixels(view, fit.knots, 2000, np.random.default_rng(1)), fit.grid, fit.knots)
        side = 1 if index == 0 else -1
        truth = np.stack([fit.grid.of_aperture(aperture.seen(side))[:, 0]] * 3)
        ratios.append(equations.error(fit.pictures) / equations.error(np.broadcast_to(truth, fit.pictures.shape)))
    return max(ratios)


def test_a_lamp_in_front_of_a_wall_keeps_its_own_blur() -> None:
    """Depth is smoothed without losing what is thin: a lamp of one pixel, which outshines all that tells of the wall's kernel, else
    passed for a part of the wall. Pixels that its light reaches (a diameter of 8 px behind the focus, 6 in front) are not used. One
    whose depth is not trusted is noise.
    """
    rng = np.random.default_rng(0)
    coc_px = (8.0 + 0.1 * rng.standard_normal((60, 80))).astype(np.float32)
    coc_px[30, 40], coc_px[12, 12] = -6.0, 14.0
    confidence = np.ones_like(coc_px)
    confidence[12, 12] = 0.0
    smooth = smoothed_coc(coc_px, confidence)
    assert smooth[30, 40] == -6.0
    assert smooth[12, 12] == pytest.approx(8.0, abs=0.2)
    assert np.delete(smooth.ravel(), 30 * 80 + 40).std() < 0.05
    sharp = np.full((60, 80, 3), 0.5, np.float32)
    usable = usable_pixels(SliceView(sharp, sharp, smooth, np.ones(coc_px.shape, bool)))
    rows, columns = np.nonzero(usable)
    assert usable.any()
    assert np.hypot(rows - 30, columns - 40).min() > 4.0


def test_shared_evidence_is_the_sum_and_the_simplest_description_is_taken() -> None:
    knots, rng = Knots((5.0, 10.0)), np.random.default_rng(0)
    evidence = Evidence(rng.random((4, 3, 7, 7)).astype(np.float32), rng.random((4, 3, 7)), rng.random(4), np.arange(4))
    merged, fewer = Sharing(colours=True, diameters=True).merged(evidence, knots)
    assert (len(fewer), merged.sides.shape) == (2, (2, 1, 7))
    np.testing.assert_allclose(merged.sides[1, 0], evidence.sides[2:].sum(axis=(0, 1)))
    np.testing.assert_allclose(merged.matrices[0, 0], evidence.matrices[:2].sum(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_array_equal(merged.counts, [1, 5])
    both, _ = Sharing(sides=True).merged(evidence, knots)
    np.testing.assert_allclose(both.energies, np.tile(evidence.energies[:2] + evidence.energies[2:], 2))
    spread = Sharing(colours=True, diameters=True).spread(merged.sides, knots, 3)
    np.testing.assert_array_equal(spread[2:], np.broadcast_to(merged.sides[1], (2, 3, 7)))
    # Squares are worse than the best by 1, 1.2 and 1.1 of everything (error 0.06), by -0.5, 0.6, 0.2 (0.32, mean 0.1), by nothing.
    squares = np.array([[11.0, 11.2, 11.1], [9.5, 10.6, 10.2], [10.0, 10.0, 10.0]])
    assert simplest_of(np.sqrt(squares).tolist()) == 1
    assert simplest_of(np.sqrt(squares[[0, 2]]).tolist()) == 1
    assert simplest_of([[], []]) == 1


@pytest.mark.slow
def test_a_symmetric_lens_tells_its_cat_eyes(tmp_path: Path) -> None:
    """One view, rings of eccentricity: at 0.12, 0.38 and 0.62 the kernels of a source on the right."""
    aperture = replace(Aperture.disc(), cat_eye=0.7)
    stacks = [make_stack(tmp_path / f"stack_{seed}", aperture, seed) for seed in (0, 1)]
    fit = fit_lens(stacks, [], replace(ONE, rings=4, pixels=30_000))
    for eccentricity in (0.12, 0.38, 0.62):
        found = [min(kernels_are_like(fit, aperture, diameter_px, (eccentricity, 0.0))) for diameter_px in (11.0, -13.0)]

        assert min(found) > 0.95
    assert fit.scores  # two of six slices were kept for the proof
    assert all(score.held_out and score.fitted < 0.7 * score.disc for score in fit.scores)
    turned = kernels_are_like(fit, aperture, 11.0, (-0.62, 0.0))  # not turned yet: the wrong way round
    assert max(turned) < 0.95


@pytest.mark.slow
def test_regions_tell_cat_eyes(tmp_path: Path) -> None:
    """A region's kernel is the mean over a third of the frame, so it is less like that of its middle than the kernel of a ring is."""
    aperture = replace(Aperture.disc(), cat_eye=0.7)
    fit = fit_lens(
        [make_stack(tmp_path / f"stack_{seed}", aperture, seed) for seed in (0, 1, 2)], [], replace(ONE, regions=(3, 1), pixels=45_000)
    )
    for x in (-0.55, 0.0, 0.55):
        found = [min(kernels_are_like(fit, aperture, diameter_px, (x, 0.0))) for diameter_px in (11.0, -13.0)]

        assert min(found) > 0.95


def lights_frame(aperture: Aperture, diameter_px: float) -> np.ndarray:
    """Four lights, dark noise around them."""
    rgb = np.zeros((150, 220, 3))
    for row, column in ((34, 40), (40, 120), (110, 60), (112, 180)):
        rgb[row, column] = diameter_px**2 * np.array([0.07, 0.05, 0.04])
    light = scatter(rgb, np.full(rgb.shape[:2], diameter_px, np.float32), aperture)
    return (0.01 + light + 0.001 * np.random.default_rng(0).standard_normal(rgb.shape)).astype(np.float32)


@pytest.mark.parametrize(("aperture", "least"), [(HEPTAGON, 0.99), (Aperture.ring(0.5), 0.97)])
@pytest.mark.slow
def test_lights_alone_suffice(aperture: Aperture, least: float) -> None:
    """In pixels, at the diameter that was measured, which is within 3 % of the true one."""
    lights = find_lights(lights_frame(aperture, 24.0), in_front=False)
    assert len(lights) == 4
    assert all(light.diameter_px == pytest.approx(24.0, rel=0.03) for light in lights)
    fit = fit_lens([], lights, ONE, (220, 150))
    diameter_px = lights[0].diameter_px
    kernel = kernel_of(fit.grid, picture_at(fit, diameter_px, 0), diameter_px)
    found = likeness(kernel[..., 1], aperture.rasterize(24.0).kernel)

    assert found > least


@pytest.mark.slow
def test_lights_help_a_stack(tmp_path: Path) -> None:
    """Their diameters are corrected by what the stack tells: told 8 % too large, they come out as the stack has them."""
    stack = make_stack(tmp_path / "stack", HEPTAGON)
    lights = find_lights(lights_frame(HEPTAGON, 14.0), in_front=False)
    wrong: list[PointLight] = [replace(light, diameter_px=1.08 * light.diameter_px) for light in lights]
    fit = fit_lens([stack], wrong, ONE)
    found = min(kernels_are_like(fit, HEPTAGON, 12.0))

    assert found > 0.98
    assert fit.lights.sum() == 4
    told = fit.pixels > 0
    assert (np.isfinite(fit.errors) == told).all()
    assert (fit.errors[told] < 1.5).all()  # about one deviation, for robust weights cut what disagrees


def test_refusals(tmp_path: Path) -> None:
    stack = make_stack(tmp_path / "stack", Aperture.disc())
    unknown = replace(stack, slices=tuple(replace(each, focus_distance_m=None) for each in stack.slices))
    for stacks, said in (
        ([unknown], "no depth in metres"),
        ([replace(stack, registered=False)], "not registered"),
        ([replace(stack, lens=None)], "does not know its lens"),
        ([replace(stack, lens=replace(LENS, f_number=16.0))], "more focus distances"),
        ([], "nothing to fit"),
    ):
        refused(said, fit_lens, stacks, [], ONE)


@pytest.mark.slow
def test_the_command_writes_a_bank_that_renders(tmp_path: Path) -> None:
    """A bank is read back, drawn, exported and used; re-blurring with it is nearer to the slice than not blurring at all."""
    stack = make_stack(tmp_path / "stack", HEPTAGON)
    app = typer.Typer()
    for command in (fit_command, show, export):
        app.command(command.__name__)(command)

    def run(*arguments: object) -> str:
        return CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False).output

    out = tmp_path / "lens"
    assert "slices" in run("fit", stack.folder, "--out", out, "--regions", "1x1", "--pixels", 5000, "--diameters", "12")
    assert (out / "kernels.png").is_file() and (out / "evidence.png").is_file()
    bank = read_bank(out)
    assert (bank.model, bank.channels) == ("measured", 3)
    np.testing.assert_allclose(bank.throughput, 1.0, atol=1e-5)
    run("export", out, "--out", tmp_path / "kernels")
    assert len(list((tmp_path / "kernels").glob("*.exr"))) == len(bank.kernels) == len(bank.settings["pixels"])
    sharp, slice_rgb = stack.all_in_focus(), stack.slice_rgb(0)
    blurred = LaplacianSpreadlets(bank=bank).render([opaque(sharp, stack.depth_m())], stack.lens_of(0)).rgb
    assert ((blurred - slice_rgb) ** 2).mean() < 0.1 * ((sharp - slice_rgb) ** 2).mean()
    refused("--overwrite", run, "fit", stack.folder, "--out", out)


def test_a_bank_over_the_field_whose_axes_go_both_ways() -> None:
    """Nine regions give nine kernels per diameter; each place takes its own region's."""
    knots = Knots((10.0,), (3, 3), highs=(0.8, 0.6))
    grid = PupilGrid(21)
    pictures = np.zeros((len(knots), 3, len(grid.places)))
    pictures[np.arange(len(knots)), :, np.arange(len(knots))] = 1.0
    bank = bank_of(LensFit(grid, knots, pictures, 12.0, np.zeros(18, np.int64), np.zeros(18, np.int64), np.ones(18)))
    assert [axis.name for axis in bank.axes] == ["diameter_px", "field_x", "field_y"]
    for field, place in enumerate((x, y) for y in (-0.5, 0.0, 0.5) for x in (-0.6, 0.0, 0.6)):
        assert int(knots.fields_at(np.array(place))) == field
        own = bank.kernel_at(np.array([10.0, *place]))[..., 0]
        alike = [likeness(own, kernel_of(grid, each.T, 10.0)[..., 0]) for each in pictures[9:]]
        assert alike[field] > 0.5 and int(np.argmax(alike)) == field
    axis = Axis("field_x", -0.8, 0.8)
    np.testing.assert_allclose(axis.to_unit(np.array([-0.8, -0.4, 0.0, 0.8])), [0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(axis.from_unit(axis.to_unit(np.array([-0.3, 0.7]))), [-0.3, 0.7])
    one = np.ones((1, 1, 1), np.float32)
    bank = PsfBank("test", (axis, Axis("field_y", -0.6, 0.6)), (2, 1), (one, one), nested=False)
    assert [int(bank.nearest(np.array([x, 0.1]))) for x in (-0.2, 0.2)] == [0, 1]
    refused("field_x and field_y", Axis, "eccentricity", -1.0, 1.0)
