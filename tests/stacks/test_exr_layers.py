"""Renders of other programs as layers: known names, parts, eyes, depth in its meanings, motion, numbered files and their gaps."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION, motion_of
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.stacks.exr_layers.cryptomatte import ObjectSplit
from mrbokeh.stacks.exr_layers.flat_render import FlatRender, LayerReader
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.errors import InputError

HEIGHT, WIDTH = 12, 16
# Rendered by Blender 4.2.23 (Cycles, 80x56 px, pixels 1.2 times as tall as wide) of a red cube in motion before a green ball;
# exported by mrbokeh/scene/blender_addon.py.
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


def test_the_unnamed_layer_goes_before_named_ones_and_a_stated_one_before_all(tmp_path: Path) -> None:
    channels = colours("", 0.1, 0.1, 0.1, 1.0) | colours("C.", 0.2, 0.2, 0.2) | colours("spec.", 0.3, 0.3, 0.3) | {"Z": plane(1.0)}
    path = written(tmp_path / "a.exr", channels | {"far.Z": plane(7.0)})
    assert FlatRender().layers(path)[0].rgb[0, 0, 0] == np.float32(0.1)
    stated = FlatRender(layer="spec", depth="far.Z").layers(path)[0]
    assert stated.rgb[0, 0, 0] == np.float32(0.3) and stated.depth_m[0, 0] == 7.0
    # Without A a layer is opaque.
    assert (stated.alpha == 1.0).all()


def test_what_could_be_meant_twice_has_to_be_stated(tmp_path: Path) -> None:
    two = colours("ViewLayer.Combined.", 0.1, 0.1, 0.1) | colours("Other.Combined.", 0.2, 0.2, 0.2)
    path = written(tmp_path / "a.exr", two | {"Other.Depth.Z": plane(2.0), "ViewLayer.Depth.Z": plane(5.0)})
    with pytest.raises(InputError, match=r"any of the layers Other\.Combined, ViewLayer\.Combined.*full name"):
        FlatRender().layers(path)
    with pytest.raises(InputError, match="could be any of"):
        FlatRender(layer="Combined").layers(path)
    # Depth is taken from beside the colour.
    assert FlatRender(layer="Other.Combined").layers(path)[0].depth_m[0, 0] == 2.0
    assert FlatRender(layer="ViewLayer.Combined").layers(path)[0].depth_m[0, 0] == 5.0


def test_missing_colour_or_depth_lists_what_is_there(tmp_path: Path) -> None:
    path = written(tmp_path / "a.exr", colours("N.", 0, 0, 1) | {"Z": plane(1.0)})
    with pytest.raises(InputError, match=r"expected R, G and B, but it has N\.B, N\.G, N\.R, Z"):
        FlatRender().layers(path)
    path = written(tmp_path / "b.exr", colours("", 0, 0, 1) | {"W": plane(1.0)})
    with pytest.raises(InputError, match=r"expected depth in a channel Z, depth\.Z.*but it has B, G, R, W"):
        FlatRender().layers(path)
    with pytest.raises(InputError, match=r"expected motion in forward\.u and forward\.v"):
        FlatRender(depth="W", shutter=1.0).layers(path)


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
    assert FlatRender(layer="diffuse").layers(path)[0].rgb[0, 0, 0] == np.float32(0.3)
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


def test_straight_colour_is_multiplied_where_it_is_said_so(tmp_path: Path) -> None:
    path = written(tmp_path / "a.exr", colours("", 0.8, 0.4, 0.2, 0.5) | {"Z": plane(1.0)})
    np.testing.assert_allclose(FlatRender(premultiplied=False).layers(path)[0].rgb[0, 0], [0.4, 0.2, 0.1], rtol=1e-6)
    np.testing.assert_allclose(FlatRender().layers(path)[0].rgb[0, 0], [0.8, 0.4, 0.2], rtol=1e-6)


def test_depth_means_what_the_setting_says(tmp_path: Path) -> None:
    """One wall 2 m before a camera, written along the axis, as 1/z and along the ray, in metres and centimetres."""
    camera = Camera(WIDTH, HEIGHT, (20.0, 18.0), (7.0, 6.5))
    rays = np.linalg.norm(camera.unproject(camera.pixel_centres_px(), np.ones((HEIGHT, WIDTH))), axis=2).astype(np.float32)
    stored = {"axis": plane(2.0), "inverse": plane(0.5), "distance": 2.0 * rays}
    for meaning, depth in stored.items():
        path = written(tmp_path / f"{meaning}.exr", colours("", 1, 1, 1) | {"depth.Z": depth})
        render = FlatRender(depth_is=meaning, camera=camera if meaning == "distance" else None)  # type: ignore[arg-type]
        np.testing.assert_allclose(render.layers(path)[0].depth_m, 2.0, rtol=1e-6)
    path = written(tmp_path / "cm.exr", colours("", 1, 1, 1) | {"Z": plane(200.0)})
    np.testing.assert_allclose(FlatRender(metres_per_unit=0.01).layers(path)[0].depth_m, 2.0, rtol=1e-6)
    with pytest.raises(InputError, match="needs the camera"):
        FlatRender(depth_is="distance")
    # Where annotations are checked, as here, that check comes first.
    with pytest.raises(Exception, match="inverse"):
        FlatRender(depth_is="nuke")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="give its own camera"):
        FlatRender(depth_is="distance", camera=camera.resized(8, 6)).layers(path)


@pytest.mark.parametrize(("meaning", "far"), [("axis", 1e10), ("axis", np.inf), ("axis", 0.0), ("inverse", 0.0)])
def test_background_is_infinite(tmp_path: Path, meaning: str, far: float) -> None:
    path = written(tmp_path / "a.exr", colours("", 1, 1, 1) | {"Z": plane(far)})
    assert np.isinf(FlatRender(depth_is=meaning).layers(path)[0].depth_m).all()  # type: ignore[arg-type]


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


def test_blender_render_agrees_with_its_camera() -> None:
    """Depth: the cube's side nearest to the camera. Motion: as far as points of the cube move in Blender's own camera (4.2)."""
    (layer,) = FlatRender(shutter=1.0).layers(BLENDER / "render.0002.exr")
    track = json.loads((BLENDER / "camera_track.json").read_text())
    camera = camera_from_json(track["frames"][1]["camera"])
    cube = (layer.rgb[..., 0] > 0.7) & (layer.alpha == 1)
    assert cube.sum() > 200
    # The face towards the camera, y = -0.2 in Blender, is at z = -0.2 in our axes. Z is that of one ray within the pixel, not its centre.
    seen = camera.unproject(camera.pixel_centres_px(), np.where(cube, layer.depth_m, 1.0).astype(np.float64))
    # Motion is the mean over the pixel: those at the edge of the face see another one too.
    on_face = binary_erosion(cube & (np.abs(seen[..., 2] + 0.2) < 3e-3))
    assert on_face.sum() > 120
    # The cube moves by 0.1 right and 0.05 up per frame: 0.1, -0.05 and 0 in our axes.
    now, _ = camera.project(seen[on_face])
    later, _ = camera.project(seen[on_face] + np.array([0.1, -0.05, 0.0]))
    motion_px = motion_of(layer.extra[MOTION], layer.alpha)[on_face]
    np.testing.assert_allclose(motion_px, later - now, atol=2e-2)
    assert np.median(motion_px[:, 0]) > 3 and np.median(motion_px[:, 1]) < -1


def test_blender_5_writes_a_part_for_each_layer() -> None:
    """Blender 5.0.1, 64x48 px: a grey cube at rest; depth, motion and Cryptomatte are in parts of their own."""
    path = BLENDER / "parts.0001.exr"
    (layer,) = FlatRender(shutter=1.0).layers(path)
    assert layer.alpha.shape == (48, 64) and layer.alpha.max() == 1.0 and not layer.extra[MOTION].any()
    # The camera is at y = -2 and z = 0.5, the cube's face towards it at y = 0.75.
    assert layer.depth_m.min() == pytest.approx(2.75, abs=0.06)
    cube, rest = ObjectSplit(("Cube",)).layers(path)
    np.testing.assert_allclose(cube.alpha, layer.alpha, atol=1e-6)
    assert rest.alpha.max() < 1e-6


@pytest.mark.parametrize("name", ["multi", pytest.param("single", marks=pytest.mark.slow)])
def test_eyes_of_stereo_files(shared_data: Path, name: str) -> None:
    """The same frame as 10 parts with data windows of their own and as one part whose channels name the eye; the default eye is right."""
    path = shared_data / "rgbd" / f"beachball_{name}.0001.exr"
    right, left = (FlatRender(view=view, shutter=1.0).layers(path)[0] for view in ("right", "left"))
    other = shared_data / "rgbd" / f"beachball_{'single' if name == 'multi' else 'multi'}.0001.exr"
    same = FlatRender(view="left", shutter=1.0).layers(other)[0]
    for field in ("rgb", "alpha", "depth_m"):
        np.testing.assert_array_equal(getattr(left, field), getattr(same, field))
    np.testing.assert_array_equal(left.extra[MOTION], same.extra[MOTION])
    default = FlatRender().layers(path)[0]
    np.testing.assert_array_equal(default.rgb, right.rgb)
    # Data windows begin at x = 654 in the right eye and at 688 in the left (header).
    assert np.flatnonzero(right.alpha.any(axis=0))[0] >= 654 and np.flatnonzero(left.alpha.any(axis=0))[0] >= 688
    with pytest.raises(InputError, match="expected the view 'middle', but it has right, left"):
        RenderChannels.read(path, "middle")


def test_an_eye_does_not_take_the_depth_of_the_other(tmp_path: Path) -> None:
    """Multi-View OpenEXR: channels without a layer are the default eye's; layers without an eye belong to all."""
    channels = colours("", 0.1, 0.1, 0.1) | colours("left.", 0.2, 0.2, 0.2) | {"Z": plane(1.0), "depth.Z": plane(5.0)}
    path = written(tmp_path / "a.exr", ExrPart(channels, attributes={"multiView": ["right", "left"]}))
    right, left = (FlatRender(view=view).layers(path)[0] for view in ("right", "left"))
    assert right.rgb[0, 0, 0] == np.float32(0.1) and right.depth_m[0, 0] == 1.0
    assert left.rgb[0, 0, 0] == np.float32(0.2) and left.depth_m[0, 0] == 5.0
    del channels["depth.Z"]
    alone = written(tmp_path / "b.exr", ExrPart(channels, attributes={"multiView": ["right", "left"]}))
    with pytest.raises(InputError, match="expected depth"):
        FlatRender(view="left").layers(alone)


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
    part = ExrSequence.of(folder, first=999, last=999)
    assert part.frames == range(999, 1000)
    with pytest.raises(InputError, match="has frames 999 to 999, not 1000"):
        part.layers(1000)


