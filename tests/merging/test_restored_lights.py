"""Lights in a focal stack: found, given to their sharp slice, and their energy read where they are out of focus."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest

from capture.merging.depth_from_focus import focus_map
from capture.merging.focus_volume import focus_volume
from capture.merging.lights import Lights, find_lights, no_lights
from capture.merging.restored_lights import Discs, restored_lights, with_restored_lights
from capture.photos.libraw import neutral_where_full
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.scatter_reference import blur_layer
from tests.support.blended_slices import all_in_focus

SIZE = (80, 400)
LIGHT_AT = (40, 60)
SHARP_SLICE = 1
FULL = 2.0
RADIANCE = np.array([90.0, 80.0, 60.0], np.float32)


def texture() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.3, (*SIZE, 3)).astype(np.float32)


def scene(radiance: np.ndarray = RADIANCE) -> np.ndarray:
    """A textured wall, sharp in slice 3, and in front of it one light of a single pixel, sharp in slice 1."""
    rgb = texture()
    rgb[LIGHT_AT] = radiance
    return rgb


def slices(rgb: np.ndarray) -> list[np.ndarray]:
    """Five photographs; the sensor is full at 2."""
    index = np.full(SIZE, 3.0, np.float32)
    index[LIGHT_AT] = SHARP_SLICE
    photographs = []
    for i in range(5):
        blurred = blur_layer(opaque(rgb, np.ones(SIZE, np.float32)), 4.0 * (index - i), Aperture.blades(6))
        photographs.append(np.minimum(blurred.rgb, FULL))
    return photographs


def test_the_light_is_found_in_its_sharp_slice_and_merged_without_a_ghost_ring() -> None:
    stack = slices(scene())
    lights = find_lights(lambda: stack)
    assert lights.sharpest.tolist() == [SHARP_SLICE]
    assert lights.focus_index[0] == pytest.approx(SHARP_SLICE, abs=0.1)
    assert lights.core[LIGHT_AT] and lights.zone[LIGHT_AT] == 1
    # Its largest disc, 12 px wide in slice 4, lies within the zone.
    assert all(lights.zone[LIGHT_AT[0] + dy, LIGHT_AT[1] + dx] == 1 for dy, dx in ((0, 6), (0, -6), (5, 0), (-5, 0)))
    assert lights.zone[:, 120:].max() == 0
    ring = np.s_[LIGHT_AT[0] - 5 : LIGHT_AT[0] + 6, LIGHT_AT[1] + 2 : LIGHT_AT[1] + 7]
    # Every slice but the light's own has light thrown on the ring; the texture alone never exceeds 0.3.
    assert max(each[ring].max() for each in stack) > 0.8
    assert merged_with_lights(stack)[0][ring].max() < 0.32


def test_a_stack_without_lights_has_none_nor_has_white_paper() -> None:
    stack = [texture()] * 3
    lights = find_lights(lambda: stack)
    assert len(lights.sharpest) == 0 and lights.zone.max() == 0 and not lights.core.any()
    assert restored_lights(lambda: stack, stack[0])[1] == []
    rgb = texture()
    rgb[10:70, 100:300] = 0.97
    stack = [rgb] * 3
    assert len(find_lights(lambda: stack).sharpest) == 0


def merged_with_lights(stack: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, Lights]:
    merged = all_in_focus(stack, focus_map(focus_volume(stack), no_lights(SIZE)).focus_index)
    lights, restored = restored_lights(lambda: stack, merged)
    return with_restored_lights(merged, restored), merged, lights


def test_energy_lost_to_saturation_is_found_in_the_discs_and_light_that_fits_left_alone() -> None:
    restored, merged, lights = merged_with_lights(slices(scene()))
    assert merged.max() <= FULL
    # In slice 4 the disc of 12 px spreads the light over 94 px, 0.95 above the wall: nothing is full there.
    np.testing.assert_allclose(restored[LIGHT_AT], RADIANCE, rtol=0.03)
    away = lights.zone == 0
    np.testing.assert_array_equal(restored[away], merged[away])
    # At 3 the sharp slice shows 1.6, below what fills the sensor; it stays as bright as that. (Below 2.5 the wall, which is noise of that
    # brightness, outweighs a single pixel.)
    stack = slices(scene(np.array([3.0, 2.8, 2.7], np.float32)))
    restored, merged, lights = merged_with_lights(stack)
    assert len(lights) == 0
    np.testing.assert_array_equal(restored, merged)
    np.testing.assert_allclose(merged[LIGHT_AT], stack[SHARP_SLICE][LIGHT_AT], rtol=0.05)


def test_a_light_that_moves_between_the_slices_is_left_as_it_is() -> None:
    """Its discs are alike in flux, but no one picture has them all; at half the bar for that a light was drawn in their midst."""
    moving = [np.roll(each, 3 * index, axis=1) for index, each in enumerate(slices(scene()))]
    assert len(find_lights(lambda: moving)) == 1
    restored, merged, _ = merged_with_lights(moving)
    np.testing.assert_array_equal(restored, merged)


@pytest.mark.parametrize(("pixel", "expected"), [
    ((2.0, 1.0, 1.6), (2.0, 2.0, 2.0)),  # all full: white, not magenta
    ((1.5, 1.0, 1.2), (1.5, 1.5, 1.2)),  # green is full: at least as bright as red
    ((2.0, 0.3, 0.1), (2.0, 0.3, 0.1)),  # a red light stays red
    ((0.9, 0.9, 0.9), (0.9, 0.9, 0.9)),  # below the ceiling nothing changes
])  # fmt: skip
def test_full_channels_do_not_take_the_tint_of_the_white_balance(pixel: tuple[float, ...], expected: tuple[float, ...]) -> None:
    result = neutral_where_full(np.full((2, 2, 3), pixel, np.float32), (2.0, 1.0, 1.6))
    np.testing.assert_allclose(result[0, 0], expected, rtol=1e-6)


def believed(flux: list[float], peak: list[float]) -> list[int]:
    count = len(flux)
    colours = np.repeat(np.array(flux)[:, None] / 3.0, 3, axis=1)
    nothing = np.zeros((count, 2, 2))
    discs = Discs(flux=colours, xy_px=nothing[:, 0], covariance_px2=nothing, peak=np.array(peak), whole=np.ones(count, bool))
    return np.flatnonzero(discs.believable).tolist()


def test_of_a_light_that_is_full_in_most_slices_the_brightest_are_believed() -> None:
    """Flux and peaks of lamps of the traced card in 12 slices: its channels are full at 1.5 to 2, so that only wide discs hold all."""
    flux = [193.6, 199.3, 192.0, 174.4, 138.7, 114.6, 59.4, 51.8, 44.2, 45.0, 62.1, 100.3]
    peak = [0.93, 1.19, 1.59, 2.0, 2.0, 1.94, 1.48, 1.9, 2.0, 1.72, 1.77, 2.0]
    assert believed(flux, peak) == [0, 1, 2]
    assert believed([flux[0], 120.0, 119.0, *flux[3:]], peak) == [0], "slice 3 is full and still has nine tenths of it"
    assert believed([flux[0], 120.0, 119.0, 118.0, *flux[4:]], peak) == [], "one that is brighter than all others tells nothing"
    assert believed([70.0 if index == 5 else 190.0 for index in range(12)], peak) == [0, 1, 2, 6, 9, 10]


def test_few_slices_that_hold_all_of_a_light_outweigh_more_that_have_lost_as_much_of_it() -> None:
    """Lamps of the traced card: four slices hold 171, or one and a full one 340; below full, others that lost most of it are alike too."""
    flux = [176.0, 173.0, 168.0, 167.0, 138.0, 103.0, 62.0, 52.0, 26.0, 34.0, 65.0, 95.0]
    peak = [0.95, 1.0, 1.25, 1.78, 2.0, 2.0, 1.83, 1.61, 1.35, 1.52, 1.81, 1.96]
    assert believed(flux, peak) == [0, 1, 2, 3]
    flux = [347.0, 326.0, 269.0, 221.0, 157.0, 121.0, 91.0, 56.0, 47.0, 53.0, 80.0, 137.0]
    peak = [1.74, 2.0, 2.0, 2.0, 2.0, 2.0, 1.99, 2.0, 1.82, 1.5, 2.0, 2.0]
    assert believed(flux, peak) == [0]


def mosaicked(rgb: np.ndarray) -> np.ndarray:
    """What a sensor with Bayer's pattern tells of a picture, full at 1; its blue counts twice after white balance."""
    gain = np.array([1.5, 1.0, 2.0], np.float32)
    raw = np.zeros(rgb.shape[:2], np.float32)
    for channel, (row, column) in ((0, (0, 0)), (1, (0, 1)), (1, (1, 0)), (2, (1, 1))):
        raw[row::2, column::2] = rgb[row::2, column::2, channel] / gain[channel]
    codes = (np.minimum(raw, 1.0) * 65535 + 0.5).astype(np.uint16)
    return cv2.cvtColor(codes, cv2.COLOR_BayerRGGB2RGB).astype(np.float32) / 65535 * gain


