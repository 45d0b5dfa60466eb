from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.renderers.bank.tables import Place, turned_kernel
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.renderers.kernels.laplacian_tables import (
    LEVELS_PER_OCTAVE,
    SPARSE,
    KernelTables,
    by_rows,
    joined_points,
    kind_of,
    stands_out,
    taps_of,
)
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, sparsify, whole_laplacian
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets, highlights_among
from mrbokeh.renderers.spreadlets.sums import FOUR, Laid, Window, _Splatting, gains_for, splat
from mrbokeh.system.errors import InputError
from tests.support.sampled_planes import LENS, Plane, sample_planes, truth
from tests.support.spreadlet_references import highlights_among_reference, splat_reference, stands_out_reference

DISC, PENTAGON = Aperture.disc(), Aperture.blades(5)
SIZE = (96, 120)


def picture(seed: int = 0, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Patches of 6 px between 0.1 and 1 in three channels, coverage 1."""
    patches = np.random.default_rng(seed).uniform(0.1, 1.0, (size[0] // 6, size[1] // 6, 4)).astype(np.float32)
    values = np.kron(patches, np.ones((6, 6, 1), np.float32))
    values[..., 3] = 1.0
    return np.ascontiguousarray(values)


def slope_px(low: float, high: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.broadcast_to(np.linspace(low, high, size[1], dtype=np.float32), size).copy()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("aperture", [DISC, PENTAGON, Aperture.ring(0.5)], ids=["disc", "pentagon", "ring"])
def test_whole_laplacians_are_dense_splatting_to_rounding(aperture: Aperture, sign: float) -> None:
    """The 3x3 Laplacian and its integration are inverse; against taps summed in double precision only the result is rounded."""
    renderer = LaplacianSpreadlets(sparsification=None, dense_up_to_px=4.0)
    values, coc_px = picture(), sign * slope_px(6.0, 44.0)
    codes = renderer._tables.codes(np.zeros_like(values), values, coc_px, aperture)
    used, cells = np.unique(codes, return_inverse=True)
    taps = renderer._tables.points(used.tolist(), aperture, 1, dense=True)
    reach, dense = taps.reach_px, np.zeros((SIZE[0] + 2 * taps.reach_px, SIZE[1] + 2 * taps.reach_px, 4))
    splat(dense, values, cells.reshape(SIZE).astype(np.int32), taps, (-reach, -reach))
    np.testing.assert_allclose(renderer.sum_kernels(values, coc_px, aperture), dense[reach:-reach, reach:-reach], atol=2e-7)
    np.testing.assert_allclose(renderer.sum_kernels(values, coc_px, aperture, densely=True), dense[reach:-reach, reach:-reach], atol=5e-5)


@pytest.mark.parametrize(("aperture", "low_px", "high_px", "least_db"), [(PENTAGON, -50.0, -30.0, 45.0), (DISC, 0.0, 24.0, 60.0)])
def test_sparse_points_and_the_fast_track_come_near_the_reference(
    aperture: Aperture, low_px: float, high_px: float, least_db: float
) -> None:
    """Those of the fast track have diameters rounded to 1/32 px."""
    values, coc_px = picture(2), slope_px(low_px, high_px)
    found, reference = (each.sum_kernels(values, coc_px, aperture) for each in (LaplacianSpreadlets(), ScatterReference()))
    assert psnr(found, reference) > least_db
    assert found.sum() == pytest.approx(reference.sum(), rel=2e-3)


def test_light_of_a_sparse_area_is_kept_and_stays_in_place() -> None:
    """A patch amid a dark frame, all of its light within: neither sum nor centroid nor the dark far away changes."""
    values = np.zeros((200, 220, 1), np.float32)
    values[90:110, 100:130] = picture(4)[:20, :30, :1]
    coc_px = np.full((200, 220), 48.0, np.float32)
    renderer = LaplacianSpreadlets()
    assert not stands_out(values)[92:108, 102:128].all(), "else all would be whole Laplacians"
    light = renderer.sum_kernels(values, coc_px, DISC).astype(np.float64)[..., 0]
    rows, columns = np.indices(light.shape)
    truth = values[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(truth.sum(), rel=1e-3)
    assert (light * rows).sum() / light.sum() == pytest.approx((truth * rows).sum() / truth.sum(), abs=0.05)
    assert (light * columns).sum() / light.sum() == pytest.approx((truth * columns).sum() / truth.sum(), abs=0.05)
    assert np.abs(light[:20]).max() < 1e-3 * light.max()


def test_a_lamp_shows_its_exact_disc_and_light_that_is_no_number_stays_none() -> None:
    """A lamp of 1e5 amid a dim picture is no sum of few points, and its rounding does not show elsewhere."""
    values, coc_px = picture(5, (192, 192)), np.full((192, 192), 42.0, np.float32)
    lamp = values.copy()
    lamp[96, 96, :3] = 1e5
    renderer = LaplacianSpreadlets()
    alone = renderer.sum_kernels(lamp, coc_px, DISC) - renderer.sum_kernels(values, coc_px, DISC)
    dense = renderer.sum_kernels(lamp, coc_px, DISC, densely=True) - renderer.sum_kernels(values, coc_px, DISC, densely=True)
    np.testing.assert_allclose(alone[..., :3], dense[..., :3], atol=2e-3 * dense.max())
    # The disc ends at 21 px. Summed in whole numbers with the rest, the lamp's rounding would show everywhere, by 1e-3.
    assert np.abs(alone[np.hypot(*(np.indices((192, 192)) - 96)) > 24.0]).max() < 5e-4, "5e-9 of the lamp"
    # Whole numbers cannot hold it: sums in double precision say so.
    values, coc_px = picture(19), slope_px(30.0, 50.0)
    values[40, 50, 1] = np.nan
    found = LaplacianSpreadlets().sum_kernels(values, coc_px, DISC)
    assert np.isnan(found[40, 50, 1])
    assert np.isfinite(found[..., 0]).all()


@pytest.mark.parametrize("dense_up_to_px", [24.0, 4.0])
def test_linear_in_radiance(dense_up_to_px: float) -> None:
    renderer = LaplacianSpreadlets(dense_up_to_px=dense_up_to_px)
    values, coc_px = picture(6), slope_px(-6.0, 36.0)
    one, scaled = (renderer.sum_kernels(factor * values, coc_px, DISC) for factor in (np.float32(1.0), np.float32(1000.0)))
    np.testing.assert_allclose(scaled, 1000.0 * one, rtol=1e-5, atol=1e-3)


def test_the_number_of_threads_changes_no_bit_and_the_pyramid_is_a_worse_integration() -> None:
    values, coc_px = picture(7, (240, 120)), slope_px(-36.0, 40.0, (240, 120))
    one, three = (LaplacianSpreadlets(threads=threads).sum_kernels(values, coc_px, PENTAGON) for threads in (1, 3))
    np.testing.assert_array_equal(one, three)
    values, coc_px = picture(8), slope_px(30.0, 50.0)
    dense = LaplacianSpreadlets().sum_kernels(values, coc_px, DISC, densely=True)
    exact, pyramid = (LaplacianSpreadlets(integration=name).sum_kernels(values, coc_px, DISC) for name in ("exact", "pyramid"))
    assert psnr(exact, dense) > psnr(pyramid, dense) + 6.0 > 26.0


def test_splatting_agrees_with_its_plain_twin() -> None:
    """Several cells, dark pixels, tiles that are cut off."""
    rng = np.random.default_rng(9)
    points = joined_points([taps_of(DISC.rasterize(size).kernel) for size in (3.0, 7.5, 12.0)])
    values, cells = rng.uniform(size=(20, 17, 3)).astype(np.float32), rng.integers(-1, 3, (20, 17)).astype(np.int32)
    found, plain = np.zeros((36, 33, 3)), np.zeros((36, 33, 3))
    splat(found, values, cells, points, (-8, -8))
    splat_reference(plain, values, cells, points, (-8, -8))
    np.testing.assert_allclose(found, plain, atol=1e-12)
    # Runs of one cell go two pixels at a time where points lie apart; tiles and strips end amid the picture.
    rng = np.random.default_rng(14)
    kernels = [sparsify(DISC.rasterize(size).kernel, UNRELAXED) for size in (11.0, 14.0)]
    points = joined_points([by_rows(each) for each in kernels])
    cells = np.repeat(rng.integers(-1, 2, (70, 9)), 5, axis=1).astype(np.int32)
    values = rng.uniform(size=(*cells.shape, 4)).astype(np.float32)
    found, plain = np.zeros((90, 65, 4)), np.zeros((90, 65, 4))
    splat(found, values, cells, points, (-10, -10))
    splat_reference(plain, values, cells, points, (-10, -10))
    np.testing.assert_allclose(found, plain, atol=1e-14)


def test_what_stands_out_agrees_with_its_plain_twin() -> None:
    """Lone pixels at the border, in corners and in pictures smaller than their surroundings."""
    rng = np.random.default_rng(15)
    for size in ((70, 90), (5, 40), (1, 9)):
        values = rng.uniform(size=(*size, 3)).astype(np.float32) ** 20
        values[0, 0, 1] = values[-1, -1, 2] = 30.0
        found = stands_out(values)
        np.testing.assert_array_equal(found, stands_out_reference(values))
        assert found[0, 0]
        assert not found.all()


def test_levels_are_the_nearest_powers() -> None:
    """Steps from neighbour to neighbour and leaps; what lies on a border may go either way."""
    sizes_px = np.random.default_rng(16).uniform(24.5, 900.0, (40, 50)).astype(np.float32)
    sizes_px[20:] = np.sort(sizes_px[20:], axis=1)
    exact = np.log2(sizes_px.astype(np.float64) / 24.0) * LEVELS_PER_OCTAVE
    values = np.ones((*sizes_px.shape, 1), np.float32)
    tables = KernelTables(24.0, UNRELAXED)
    codes = tables.codes(np.zeros_like(values), values, sizes_px, DISC)
    assert all(kind_of(int(code)) == SPARSE for code in np.unique(codes))
    found = np.array([tables.diameter_px(int(code)) for code in codes.ravel()]).reshape(codes.shape)
    clear = np.abs(exact - np.floor(exact) - 0.5) > 1e-3
    assert clear.mean() > 0.9
    np.testing.assert_allclose(found[clear], 24.0 * 2.0 ** (np.rint(exact[clear]) / LEVELS_PER_OCTAVE), rtol=1e-12)


def in_double(renderer: LaplacianSpreadlets) -> LaplacianSpreadlets:
    """The same kernels and the same lamps, but every sum of Laplacians in double precision."""
    twin = replace(renderer)
    object.__setattr__(twin, "_tables", renderer._tables)
    add_light = twin._add_light

    def add_in_double(out: np.ndarray, *task: object, largest: object = None, taps: tuple | None = None) -> None:  # noqa: ARG001
        add_light(out, *task)
        if taps is not None:
            add_light(out, task[0], *taps, None, task[4])

    object.__setattr__(twin, "_add_light", add_in_double)
    return twin


def dim_but_for_lamps(size: tuple[int, int], lamp: float) -> np.ndarray:
    """Colour about 0.01 beside a coverage of 1, as at night, and one lamp in a thousand pixels."""
    values = 0.01 * picture(17, size)
    values[..., 3] = 1.0
    values[np.random.default_rng(18).uniform(size=size) < 1e-3, :3] = lamp
    return values


LIGHTS = {
    "patches": lambda: picture(17, (192, 192)),
    "even": lambda: np.ones((192, 192, 4), np.float32),
    "night": lambda: dim_but_for_lamps((192, 192), 50.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LIGHTS)
def test_whole_numbers_are_as_good_as_double_precision(name: str) -> None:
    """To 1e-5 of what each channel is without lamps and the rounding of the result; coverage far brighter than colour costs nothing."""
    values, coc_px = LIGHTS[name](), slope_px(30.0, 50.0, (192, 192))
    whole = LaplacianSpreadlets()
    found, exact = (each.sum_kernels(values, coc_px, DISC) for each in (whole, in_double(whole)))
    typical = np.median(values, axis=(0, 1))
    assert np.all(np.abs(found - exact) <= 1e-5 * typical + 2.0**-22 * np.abs(exact))
    np.testing.assert_allclose(found.sum(axis=(0, 1), dtype=np.float64), exact.sum(axis=(0, 1), dtype=np.float64), rtol=3e-6)
    assert np.any(found != exact), "else the twin is no twin"


def sums_in_whole_numbers(values: np.ndarray, cells: np.ndarray, kernels: list, ends: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Whole numbers, over their gains, in strips that end there; and the plain sums."""
    points = joined_points([by_rows(each) for each in kernels])
    size, margin = cells.shape, points.reach_px
    window = Window(-margin, -margin, size[0] + 2 * margin, size[1] + 2 * margin)
    gains = gains_for(np.abs(values).max(axis=(0, 1)), points)
    splatting = _Splatting(values, cells, Laid.out(points, window.width, np.int32), window, gains)
    reals, plain = np.zeros((*window[2:], FOUR), np.float32), np.zeros((*window[2:], FOUR))
    for first, end in pairwise((0, *ends, window.height)):
        splatting.fill(reals, first, end)
    splat_reference(plain, values, cells, points, window[:2])
    return reals.astype(np.float64), plain, gains


def test_whole_numbers_agree_with_the_plain_twin_and_their_rounding_does_not_add_up() -> None:
    """Each pixel's points sum to 0, so all sums do, to the last bit, wherever strips end; a point is off by one rounding, 126 of them
    by less than 20 units."""
    rng = np.random.default_rng(20)
    kernels = [sparsify(DISC.rasterize(size).kernel, UNRELAXED) for size in (26.0, 29.0)]
    cells = np.repeat(rng.integers(-1, 2, (40, 8)), 5, axis=1).astype(np.int32)
    values = (rng.uniform(size=(*cells.shape, 4)) * (1.0, 0.01, 30.0, 1.0)).astype(np.float32)
    found, plain, gains = sums_in_whole_numbers(values, cells, kernels, (31, 70))
    again, _, _ = sums_in_whole_numbers(values, cells, kernels, ())
    np.testing.assert_array_equal(found, again)
    assert np.all(np.abs(found - plain) * gains < 20.0 + 2.0**-23 * np.abs(plain) * gains)
    assert np.abs(plain * gains).max() > 1e6, "else 20 units were no small error"
    # Dithers spread evenly: those of any 100 x 100 pixels leave at most a few of 10 000; all alike would leave thousands.
    from mrbokeh.renderers.spreadlets._splat_numba import dither_of

    dithers = np.array([[dither_of(x, y) for x in range(100)] for y in range(700, 800)])
    assert np.abs(dithers).max() <= 0.5
    for product in (0.1, 0.35, 0.5, 0.77):
        assert abs(np.rint(product + dithers).sum() - product * dithers.size) < 10.0


def test_no_light_is_too_much_for_whole_numbers() -> None:
    """The worst there is: every pixel around one takes the kernel and the sign that add most to it."""
    kernels = [whole_laplacian(DISC.rasterize(size).kernel) for size in (5.0, 9.0, 13.0)]
    points = joined_points([by_rows(each) for each in kernels])
    reach, best = points.reach_px, {}
    for cell in range(3):
        for n in range(points.starts[cell], points.starts[cell + 1]):
            place, weight = tuple(points.xy[n]), points.weights[n]
            if abs(weight) > abs(best.get(place, (0, 0.0))[1]):
                best[place] = cell, weight
    side = 2 * reach + 1
    values, cells = np.zeros((side, side, 4), np.float32), np.full((side, side), -1, np.int32)
    for (x, y), (cell, weight) in best.items():
        cells[reach - y, reach - x], values[reach - y, reach - x] = cell, 0.9999 * np.sign(weight)
    found, plain, gains = sums_in_whole_numbers(values, cells, kernels, ())
    middle = plain[2 * reach, 2 * reach, 0]
    assert middle == pytest.approx(0.9999 * sum(abs(weight) for _, weight in best.values()))
    assert 2.0**29 <= middle * gains[0] < 2.0**31
    assert found[2 * reach, 2 * reach, 0] == pytest.approx(middle, rel=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_lamps_agree_with_their_plain_twin(share: float) -> None:
    """A share of the pixels is dense or has no code, some of those too bright; lone bright pixels and a channel of its own scale."""
    rng = np.random.default_rng(21)
    values = rng.uniform(0.2, 1.0, (90, 150, 3)).astype(np.float32) * np.float32([1.0, 0.01, -300.0])
    values[rng.uniform(size=(90, 150)) < 2e-3] *= 100.0
    codes = np.where(rng.uniform(size=(90, 150)) < share, rng.integers(-1, 2, (90, 150)), rng.integers(2, 5, (90, 150))).astype(np.int32)
    sparse = np.array([False, False, True, True, True])
    found, plain = highlights_among(values, codes, sparse), highlights_among_reference(values, codes, sparse)
    np.testing.assert_array_equal(found.found, plain.found)
    assert 0 < found.found.sum() < 0.03 * found.found.size
    assert np.all(found.largest >= plain.largest)
    assert np.all(found.largest <= 33.0 * np.abs(values).mean(axis=(0, 1)))


def test_by_name_and_by_mistake() -> None:
    assert isinstance(make_renderer("laplacian"), LaplacianSpreadlets)
    plain = LaplacianSpreadlets()
    for wrong, said in (
        (lambda: LaplacianSpreadlets(integration="sum"), "'exact' or 'pyramid'"),  # type: ignore[arg-type]
        (lambda: LaplacianSpreadlets(dense_up_to_px=0.0), "at least 2 px"),
        (lambda: plain.sum_kernels(picture(), np.full(SIZE, np.nan, np.float32), DISC), "finite circle of confusion"),
        (lambda: plain.sum_bank_kernels(picture(), slope_px(1, 2), Place()), "without a bank"),
    ):
        with pytest.raises(InputError, match=said):
            wrong()


def bank_of(aperture: Aperture, sizes_px: tuple[float, ...] = (6.0, 18.0, 30.0, 42.0), **facts: object) -> PsfBank:
    """Kernels at the middles of equal cells from 0 to 48 px."""
    kernels = tuple(aperture.rasterize(size).kernel[..., None].astype(np.float32) for size in sizes_px)
    axis = Axis("diameter_px", 0.0, 12.0 * len(sizes_px), 1.0)
    return PsfBank("made", (axis,), (len(sizes_px),), kernels, nested=False, **{"near_side_turned": True, **facts})


@pytest.mark.parametrize("coc_px", [18.0, 42.0, -42.0])
def test_a_bank_of_an_apertures_kernels_is_the_aperture(coc_px: float) -> None:
    values, circles = picture(10), np.full(SIZE, coc_px, np.float32)
    found = LaplacianSpreadlets(bank_of(PENTAGON)).sum_bank_kernels(values, circles, Place())
    reference = ScatterReference().sum_kernels(values, circles, PENTAGON)
    assert psnr(found, reference) > 45.0
    densely = LaplacianSpreadlets(bank_of(PENTAGON)).sum_bank_kernels(values, circles, Place(), densely=True)
    np.testing.assert_allclose(densely, reference, atol=4e-5)  # single precision: each of 1400 sums may round by 2**-25


def test_kernels_are_turned_with_the_motion() -> None:
    """A bar to the right, used for a point that moves down, is a bar downwards; its light is the same."""
    bar = np.zeros((41, 41, 1), np.float32)
    bar[18:23, :] = 1.0 / 205.0
    bank = PsfBank("bar", (Axis("motion_px", 0.0, 40.0, 1.0),), (1,), (bar,), turns="motion")
    values = np.zeros((81, 81, 1), np.float32)
    values[40, 40] = 1.0
    motion = np.broadcast_to(np.float32([0.0, 30.0]), (81, 81, 2))
    found = LaplacianSpreadlets(bank).sum_bank_kernels(values, np.zeros((81, 81), np.float32), Place(motion_px=motion))[..., 0]
    np.testing.assert_allclose(found[20:61, 20:61], bar[..., 0].T, atol=1e-7)
    with pytest.raises(InputError, match="needs motion"):
        LaplacianSpreadlets(bank).sum_bank_kernels(values, np.zeros((81, 81), np.float32), Place())


def test_a_kernel_of_very_many_points_is_turned_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole Laplacians are exact, so the sums are those of all taps of the turned kernel; fitted points are not."""
    star = Aperture.star().rasterize(40.0).kernel[..., None].astype(np.float32)
    bank = PsfBank("star", (Axis("motion_px", 0.0, 9.0),), (1,), (star,), turns="motion", nested=False)
    values, circles = picture(13), np.zeros(SIZE, np.float32)
    place = Place(motion_px=np.broadcast_to(np.float32([3.0, 2.0]), (*SIZE, 2)))
    dense = LaplacianSpreadlets(bank).sum_bank_kernels(values, circles, place, densely=True)
    assert np.abs(LaplacianSpreadlets(bank).sum_bank_kernels(values, circles, place) - dense).max() > 1e-3
    monkeypatch.setattr("mrbokeh.renderers.bank.tables._MOST_TURNED", 10)
    np.testing.assert_allclose(LaplacianSpreadlets(bank).sum_bank_kernels(values, circles, place), dense, atol=1e-4)


def test_colours_of_a_bank_take_their_own_kernels_and_coverage_too() -> None:
    kernels = np.zeros((5, 5, 3), np.float32)
    kernels[2, 0, 0] = kernels[2, 2, 1] = kernels[2, 4, 2] = 1.0
    bank = PsfBank("prism", (Axis("eccentricity", 0.0, 1.0, 1.0),), (1,), (kernels,), turns="none")
    values = np.zeros((9, 9, 4), np.float32)
    values[4, 4] = 1.0
    field_xy = np.zeros((9, 9, 2))
    found = LaplacianSpreadlets(bank).sum_bank_kernels(values, np.zeros((9, 9), np.float32), Place(field_xy=field_xy))
    np.testing.assert_allclose(found[4, 2:7, :3], kernels[2], atol=1e-7)
    np.testing.assert_allclose(found[4, 2:7, 3:6], kernels[2], atol=1e-7)


def test_turning_a_kernel_is_turning_its_aperture_and_one_turned_first_is_the_same_upright() -> None:
    kernel = Aperture.star().rasterize(60.0).kernel[..., None].astype(np.float32)
    found = turned_kernel(kernel, 0.7)
    truth = np.zeros_like(found[..., 0])
    turned = Aperture.star().rotated(0.7).rasterize(60.0).kernel
    side = (len(truth) - len(turned)) // 2
    truth[side : side + len(turned), side : side + len(turned)] = turned
    assert found.sum() == pytest.approx(1.0, abs=1e-6)
    assert np.abs(found[..., 0] - truth).sum() < 0.05
    np.testing.assert_array_equal(turned_kernel(kernel, np.pi), kernel[::-1, ::-1].astype(np.float64))
    # What lies before the focus asks for it turned; kept unsorted for that, it was summed wrongly for what lies behind.
    values, far, near = picture(11), np.full(SIZE, 42.0, np.float32), np.full(SIZE, -42.0, np.float32)
    renderer = LaplacianSpreadlets(bank_of(PENTAGON))
    renderer.sum_bank_kernels(values, near, Place())
    expected = LaplacianSpreadlets(bank_of(PENTAGON)).sum_bank_kernels(values, far, Place())
    np.testing.assert_array_equal(renderer.sum_bank_kernels(values, far, Place()), expected)


@pytest.mark.parametrize(("coc_px", "motion_px"), [(20.0, (0.0, 0.0)), (-20.0, (0.0, 0.0)), (12.0, (15.0, 6.0))])
def test_reconstruction_puts_each_kernel_once_and_where_it_belongs(coc_px: float, motion_px: tuple[float, float]) -> None:
    """Of 4 noisy samples per pixel, the blur of a bright square on black, one plane; splatted at the samples' own places it would be
    blurred twice."""

    def square(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.repeat(((x >= 30) & (x < 50) & (y >= 30) & (y < 50))[:, None], 3, axis=1)

    planes = [Plane(square, coc_px, motion_px=motion_px)]
    samples, exact = sample_planes(planes, 80, 4), truth(planes, 80, 128)
    found = LaplacianSpreadlets().reconstruct(samples, LENS).rgb
    assert psnr(found, exact) > psnr(samples.raw_picture(), exact) + 6.0
    assert psnr(found, exact) > 34.0
    assert 0.9 < found.sum() / (3 * 20**2) < 1.1