def test_numbers_may_outgrow_their_digits_and_be_negative(tmp_path: Path) -> None:
    assert ExrSequence.of(sequence(tmp_path / "a", [99, 100], "b.{:02d}.exr") / "b.##.exr").frames == range(99, 101)
    assert ExrSequence.of(sequence(tmp_path / "b", [-1, 0, 1], "b.{:04d}.exr")).frames == range(-1, 2)
    assert ExrSequence.of(sequence(tmp_path / "c", [1, 2], "shot-{:04d}.exr")).frames == range(1, 3)


def test_gaps_are_named_or_held(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [1, 2, 5, 6])
    with pytest.raises(InputError, match=r"frames 1 to 6 were asked for, of which 2 are missing \(3, 4\)"):
        ExrSequence.of(folder)
    held = ExrSequence.of(folder, gaps="hold")
    assert [held.layers(frame)[0].rgb[0, 0, 0] for frame in held.frames] == [1, 2, 2, 2, 5, 6]
    # Inside a gap a range begins with what is held.
    assert ExrSequence.of(folder, first=4, last=5, gaps="hold").layers(4)[0].rgb[0, 0, 0] == 2
    assert ExrSequence.of(folder, first=5).frames == range(5, 7)
    for outside in ({"first": 0}, {"last": 7}):
        with pytest.raises(InputError, match="there are 1 to 6"):
            ExrSequence.of(folder, gaps="hold", **outside)
    with pytest.raises(InputError, match="comes after"):
        ExrSequence.of(folder, first=5, last=2)
    with pytest.raises(Exception, match="hold"):
        ExrSequence.of(folder, gaps="skip")  # type: ignore[arg-type]


def test_files_are_read_when_asked_for(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [1])
    (folder / "beauty.0002.exr").write_bytes(b"not EXR")
    found = ExrSequence.of(folder)
    assert found.layers(1)
    with pytest.raises(InputError, match="cannot be read as EXR"):
        found.layers(2)


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
    with pytest.raises(InputError, match="no such file"):
        ExrSequence.of(folder / "nothing.exr")
