"""Deep EXR: samples are read, made tidy by OpenEXR's rules, and flattened by depth; laid over one another surfaces are the flat picture."""

import itertools
import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.exr_layers.composite_exr import write_deep_exr
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, DeepSurfaces, is_deep, merged, peeled
from mrbokeh.stacks.exr_layers.render_channels import LayerReader
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.errors import InputError
from tests.support.deep_pixels_reference import DeepSample, flattened, split, tidied
from tests.support.deep_pixels_reference import merged as merged_samples
from tests.support.refusals import refused

Pixels = dict[tuple[int, int], list[DeepSample]]


def write_deep(path: Path, size: tuple[int, int], pixels: Pixels, with_back: bool = True, **header: object) -> Path:
    """A deep EXR of samples by (row, column); float32 throughout."""
    names = ("R", "G", "B", "A", "Z", "ZBack") if with_back else ("R", "G", "B", "A", "Z")
    planes = {name: np.full(size, None, object) for name in names}
    for place, samples in pixels.items():
        rows = np.array([(*each.rgb, each.alpha, each.front_m, each.back_m) for each in samples], np.float32)
        for i, name in enumerate(names):
            planes[name][place] = np.ascontiguousarray(rows[:, i])
    part = OpenEXR.Part({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, **header}, planes, "deep")
    OpenEXR.File([part]).write(str(path))
    return path


def point(z_m: float, alpha: float, grey: float = 1.0) -> DeepSample:
    return DeepSample((grey * alpha, 0.5 * grey * alpha, 0.2), alpha, float(z_m), float(z_m))


def fog(front_m: float, back_m: float, alpha: float, grey: float = 1.0) -> DeepSample:
    return point(front_m, alpha, grey)._replace(back_m=float(back_m))


def random_pixels(seed: int, size: tuple[int, int]) -> Pixels:
    """Points and fog in no order, overlapping, some opaque, some without alpha; depths on a grid of 1/8 m so that they coincide too."""
    rng = np.random.default_rng(seed)
    pixels: Pixels = {}
    for place in np.ndindex(*size):
        samples = []
        for _ in range(rng.integers(0, 7)):
            front, thickness = rng.integers(8, 40) / 8, rng.choice([0, 0, 1, 5, 16]) / 8
            alpha = float(rng.choice([0.0, 1.0, rng.uniform(), rng.uniform()]))
            samples.append(fog(float(np.float32(front)), float(np.float32(front + thickness)), float(np.float32(alpha)), rng.uniform()))
        if samples:
            pixels[place] = samples
    return pixels


def flat_of(samples: DeepSamples) -> list[Layer]:
    """All samples laid over one another."""
    return peeled(samples, 1, 1.0)


def test_fog_cut_in_two_looks_the_same() -> None:
    """Beer-Lambert: transparency of parts multiplies; at half its length a fog of alpha 0.75 has 0.5, for 0.5 * 0.5 = 0.25."""
    whole = fog(1.0, 3.0, 0.75)
    front, back = split(whole, 2.0)
    assert front.alpha == pytest.approx(0.5) and back.alpha == pytest.approx(0.5)
    assert (front.front_m, front.back_m, back.front_m, back.back_m) == (1.0, 2.0, 2.0, 3.0)
    assert flattened([front, back])[0] == pytest.approx(whole.rgb) and flattened([front, back])[1] == pytest.approx(0.75)
    uneven = split(whole, 1.2)
    assert uneven[0].alpha == pytest.approx(1 - 0.25**0.1)
    assert flattened(uneven)[0] == pytest.approx(whole.rgb)
    # What is opaque stays so, however thin; light without alpha is shared out evenly.
    assert [each.alpha for each in split(fog(1, 2, 1.0), 1.5)] == [1.0, 1.0]
    assert [each.rgb[2] for each in split(fog(1, 2, 0.0), 1.25)] == pytest.approx([0.05, 0.15])


