"""Exposure differences within a stack: found in spite of blur, breathing, vignetting and lamps."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import affine_transform, gaussian_filter

from capture.photos.photo_metadata import StatedExposure
from capture.stacks.exposure import ExposureGain, fit_gain, gain_to_reference, low_frequency, overlap_gain
from capture.stacks.ingest import ingest
from tests.support.made_photographs import Picture, make_raw_photo, only_stack, scene_rgb


def refocused(rgb: Picture, focus: float, gain: float) -> Picture:
    """A slanted plane photographed with focus in 0 .. 1: blur up to 5 % of the width, breathing of 8 %, a vignette that
    grows with focus, saturation at 1 and a gain before it."""
    height, width = rgb.shape[:2]
    place = np.linspace(0.0, 1.0, width)[None, :, None]
    strips = 13
    blurred = np.zeros(rgb.shape)
    for index in range(strips):
        weight = np.clip(1.0 - np.abs(place * (strips - 1) - index), 0.0, 1.0)
        sigma_px = 0.0125 * width * abs(index / (strips - 1) - focus)
        blurred += gaussian_filter(rgb * weight, (sigma_px, sigma_px, 0.0), mode="constant")
    scale = 1.0 / (1.0 + 0.08 * focus)
    middle = np.array([height / 2.0, width / 2.0])
    matrix = np.diag([scale, scale])
    offset = middle - matrix @ (middle + 6.0 * focus)
    breathed = np.stack([affine_transform(blurred[..., each], matrix, offset, order=1, mode="reflect") for each in range(3)], axis=-1)
    y, x = np.mgrid[:height, :width]
    radius_squared = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width**2 / 4 + height**2 / 4)
    vignetted = breathed * (1.0 - (0.15 + 0.05 * focus) * radius_squared[..., None] ** 2)
    return np.minimum(vignetted * gain, 1.0).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "focus", "gain"), [(1, 0.25, 0.8), (2, 0.5, 1.3), (3, 0.75, 0.97), (1, 1.0, 0.55)])
def test_known_gains_are_found_within_a_percent(seed: int, focus: float, gain: float) -> None:
    """The first slice is the reference; blur, breathing, vignetting and lamps that saturate must not pass for exposure."""
    rgb = scene_rgb(240, 320, seed)
    reference, other = refocused(rgb, 0.0, 1.0), refocused(rgb, focus, gain)
    low, low_other = (low_frequency(each, np.any(each >= 1.0, axis=-1)) for each in (reference, other))
    found = fit_gain(low, low_other)
    assert found is not None and found.gain == pytest.approx(1.0 / gain, rel=0.01)


def test_gains_are_limited_and_small_ones_left_alone() -> None:
    rgb = np.minimum(scene_rgb(96, 128), 0.6)
    none_full = np.zeros(rgb.shape[:2], bool)

    def gain_of(factor: float, stated: float | None) -> ExposureGain:
        return gain_to_reference(low_frequency(rgb, none_full), low_frequency(rgb * np.float32(factor), none_full), stated)

    assert gain_of(1.005, None).total == 1.0  # within the error of measurement
    assert gain_of(0.5, 2.0).total == pytest.approx(2.0)  # metadata explain it
    assert gain_of(0.45, 2.0).total == pytest.approx(1 / 0.45, rel=0.01)  # and nearly do
    assert gain_of(0.25, 2.0).total == pytest.approx(2.0 * 1.26)  # a third of a stop on top, not more
    assert gain_of(0.25, 2.0).was_limited
    assert gain_of(0.25, None).total == pytest.approx(2.0)  # one stop where nothing was stated


def test_stated_exposure_is_evened_out(tmp_path: Path) -> None:
    """Half the exposure time, half the raw signal: the slices agree after a gain of 2."""
    rgb = gaussian_filter(np.minimum(scene_rgb(72, 96), 0.5), (1, 1, 0))
    make_raw_photo(tmp_path / "shoot" / "0.dng", rgb, 0.6)
    make_raw_photo(tmp_path / "shoot" / "1.dng", rgb, 0.8, Fraction(1, 120))
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    metadata = stack.slices[1].metadata
    assert metadata["exposure_gain"] == pytest.approx(2.0)
    assert metadata["exposure_gain_stated"] == pytest.approx(2.0)
    assert metadata["exposure_gain_measured"] == pytest.approx(2.0, rel=0.002)
    assert metadata["saturation_level"] == pytest.approx(2.0)
    assert stack.slice_rgb(1).mean(axis=(0, 1)) == pytest.approx(stack.slice_rgb(0).mean(axis=(0, 1)), rel=0.002)


def test_overlap_is_trusted_only_where_pictures_agree() -> None:
    """The same scene 3 % larger and 5 % aside at 0.6 of the light; another scene altogether; and a difference too small to tell."""
    rgb = np.minimum(scene_rgb(120, 160), 0.6)
    none_full = np.zeros(rgb.shape[:2], bool)
    matrix = np.diag([0.97, 0.97])
    moved = np.stack([affine_transform(rgb[..., each], matrix, [2.0, 8.0], order=1, mode="reflect") for each in range(3)], axis=-1)
    reference = low_frequency(rgb, none_full)
    assert overlap_gain(reference, low_frequency((moved * 0.6).astype(np.float32), none_full)) == pytest.approx(1 / 0.6, rel=0.01)
    assert overlap_gain(reference, low_frequency((moved * 0.98).astype(np.float32), none_full)) == 1.0
    assert overlap_gain(reference, low_frequency(np.minimum(scene_rgb(120, 160, 7), 0.6), none_full)) is None
    assert overlap_gain(reference, low_frequency(np.minimum(scene_rgb(120, 120), 0.6), np.zeros((120, 120), bool))) is None


@pytest.mark.parametrize(
    ("own", "other", "gain"),
    [
        ((0.01, 2.0), (0.02, 2.0), 2.0),
        ((0.01, 4.0), (0.01, 2.0), 4.0),  # two stops of aperture
        ((0.01, None), (0.04, None), 4.0),  # a lens without contacts stays as it is
        ((0.01, 2.0), (0.01, None), None),
    ],
)
def test_stated_exposures_compare(own: tuple[float, float | None], other: tuple[float, float | None], gain: float | None) -> None:
    assert StatedExposure(*own).gain_to(StatedExposure(*other)) == (None if gain is None else pytest.approx(gain))
