"""The add-on for Blender: its camera mathematics against closed forms and against Blender's own projection, and what it asks the server.

Files in data/blender were written by Blender 4.2.23 through the add-on. Where the package bpy is installed, or MRBOKEH_BPY_PYTHON names
a Python that has it, the add-on runs in Blender itself: 4.2.23, 4.5.15 and 5.0.1 when this was written.
"""

import importlib.util
import json
import math
import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.host import Program, app, written
from mrbokeh.hosts.blender import Film, camera_from_world, check_scene, intrinsics, lens_request, track_frame
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.camera import camera_from_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json
from mrbokeh.scene.virtual_scene import WORLD_FROM_GLTF
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import read_track
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD

DATA = Path(__file__).parents[1] / "data" / "blender"
BPY_PYTHON = os.environ.get("MRBOKEH_BPY_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else "")
in_blender = pytest.mark.skipif(not BPY_PYTHON, reason="MRBOKEH_BPY_PYTHON names no Python with the package bpy (Blender as a module)")


@pytest.fixture
def addon(tmp_path: Path) -> Path:
    """The file that users install."""
    (tmp_path / "mrbokeh_blender.py").write_text(written(Program.BLENDER), encoding="utf-8")
    return tmp_path / "mrbokeh_blender.py"


def test_a_full_frame_camera() -> None:
    """36 mm over 1920 px: 35 mm are 35 / 36 * 1920 px; the axis meets the middle, between pixels 959 and 960."""
    focal_px, principal_px, width_mm = intrinsics(Film(1920, 1080, 35.0, 36.0, 24.0))
    assert focal_px == pytest.approx((35 / 36 * 1920,) * 2) and principal_px == (960.0, 540.0) and width_mm == pytest.approx(36.0)
    # Blender's lens stays where it is when it focuses, as ours does at infinity.
    assert focal_px[0] == pytest.approx(Lens(35.0, 2.0, 1e6, width_mm).focal_px(1920))


@pytest.mark.parametrize(
    ("size", "fit", "focal_px", "width_mm"),
    [
        ((1000, 500), "AUTO", 50 / 40 * 1000, 40.0),  # the sensor's width along the longer side
        ((500, 1000), "AUTO", 50 / 40 * 1000, 20.0),
        ((500, 1000), "HORIZONTAL", 50 / 40 * 500, 40.0),
        ((1000, 500), "VERTICAL", 50 / 30 * 500, 60.0),  # the sensor's height along the picture's height
    ],
)
def test_sensor_fit(size: tuple[int, int], fit: str, focal_px: float, width_mm: float) -> None:
    found, _, covered_mm = intrinsics(Film(*size, 50.0, 40.0, 30.0, fit))
    assert found == pytest.approx((focal_px, focal_px)) and covered_mm == pytest.approx(width_mm)


def test_shift_and_tall_pixels_move_the_axis() -> None:
    """Shift counts in the fitted side: the lens moved up and right shows more of what is there, so the axis goes left and down."""
    _, principal_px, _ = intrinsics(Film(1000, 500, 50.0, 36.0, 24.0, "AUTO", 0.1, 0.05))
    assert principal_px == pytest.approx((500 - 100, 250 + 50))
    # Pixels twice as tall as wide need half as many for the same angle.
    focal_px, principal_px, _ = intrinsics(Film(1000, 250, 50.0, 36.0, 24.0, shift_y=0.1, pixel_aspect=(1.0, 2.0)))
    assert focal_px[1] == pytest.approx(focal_px[0] / 2) and principal_px == pytest.approx((500.0, 125 + 50))


def matrix_of(columns: np.ndarray, place: tuple[float, float, float]) -> list[list[float]]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = columns, place
    return pose.tolist()


def test_cameras_look_down_and_ahead_in_the_world_of_the_glb() -> None:
    """Blender's camera looks along its -z: at height 5 it sees the origin 5 m below. Ours: z up in Blender is -y, so it looks along +y."""
    camera = np.array(camera_from_world(matrix_of(np.eye(3), (0, 0, 5))))
    np.testing.assert_allclose(camera @ [0, 0, 0, 1], [0, 0, 5, 1])
    # Blender's +y is up in its picture: our -z in the world is Blender's +y negated.
    np.testing.assert_allclose(camera[:3, :3] @ [0, 0, 1], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(camera[:3, :3]), 1.0)
    # Rotated by 90 degrees about x, two metres before the origin (Blender's front view): our axes are those of the world.
    turned = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    camera = np.array(camera_from_world(matrix_of(turned, (0.5, -2.0, 1.0))))
    np.testing.assert_allclose(camera, [[1, 0, 0, -0.5], [0, 1, 0, 1.0], [0, 0, 1, 2.0], [0, 0, 0, 1]], atol=1e-12)
    # The scale of a camera object does not count.
    np.testing.assert_allclose(camera_from_world(matrix_of(turned * 3.0, (0.5, -2.0, 1.0))), camera, atol=1e-12)
    # glTF's exporter writes (x, z, -y); mrbokeh's loader turns that into the upright world, where a floor with z up goes as well.
    blender = np.array([1.0, 2.0, 3.0])
    in_gltf = np.array([blender[0], blender[2], -blender[1], 1.0])
    np.testing.assert_allclose((WORLD_FROM_GLTF @ in_gltf)[:3], (UPRIGHT_FROM_WORLD["+z"] @ [*blender, 1.0])[:3])
    looking_ahead = camera_from_world(matrix_of(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), (0, 0, 0)))
    np.testing.assert_allclose(np.array(looking_ahead)[:3, :3] @ (WORLD_FROM_GLTF @ in_gltf)[:3], [1, -3, 2], atol=1e-12)


