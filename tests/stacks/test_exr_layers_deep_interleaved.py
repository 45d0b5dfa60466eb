"""Deep pictures among other layers: whatever the order of arguments, depth says what hides what."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands.composite import app
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.shots.inputs import Moment
from mrbokeh.shots.layer_sources import AmongDeep, LayerFiles, sources_by_depth
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, cut_at, interleaved, merged, peeled
from tests.stacks.test_exr_layers_deep import Pixels, fog, point, random_pixels, write_deep
from tests.support.command_line import printed_by
from tests.support.deep_pixels_reference import DeepSample, flattened, tidied
from tests.support.refusals import refused

SIZE = (6, 9)


def sheet(depth_m: np.ndarray | float, alpha: np.ndarray | float = 1.0, grey: float = 0.3, size: tuple[int, int] = SIZE) -> Layer:
    coverage = np.broadcast_to(np.float32(alpha), size).copy()
    return Layer(
        np.repeat(grey * coverage[..., None], 3, axis=2).astype(np.float32),
        coverage,
        np.where(coverage > 0, np.float32(depth_m), np.float32(np.inf)).astype(np.float32),
    )


def deep(tmp_path: Path, pixels: Pixels, name: str = "deep.exr", size: tuple[int, int] = SIZE) -> DeepSamples:
    return DeepSamples.read(write_deep(tmp_path / name, size, pixels))


def test_together_they_are_the_deep_merge_of_all_samples(tmp_path: Path) -> None:
    """The plain twin: at each pixel all samples made tidy by OpenEXR's rules, the sheet as one more."""
    pixels, rng = random_pixels(3, SIZE), np.random.default_rng(5)
    # Depths off the grid of the samples: in one place there is no order to find.
    layer = sheet((rng.integers(8, 40, SIZE) / 8 + 0.05).astype(np.float32), rng.choice([0.0, 0.4, 1.0], SIZE).astype(np.float32))
    picture = flatten(interleaved([deep(tmp_path, pixels)], [layer]))
    for place in np.ndindex(*SIZE):
        red, green, blue = map(float, layer.rgb[place])
        own = DeepSample((red, green, blue), float(layer.alpha[place]), float(layer.depth_m[place]), float(layer.depth_m[place]))
        there = [*pixels.get(place, []), *([own] if layer.alpha[place] > 0 else [])]
        rgb, alpha = flattened(tidied(there))
        np.testing.assert_allclose(picture.rgb[place], rgb, atol=2e-5)
        assert picture.alpha[place] == pytest.approx(alpha, abs=2e-5)


def test_the_order_of_deep_pictures_does_not_matter(tmp_path: Path) -> None:
    one, other = (deep(tmp_path, random_pixels(seed, SIZE), f"{seed}.exr") for seed in (1, 2))
    first, second = interleaved([one, other], []), interleaved([other, one], [])
    np.testing.assert_allclose(flatten(first).rgb, flatten(second).rgb, atol=1e-5)
    np.testing.assert_allclose(flatten(first).rgb, flatten(peeled(merged([one, other]), 4, 0.02)).rgb, atol=1e-5)


def test_a_flat_layer_stays_whole_between_what_is_before_and_behind_it(tmp_path: Path) -> None:
    samples = deep(tmp_path, {(2, 3): [point(1.0, 0.5), point(5.0, 1.0)], (2, 8): [point(1.0, 0.5)]})
    layer = sheet(3.0)
    layer.alpha[:, 6:], layer.rgb[:, 6:], layer.depth_m[:, 6:] = 0.0, 0.0, np.inf
    front, middle, behind = interleaved([samples], [layer])
    assert middle is layer
    assert np.argwhere(front.alpha > 0).tolist() == [[2, 3], [2, 8]]  # beside the layer, but nearer than its depth there
    assert np.argwhere(behind.alpha > 0).tolist() == [[2, 3]] and behind.depth_m[2, 3] == pytest.approx(5.0)


def test_fog_is_cut_at_the_layer_that_stands_in_it(tmp_path: Path) -> None:
    """0.75 over 2 m, cut in the middle: 0.5 before and 0.5 behind, for 0.5 * 0.5 = 0.25 get through both."""
    samples = deep(tmp_path, {(1, 1): [fog(2.0, 4.0, 0.75)]})
    front, _, behind = interleaved([samples], [sheet(3.0)])
    assert front.alpha[1, 1] == pytest.approx(0.5) and behind.alpha[1, 1] == pytest.approx(0.5)
    halves = cut_at(samples, np.full(SIZE[0] * SIZE[1], 3.0))
    assert sorted(zip(halves.front_m, halves.back_m, strict=True)) == [(2.0, 3.0), (3.0, 4.0)]


