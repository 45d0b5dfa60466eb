"""Layers through a bank of kernels: kernels wide in focus, kernels that lose light, kernels chosen by depth, place and motion."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.layering.motion import MOTION, with_motion
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.psf_models.build import Combined
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.volume import Volume
from mrbokeh.renderers.bank.tables import BankTables
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.system.errors import InputError
from tests.psf_models.test_physical_lens import pair

HEIGHT, WIDTH = SIZE = (64, 90)
LENS = Lens(focal_length_mm=50.0, f_number=0.7, focus_distance_m=0.5, sensor_width_mm=22.0)
HALF_DIAGONAL_PX = 0.5 * np.hypot(*SIZE)


def depth_m(coc_px: np.ndarray | float, lens: Lens = LENS) -> np.ndarray:
    dioptres = 1.0 / lens.focus_distance_m - np.broadcast_to(coc_px, SIZE) / lens.coc_px_per_dioptre(WIDTH)
    return (1.0 / dioptres).astype(np.float32)


def white(coc_px: np.ndarray | float) -> Layer:
    return opaque(np.ones((*SIZE, 3), np.float32), depth_m(coc_px))


def lone_pixel(coc_px: float, value: float = 1.0) -> Layer:
    rgb, alpha = np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32)
    rgb[32, 45], alpha[32, 45] = value, 1.0
    return Layer(rgb, alpha, depth_m(coc_px))


def bank_of(model: object, rays: int) -> PsfBank:
    """The kernels of a model with one coordinate, on a regular grid."""
    (axis,), (count,) = model.axes, model.counts  # type: ignore[attr-defined]
    ends = axis.from_unit(np.linspace(0.0, 1.0, count + 1))
    kernels = tuple(model.kernel(np.array([ends[i : i + 2]]), rays, i) for i in range(count))  # type: ignore[attr-defined]
    return PsfBank(model.name, (axis,), (count,), kernels, model.turns, nested=False)  # type: ignore[attr-defined]


@pytest.fixture(scope="module", name="mist")
def fixture_mist() -> PsfBank:
    """Four distances up to 2 m of a medium that takes 10 % of blue and 50 % of red at every collision; kernels of 41 px."""
    return bank_of(Volume(size_px=41, focal_px=60.0, farthest_m=2.0, albedo=(0.5, 1.0, 0.9), counts=(4,)), 1 << 14)


@pytest.mark.parametrize("coc_px", [0.0, -0.7, 6.0])
def test_light_of_a_kernel_wider_than_the_circle_of_confusion_is_all_there(mist: PsfBank, coc_px: float) -> None:
    """A lone pixel in focus shows the whole veil, tap by tap, and coverage of 1 in each colour before the mean is taken."""
    kernel = mist.kernels[int(mist.nearest(np.array([depth_m(coc_px)[0, 0]], np.float64)))]
    assert len(kernel) == 41
    seen = LaplacianSpreadlets(mist).render([lone_pixel(coc_px, 3.0)], LENS)
    expected = np.zeros((*SIZE, 3))
    expected[12:53, 25:66] = 3.0 * kernel
    np.testing.assert_allclose(seen.rgb, expected, atol=3e-6)
    assert seen.alpha.sum(dtype=np.float64) == pytest.approx(1.0, abs=1e-4)


def test_an_absorbing_medium_darkens_a_scene_once_and_its_veil_is_not_cut_at_slices(mist: PsfBank) -> None:
    """Evenly white and of one distance: every colour is what the kernel sums to, and alpha stays 1."""
    seen = LaplacianSpreadlets(mist).render([white(5.0)], LENS)
    light = mist.throughput[int(mist.nearest(np.array([depth_m(5.0)[0, 0]], np.float64)))]
    np.testing.assert_allclose(seen.rgb, np.broadcast_to(light, (*SIZE, 3)), rtol=2e-3)
    np.testing.assert_array_equal(seen.alpha, 1.0)
    # A lamp far behind and one in focus: their light adds up to what their kernels let through, less what the near one hides. Both veils
    # spread over 41 x 41 pixels; where they overlap, the near lamp covers less than 1e-4 of the pupil.
    far, near = lone_pixel(20.0, 5.0), lone_pixel(0.0, 2.0)
    far = replace(far, rgb=np.roll(far.rgb, -25, axis=1), alpha=np.roll(far.alpha, -25, axis=1))
    both = LaplacianSpreadlets(mist).render([near, far], LENS).rgb.sum(axis=(0, 1), dtype=np.float64)
    light = mist.throughput[mist.nearest(np.array([[depth_m(0.0)[0, 0]], [depth_m(20.0)[0, 0]]], np.float64))]
    together = 2.0 * light[0] + 5.0 * light[1]
    assert (both < 1.0001 * together).all() and (both > 0.9999 * together).all()


def vignetted(cells: int = 10, taps: int = 9) -> PsfBank:
    """Even squares whose light falls from 1 in the middle to 0.2 in the corners, in equal steps."""
    light = np.linspace(1.0, 0.2, cells)
    kernels = tuple(np.full((taps, taps, 1), each / taps**2, np.float32) for each in light)
    return PsfBank("rims", (Axis("eccentricity", 0.0, 1.0),), (cells,), kernels, nested=False)


def plainly_spread_white(bank: PsfBank) -> np.ndarray:
    """The slow twin on a white plane that goes on beyond the frame: sums of kernels over sums of kernels scaled to 1."""
    margin = bank.radius_px
    rows, columns = np.mgrid[-margin : HEIGHT + margin, -margin : WIDTH + margin]
    eccentricity = np.hypot(columns + 0.5 - 0.5 * WIDTH, rows + 0.5 - 0.5 * HEIGHT) / HALF_DIAGONAL_PX
    cells = bank.nearest(eccentricity[..., None])
    colour, coverage = (np.zeros(np.add(cells.shape, 2 * margin)) for _ in range(2))
    for (y, x), cell in np.ndenumerate(cells):
        kernel = bank.kernels[cell][..., 0].astype(np.float64)
        there = np.s_[y : y + 2 * margin + 1, x : x + 2 * margin + 1]
        colour[there] += kernel
        coverage[there] += kernel / kernel.sum()
    inside = np.s_[2 * margin : -2 * margin, 2 * margin : -2 * margin]
    return colour[inside] / coverage[inside]


@pytest.mark.parametrize("slices", [1, 12])
@pytest.mark.parametrize("coc_px", [3.0, np.linspace(-8.0, 8.0, WIDTH)], ids=["even", "slanted"])
def test_vignetting_darkens_once_and_leaves_no_seams(coc_px: np.ndarray | float, slices: int) -> None:
    """However the white surface is cut, it has the brightness that its kernels let through, as the slow twin finds it."""
    bank = vignetted()
    seen = LaplacianSpreadlets(bank, Layering(slices)).render([white(coc_px)], LENS)
    np.testing.assert_allclose(seen.rgb, np.repeat(plainly_spread_white(bank)[..., None], 3, axis=2), rtol=1e-5)
    np.testing.assert_array_equal(seen.alpha, 1.0)


def test_what_is_behind_a_vignetted_object_does_not_shine_through() -> None:
    """A black card before a lamp wall of 1000, where rims take up to 80 % of the light; extra channels are not darkened."""
    card = np.zeros(SIZE, np.float32)
    card[:, :40] = 1.0
    near_m = np.where(card > 0, depth_m(-6.0), np.float32(np.inf))
    near = Layer(np.zeros((*SIZE, 3), np.float32), card, near_m, {"id": 7.0 * card[..., None]})
    wall = replace(white(9.0), rgb=np.full((*SIZE, 3), 1000.0, np.float32), extra={"id": np.zeros((*SIZE, 1), np.float32)})
    seen = LaplacianSpreadlets(vignetted()).render([near, wall], LENS)
    inside = np.s_[6:-6, 6:34]  # layers with holes end at the frame
    assert np.abs(seen.rgb[inside]).max() < 1e-2, "1e-5 of the wall"
    np.testing.assert_allclose(seen.extra["id"][inside], 7.0, rtol=1e-5)
    alone = LaplacianSpreadlets(vignetted()).render([near], LENS)
    np.testing.assert_allclose(alone.alpha[inside], 1.0, atol=1e-5)


@pytest.mark.slow
def test_a_lens_with_rims_shades_a_white_picture_as_its_throughput_says() -> None:
    """Two achromats about a stop whose rims cut the beam to a quarter in the corners: the picture gets what is measured ray by ray."""
    sensor_mm = (30.0, 30.0 * HEIGHT / WIDTH)
    model = PhysicalLens(pair(13.0), focus_distance_m=2.0, sensor_mm=sensor_mm, image_width_px=WIDTH, nearest_m=1.5, farthest_m=3.0)
    depth, field = model.axes
    edges = field.from_unit(np.linspace(0.0, 1.0, 17))
    kernels = tuple(model.kernel(np.array([[2.0, 2.0], edges[i : i + 2]]), 1 << 12, i) for i in range(16))
    bank = PsfBank("physical", (depth, field), (1, 16), kernels, model.turns, nested=False)
    lens = Lens(model.lens.focal_length_mm, model.lens.f_number, 2.0, sensor_mm[0])
    seen = LaplacianSpreadlets(bank).render([opaque(np.ones((*SIZE, 3), np.float32), np.full(SIZE, 2.0, np.float32))], lens)
    rows, columns = np.indices(SIZE) + 0.5
    eccentricity = np.hypot(columns - 0.5 * WIDTH, rows - 0.5 * HEIGHT) / HALF_DIAGONAL_PX
    throughput = np.array([model.throughput(2.0, each) for each in edges.tolist()])
    expected = np.repeat(np.interp(eccentricity, edges, throughput)[..., None], 3, axis=2)
    assert expected.min() < 0.3
    # A cell stands for up to half of what the light falls across it more and less than its middle; 1 % is noise of the rays.
    np.testing.assert_allclose(seen.rgb, expected, atol=0.01 + 0.5 * np.abs(np.diff(throughput)).max())
    assert np.abs(seen.rgb - expected).mean() < 0.015
    np.testing.assert_array_equal(seen.alpha, 1.0)


@pytest.mark.parametrize("tilt_rad", [(0.0, 0.0), (0.0, 0.02)])
def test_the_kernel_is_that_of_the_pixels_own_depth(tilt_rad: tuple[float, float]) -> None:
    """Each of five depths throws its light another number of pixels to the right; with a tilted lens too, whose circles of
    confusion depend on the place as well."""
    shifts = range(5)
    kernels = tuple(np.float32(np.eye(9)[4][:, None] * np.eye(9)[4 + shift] * 1.0)[..., None] for shift in shifts)
    bank = PsfBank("steps", (Axis("depth_m", 0.0, 5.0),), (5,), kernels, nested=False)
    layer = lone_pixel(0.0)
    for shift in shifts:
        at = replace(layer, depth_m=np.full(SIZE, shift + 0.5, np.float32))
        seen = LaplacianSpreadlets(bank).render([at], replace(LENS, tilt_rad=tilt_rad)).rgb[..., 0]
        assert seen[32, 45 + shift] == pytest.approx(1.0, abs=1e-5) and seen.sum() == pytest.approx(1.0, abs=1e-5)


def test_samples_through_an_absorbing_bank_are_darkened_once() -> None:
    """Four samples a pixel of an even plane; the picture is what the kernel lets through."""
    kernels = (np.full((5, 5, 1), 0.4 / 25.0, np.float32),)
    bank = PsfBank("grey", (Axis("diameter_px", 0.0, 10.0),), (1,), kernels, nested=False)
    rng = np.random.default_rng(0)
    xy = np.indices((40, 50))[::-1].reshape(2, -1).T.repeat(4, axis=0) + rng.uniform(size=(8000, 2))
    arrays = (xy, np.zeros((8000, 2)), np.full(8000, 0.5), np.ones((8000, 3)), np.full(8000, 0.5), np.zeros((8000, 2)))
    samples = LightFieldSamples(50, 40, *(np.ascontiguousarray(each, np.float32) for each in arrays))
    np.testing.assert_allclose(LaplacianSpreadlets(bank).reconstruct(samples, LENS).rgb, 0.4, rtol=1e-4)


@pytest.mark.parametrize("turns", ["none", "motion"])
def test_the_reach_of_a_kernel_holds_all_its_taps_however_it_is_turned(turns: str) -> None:
    """A square of 13 px amid dark: 6 px as it is, at an angle 6 sqrt(2) and the width of the interpolation."""
    kernel = np.zeros((21, 21, 1), np.float32)
    kernel[4:17, 4:17] = 1.0 / 169.0
    tables = BankTables(PsfBank("square", (Axis("motion_px", 0.0, 9.0),), (1,), (kernel,), turns, nested=False), None)
    codes = range(0, 2 * tables.angles if turns == "motion" else 2, 2)
    farthest = max(tables.points([code], True, 0).reach_px for code in codes)
    assert farthest <= tables.reaches_px[0] <= farthest + 1
    assert tables.reaches_px[0] == (6 if turns == "none" else 10)


@pytest.fixture(scope="module", name="combined")
def fixture_combined() -> PsfBank:
    """Circles up to 32 px and motion up to 40 px; the largest kernels are wide enough for spreadlets."""
    model = Combined(32.0, 40.0, (40, 40))
    bank = PsfBank("combined", model.axes, model.counts, (np.ones((1, 1, 1), np.float32),) * 189, model.turns)
    return replace(bank, kernels=tuple(model.kernel(box, 0, 0) for box in bank.boxes))


def card(left: int, coc_px: float, motion_px: tuple[float, float]) -> Layer:
    """A textured card of 24 x 30 px over nothing that moves."""
    rgb, alpha = np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32)
    where = np.s_[20:44, left : left + 30]
    rgb[where], alpha[where] = np.random.default_rng(2).uniform(0.0, 2.0, (24, 30, 3)), 1.0
    layer = Layer(rgb, alpha, np.where(alpha > 0, depth_m(coc_px), np.float32(np.inf)))
    return with_motion(layer, np.broadcast_to(np.float32(motion_px), (*SIZE, 2)).copy())


def still(coc_px: float) -> Layer:
    rgb = np.random.default_rng(3).uniform(0.0, 1.0, (*SIZE, 3)).astype(np.float32)
    return with_motion(opaque(rgb, depth_m(coc_px)), np.zeros((*SIZE, 2), np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("coc_px", [0.0, 9.0, -13.0])
@pytest.mark.parametrize("motion_px", [(12.0, 0.0), (-5.0, 9.0), (0.0, -36.0)])
def test_kernels_that_hold_motion_are_motion_drawn_out(combined: PsfBank, coc_px: float, motion_px: tuple[float, float]) -> None:
    """The same physics by the exact renderer, whose light is drawn out before it is spread: a card before a still background."""
    layers = [card(30, coc_px, motion_px), still(24.0)]
    found, drawn = LaplacianSpreadlets(combined).render(layers, LENS), ScatterReference().render(layers, LENS)
    assert psnr(found.rgb, drawn.rgb) > 38.0
    np.testing.assert_array_equal(found.alpha, 1.0)


@pytest.mark.parametrize("as_layers", [True, False], ids=["layers", "one picture"])
def test_a_moving_edge_hides_what_is_behind_it_for_the_time_that_it_is_there(combined: PsfBank, as_layers: bool) -> None:
    """A black card in focus, 12 px per shutter to the right, before a white wall as far behind: x pixels inside the path of its
    edge the wall is seen for x / 12 of the time."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[:, :45] = 1.0
    motion = np.zeros((*SIZE, 2), np.float32)
    motion[..., 0] = 12.0
    near, wall = Layer(np.zeros((*SIZE, 3), np.float32), alpha, np.where(alpha > 0, depth_m(0.0), np.float32(np.inf))), white(9.0)
    if as_layers:
        layers = [with_motion(near, motion), with_motion(wall, 0.0 * motion)]
    else:
        whole = opaque(np.where(alpha[..., None] > 0, near.rgb, wall.rgb), np.where(alpha > 0, near.depth_m, wall.depth_m))
        layers = [with_motion(whole, motion * alpha[..., None])]
    seen = LaplacianSpreadlets(combined).render(layers, LENS).rgb[32, :, 0]
    share = np.clip((np.arange(WIDTH) + 0.5 - 39.0) / 12.0, 0.0, 1.0)
    # The cell of the bank stands for motion of 12 to 13 px: a ramp over 12.5 px differs by up to 0.02 from the one over 12.
    np.testing.assert_allclose(seen[12:], share[12:], atol=0.025)


