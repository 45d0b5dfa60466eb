"""Slices: sorted, cut into connected_components, spread and put together, against a plain composition of the same."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering._slices_numba import claim, share_out
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.layering.padded_layers import Part, Pixels
from mrbokeh.layering.psf_over_field import AperturePsf, Frame, KernelSum, blur_colours
from mrbokeh.layering.slices import Slicing, composited, connected_components, sorted_slices
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.resources import CallingThread, ZeroedMemory

SIZE, MARGIN = (34, 42), 7
FRAME = Frame(SIZE[1] - 2 * MARGIN, SIZE[0] - 2 * MARGIN, -MARGIN, -MARGIN)
SPREAD = ScatterReference().sum_kernels
DISC = Aperture.disc(16)
INSIDE = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]


def sheet(seed: int, covered: float, extra: int = 0) -> Pixels:
    """Random light of some share of all pixels, partly see-through unless all are covered, on rolling ground of -9 to 13 px."""
    rng = np.random.default_rng(seed)
    places = np.flatnonzero(rng.uniform(size=SIZE[0] * SIZE[1]) < covered).astype(np.int32)
    values = rng.uniform(0.1, 1.0, (len(places), 4 + extra)).astype(np.float32)
    values[:, 3] = 1.0 if covered == 1.0 else rng.uniform(0.0, 1.0, len(places))
    rows, columns = places // SIZE[1], places % SIZE[1]
    coc_px = 2.0 + 11.0 * np.sin(rows / 7.0 + seed) * np.cos(columns / 9.0) + rng.normal(0.0, 0.3, len(places))
    return Pixels(places, values, coc_px.astype(np.float32))


def slicing(aperture: Aperture, spread: KernelSum = SPREAD, slices: int = 6) -> Slicing:
    return Slicing(AperturePsf(aperture, spread, (4, 3)), slices, FRAME, CallingThread(), ZeroedMemory())


def plainly_composited(
    sheets: Sequence[Pixels], aperture: Aperture, slices: int, by_depth: bool, spread: KernelSum = SPREAD
) -> tuple[np.ndarray, np.ndarray]:
    """Slice by slice and sheet by sheet over whole arrays; where two sheets meet in a pixel of a slice the later one goes after.

    What hides behind something on the other side of the focus goes before its slice, what else hides after all.
    """
    dense = []
    for each in sheets:
        values, coc_px = np.zeros((SIZE[0] * SIZE[1], each.values.shape[1]), np.float32), np.zeros(SIZE[0] * SIZE[1], np.float32)
        values[each.places], coc_px[each.places] = each.values, each.coc_px
        dense.append((values.reshape(*SIZE, -1), coc_px.reshape(SIZE)))
    coverage, diameters_px = np.stack([values[..., 3] for values, _ in dense]), np.stack([coc_px for _, coc_px in dense])
    shown, across = np.ones_like(coverage), np.zeros(coverage.shape, bool)
    for i in range(len(sheets)):
        for j in range(len(sheets)):
            before = j < i if not by_depth else (diameters_px[j] < diameters_px[i]) | ((diameters_px[j] == diameters_px[i]) & (j < i))
            shown[i] *= np.where(before, 1.0 - coverage[j], 1.0)
            across[i] |= before & (coverage[j] > 0) & (diameters_px[j] < -6.0) & (diameters_px[i] > 6.0)
    hidden = np.float32(1.0) - shown
    step = np.float32(max((diameters_px.max() - diameters_px.min()) / slices, 0.5))
    index = np.floor(diameters_px / step + np.float32(0.5)).astype(int)
    kinds = 3 if aperture.is_chromatic else 1
    colour, taken = np.zeros((*SIZE, dense[0][0].shape[2] - 1)), np.zeros((*SIZE, kinds))
    slices = np.unique(index)
    turns = [*((shares, k) for k in slices for shares in (hidden * across, shown)), *((hidden * ~across, k) for k in slices)]
    for shares, k in turns:
        there = (index == k) & (shares > 0) & (coverage > 0)
        turn = np.cumsum(there, axis=0)
        for turn_of in range(1, len(sheets) + 1):
            mine = there & (turn == turn_of)
            light = sum(values * (mine[i] * shares[i])[..., None] for i, (values, _) in enumerate(dense)).astype(np.float32)
            coc_px = np.where(mine, diameters_px, 0.0).sum(axis=0, dtype=np.float32)
            if mine.any():
                plainly_claim(colour, taken, blur_colours(spread, light, coc_px, aperture, FRAME, (4, 3)))
    return colour[INSIDE], taken[INSIDE]


def plainly_claim(colour: np.ndarray, taken: np.ndarray, light: np.ndarray) -> None:
    kinds = taken.shape[2]
    coverage = np.maximum(light[..., 3 : 3 + kinds], 0.0)
    share = np.minimum(1.0, (1.0 - taken) / np.maximum(coverage, 1e-30)) * (coverage > 0)
    of_channel = [*np.arange(3) % kinds, *[kinds // 2] * (colour.shape[2] - 3)]
    colour += np.delete(light, np.s_[3 : 3 + kinds], axis=2) * share[..., of_channel]
    taken[:] = np.minimum(1.0, taken + coverage)


@pytest.mark.parametrize("aperture", [DISC, replace(DISC, lateral_chromatic=(0.1, 0.0, -0.1)), replace(DISC, cat_eye=0.7)])
def test_slices_against_a_plain_composition(aperture: Aperture) -> None:
    """A whole sheet and two sparse ones behind it, with two further channels, which change nothing else, and without; the exact spread, so
    that only float32 rounding may differ."""
    front = sheet(1, 1.0, 2)
    front.values[::3, 3] = 0.6
    sheets = [front, sheet(2, 0.2, 2), sheet(3, 0.5, 2)]
    bare = [Pixels(each.places, np.ascontiguousarray(each.values[:, :4]), each.coc_px) for each in sheets]
    colour, taken = check_composition(sheets, aperture, by_depth=False)
    for one, expected in zip(composited(bare, slicing(aperture), by_depth=False), (colour[..., :3], taken), strict=True):
        np.testing.assert_allclose(one, expected, atol=3e-6)


def check_composition(sheets: list[Pixels], aperture: Aperture, by_depth: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the plain composition."""
    plain = plainly_composited(sheets, aperture, 6, by_depth=by_depth)
    for one, expected in zip(composited(sheets, slicing(aperture), by_depth=by_depth), plain, strict=True):
        np.testing.assert_allclose(one, expected, atol=3e-6)
    return plain