def test_two_flat_layers_keep_their_order(tmp_path: Path) -> None:
    samples = deep(tmp_path, {(0, 0): [point(1.0, 1.0), point(2.5, 1.0), point(9.0, 1.0)]})
    near, far = sheet(2.0), sheet(3.0)
    found = interleaved([samples], [near, far])
    assert [layer is near or layer is far for layer in found] == [False, True, False, True, False]
    assert [round(float(layer.depth_m[0, 0]), 1) for layer in found] == [1.0, 2.0, 2.5, 3.0, 9.0]


def test_sizes_are_compared(tmp_path: Path) -> None:
    refused("4x4 px but the deep picture is 9x6 px", interleaved, [deep(tmp_path, {(0, 0): [point(1.0, 1.0)]})], [sheet(1.0, size=(4, 4))])
    refused("expected a deep picture", interleaved, [], [sheet(1.0)])


@pytest.mark.slow
def test_real_deep_pictures_by_the_command(shared_data: Path, tmp_path: Path) -> None:
    """Balls among trunks, in both orders of arguments, are the flat picture of all their samples.

    That it agrees with the composite that came with them is in test_exr_layers_deep.test_real_deep_files.
    """
    folder = shared_data / "deep"
    (truth,) = peeled(merged([DeepSamples.read(folder / f"{name}_lowres.exr") for name in ("balls", "trunks")]), 1, 1.0)
    height, width = truth.alpha.shape
    write_image(tmp_path / "black.exr", np.zeros((height, width, 3), np.float32))
    write_lens(tmp_path / "lens.json", Lens(50.0, 1000.0, 100.0, 36.0))
    pictures = []
    for names in (("balls", "trunks"), ("trunks", "balls")):
        out = tmp_path / f"{names[0]}.exr"
        layers = [word for name in names for word in ("--layer", str(folder / f"{name}_lowres.exr"))]
        printed_by(app, tmp_path / "black.exr", *layers, "--lens", tmp_path / "lens.json", "--out", out, "--mode", "front")
        pictures.append(read_layer(out, extra=True).extra)
    for picture in pictures:
        np.testing.assert_allclose(picture["sharp.G"][..., 0], truth.rgb[..., 1], atol=2e-3)
        np.testing.assert_allclose(picture["sharp.A"][..., 0], truth.alpha, atol=2e-3)


def test_a_deep_file_stands_behind_a_flat_one_that_is_nearer(tmp_path: Path) -> None:
    """By `mrbokeh composite`, the deep file given first."""
    size = (24, 36)
    write_deep(tmp_path / "deep.exr", size, {place: [point(4.0, 1.0, 0.5)] for place in np.ndindex(*size)})
    write_layer(tmp_path / "near.exr", sheet(2.0, grey=0.9, size=size), half=False)
    write_image(tmp_path / "photo.exr", np.zeros((*size, 3), np.float32))
    write_lens(tmp_path / "lens.json", Lens(50.0, 100.0, 2.0, 36.0))
    layers = ("--layer", tmp_path / "deep.exr", "--layer", tmp_path / "near.exr")
    printed_by(app, tmp_path / "photo.exr", *layers, "--lens", tmp_path / "lens.json", "--out", tmp_path / "out.exr")
    np.testing.assert_allclose(read_image(tmp_path / "out.exr")[8:-8, 8:-8], 0.9, atol=2e-3)


def test_clips_put_deep_files_among_others_too(tmp_path: Path) -> None:
    write_deep(tmp_path / "deep.exr", SIZE, {(2, 3): [point(1.0, 1.0), point(5.0, 1.0)]})
    write_layer(tmp_path / "flat.exr", sheet(3.0), half=False)
    files = [LayerFiles(tmp_path / name) for name in ("deep.exr", "flat.exr")]
    (described,) = sources_by_depth(files, ())
    assert isinstance(described, AmongDeep) and set(described.files) == {tmp_path / "deep.exr", tmp_path / "flat.exr"}
    moment, opened = Moment(0, 0.0, SIZE[::-1]), described.opened(1)
    layers = opened.layers_at(moment, None)
    assert [round(float(layer.depth_m[2, 3]), 1) for layer in layers] == [1.0, 3.0, 5.0]
    assert all(one is other for one, other in zip(layers, opened.layers_at(moment, None), strict=True))
    assert sources_by_depth(files[1:], ()) == (files[1],)
    refused("9x6 px but the clip is 8x6 px", opened.layers_at, Moment(0, 0.0, (8, 6)), None)
