"""Light field samples: what they are, where they lie, and their files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.layering.light_field_samples import CHANNELS, LightFieldSamples, joined, read_samples
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from tests.support.light_field_files import write_samples
from tests.support.refusals import refused
from tests.support.sampled_planes import LENS, Plane, even, fence_scene, sample_planes, waves

SIZE_PX = 16


@pytest.fixture(name="samples")
def fixture_samples() -> LightFieldSamples:
    return sample_planes(fence_scene(SIZE_PX), SIZE_PX, 4)


def test_samples_lie_where_the_middle_of_the_lens_sees_them_with_the_blur_of_their_pixel(samples: LightFieldSamples) -> None:
    """The colour of each sample is the texture there: with the wrong sign of coc, uv or motion it is not."""
    texture = waves(7.0)
    moving = sample_planes([Plane(texture, -9.0, motion_px=(5.0, -3.0))], 32, 4)
    at = moving.positions_at_lens_centre_px(LENS).astype(np.float64)
    np.testing.assert_allclose(moving.rgb, texture(at[:, 0], at[:, 1]), atol=1e-4)
    tilted = Lens(50.0, 0.7, 0.5, 12.0, tilt_rad=(0.05, 0.0))
    flat = replace(samples, depth_m=np.full(samples.count, 0.6, np.float32))
    picture = tilted.coc_px(np.full((SIZE_PX, SIZE_PX), 0.6), SIZE_PX)
    x, y = flat.pixels()
    np.testing.assert_allclose(flat.coc_px(tilted), picture[y, x], rtol=1e-4, atol=1e-4)


def test_the_raw_picture_is_the_mean_of_each_pixel_and_joined_samples_are_all_of_them(samples: LightFieldSamples) -> None:
    samples = sample_planes([Plane(even(0.3))], 8, 4)
    np.testing.assert_allclose(samples.raw_picture(), 0.3, rtol=1e-6)
    one = replace(samples, rgb=np.where((samples.pixels()[0] == 3)[:, None], samples.rgb, 0).astype(np.float32))
    np.testing.assert_allclose(one.raw_picture()[..., 0], np.where(np.arange(8) == 3, 0.3, 0.0)[None].repeat(8, 0), rtol=1e-6)
    both = joined([samples, samples])
    assert both.count == 2 * samples.count and both.per_pixel == 8.0
    np.testing.assert_array_equal(both.raw_picture(), samples.raw_picture())
    refused("one picture", joined, [samples, replace(samples, width_px=SIZE_PX + 1)])


@pytest.mark.parametrize(("name", "value", "says"), [
    ("rgb", np.nan, "rgb .* finite"), ("depth_m", 0.0, "positive metres"), ("depth_m", np.nan, "positive metres"),
    ("xy_px", -3.0, "within the picture"), ("xy_px", 17.0, "within the picture"), ("time", 24.0, "divide it by the exposure"),
    ("lens_uv", 12.5, "unit pupil"), ("motion_px", np.inf, "motion_px .* finite"),
])  # fmt: skip
def test_what_cannot_be_is_refused(samples: LightFieldSamples, name: str, value: float, says: str) -> None:
    wrong = getattr(samples, name).copy()
    wrong[5] = value
    refused(says, replace, samples, **{name: wrong})
    with pytest.raises((InputError, TypeError)):  # jaxtyping's own check, where it runs, comes first
        replace(samples, **{name: getattr(samples, name)[:-1]})
    none = [np.zeros((0, 2) if width == 2 else (0, 3) if width == 3 else 0, np.float32) for width in (2, 2, 1, 3, 1, 2)]
    refused("at least one", LightFieldSamples, 4, 4, *none)


def test_an_archive_and_exr_keep_every_bit_whatever_the_order(samples: LightFieldSamples, tmp_path: Path) -> None:
    samples.depth_m[7] = np.inf
    write_samples(tmp_path / "samples.npz", samples)
    read = read_samples(tmp_path / "samples.npz")
    assert (read.width_px, read.height_px) == (SIZE_PX, SIZE_PX)
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(read, name), getattr(samples, name))
    # Sorted by pixel; within a pixel in the order in which they came. One pixel has a sample less than the others.
    samples.depth_m[7] = np.inf
    order = np.random.default_rng(3).permutation(samples.count)[:-1]
    shuffled = LightFieldSamples(SIZE_PX, SIZE_PX, *(getattr(samples, name)[order] for name in _FIELDS))
    write_samples(tmp_path / "samples.exr", shuffled)
    read = read_samples(tmp_path / "samples.exr")
    x, y = shuffled.pixels()
    by_pixel = np.argsort(y * SIZE_PX + x, kind="stable")
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(read, name), getattr(shuffled, name)[by_pixel])
    assert [part.name for part in read_exr(tmp_path / "samples.exr")] == ["sample00", "sample01", "sample02", "sample03"]


def test_files_that_hold_no_samples_are_cut_short_or_of_the_future_say_so(samples: LightFieldSamples, tmp_path: Path) -> None:
    refused("no such file", read_samples, tmp_path / "none.npz")
    refused(r"\.npz or \.exr", read_samples, tmp_path / "samples.csv")
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    refused("cannot be read", read_samples, tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", picture=np.zeros(3))
    refused("are missing", read_samples, tmp_path / "other.npz")
    write_exr(tmp_path / "picture.exr", ExrPart({"R": np.zeros((4, 4), np.float32)}))
    refused("sample00", read_samples, tmp_path / "picture.exr")
    ones = np.ones((4, 4), np.float32)
    write_exr(tmp_path / "half.exr", [ExrPart({"R": ones, "Z": ones}, f"sample0{k}") for k in (0, 1)])
    refused(r"missing", read_samples, tmp_path / "half.exr")
    write_samples(tmp_path / "samples.npz", samples)
    whole = (tmp_path / "samples.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    refused(r"cut\.npz", read_samples, tmp_path / "cut.npz")
    arrays = {name: getattr(samples, name) for name in CHANNELS}
    np.savez(tmp_path / "new.npz", version=2, width_px=SIZE_PX, height_px=SIZE_PX, **arrays)
    refused("version 2", read_samples, tmp_path / "new.npz")


_FIELDS = ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")


def test_motion_points_up_in_files(tmp_path: Path) -> None:
    """forward.v counts upwards in EXR files, as in those of renderers; here y goes down."""
    one = ([[0.5, 0.5]], [[0.0, 0.0]], [0.5], [[1.0, 1.0, 1.0]], [2.0], [[3.0, 4.0]])
    samples = LightFieldSamples(1, 1, *(np.array(values, np.float32) for values in one))
    write_samples(tmp_path / "one.exr", samples)
    channels = read_exr(tmp_path / "one.exr")[0].channels
    assert (channels["forward.u"][0, 0], channels["forward.v"][0, 0]) == (3.0, -4.0)
    np.testing.assert_array_equal(read_samples(tmp_path / "one.exr").motion_px, samples.motion_px)