class Lamps(NamedTuple):
    restored: np.ndarray
    merged: np.ndarray
    lights: Lights

    def light(self, at: tuple[int, int], radius_px: float = 4.0) -> tuple[float, float]:
        """The light of the merged and of the restored picture within a circle, above the wall."""
        near = np.hypot(*np.ogrid[-at[0] : SIZE[0] - at[0], -at[1] : SIZE[1] - at[1]]) < radius_px
        merged, restored = (float((each[near] - 0.04).sum()) for each in (self.merged, self.restored))
        return merged, restored


def lamps_behind_a_mosaic(
    lamps: dict[tuple[int, int], tuple[float, float, float]], brighter: dict[int, float] | None = None, sharp_in: tuple[int, ...] = ()
) -> Lamps:
    """Lamps of one pixel in 12 slices. brighter: factors in some slices. sharp_in: slice of each lamp, 1 without."""
    index, wall = np.full(SIZE, 3.0, np.float32), texture() * np.float32(0.2)
    stack = []
    for number in range(12):
        rgb = wall.copy()
        for at, colour, sharp in zip(lamps, lamps.values(), sharp_in or (SHARP_SLICE,) * len(lamps), strict=True):
            rgb[at], index[at] = np.array(colour, np.float32) * (brighter or {}).get(number, 1.0), sharp
        blurred = blur_layer(opaque(rgb, np.ones(SIZE, np.float32)), 3.0 * (index - number), Aperture.blades(6)).rgb
        stack.append(mosaicked(cv2.GaussianBlur(blurred, None, 0.6)))
    return Lamps(*merged_with_lights(stack))


