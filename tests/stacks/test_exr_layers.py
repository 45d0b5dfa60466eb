"""Renders of other programs as layers: known names, parts, eyes, numbered files and their gaps."""

import json
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import camera_from_json
from mrbokeh.stacks.exr_layers.cryptomatte import ObjectSplit
from mrbokeh.stacks.exr_layers.render_channels import FlatRender, LayerReader, RenderChannels
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

HEIGHT, WIDTH = 12, 16
# Rendered by Blender 4.2.23 (Cycles, 80x56 px, pixels 1.2 times as tall as wide) of a red cube in motion before a green ball;
# exported by mrbokeh/hosts/blender.py.
BLENDER = Path(__file__).parents[1] / "data" / "blender"


def plane(value: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), value, np.float32)


def colours(prefix: str, *values: float) -> dict[str, np.ndarray]:
    return {f"{prefix}{name}": plane(value) for name, value in zip("RGBA", values, strict=False)}


def written(path: Path, *parts: ExrPart | dict[str, np.ndarray]) -> Path:
    write_exr(path, [part if isinstance(part, ExrPart) else ExrPart(part) for part in parts])
    return path


@pytest.mark.parametrize(
    ("layer", "depth"),
    [
        ("", "Z"),
        ("", "depth.Z"),
        ("", "Pz"),
        ("ViewLayer.Combined.", "ViewLayer.Depth.Z"),
        ("C.", "Pz"),
        ("C.", "C.Z"),
        ("beauty.", "depth.Z"),
    ],
)
def test_known_names_are_found(tmp_path: Path, layer: str, depth: str) -> None:
    path = written(tmp_path / "a.exr", colours(layer, 0.1, 0.2, 0.3, 0.5) | {depth: plane(3.0)} | colours("ViewLayer.DiffDir.", 9, 9, 9))
    (read,) = FlatRender().layers(path)
    np.testing.assert_array_equal(read.rgb[0, 0], np.float32([0.1, 0.2, 0.3]))
    assert (read.alpha == 0.5).all() and (read.depth_m == 3.0).all()
    assert isinstance(FlatRender(), LayerReader)


def test_the_unnamed_layer_goes_before_named_ones(tmp_path: Path) -> None:
    channels = colours("", 0.1, 0.1, 0.1) | colours("C.", 0.2, 0.2, 0.2) | colours("spec.", 0.3, 0.3, 0.3) | {"Z": plane(1.0)}
    read = FlatRender().layers(written(tmp_path / "a.exr", channels))[0]
    assert read.rgb[0, 0, 0] == np.float32(0.1) and (read.alpha == 1.0).all(), "without A a layer is opaque"


def test_what_could_be_meant_twice_is_refused(tmp_path: Path) -> None:
    two = colours("ViewLayer.Combined.", 0.1, 0.1, 0.1) | colours("Other.Combined.", 0.2, 0.2, 0.2)
    path = written(tmp_path / "a.exr", two | {"Other.Depth.Z": plane(2.0), "ViewLayer.Depth.Z": plane(5.0)})
    with pytest.raises(InputError, match=r"any of the layers Other\.Combined, ViewLayer\.Combined.*without a layer's name"):
        FlatRender().layers(path)
    # Depth is taken from beside the colour.
    render = RenderChannels.read(path)
    assert (render.depth_name("Other.Combined"), render.depth_name("ViewLayer.Combined")) == ("Other.Depth.Z", "ViewLayer.Depth.Z")


def test_missing_colour_or_depth_lists_what_is_there(tmp_path: Path) -> None:
    path = written(tmp_path / "a.exr", colours("N.", 0, 0, 1) | {"Z": plane(1.0)})
    with pytest.raises(InputError, match=r"expected R, G and B, but it has N\.B, N\.G, N\.R, Z"):
        FlatRender().layers(path)
    path = written(tmp_path / "b.exr", colours("", 0, 0, 1) | {"W": plane(1.0)})
    with pytest.raises(InputError, match=r"expected depth in a channel Z, depth\.Z.*but it has B, G, R, W"):
        FlatRender().layers(path)