def test_samples_in_one_place_mix() -> None:
    """Two fogs in one place are as transparent as one after the other, in either order, and a hundred thin slices of both interleaved."""
    one, other = fog(1, 2, 0.6, 1.0), fog(1, 2, 0.3, 0.1)
    both = merged_samples([one, other])
    assert both.alpha == pytest.approx(1 - 0.4 * 0.7)
    assert merged_samples([other, one]).rgb == pytest.approx(both.rgb)
    thin = [[sample._replace(alpha=1 - (1 - sample.alpha) ** 1e-4) for sample in (one, other)] for _ in range(10000)]
    scaled = [
        piece._replace(rgb=tuple(c * piece.alpha / whole.alpha for c in whole.rgb))
        for pair in thin
        for piece, whole in zip(pair, (one, other), strict=True)
    ]
    assert flattened(scaled)[0] == pytest.approx(both.rgb, rel=1e-3)


def test_tidy_samples_are_sorted_and_do_not_overlap() -> None:
    tidy = tidied([fog(2, 4, 0.5), point(3, 0.4), fog(1, 3, 0.2), point(3, 0.1)], cuts_m=[3.5])
    assert [(each.front_m, each.back_m) for each in tidy] == [(1, 2), (2, 3), (3, 3), (3, 3.5), (3.5, 4)]
    # Transparencies multiply, whatever the order.
    assert flattened(tidy)[1] == pytest.approx(1 - 0.5 * 0.6 * 0.8 * 0.9)


@pytest.mark.parametrize("seed", [0, 1])
def test_surfaces_over_one_another_are_the_flat_picture(tmp_path: Path, seed: int) -> None:
    path = write_deep(tmp_path / "a.exr", (16, 16), random_pixels(seed, (16, 16)))
    samples = DeepSamples.read(path)
    (flat,) = flat_of(samples)
    for surfaces, apart in ((1, 0.02), (3, 0.02), (9, 1e-6)):
        again = flatten(peeled(samples, surfaces, apart))
        np.testing.assert_allclose(again.rgb, flat.rgb, atol=1e-6)
        np.testing.assert_allclose(again.alpha, flat.alpha, atol=1e-6)
    assert isinstance(DeepSurfaces(), LayerReader)


@pytest.mark.parametrize(("surfaces", "apart"), [(1, 0.1), (2, 0.1), (3, 1e-9), (4, 0.5)])
def test_compiled_surfaces_agree_with_plain_ones(tmp_path: Path, surfaces: int, apart: float) -> None:
    size = (6, 9)
    pixels = random_pixels(5, size)
    layers = peeled(DeepSamples.read(write_deep(tmp_path / "a.exr", size, pixels)), surfaces, apart)
    assert len(layers) == surfaces
    for place, samples in pixels.items():
        piles: list[list[DeepSample]] = [[]]
        for sample in tidied(samples):
            if piles[-1] and len(piles) < surfaces and sample.front_m > piles[-1][0].front_m * (1 + apart):
                piles.append([])
            piles[-1].append(sample)
        for layer, pile in itertools.zip_longest(layers, piles, fillvalue=[]):
            rgb, alpha = flattened(pile)
            np.testing.assert_allclose(layer.rgb[place], rgb, atol=2e-6)
            assert layer.alpha[place] == pytest.approx(alpha, abs=2e-6)


def test_a_receding_surface_stays_whole(tmp_path: Path) -> None:
    """An opaque card from 1 to 3 m, focus 1.5 m: blurred as one layer it is opaque inside."""
    height, width = 40, 120
    depths_m = np.linspace(1.0, 3.0, 100)
    pixels = {(y, 10 + x): [point(z, 1.0)] for y in range(5, 35) for x, z in enumerate(depths_m)}
    path = write_deep(tmp_path / "a.exr", (height, width), pixels)
    lens, inside = Lens(50.0, 1.4, 1.5, 36.0), np.s_[15:25, 30:90]
    renderer = PolygonDifferences()
    whole = renderer.render(DeepSurfaces().layers(path), lens).alpha[inside].min()
    assert len(DeepSurfaces().layers(path)) == 1
    assert whole > 0.99