def test_lamps_behind_a_mosaic_are_drawn_and_their_discs_go() -> None:
    """Near focus the channels of a lamp are full at different values, and demosaicing spreads that: only wide discs tell what is true."""
    lamps = {(40, 60): (20.0, 18.0, 14.0), (41, 161): (60.0, 54.0, 42.0), (40, 250): (25.0, 0.3, 0.3), (40, 340): (0.3, 25.0, 0.3)}
    seen = lamps_behind_a_mosaic(lamps)
    assert len(seen.lights) == len(lamps)
    for (row, column), colour in lamps.items():
        merged, restored = seen.light((row, column))
        assert restored == pytest.approx(sum(colour), rel=0.12), "all of its light is in its place"
        assert merged < 0.75 * sum(colour), "a slice alone has lost most of it"
        disc = np.hypot(*np.ogrid[-row : SIZE[0] - row, -column : SIZE[1] - column])
        assert seen.restored[(disc > 4) & (disc < 12)].max() < 0.12, "the wall around it has 0.06 at most, its discs 0.4"


@pytest.mark.parametrize(("factor", "where"), [(1.5, (6, 7, 8)), (1.8, (9, 10, 11)), (2.5, (6, 7, 8))])
def test_a_lamp_that_flickers_is_not_taken_at_its_brightest(factor: float, where: tuple[int, ...]) -> None:
    """Brighter in three slices, in which nothing is full; so are others, which have lost nothing and are more."""
    lamp = (60.0, 54.0, 42.0)
    merged, restored = lamps_behind_a_mosaic({(40, 160): lamp}, dict.fromkeys(where, factor)).light((40, 160))
    assert restored == merged or restored == pytest.approx(sum(lamp), rel=0.12)


def test_of_two_lamps_side_by_side_no_light_is_lost() -> None:
    """7 px apart and sharp in slices 1 and 8: the brighter is drawn, the other stays the disc that lies on it where that is sharp."""
    lamps = {(40, 160): (60.0, 54.0, 42.0), (40, 167): (200.0, 180.0, 140.0)}
    merged, restored = lamps_behind_a_mosaic(lamps, sharp_in=(1, 8)).light((40, 163), 20.0)
    assert merged < 0.8 * 676.0
    assert restored == pytest.approx(676.0, rel=0.15)
