"""The add-on for Blender: its camera mathematics against closed forms and against Blender's own projection, and the command that copies it.

Files in data/blender were written by Blender 4.2.23 through the add-on. Where the package bpy is installed it is run again.
"""

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands.host import app
from mrbokeh.hosts import blender
from mrbokeh.hosts.blender import Film, camera_from_world, check_scene, intrinsics, track_frame
from mrbokeh.optics.camera import camera_from_json
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.virtual_scene import WORLD_FROM_GLTF
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import read_track
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD

DATA = Path(__file__).parents[1] / "data" / "blender"
ADDON = Path(blender.__file__)


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


def test_the_addon_needs_nothing_of_mrbokeh() -> None:
    """Blender's Python has none of our packages: outside the tests' hooks it loads with what Python brings, and says what it is."""
    code = f"import runpy; print(runpy.run_path({str(ADDON)!r})['bl_info']['blender'])"
    done = subprocess.run([sys.executable, "-S", "-I", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "(4, 2, 0)", done.stderr


def test_the_command_copies_it_and_keeps_what_is_there(tmp_path: Path) -> None:
    out = tmp_path / "addons"
    done = CliRunner().invoke(app, ["--out", str(out)])
    assert done.exit_code == 0 and "Install from Disk" in done.stdout
    copied = out / "mrbokeh_export.py"
    assert copied.read_bytes() == ADDON.read_bytes()
    copied.write_text("mine")
    again = CliRunner().invoke(app, ["--out", str(out)])
    assert isinstance(again.exception, InputError) and "exists already" in str(again.exception) and copied.read_text() == "mine"
    assert CliRunner().invoke(app, ["--out", str(out), "--overwrite"]).exit_code == 0
    assert copied.read_bytes() == ADDON.read_bytes()
    refused = CliRunner().invoke(app, ["--out", str(copied)])
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
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="the package bpy (Blender as a module) is not installed")
def test_in_blender_itself(tmp_path: Path) -> None:
    """GLB, camera and render of one scene agree: the cube's corners, projected from the GLB, frame the cube that Cycles rendered."""
    from mrbokeh.scene.gltf.gltf_loader import load_glb
    from mrbokeh.stacks.exr_layers.sequence import ExrSequence

    script = tmp_path / "script.py"
    script.write_text(_IN_BLENDER)
    out = tmp_path / "out"
    done = subprocess.run([sys.executable, str(script), str(ADDON), str(out)], capture_output=True, text=True)
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