def test_parts_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """Arnold and others write one part per layer, each with plain R, G and B, in any order."""
    parts = [
        ExrPart(colours("", 0.3, 0.3, 0.3), "diffuse"),
        ExrPart(colours("", 0.1, 0.1, 0.1, 0.5), "RGBA"),
        ExrPart({"Z": plane(4.0)}, "depth"),
    ]
    path = written(tmp_path / "a.exr", *parts)
    (read,) = FlatRender().layers(path)
    assert read.rgb[0, 0, 0] == np.float32(0.1) and read.alpha[0, 0] == 0.5 and read.depth_m[0, 0] == 4.0
    assert RenderChannels.read(path).plane("diffuse.R")[0, 0] == np.float32(0.3)
    two = written(tmp_path / "b.exr", ExrPart(colours("", 1, 1, 1), "diffuse"), ExrPart(colours("", 2, 2, 2), "specular"))
    with pytest.raises(InputError, match="expected R, G and B"):
        FlatRender().layers(two)


def test_light_without_alpha_is_kept_with_its_depth(tmp_path: Path) -> None:
    """A flame adds light and covers nothing: premultiplied colour above alpha is legal and stays; so does its place."""
    flame = colours("", 5.0, 2.0, 0.5, 0.0) | {"Z": plane(2.5)}
    (read,) = FlatRender().layers(written(tmp_path / "a.exr", flame))
    assert read.rgb[0, 0, 0] == 5.0 and read.alpha[0, 0] == 0.0 and read.depth_m[0, 0] == 2.5
    (empty,) = FlatRender().layers(written(tmp_path / "b.exr", colours("", 0, 0, 0, 0) | {"Z": plane(2.5)}))
    assert np.isinf(empty.depth_m).all()


@pytest.mark.parametrize("far", [1e10, np.inf, 0.0])
def test_background_is_infinite(tmp_path: Path, far: float) -> None:
    path = written(tmp_path / "a.exr", colours("", 1, 1, 1) | {"Z": plane(far)})
    assert np.isinf(FlatRender().layers(path)[0].depth_m).all()


def test_negative_depth_is_background_beside_others_and_where_nothing_is_seen(tmp_path: Path) -> None:
    """-1 as some programs mark the sky. Where all that is seen is negative, it is distance along -z, and refused."""
    channels = colours("", 1, 1, 1) | {"Z": plane(-1.0)}
    with pytest.raises(InputError, match="turn the sign"):
        FlatRender().layers(written(tmp_path / "a.exr", channels))
    channels["Z"][0, 0] = 2.0
    assert np.isinf(FlatRender().layers(written(tmp_path / "b.exr", channels))[0].depth_m).sum() == channels["Z"].size - 1
    unseen = colours("", 0, 0, 0, 0) | {"Z": plane(-1.0)}
    assert np.isinf(FlatRender().layers(written(tmp_path / "c.exr", unseen))[0].depth_m).all()


def test_edges_take_the_depth_of_what_covers_them(tmp_path: Path) -> None:
    """Z is one ray's: where it passed by, a partly covered pixel has the background's depth and would be blurred as that."""
    channels = colours("", 0.5, 0.5, 0.5, 0.5) | {"Z": plane(1e10)}
    channels["Z"][:, :4] = 2.0
    channels["A"][:, :4] = 1.0
    channels["A"][:, 10:] = 1.0
    (read,) = FlatRender().layers(written(tmp_path / "a.exr", channels))
    # Beside the wall the pixel is the wall's; farther away, and where the sky is opaque, nothing is known and stays.
    assert (read.depth_m[:, :5] == 2.0).all() and np.isinf(read.depth_m[:, 5:]).all()
    channels["A"][:, 4] = 1.0
    assert np.isinf(FlatRender().layers(written(tmp_path / "a.exr", channels))[0].depth_m[:, 4]).all()