def test_the_track_has_every_frame_and_the_focus_and_is_one_of_ours() -> None:
    """The ball in focus stands still at (-0.3, 1, 0.3); f/1.4; 24 frames per second from frame 1 to 3."""
    track = json.loads((DATA / "camera_track.json").read_text())
    assert (track["format"], track["version"], track["up"]) == ("mrbokeh-camera-track", 1, "-y")
    assert [frame["frame"] for frame in track["frames"]] == [1, 2, 3]
    for number, frame in enumerate(track["frames"]):
        assert frame["time_s"] == pytest.approx(number / 24) and frame["f_number"] == pytest.approx(1.4)
        _, depth_m = camera_from_json(frame["camera"]).project(np.array([-0.3, -0.3, 1.0]))
        assert frame["focus_distance_m"] == pytest.approx(depth_m, abs=1e-5)
    track = read_track(DATA / "camera_track.json")
    assert (track.up, track.numbers, track.size_px) == ("-y", [1, 2, 3], (80, 56))
    assert track.at(2).f_number == pytest.approx(1.4) and track.at(2).focus_distance_m == pytest.approx(3.0391, abs=1e-4)
    frame = track_frame(7, 0.25, matrix_of(np.eye(3), (0, 0, 5)), Film(64, 48, 50.0, 36.0, 24.0))
    camera = camera_from_json(json.loads(json.dumps(frame))["camera"])
    assert (camera.width_px, camera.height_px) == (64, 48) and frame["frame"] == 7 and frame["sensor_width_mm"] == pytest.approx(36.0)
    # bpy_extras.object_utils.world_to_camera_view of Blender 4.2.23: a turned camera with shift and pixels 1.2 times as tall as wide.
    frame = json.loads((DATA / "camera_track.json").read_text())["frames"][1]
    camera = camera_from_json(frame["camera"])
    for point, (right, up, depth_m) in json.loads((DATA / "blender_projection.json").read_text()):
        xy_px, ours_m = camera.project(np.array([point[0], -point[2], point[1]], np.float64))
        np.testing.assert_allclose(xy_px, [right * camera.width_px, (1 - up) * camera.height_px], atol=1e-4)
        assert ours_m == pytest.approx(depth_m, abs=1e-5)


class _Scene:
    """As much of a Blender scene as is checked."""

    def __init__(self, kind: str | None = "PERSP", scale: float = 1.0) -> None:
        data = type("Data", (), {"type": kind})
        self.camera = None if kind is None else type("Camera", (), {"data": data})
        self.unit_settings = type("Units", (), {"scale_length": scale})


@pytest.mark.parametrize(
    ("scene", "message"), [(_Scene(None), "no camera"), (_Scene("ORTHO"), "ORTHO"), (_Scene(scale=0.01), "unit scale of 1")]
)
def test_scenes_that_cannot_be_exported_truly(scene: _Scene, message: str) -> None:
    check_scene(_Scene())
    with pytest.raises(ValueError, match=message):
        check_scene(scene)


