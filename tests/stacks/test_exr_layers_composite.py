"""The layered EXR that we write: names and precision by which other programs know it, and that it reads back."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.exr_io import REC709, read_exr
from mrbokeh.images.image_io import read_depth, read_image
from mrbokeh.images.layer import Layer
from mrbokeh.stacks.exr_layers.composite_exr import CompositeLayers, write_composite_exr
from mrbokeh.stacks.exr_layers.render_channels import FlatRender
from tests.support.composite_exr_reader import read_composite_exr
from tests.support.refusals import refused

HEIGHT, WIDTH = 10, 14
SIZE = (HEIGHT, WIDTH)


def random(seed: int, *more: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 0.95, (*SIZE, *more)).astype(np.float32)


def layer(seed: int) -> Layer:
    depth_m = 1.0 + random(seed + 20)
    depth_m[0] = np.inf
    return Layer(random(seed, 3), random(seed + 10), depth_m)


def composite() -> CompositeLayers:
    layers = {"virtual": layer(1), "shadow": layer(2)}
    return CompositeLayers(random(0, 3), random(9), 2 * random(3), layers, random(4), 20 * random(5) - 10)


def test_names_and_precision_are_those_that_other_programs_expect(tmp_path: Path) -> None:
    write_composite_exr(tmp_path / "a.exr", composite())
    (part,) = read_exr(tmp_path / "a.exr")
    named = {f"{name}.{channel}" for name in ("virtual", "shadow") for channel in "RGBAZ"}
    assert part.channels.keys() == {*"RGBAZ", "matte.A", "coc.px"} | named
    float32 = {name for name, plane in part.channels.items() if plane.dtype == np.float32}
    assert float32 == {"Z", "coc.px", "virtual.Z", "shadow.Z"}
    for word in ("premultiplied", "metres along the optical axis", "not antialiased", "coc.px"):
        assert word in part.attributes["comments"]
    assert part.attributes["chromaticities"] == pytest.approx(REC709, abs=1e-6)


@pytest.mark.parametrize("half", [True, False])
def test_it_reads_back(tmp_path: Path, half: bool) -> None:
    written = composite()
    write_composite_exr(tmp_path / "a.exr", written, half=half)
    read = read_composite_exr(tmp_path / "a.exr")
    # Half has 11 bits.
    rtol = 2**-11 if half else 0.0
    assert list(read.layers) == ["virtual", "shadow"]
    pairs = [(read, written), *zip(read.layers.values(), written.layers.values(), strict=True)]
    for one, other in pairs:
        np.testing.assert_allclose(one.rgb, other.rgb, rtol=rtol)
        np.testing.assert_allclose(one.alpha, other.alpha, rtol=rtol)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
    np.testing.assert_allclose(read.matte, written.matte, rtol=rtol)
    np.testing.assert_array_equal(read.coc_px, written.coc_px)


def test_other_readers_find_picture_and_depth(tmp_path: Path) -> None:
    written = composite()
    write_composite_exr(tmp_path / "a.exr", written, half=False)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), written.rgb)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.exr"), written.depth_m)
    (picture,) = FlatRender().layers(tmp_path / "a.exr")
    np.testing.assert_array_equal(picture.rgb, written.rgb)


def test_what_is_not_there_is_not_written(tmp_path: Path) -> None:
    write_composite_exr(tmp_path / "a.exr", CompositeLayers(random(0, 3)))
    (part,) = read_exr(tmp_path / "a.exr")
    assert part.channels.keys() == set("RGBA") and (part.channels["A"] == 1).all()
    read = read_composite_exr(tmp_path / "a.exr")
    assert read.depth_m is None and read.matte is None and read.coc_px is None and not read.layers


def test_light_too_bright_for_half_stays_finite(tmp_path: Path) -> None:
    """65504 is the largest half; infinite light would spread over the whole picture in the next blur. Infinite depth is meant."""
    bright = CompositeLayers(np.full((*SIZE, 3), 1e6, np.float32), depth_m=np.full(SIZE, np.inf, np.float32))
    write_composite_exr(tmp_path / "a.exr", bright)
    assert read_image(tmp_path / "a.exr").max() == 65504.0
    assert np.isinf(read_depth(tmp_path / "a.exr")).all()
    write_composite_exr(tmp_path / "a.exr", bright, half=False)
    assert read_image(tmp_path / "a.exr").max() == 1e6


def test_what_does_not_fit_says_so() -> None:
    for name in ("0", "a.b", "two words", "", "matte", "coc", "1st"):
        refused("letters, digits and _", CompositeLayers, random(0, 3), layers={name: layer(1)})
    refused("virtual is 14x10 px but the picture is 14x5 px", CompositeLayers, random(0, 3)[:5], layers={"virtual": layer(1)})
    other = Path(__file__).parents[1] / "data" / "blender" / "render.0002.exr"
    refused("layered EXR of mrbokeh", read_composite_exr, other)