def test_sheets_by_depth_against_a_plain_composition() -> None:
    check_composition([sheet(4, 0.6), sheet(5, 0.4), sheet(4, 0.3)], DISC, by_depth=True)


def test_a_slice_holds_the_pixels_nearest_to_its_multiple_of_the_step() -> None:
    ground = sheet(6, 0.7)
    share = (np.arange(len(ground.places)) % 5 > 0).astype(np.float32)
    slices = sorted_slices([ground], [share], 2.5, SIZE[1], CallingThread())
    numbers = {k: np.concatenate([np.arange(*run) for run in parts[0].runs]) for k, parts in slices}
    assert sorted(numbers) == [k for k, _ in slices]
    index = np.floor(ground.coc_px / np.float32(2.5) + np.float32(0.5))
    for k, members in numbers.items():
        np.testing.assert_array_equal(members, np.flatnonzero((index == k) & (share > 0)))
    for _, parts in slices:
        first, end = parts[0].runs.T
        side_by_side = ground.places[end - 1] - ground.places[first] == end - 1 - first
        one_row = ground.places[end - 1] // SIZE[1] == ground.places[first] // SIZE[1]
        assert side_by_side.all() and one_row.all()


def patches(corners: Sequence[tuple[int, int]], size: tuple[int, int]) -> list[Part]:
    """Squares of 4 px on nothing."""
    covered = np.zeros(size, bool)
    for y, x in corners:
        covered[y : y + 4, x : x + 4] = True
    places = np.flatnonzero(covered).astype(np.int32)
    pixels = Pixels(places, np.ones((len(places), 4), np.float32), np.full(len(places), 6.0, np.float32))
    return sorted_slices([pixels], [np.ones(len(places), np.float32)], 6.0, size[1], CallingThread())[0][1]