def test_the_pupil_and_image_distance_are_those_of_blenders_camera() -> None:
    """Cycles: a point z away blurs to lens / N * lens / sensor * width * |1/d - 1/z| px, for its lens does not move when it focuses."""
    film, focus = Film(1920, 1080, 50.0, 36.0, 24.0), {"focus_distance_m": 1.2, "f_number": 2.0}
    lens = lens_from_json(lens_request(film, focus, blades=5, rotation_deg=10.0)["lens"])
    for depth_m in (0.7, 3.0, 1e6):
        wanted_px = 0.05 / 2.0 * 50.0 / 36.0 * 1920 * (1 / 1.2 - 1 / depth_m)
        assert lens.coc_px(depth_m, 1920) == pytest.approx(wanted_px, rel=1e-6)
    assert lens.focus_distance_m == 1.2 and len(lens.aperture.outlines[0]) == 5
    named = lens_request(film, focus, "fast-50")
    assert named == {"lens": "fast-50", "focus": 1.2, "focal_length_mm": 50.0, "f_number": 2.0, "sensor_width_mm": 36.0}
    assert lens_request(film, focus, "my.onnx") == {"lens": "my.onnx", "focus": 1.2}


class _Bag(types.SimpleNamespace):
    """A stand-in for anything of Blender: what is not told is another bag, and calling it gives one."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, _Bag())
        return getattr(self, name)

    def __call__(self, *_: Any, **__: Any) -> Any:
        return _Bag()


def test_it_registers_and_asks_for_the_scene_camera(addon: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in for bpy: three classes come and go, and one request leaves with the lens of the camera."""
    classes: list[Any] = []
    picture = _Bag(save_render=lambda path, scene: Path(path).write_text(scene.render.image_settings.file_format))
    bpy = _Bag(types=_Bag(Operator=type("Operator", (), {}), Panel=object, Scene=type("Scene", (), {})))
    bpy.utils = _Bag(register_class=classes.append, unregister_class=classes.remove)
    bpy.app, bpy.context, bpy.data = _Bag(tempdir=str(tmp_path)), _Bag(screen=None), _Bag()
    bpy.data.images = type("Images", (dict,), {"load": lambda *_: _Bag(), "remove": lambda *_: None})({"Render Result": picture})
    for name, module in (("bpy", bpy), ("bpy_extras", _Bag()), ("bpy_extras.io_utils", _Bag(ExportHelper=type("ExportHelper", (), {})))):
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("mrbokeh_blender", addon)
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    loaded.register()
    export, blur, _ = classes
    assert (export.bl_idname, blur.bl_idname) == ("export_scene.mrbokeh", "render.mrbokeh_blur") and hasattr(
        bpy.types.Scene, "mrbokeh_lens"
    )
    dof = _Bag(use_dof=False, focus_object=None, focus_distance=3.0, aperture_fstop=2.8, aperture_blades=0, aperture_rotation=0.0)
    data = _Bag(type="PERSP", lens=50.0, sensor_width=36.0, sensor_height=24.0, sensor_fit="AUTO", shift_x=0.0, shift_y=0.0, dof=dof)
    size = {"resolution_x": 640, "resolution_y": 360, "resolution_percentage": 50, "pixel_aspect_x": 1.0, "pixel_aspect_y": 1.0}
    camera, settings = _Bag(data=data), _Bag(file_format="PNG")
    camera.evaluated_get = lambda _: camera
    scene = _Bag(camera=camera, unit_settings=_Bag(scale_length=1.0), mrbokeh_lens="", view_layers=[_Bag(use_pass_z=True)], use_nodes=False)
    scene.render, scene.compositing_node_group = _Bag(image_settings=settings, use_border=False, **size), None
    asked: list[dict[str, Any]] = []

    def answered(request: dict[str, Any]) -> dict[str, Any]:
        assert Path(request["picture"]).read_text() == "OPEN_EXR_MULTILAYER"
        asked.append(request)
        return {"seconds": 0.5, "warnings": []}

    monkeypatch.setattr(loaded, "ask", answered)
    operator, reported = blur(), list[tuple[Any, str]]()
    operator.report, operator.render_first = lambda kind, text: reported.append((kind, text)), False
    assert operator.execute(_Bag(scene=scene)) == {"FINISHED"} and "blurred in 0.5 s" in reported[-1][1] and settings.file_format == "PNG"
    (request,) = asked
    assert request["what"] == "render" and request["lens"]["sensor_width_mm"] == 36.0 and request["lens"]["focus_distance_m"] == 3.0
    dof.use_dof = True
    assert operator.execute(_Bag(scene=scene)) == {"CANCELLED"} and "blurred twice" in reported[-1][1]
    dof.use_dof, scene.view_layers[0].use_pass_z = False, False
    assert operator.execute(_Bag(scene=scene)) == {"CANCELLED"} and "has no depth" in reported[-1][1] and len(asked) == 1
    loaded.unregister()
    assert not classes and not hasattr(bpy.types.Scene, "mrbokeh_lens")


