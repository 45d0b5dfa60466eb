from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrbokeh.depth.open_depth import DepthSettings, read_number_map
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import read_depth, read_image, read_layer, write_image, write_layer, write_preview
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import write_stored
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels, layer_of
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused


def picture(highest: float = 1.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, highest, (13, 17, 3)).astype(np.float32)


def test_float_exr_is_lossless_and_keeps_highlights(tmp_path: Path) -> None:
    rgb = picture(5e4)
    write_image(tmp_path / "a.exr", rgb, half=False)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), rgb)


def test_half_exr_keeps_eleven_bits(tmp_path: Path) -> None:
    rgb = picture(100.0)
    write_image(tmp_path / "a.exr", rgb)
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), rgb, rtol=2.0**-11)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_integer_files_keep_sixteen_bits(tmp_path: Path, suffix: str, encoding: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_image(path, picture(), encoding)
    # Half a step of 16 bit; the sRGB curve is steepest at white, where a code is 2.27 times as wide in linear light.
    np.testing.assert_allclose(read_image(path, encoding), picture(), atol=2.28 * 0.5 / 65535 + 1e-6)


def test_jpeg_of_a_flat_colour(tmp_path: Path) -> None:
    flat = np.full((16, 16, 3), (0.2, 0.5, 0.8), np.float32)
    write_image(tmp_path / "a.jpg", flat)
    assert np.abs(linear_to_srgb(read_image(tmp_path / "a.jpg")) - linear_to_srgb(flat)).max() < 2.5 / 255


def test_encodings_are_not_mixed_up(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.full((4, 4, 3), 0.5, np.float32), "linear")
    np.testing.assert_allclose(read_image(tmp_path / "a.png", "srgb"), 0.21404, atol=1e-4)


def test_layer_round_trip_with_background_at_infinity(tmp_path: Path) -> None:
    alpha = np.zeros((5, 6), np.float32)
    alpha[1:3, 2:4] = 0.5
    depth_m = np.where(alpha > 0, 1.25, np.inf).astype(np.float32)
    layer = Layer(picture()[:5, :6] * alpha[..., None], alpha, depth_m)
    write_layer(tmp_path / "a.exr", layer, half=False)
    again = read_layer(tmp_path / "a.exr")
    for name in ("rgb", "alpha", "depth_m"):
        np.testing.assert_array_equal(getattr(again, name), getattr(layer, name))


def test_parts_keep_names_types_and_attributes(tmp_path: Path) -> None:
    plane = picture()[..., 0]
    write_exr(tmp_path / "a.exr", [ExrPart({"R": plane}, "colour"), ExrPart({"Z": plane.astype(np.float16)}, "depth", {"unit": "m"})])
    colour, depth = read_exr(tmp_path / "a.exr")
    assert (colour.name, depth.name, depth.attributes["unit"]) == ("colour", "depth", "m")
    assert (colour.channels["R"].dtype, depth.channels["Z"].dtype) == (np.float32, np.float16)


def test_real_multipart_exr_with_small_data_windows(shared_data: Path) -> None:
    """Beachball of openexr-images: ten parts whose data windows differ, all in one display window of 2048 x 1556."""
    parts = read_exr(shared_data / "rgbd" / "beachball_multi.0001.exr")
    assert len(parts) == 10
    assert {channel.shape for part in parts for channel in part.channels.values()} == {(1556, 2048)}
    depth = next(part for part in parts if part.name == "depth_left").channels["Z"]
    assert depth[245:1121, 688:1565].max() > 0 and depth[:245].max() == 0 and depth[:, :688].max() == 0


def test_real_single_part_layer(shared_data: Path) -> None:
    layer = read_layer(shared_data / "rgbd" / "beachball_single.0001.exr")
    assert np.isinf(layer.depth_m[layer.alpha == 0]).all()
    assert layer.depth_m.min() > 1.0


def test_a_layer_of_a_stereo_file_keeps_to_one_view(shared_data: Path) -> None:
    path = shared_data / "rgbd" / "beachball_multi.0001.exr"
    layer = read_layer(path)
    right = next(part for part in read_exr(path) if part.name == "depth_right").channels["Z"].astype(np.float32)
    seen = np.isfinite(layer.depth_m)
    assert seen.mean() > 0.1
    np.testing.assert_array_equal(layer.depth_m[seen], right[seen])


def test_highlights_of_real_files(shared_data: Path) -> None:
    assert read_image(shared_data / "hdr" / "golden_gate.exr").max() == pytest.approx(685.5, rel=1e-3)
    assert read_image(shared_data / "hdri" / "spiaggia_di_mondello_1k.hdr").max() == pytest.approx(72704.0)


def test_deep_exr_is_refused_with_advice(shared_data: Path) -> None:
    refused("flatten it first", read_exr, shared_data / "deep" / "balls_lowres.exr")


@pytest.mark.parametrize(("name", "content", "message"), [
    ("none.png", None, "no such file"),
    ("broken.png", b"not a picture", "damaged"),
    ("broken.exr", b"not a picture", "cannot be read as EXR"),
    ("notes.txt", b"words", "expected one of .exr"),
])  # fmt: skip
def test_bad_files_are_named(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_image(path)
    assert name in str(error.value)


def test_missing_channels_are_named() -> None:
    with pytest.raises(InputError, match=r"\['G', 'B'\] are missing"):
        ExrPart({"R": np.zeros((2, 2), np.float32)}).stacked("RGB")


def test_a_renderer_s_file_of_layers_is_no_single_picture(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", ExrPart({f"ViewLayer.Combined.{name}": picture()[..., 0] for name in "RGB"}))
    for read in (read_layer, read_image):
        refused(r"R, G and B, but it has ViewLayer.Combined.B, .*: write the picture with these names", read, tmp_path / "a.exr")


def test_a_failed_write_leaves_the_old_file_and_no_rest(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_image(path, picture())
    before = path.read_bytes()
    with pytest.raises(Exception):  # noqa: B017 - whatever the library raises for channels of two sizes
        write_exr(path, ExrPart({"R": np.zeros((2, 2), np.float32), "G": np.zeros((3, 3), np.float32)}))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_preview_is_an_8_bit_picture(tmp_path: Path) -> None:
    write_preview(tmp_path / "a.png", picture(3.0))
    assert read_image(tmp_path / "a.png").shape == (13, 17, 3)


def layer_file(path: Path, depth_m: np.ndarray) -> None:
    write_exr(path, ExrPart(dict.fromkeys("RGBA", np.ones_like(depth_m)) | {"Z": depth_m}))


@pytest.mark.parametrize(("nearest", "told"), [(99.0, False), (100.0, True)])
@pytest.mark.parametrize(
    ("name", "write", "read", "divided"),
    [
        ("depth.exr", lambda path, depth: write_exr(path, ExrPart({"Z": depth})), read_depth, "it"),
        (
            "steps.png",
            lambda path, depth: write_stored(path, (10 * depth).astype(np.uint16)),
            lambda path: read_number_map(path, DepthSettings(metres_per_unit=0.1)).depth_m,
            "the metres per step",
        ),
        ("layer.exr", layer_file, lambda path: layer_of(RenderChannels.read(path)).depth_m, "it"),
    ],
    ids=["depth", "numbers", "layer"],
)
def test_depth_of_files_is_doubted_where_nothing_is_nearer_than_100_m(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, write: Any, read: Any, divided: str, nearest: float, told: bool
) -> None:
    """0 is background and not near. Metres stay as they are; the sentence names the file and what to divide."""
    depth, path = np.array([[nearest, 500.0, 0.0]], np.float32), tmp_path / name
    write(path, depth)
    np.testing.assert_allclose(read(path), [[nearest, 500.0, np.inf]], rtol=1e-6)
    sentence = (
        f"warning: nothing in {path} is nearer than 100 m: is its depth in metres? If it is in millimetres, divide {divided} by 1000\n"
    )
    assert capsys.readouterr().err == (sentence if told else "")