def test_silhouettes_before_something_have_both_surfaces(tmp_path: Path) -> None:
    """A near card whose edge half covers a pixel: there the wall behind is known, elsewhere it is hidden or first itself."""
    pixels = {
        (0, 0): [point(1, 1.0)],
        (0, 1): [point(1, 0.5), point(3, 1.0)],
        (0, 2): [point(3, 1.0)],
        (0, 3): [point(1, 0.2), point(1.01, 0.5)],
    }
    first, second = DeepSurfaces().layers(write_deep(tmp_path / "a.exr", (1, 4), pixels))
    np.testing.assert_allclose(first.alpha, [[1.0, 0.5, 1.0, 0.6]], rtol=1e-6)
    np.testing.assert_allclose(first.depth_m[0, :3], [1, 1, 3])
    np.testing.assert_allclose(second.alpha, [[0, 1, 0, 0]])


def test_depth_is_the_mean_in_dioptres_of_what_is_seen(tmp_path: Path) -> None:
    """alpha 0.5 at 1 m before opaque at 2 m: half and half of 1 and 0.5 dioptres, 4/3 m. Hidden things do not count, fog by its middle."""
    pixels = {
        (0, 0): [point(2, 1.0), point(1, 0.5)],
        (0, 1): [point(1, 1.0), point(2, 1.0)],
        (0, 2): [fog(1, 3, 0.5)],
        (1, 0): [DeepSample((1.0, 0.0, 0.0), 0.0, 4.0, 4.0)],
    }
    (layer,) = flat_of(DeepSamples.read(write_deep(tmp_path / "a.exr", (2, 3), pixels)))
    np.testing.assert_allclose(layer.depth_m, [[4 / 3, 1.0, 2.0], [4.0, np.inf, np.inf]], rtol=1e-6)
    # Light without alpha has a place too.
    assert layer.alpha[1, 0] == 0 and layer.rgb[1, 0, 0] == 1


def test_windows_and_parts(tmp_path: Path) -> None:
    """The data window is placed in the display window and what lies outside it is cut off."""
    window = {"dataWindow": (np.array([2, -1], np.int32), np.array([4, 1], np.int32))}
    display = {"displayWindow": (np.array([0, 0], np.int32), np.array([3, 2], np.int32))}
    pixels = {(y, x): [point(1 + y, 1.0, x)] for y, x in np.ndindex(3, 3)}
    samples = DeepSamples.read(write_deep(tmp_path / "a.exr", (3, 3), pixels, **window, **display))
    (layer,) = flat_of(samples)
    assert layer.alpha.shape == (3, 4)
    np.testing.assert_array_equal(layer.alpha, [[0, 0, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0]])
    np.testing.assert_allclose(layer.depth_m[:2, 2:], [[2, 2], [3, 3]])
    np.testing.assert_allclose(layer.rgb[0, 2:, 0], [0, 1])


def test_what_cannot_be_read_says_so(tmp_path: Path) -> None:
    refused("there is none", DeepSamples.read, tmp_path / "none.exr")
    (tmp_path / "bad.exr").write_bytes(b"bad")
    refused("cannot be read as EXR", DeepSamples.read, tmp_path / "bad.exr")
    refused("cannot be read as EXR", is_deep, tmp_path / "bad.exr")
    with pytest.raises(InputError, match="1 deep samples have NaN"):
        DeepSamples.read(write_deep(tmp_path / "nan.exr", (1, 1), {(0, 0): [point(1, 0.5), point(math.nan, 0.5)]}))
    flat = write_deep(tmp_path / "noz.exr", (1, 1), {(0, 0): [point(1, 0.5)]})
    with OpenEXR.File(str(flat), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.parts[0].channels.items() if name != "Z"}
        OpenEXR.File([OpenEXR.Part({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}, channels, "d")]).write(
            str(tmp_path / "z.exr")
        )
    refused("Z are missing", DeepSamples.read, tmp_path / "z.exr")


def test_a_sequence_of_deep_files_is_read_as_such(tmp_path: Path) -> None:
    for frame in (1, 2):
        write_deep(tmp_path / f"deep.{frame:04d}.exr", (1, 1), {(0, 0): [point(1, 0.5), point(3, 0.5, frame)]}, with_back=False)
    found = ExrSequence.of(tmp_path)
    assert [len(found.layers(frame)) for frame in found.frames] == [2, 2]