def test_nan_is_refused(tmp_path: Path) -> None:
    broken = colours("", 1, 1, 1) | {"Z": plane(1.0)}
    for name, what in (("R", "colour"), ("Z", "Z")):
        bad = {**broken, name: broken[name].copy()}
        bad[name][3, 4] = np.nan
        with pytest.raises(InputError, match=f"{what} is NaN in 1 place"):
            FlatRender().layers(written(tmp_path / "a.exr", bad))


def test_it_reads_what_we_write(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    alpha = rng.uniform(0.1, 1, (HEIGHT, WIDTH)).astype(np.float32)
    layer = Layer(rng.uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32), alpha, rng.uniform(1, 9, (HEIGHT, WIDTH)).astype(np.float32))
    write_layer(tmp_path / "a.exr", layer, half=False)
    for read in (FlatRender().layers(tmp_path / "a.exr")[0], read_layer(tmp_path / "a.exr")):
        for name in ("rgb", "alpha", "depth_m"):
            np.testing.assert_array_equal(getattr(read, name), getattr(layer, name))


def test_depth_of_blender_lies_where_its_camera_sees_the_cube() -> None:
    """Blender 4.2: the face towards the camera, y = -0.2 there, is at z = -0.2 in our axes; Z is that of one ray within the pixel."""
    (layer,) = FlatRender().layers(BLENDER / "render.0002.exr")
    camera = camera_from_json(json.loads((BLENDER / "camera_track.json").read_text())["frames"][1]["camera"])
    cube = (layer.rgb[..., 0] > 0.7) & (layer.alpha == 1)
    seen = camera.unproject(camera.pixel_centres_px(), np.where(cube, layer.depth_m, 1.0).astype(np.float64))
    assert (cube & (np.abs(seen[..., 2] + 0.2) < 3e-3)).sum() > 120


def test_blender_5_writes_a_part_for_each_layer() -> None:
    """Blender 5.0.1, 64x48 px: a grey cube at rest; depth and Cryptomatte are in parts of their own."""
    path = BLENDER / "parts.0001.exr"
    (layer,) = FlatRender().layers(path)
    assert layer.alpha.shape == (48, 64) and layer.alpha.max() == 1.0
    # The camera is at y = -2 and z = 0.5, the cube's face towards it at y = 0.75.
    assert layer.depth_m.min() == pytest.approx(2.75, abs=0.06)
    cube, rest = ObjectSplit(("Cube",)).layers(path)
    np.testing.assert_allclose(cube.alpha, layer.alpha, atol=1e-6)
    assert rest.alpha.max() < 1e-6


def test_what_blenders_compositor_made_is_not_the_render(tmp_path: Path) -> None:
    """Blender 4.5 saves Composite.Combined beside the view layer, which alone has depth; of two view layers none is chosen."""
    rgb, depth_m = {name: np.full((4, 6), 0.25, np.float32) for name in "RGBA"}, np.full((4, 6), 3.0, np.float32)
    planes = {f"ViewLayer.Combined.{name}": values for name, values in rgb.items()} | {"ViewLayer.Depth.Z": depth_m}
    planes |= {f"Composite.Combined.{name}": 2 * values for name, values in rgb.items()}
    write_exr(tmp_path / "render.exr", ExrPart(planes))
    (layer,) = FlatRender().layers(tmp_path / "render.exr")
    assert (layer.rgb == 0.25).all() and (layer.depth_m == 3.0).all()
    write_exr(tmp_path / "two.exr", ExrPart(planes | {"Composite.Depth.Z": depth_m}))
    refused("could be any of the layers", FlatRender().layers, tmp_path / "two.exr")


@pytest.mark.parametrize("name", ["multi", pytest.param("single", marks=pytest.mark.slow)])
def test_eyes_of_stereo_files(shared_data: Path, name: str) -> None:
    """The same frame as 10 parts with data windows of their own and as one part whose channels name the eye; the default eye is right."""
    right = FlatRender().layers(shared_data / "rgbd" / f"beachball_{name}.0001.exr")[0]
    same = FlatRender().layers(shared_data / "rgbd" / f"beachball_{'single' if name == 'multi' else 'multi'}.0001.exr")[0]
    for field in ("rgb", "alpha", "depth_m"):
        np.testing.assert_array_equal(getattr(right, field), getattr(same, field))
    # The data window begins at x = 654 in the right eye and at 688 in the left (header).
    assert 654 <= np.flatnonzero(right.alpha.any(axis=0))[0] < 688