def test_the_addon_needs_nothing_of_mrbokeh(addon: Path) -> None:
    """Blender's Python has none of our packages: outside the tests' hooks it loads with what Python brings, and says what it is."""
    code = f"import runpy; print(runpy.run_path({str(addon)!r})['bl_info']['blender'])"
    done = subprocess.run([sys.executable, "-S", "-I", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "(4, 2, 0)", done.stderr


def test_the_command_writes_it_and_keeps_what_is_there(tmp_path: Path) -> None:
    out = tmp_path / "addons"
    done = CliRunner().invoke(app, ["blender", "--out", str(out)])
    assert done.exit_code == 0 and "Install from Disk" in done.stdout
    made = out / "mrbokeh_blender.py"
    assert made.read_text() == written(Program.BLENDER)
    made.write_text("mine")
    again = CliRunner().invoke(app, ["blender", "--out", str(out)])
    assert (
        isinstance(again.exception, InputError)
        and "exists already: give another folder as --out" in str(again.exception)
        and made.read_text() == "mine"
    )
    assert CliRunner().invoke(app, ["blender", "--out", str(out), "--overwrite"]).exit_code == 0
    assert made.read_text() == written(Program.BLENDER)
    refused = CliRunner().invoke(app, ["blender", "--out", str(made)])
    assert isinstance(refused.exception, InputError) and "name a folder" in str(refused.exception)


_IN_BLENDER = """
import importlib.util, math, os, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
spec = importlib.util.spec_from_file_location("mrbokeh_export", sys.argv[1])
addon = importlib.util.module_from_spec(spec)
sys.modules["mrbokeh_export"] = addon
spec.loader.exec_module(addon)
bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
scene = bpy.context.scene
bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0.2, 1.0, 0.4))
data = bpy.data.cameras.new("camera")
scene.camera = bpy.data.objects.new("camera", data)
scene.collection.objects.link(scene.camera)
scene.camera.location, scene.camera.rotation_euler = (0.0, -2.0, 0.5), (math.radians(88), 0.0, math.radians(4))
data.dof.use_dof, data.dof.focus_distance, scene.frame_end = True, 2.5, 1
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 4, False
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 128, 96, 50
addon.register()
assert bpy.ops.export_scene.mrbokeh(filepath=sys.argv[2]) == {"FINISHED"}
bpy.ops.render.render(animation=True)
scene.unit_settings.scale_length = 0.01
try:
    bpy.ops.export_scene.mrbokeh(filepath=sys.argv[2])
    raise SystemExit("a scene in centimetres was exported")
except RuntimeError as error:
    assert "unit scale" in str(error), error
addon.unregister()
# Once it has exported any glTF, bpy 4.2 crashes when Python shuts down (so it does without the add-on).
sys.stdout.flush()
os._exit(0)
"""


@pytest.mark.slow
@in_blender
def test_in_blender_itself(addon: Path, tmp_path: Path) -> None:
    """GLB, camera and render of one scene agree: the cube's corners, projected from the GLB, frame the cube that Cycles rendered."""
    from mrbokeh.scene.gltf.gltf_loader import load_glb
    from mrbokeh.stacks.exr_layers.sequence import ExrSequence

    script = tmp_path / "script.py"
    script.write_text(_IN_BLENDER)
    out = tmp_path / "out"
    done = subprocess.run([BPY_PYTHON, str(script), str(addon), str(out)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    frame = json.loads((out / "camera_track.json").read_text())["frames"][0]
    camera = camera_from_json(frame["camera"])
    assert frame["focus_distance_m"] == 2.5 and (camera.width_px, camera.height_px) == (64, 48)
    (layer,) = ExrSequence.of(out / "render").layers(1)
    low_m, high_m = load_glb(out / "scene.glb").bounds_m
    corners = np.array([[x, y, z] for x in (low_m[0], high_m[0]) for y in (low_m[1], high_m[1]) for z in (low_m[2], high_m[2])])
    xy_px, depth_m = camera.project(corners)
    rows, columns = np.nonzero(layer.alpha > 0.5)
    box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(box, [*xy_px.min(axis=0), *xy_px.max(axis=0)], atol=1.0)
    assert math.isclose(layer.depth_m[layer.alpha == 1].min(), depth_m.min(), rel_tol=0.02)


_BLUR_IN_BLENDER = """
import importlib.util, math, os, sys
import bpy
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
spec = importlib.util.spec_from_file_location("mrbokeh_blender", sys.argv[1])
addon = importlib.util.module_from_spec(spec)
sys.modules["mrbokeh_blender"] = addon
spec.loader.exec_module(addon)
scene = bpy.context.scene
for x, y in ((-0.6, 1.0), (0.1, 2.5), (0.9, 5.0)):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.35, location=(x, y, 0.35))
bpy.ops.mesh.primitive_plane_add(size=40)
sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
sun.data.energy, sun.rotation_euler = 3.0, (0.6, 0.3, 0.0)
scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
for each in (sun, scene.camera):
    scene.collection.objects.link(each)
scene.camera.location, scene.camera.rotation_euler = (0.0, -2.0, 0.6), (math.radians(88), 0.0, 0.0)
dof = scene.camera.data.dof
dof.focus_distance, dof.aperture_fstop, dof.use_dof = 3.0, 0.25, True
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 64, False
scene.render.resolution_x, scene.render.resolution_y = 320, 180
if hasattr(scene, "compositing_node_group"):
    tree = scene.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.links.new(tree.nodes.new("CompositorNodeRLayers").outputs["Image"], tree.nodes.new("NodeGroupOutput").inputs["Image"])
else:
    scene.use_nodes = True
    tree = scene.node_tree
addon.register()

def refused(word):
    try:
        bpy.ops.render.mrbokeh_blur()
    except RuntimeError as error:
        assert word in str(error), error
    else:
        raise SystemExit("not refused: " + word)

def pixels(image):
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]

refused("blurred twice")
bpy.ops.render.render()
scene.render.image_settings.file_format = "OPEN_EXR"
bpy.data.images["Render Result"].save_render(sys.argv[2] + ".own.exr", scene=scene)
theirs = pixels(bpy.data.images.load(sys.argv[2] + ".own.exr"))
assert bpy.ops.render.mrbokeh_blur(render_first=True) == {"FINISHED"} == bpy.ops.render.mrbokeh_blur()
assert scene.render.image_settings.file_format == "OPEN_EXR" and tree.nodes["mrbokeh blur"].image.name == "mrbokeh blur"
assert [image.name for image in bpy.data.images].count("mrbokeh blur") == 1 and bpy.data.images["mrbokeh blur"].packed_file
bpy.data.images["Render Result"].save_render(sys.argv[2] + ".sharp.exr", scene=scene)
sharp = pixels(bpy.data.images.load(sys.argv[2] + ".sharp.exr"))
np.savez(sys.argv[2], theirs=theirs, ours=pixels(bpy.data.images["mrbokeh blur"]), sharp=sharp)
os.environ["MRBOKEH_SERVER"] = "none.json"
refused("start `mrbokeh serve`")
addon.unregister()
sys.stdout.flush()
os._exit(0)
"""


@pytest.mark.slow
@in_blender
def test_the_blur_in_blender_is_that_of_its_own_camera(addon: Path, tmp_path: Path) -> None:
    """Three balls 3 to 7 m away at f/0.25, focused at 3 m: 64 rays a pixel through Cycles' lens, beside one sharp render and our blur."""
    connection, script = tmp_path / "server.json", tmp_path / "script.py"
    script.write_text(_BLUR_IN_BLENDER)
    words = [sys.executable, "-m", "mrbokeh.cli", "serve", "--connection", str(connection)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        assert server.stdout is not None and "Ctrl-C ends it" in server.stdout.readline()
        environment = os.environ | {"MRBOKEH_SERVER": str(connection), "PYTHONPATH": ""}
        out = str(tmp_path / "pictures.npz")
        done = subprocess.run([BPY_PYTHON, str(script), str(addon), out], capture_output=True, text=True, env=environment)
        server.terminate()
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    pictures = {name: np.clip(values, 0.0, 1.0) for name, values in np.load(out).items()}
    ours_db, sharp_db = (psnr(pictures[name], pictures["theirs"]) for name in ("ours", "sharp"))
    print(f"PSNR beside Blender's own depth of field: {ours_db:.1f} dB, sharp {sharp_db:.1f} dB")
    assert ours_db > 30.0 and ours_db > sharp_db + 5.0