def test_light_of_different_islands_does_not_meet_but_those_too_near_to_pay_are_one() -> None:
    size = (300, 400)
    parts = patches([(10, 10), (10, 22), (150, 200), (280, 390)], size)
    pieces = list(connected_components(parts, 3, size))
    reached = []
    for piece in pieces:
        covered = np.zeros(size, bool)
        covered.reshape(-1)[np.concatenate([piece[0].pixels.places[first:end] for first, end in piece[0].runs])] = True
        rows, columns = np.nonzero(covered)
        lit = np.zeros(size, int)
        for y, x in zip(rows, columns, strict=True):
            lit[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4] = 1
        reached.append(lit)
    assert [int(piece[0].runs[:, 1].sum() - piece[0].runs[:, 0].sum()) for piece in pieces] == [32, 16, 16]
    assert np.sum(reached, axis=0).max() == 1
    # Two patches of 4 px with 46 px between: one window of 60 x 60 px costs less than to spread twice.
    parts = patches([(10, 10), (60, 60)], (80, 80))
    assert len(list(connected_components(parts, 3, (80, 80)))) == 1


@pytest.mark.parametrize(("extra", "kinds"), [(0, 1), (2, 1), (0, 3), (2, 3)])
def test_claims_against_the_plain_formula(extra: int, kinds: int) -> None:
    """Some of the light is none, some more than the pupil; a window that hangs over the frame on all sides loses its rim."""
    rng = np.random.default_rng(9)
    colour, taken = np.zeros((11, 14, 3 + extra), np.float32), np.zeros((11, 14, kinds), np.float32)
    plain_colour, plain_taken = colour.astype(np.float64), taken.astype(np.float64)
    for window in (np.s_[0:11, 0:14], np.s_[2:9, 3:14], np.s_[0:4, 0:5]):
        size = window[0].stop - window[0].start + 4, window[1].stop - window[1].start + 4
        light = rng.uniform(-0.2, 0.9, (*size, 3 + kinds + extra)).astype(np.float32)
        whole = np.zeros((15, 18, light.shape[2]))
        whole[window[0].start : window[0].stop + 4, window[1].start : window[1].stop + 4] = light
        claim(colour, taken, light, window[0].start - 2, window[1].start - 2)
        plainly_claim(plain_colour, plain_taken, whole[2:-2, 2:-2])
    np.testing.assert_allclose(colour, plain_colour, atol=2e-6)
    np.testing.assert_allclose(taken, plain_taken, atol=2e-6)


@pytest.mark.parametrize(("extra", "kinds"), [(0, 1), (1, 1), (0, 3), (2, 3)])
def test_what_nobody_claimed_is_shared_out(extra: int, kinds: int) -> None:
    rng = np.random.default_rng(10)
    colour, taken = rng.uniform(size=(5, 9, 3 + extra)).astype(np.float32), rng.uniform(size=(5, 9, kinds)).astype(np.float32)
    expected = colour / np.maximum(taken, np.float32(0.25))[..., [*np.arange(3) % kinds, *[kinds // 2] * extra]]
    share_out(colour, taken, np.float32(0.25))
    np.testing.assert_array_equal(colour, expected)
    assert (taken == 1.0).all()


def two_sheets() -> list[Pixels]:
    front = sheet(1, 1.0)
    front.values[::3, 3] = 0.6
    return [front, sheet(2, 0.4)]


def test_a_spread_may_return_what_it_was_given() -> None:
    """One that lets light be hands back memory that the next slice uses again."""

    def let_be(values: np.ndarray, _coc_px: np.ndarray, _aperture: Aperture) -> np.ndarray:
        return values

    found = composited(two_sheets(), slicing(DISC, let_be), by_depth=False)
    for one, expected in zip(found, plainly_composited(two_sheets(), DISC, 6, False, let_be), strict=True):
        np.testing.assert_allclose(one, expected, atol=1e-6)


def test_slices_do_not_depend_on_threads_and_nothing_renders_as_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit."""
    alone = composited(two_sheets(), slicing(DISC), by_depth=False)
    for module in ("system.resources", "layering.slices"):
        monkeypatch.setattr(f"mrbokeh.{module}.cores", lambda: 5)
    with ThreadPoolExecutor(5) as pool:
        together = composited(two_sheets(), replace(slicing(DISC), pool=pool), by_depth=False)
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one, other)
    nothing = render_layers([clear(8, 9)], Lens(50.0, 2.0, 2.0, 36.0), SPREAD, Layering())
    assert isinstance(nothing, Layer) and not nothing.rgb.any() and not nothing.alpha.any()