def test_an_eye_does_not_take_the_depth_of_the_other(tmp_path: Path) -> None:
    """Multi-View OpenEXR: channels without a layer are the default eye's; layers without an eye belong to all."""
    channels = colours("", 0.1, 0.1, 0.1) | colours("left.", 0.2, 0.2, 0.2) | {"Z": plane(1.0), "depth.Z": plane(5.0)}
    path = written(tmp_path / "a.exr", ExrPart(channels, attributes={"multiView": ["right", "left"]}))
    right = FlatRender().layers(path)[0]
    assert right.rgb[0, 0, 0] == np.float32(0.1) and right.depth_m[0, 0] == 1.0
    other = written(tmp_path / "b.exr", ExrPart(colours("left.", 0.2, 0.2, 0.2) | channels, attributes={"multiView": ["left", "right"]}))
    assert FlatRender().layers(other)[0].rgb[0, 0, 0] == np.float32(0.2)


def sequence(folder: Path, numbers: list[int], name: str = "beauty.{:04d}.exr") -> Path:
    folder.mkdir(exist_ok=True)
    for number in numbers:
        written(folder / name.format(number), colours("", number, 0, 0) | {"Z": plane(1.0)})
    return folder


@pytest.mark.parametrize("pattern", ["beauty.%04d.exr", "beauty.####.exr", "beauty.$F4.exr", "beauty.%d.exr", ""])
def test_sequences_by_pattern_or_folder(tmp_path: Path, pattern: str) -> None:
    folder = sequence(tmp_path / "s", [998, 999, 1000])
    found = ExrSequence.of(folder / pattern if pattern else folder)
    assert found.frames == range(998, 1001) and not found.is_still
    assert [found.layers(frame)[0].rgb[0, 0, 0] for frame in found.frames] == [998, 999, 1000]
    refused("has frames 998 to 1000, not 1001", found.layers, 1001)


def test_numbers_may_outgrow_their_digits_and_be_negative(tmp_path: Path) -> None:
    assert ExrSequence.of(sequence(tmp_path / "a", [99, 100], "b.{:02d}.exr") / "b.##.exr").frames == range(99, 101)
    assert ExrSequence.of(sequence(tmp_path / "b", [-1, 0, 1], "b.{:04d}.exr")).frames == range(-1, 2)
    assert ExrSequence.of(sequence(tmp_path / "c", [1, 2], "shot-{:04d}.exr")).frames == range(1, 3)


def test_gaps_are_named(tmp_path: Path) -> None:
    refused(r"2 of the frames 1 to 6 are missing \(3, 4\)", ExrSequence.of, sequence(tmp_path / "s", [1, 2, 5, 6]))


def test_files_are_read_when_asked_for(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [1])
    (folder / "beauty.0002.exr").write_bytes(b"not EXR")
    found = ExrSequence.of(folder)
    assert found.layers(1)
    refused("cannot be read as EXR", found.layers, 2)


def test_a_single_file_stands_for_every_frame(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [7])
    still = ExrSequence.of(folder / "beauty.0007.exr")
    assert still.is_still and still.frames == range(7, 8)
    assert still.layers(123)[0].rgb[0, 0, 0] == 7


def test_what_is_no_sequence_says_so(tmp_path: Path) -> None:
    folder = sequence(sequence(tmp_path / "s", [1]), [1], "other.{:04d}.exr")
    with pytest.raises(InputError, match=r"found beauty\.####\.exr, other\.####\.exr"):
        ExrSequence.of(folder)
    with pytest.raises(InputError, match="there is none in"):
        ExrSequence.of(folder / "nothing.####.exr")
    refused("no such file", ExrSequence.of, folder / "nothing.exr")
