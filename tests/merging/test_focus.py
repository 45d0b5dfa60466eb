"""Focus energies in noise, confidence beside edges and saturation, and the blend's fast and plain twins."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.merging.all_in_focus import BANDS, BandBlend, crossover_of, slice_weight
from capture.merging.depth_from_focus import focus_map
from capture.merging.focus_volume import FocusVolume, focus_energy, focus_volume
from capture.merging.lights import no_lights
from capture.merging.merged_pictures import depth_m_of
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.scatter_reference import blur_layer
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from tests.support.blended_slices import all_in_focus

SIZE = (96, 128)
SLICES = 7
STEP_PX = 1.2


@pytest.fixture(scope="module")
def noisy() -> tuple[list[np.ndarray], np.ndarray]:
    """A slanted texture of low contrast in seven slices with 1 % shot noise, and the index at which each column is sharp."""
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.uniform(-1, 1, (128, 160, 3)).astype(np.float32), (0, 0), 0.8)
    rgb = np.clip(0.4 + 0.25 * grain, 0.02, 1.0)
    index = np.tile(np.linspace(1.0, 5.0, 160, dtype=np.float32), (128, 1))
    slices = []
    for i in range(SLICES):
        blurred = blur_layer(opaque(rgb, np.ones(index.shape, np.float32)), STEP_PX * (index - i), Aperture.disc(24))
        clean = (blurred.rgb / blurred.alpha[..., None])[16:-16, 16:-16]
        slices.append((rng.poisson(clean * 1e4) / 1e4).astype(np.float32))
    return slices, index[16:-16, 16:-16]


def test_averaging_slices_finds_depth_in_noise(noisy: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    import capture.merging.focus_volume as module

    slices, truth = noisy
    calm = np.abs(focus_map(focus_volume(slices), no_lights(SIZE)).focus_index - truth)
    monkeypatch.setattr(module, "CALM_NOISE_FLOORS", 1e-9)
    nervous = np.abs(focus_map(focus_volume(slices), no_lights(SIZE)).focus_index - truth)
    assert calm.mean() < 0.9 * nervous.mean()
    # Half a step is 0.6 px of blur, the least that this texture shows.
    assert np.median(calm) < 0.5


def test_energies_far_above_the_noise_are_kept() -> None:
    """Weights 1, 2, 1 have full effect on noise alone, none on energies a million times as large."""
    rng = np.random.default_rng(0)
    energies = rng.uniform(0.5, 1.5, (5, 20, 20)).astype(np.float32)
    energies[2, :, 10:] *= 1e6
    even = np.ones((20, 20), np.float32)
    volume = FocusVolume(energies=energies, noise=even, lights=np.zeros(energies.shape, np.uint8), shape=(40, 40), details=())
    calmed = volume.calmed()
    np.testing.assert_allclose(calmed[2, :, 10:], energies[2, :, 10:], rtol=1e-3)
    averaged = 0.25 * energies[0] + 0.5 * energies[1] + 0.25 * energies[2]
    np.testing.assert_allclose(calmed[1, :, :10], averaged[:, :10], rtol=0.01)


def test_a_volume_is_never_larger_than_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    import capture.merging.focus_volume as module

    monkeypatch.setattr(module, "LARGEST_VOLUME_BYTES", 4.0 * 3 * 96 * 128 / 9)
    rgb = np.random.default_rng(0).uniform(0, 1, (*SIZE, 3)).astype(np.float32)
    volume = focus_volume([rgb] * 3, count=3)
    assert volume.energies.shape == (3, 32, 43) and volume.energies.nbytes <= 1.02 * module.LARGEST_VOLUME_BYTES
    # In multiples of noise, which is the same at all sizes.
    ratio = volume.energies.mean() / focus_energy(rgb).mean()
    whole = np.stack([focus_energy(rgb)] * 3)
    assert ratio == pytest.approx(focus_volume([rgb] * 3, count=1).energies.mean() / whole.mean(), rel=0.3)
    assert volume.enlarged(volume.energies[0]).shape == SIZE


def test_where_a_slice_has_no_data_it_is_never_the_sharpest(noisy: tuple) -> None:
    slices, truth = noisy

    def valid(index: int) -> np.ndarray:
        return np.full(SIZE, index != 3)

    focus = focus_map(focus_volume(slices, valid), no_lights(SIZE))
    assert focus_volume(slices, valid).energies[3].max() == 0.0
    assert (np.abs(focus.focus_index - 3) < 0.4).mean() < 0.1 < (np.abs(truth - 3) < 0.4).mean()


def test_no_confidence_beside_what_is_saturated(noisy: tuple) -> None:
    slices, _ = noisy
    saturated = np.zeros(SIZE, bool)
    saturated[40:44, 60:64] = True
    volume = focus_volume(slices)
    with_veto, without = (focus_map(volume, no_lights(SIZE), mask).confidence for mask in (saturated, None))
    for beside in (np.s_[36:48, 60:64], np.s_[40:44, 56:68]):
        assert with_veto[beside].max() == 0.0 < without[beside].max()
    np.testing.assert_array_equal(with_veto[:30], without[:30])


def test_confidence_is_low_where_the_window_sees_two_surfaces() -> None:
    rng = np.random.default_rng(0)
    rgb = np.clip(0.4 + cv2.GaussianBlur(rng.uniform(-1, 1, (*SIZE, 3)).astype(np.float32), (0, 0), 0.8), 0.02, 1.0)
    index = np.ones(SIZE, np.float32)
    index[:, 64:] = 5.0
    slices = [blur_layer(opaque(rgb, np.ones(SIZE, np.float32)), 2.5 * (index - i), Aperture.disc(24)).rgb for i in range(SLICES)]
    focus = focus_map(focus_volume(slices), no_lights(SIZE))
    beside, away = focus.confidence[16:-16, 60:68], focus.confidence[16:-16, 16:50]
    assert beside.mean() < 0.5 * away.mean()


def test_depth_lies_between_slices_evenly_in_dioptres() -> None:
    index = np.array([[0.0, 0.5, 1.75]], np.float32)
    stack = FocalStack(Path(), tuple(Slice("", 1.0 / each) for each in (2.0, 1.0, 0.6)))
    depth_m = depth_m_of(stack, index)
    assert depth_m is not None
    np.testing.assert_allclose(1.0 / depth_m, [[2.0, 1.5, 0.7]], rtol=1e-6)
    assert depth_m_of(replace(stack, slices=(*stack.slices, Slice("", None))), index) is None


@pytest.mark.parametrize("crossover", [0.5, 0.8, 1.0])
def test_without_bands_the_blend_is_the_plain_sum(crossover: float) -> None:
    """A blend mixes square roots of light, in which noise is even."""
    rng = np.random.default_rng(0)
    slices = [rng.uniform(0, 2, (20, 30, 3)).astype(np.float32) for _ in range(4)]
    index = rng.uniform(0, 3, (20, 30)).astype(np.float32)
    plain = sum(slice_weight(index, i, crossover)[..., None] * np.sqrt(rgb) for i, rgb in enumerate(slices)) ** 2
    np.testing.assert_allclose(all_in_focus(slices, index, crossover, bands=0), plain, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sum(slice_weight(index, i, crossover) for i in range(4)), 1.0, atol=1e-6)


def test_a_blend_works_only_where_a_slice_counts() -> None:
    """Boxes around the weights give what the whole picture gives."""
    rng = np.random.default_rng(1)
    index = np.clip(np.linspace(-1.0, 4.0, 700), 0, 3).astype(np.float32)[None].repeat(90, axis=0)
    slices = [cv2.GaussianBlur(rng.uniform(0, 2, (90, 700, 3)).astype(np.float32), (0, 0), 3) for _ in range(4)]
    whole = BandBlend(index.shape)
    whole._box = lambda _: (slice(0, 90), slice(0, 700))  # type: ignore[method-assign]
    for i, rgb in enumerate(slices):
        whole.add(rgb, slice_weight(index, i))
    assert BandBlend(index.shape)._box(slice_weight(index, 0))[1].stop < 400
    np.testing.assert_allclose(all_in_focus(slices, index), whole.result(), atol=1e-6)


def test_slices_of_other_brightness_leave_no_seam() -> None:
    """Two slices of one even tone, one 10 % brighter: mixed pixel by pixel they meet in a step, in bands in a slope."""
    index = np.repeat(np.float32([[0.0] * 100 + [1.0] * 100]), 100, axis=0)
    slices = [np.full((100, 200, 3), each, np.float32) for each in (0.3, 0.33)]
    steps = [np.abs(np.diff(all_in_focus(slices, index, bands=bands), axis=1)).max() for bands in (0, BANDS)]
    assert steps[0] > 0.025 and steps[1] < 0.1 * steps[0]


def test_a_blend_stays_within_its_slices() -> None:
    """Beside a bright edge bands alone overshoot; the result never leaves what the slices show at a pixel."""
    rgb = np.full((64, 128, 3), 0.05, np.float32)
    rgb[:, 60:] = 4.0
    slices = [rgb, cv2.GaussianBlur(rgb, (0, 0), 4)]
    index = np.repeat(np.float32([[0.0] * 64 + [1.0] * 64]), 64, axis=0)
    blended = all_in_focus(slices, index)
    assert (blended <= np.maximum(*slices)).all() and (blended >= np.minimum(*slices)).all()


def test_noise_is_measured_at_every_brightness() -> None:
    """A dark bar with hardly any noise, sharp in slice 0, and in slice 1 defocused light with noise over it: the bar is in slice 0."""
    rng = np.random.default_rng(2)
    sharp = np.full((*SIZE, 3), 0.02, np.float32)
    sharp[:, :40] = sharp[:, 88:] = 0.5
    blurred = cv2.GaussianBlur(sharp, (0, 0), 16)
    noisy = [np.maximum(each + 0.02 * each * rng.standard_normal(each.shape), 0.0).astype(np.float32) for each in (sharp, blurred)]
    index = focus_map(focus_volume(noisy), no_lights(SIZE)).focus_index
    assert index[10:-10, 50:78].max() < 0.5


def test_little_noise_near_white_makes_no_blurred_slice_sharp() -> None:
    """Near white the noise has a sixteenth of the energy. Where a spread sky brightens a blurred slice, its wave has a quarter of the
    energy of the sharp one, however little noise is there."""
    rng = np.random.default_rng(4)
    wave = np.cos(2.0 * np.pi * np.arange(SIZE[1], dtype=np.float32) / 8.0)
    places = np.arange(SIZE[1])
    slices = []
    for grey, amplitude in ((0.45, 0.08), (0.9, 0.04)):
        level = np.where(places < 40, 0.45, np.where(places < 88, grey, 0.9))
        roots = level + np.where((places >= 40) & (places < 88), amplitude * wave, 0.0)
        noise = np.where(level < 0.7, 0.008, 0.002)[:, None] * rng.standard_normal((*SIZE, 3))
        slices.append(((roots[:, None] + noise) ** 2).astype(np.float32))
    volume = focus_volume(slices)
    sharp, blurred = volume.energies[:, 10:-10, 24:40].mean(axis=(1, 2))
    assert sharp / blurred == pytest.approx(4.0, rel=0.2)
    assert focus_map(volume, no_lights(SIZE)).focus_index[10:-10, 48:80].max() < 0.5


def test_close_slices_cross_over_all_the_way() -> None:
    """Up to 2 px from slice to slice both neighbours are within 1 px of sharp in the middle."""
    assert crossover_of(1.2) == crossover_of(2.0) == 1.0
    assert crossover_of(3.0) == pytest.approx(2 / 3)
    assert crossover_of(20.0) == 0.5