def test_without_motion_kernels_stand_still_and_a_bank_without_it_gets_its_light_drawn_out(combined: PsfBank) -> None:
    layers = [card(30, -8.0, (0.0, 0.0)), still(10.0)]
    without = [replace(layer, extra={name: each for name, each in layer.extra.items() if name != MOTION}) for layer in layers]
    renderer = LaplacianSpreadlets(combined)
    np.testing.assert_array_equal(renderer.render(layers, LENS).rgb, renderer.render(without, LENS).rgb)
    # A bank of a disc's kernels moves as the disc does: the same slices, the same paths.
    kernels = tuple(Aperture.disc().rasterize(size).kernel[..., None].astype(np.float32) for size in (6.0, 18.0))
    bank = PsfBank("discs", (Axis("diameter_px", 0.0, 24.0),), (2,), kernels, nested=False)
    layers = [card(30, 6.0, (14.0, 5.0)), still(18.0)]
    found, drawn = LaplacianSpreadlets(bank).render(layers, LENS), ScatterReference().render(layers, LENS)
    assert psnr(found.rgb, drawn.rgb) > 45.0
    for layers, said in (
        ([still(-50.0)], r"up to 32 px, but this picture has 50\.0 px: .*--diameter"),
        ([card(30, 5.0, (60.0, 0.0)), still(9.0)], r"motion up to 40 px, but this picture has 60\.0 px: .*--longest-motion"),
    ):
        with pytest.raises(InputError, match=said):
            LaplacianSpreadlets(combined).render(layers, LENS)