@pytest.mark.slow
def test_real_deep_files(shared_data: Path) -> None:
    """Balls and Trunks are two of the four deep layers whose composite lies beside them (openexr-images, LowResLeftView).

    What more layers can do: alpha only grows, and where both others are hidden behind the two or absent nothing changes, so that
    a part of the picture has to agree to the precision of half floats. Either file laid over the other as a whole must not.
    """
    folder = shared_data / "deep"
    balls, trunks = (DeepSamples.read(folder / f"{name}_lowres.exr") for name in ("balls", "trunks"))
    both = merged([balls, trunks])
    assert both.starts[-1] == balls.starts[-1] + trunks.starts[-1] == 212029
    (flat,) = flat_of(both)
    # The composite's data window lacks one pixel at each border.
    inner = np.s_[1:-1, 1:-1]
    truth = read_exr(folder / "composited_lowres.exr")[0].stacked("RGBA")[inner]
    ours = np.dstack([flat.rgb, flat.alpha])[inner]
    assert (truth[..., 3] - ours[..., 3]).min() > -2e-3
    is_same = np.abs(truth - ours).max(axis=2) < 1e-3
    covered = ours[..., 3] > 0.999
    assert is_same[covered].mean() > 0.4
    meeting = (flat_of(balls)[0].alpha[inner] > 0.1) & (flat_of(trunks)[0].alpha[inner] > 0.1)
    assert is_same[meeting].sum() > 500
    trunks_first = flatten([flat_of(trunks)[0], flat_of(balls)[0]])
    wrong = np.abs(truth - np.dstack([trunks_first.rgb, trunks_first.alpha])[inner]).max(axis=2)
    assert (wrong[meeting & is_same] > 1e-3).all()
    again = flatten(DeepSurfaces().layers(folder / "balls_lowres.exr"))
    np.testing.assert_allclose(again.rgb, flat_of(balls)[0].rgb, atol=1e-6)


@pytest.mark.parametrize("half", [True, False])
def test_layers_written_deep_flatten_to_the_same(tmp_path: Path, half: bool) -> None:
    """Three layers at depths of their own, one of them light without alpha; a corner is empty."""
    rng = np.random.default_rng(2)
    layers = []
    for depth in (1.0, 2.0, 4.0):
        alpha = rng.uniform(0, 1, (9, 11)).astype(np.float32) * (rng.uniform(size=(9, 11)) < 0.6)
        alpha[0] = 0.0
        rgb = alpha[..., None] * rng.uniform(0, 1, (9, 11, 3)).astype(np.float32)
        layers.append(Layer(rgb, alpha, np.where(alpha > 0, depth, np.inf).astype(np.float32)))
    flame = Layer(np.zeros((9, 11, 3), np.float32), np.zeros((9, 11), np.float32), np.full((9, 11), 3.0, np.float32))
    flame.rgb[4, 4] = 7.0
    written = [*layers[:2], flame, layers[2]]
    write_deep_exr(tmp_path / "a.exr", written, half=half)
    samples = DeepSamples.read(tmp_path / "a.exr")
    assert samples.starts[-1] == sum(int((layer.alpha > 0).sum()) for layer in layers) + 1
    assert samples.counts[:11].max() == 0
    flat, (read,) = flatten(written), flat_of(samples)
    tolerance = 2**-10 if half else 1e-6
    np.testing.assert_allclose(read.rgb, flat.rgb, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(read.alpha, flat.alpha, atol=tolerance)
    for wrong in ([], [layers[0], Layer(flame.rgb[:3], flame.alpha[:3], flame.depth_m[:3])]):
        refused("layers of one size", write_deep_exr, tmp_path / "b.exr", wrong)


def test_only_pictures_of_one_size_are_merged(tmp_path: Path) -> None:
    one, other = (DeepSamples.read(write_deep(tmp_path / f"{w}.exr", (1, w), {(0, 0): [point(1, 0.5)]})) for w in (1, 2))
    refused("one size", merged, [one, other])
