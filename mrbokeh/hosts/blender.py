# SPDX-License-Identifier: Apache-2.0
"""Blender add-on (4.2 and later): blurs renders as a lens does, and exports scenes as mrbokeh wants them.

Image Editor > sidebar > mrbokeh asks a running `mrbokeh serve` to blur the render by the scene camera's focus and f-stop; the result is
the image "mrbokeh blur", also in the compositor where that uses nodes.

File > Export > mrbokeh writes into a folder:
- scene.glb: the objects (all that render, or the selected ones);
- camera_track.json: the camera of every frame, with focus and f-number;
and sets the scene up to render `render/####.exr` there: multilayer EXR with RGBA, Z, motion vectors and Cryptomatte, everything
sharp, for the lens blur comes later. Press Ctrl+F12 to render it.

The world written is x right, y down, z forward of Blender's front view: a point (x, y, z) of Blender is (x, -z, y) there, just where
mrbokeh puts the same point of the GLB file. Camera axes are x right, y down, z forward, and the centre of the first pixel is at (0.5, 0.5).

Licence: this file is under the Apache License 2.0 as mrbokeh is, which the GPL 3 under which Blender is distributed permits to be
combined with it. It uses Blender's Python interface only and nothing of mrbokeh, and what it writes is yours.
"""

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from mrbokeh.hosts.client import Refused, ask

bl_info = {
    "name": "mrbokeh",
    "author": "mrbokeh",
    "version": (1, 1, 0),
    "blender": (4, 2, 0),
    "location": "Image Editor > sidebar > mrbokeh, and File > Export > mrbokeh (folder)",
    "description": "Lens blur of renders by mrbokeh; objects, camera track and render settings for it",
    "category": "Render",
}

FORMAT = "mrbokeh-camera-track"
Matrix = list[list[float]]
# Blender's world (z up) to ours (y down); a half turn about x for cameras, which look along -z there with y up.
OUR_FROM_BLENDER: Matrix = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
_FLIP = (1.0, -1.0, -1.0)


class Film(NamedTuple):
    """Film of a Blender camera: pixels, pixel aspect, millimetres, shift in parts of the fitted side."""

    width_px: int
    height_px: int
    lens_mm: float
    sensor_width_mm: float
    sensor_height_mm: float
    sensor_fit: str = "AUTO"
    shift_x: float = 0.0
    shift_y: float = 0.0
    pixel_aspect: tuple[float, float] = (1.0, 1.0)


def intrinsics(film: Film) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return (focal length in pixels, principal point in pixels, width of the film in mm that the picture covers).

    Follows Blender's view plane: the sensor's side lies along the fitted side of the picture, counted in pixel widths.
    """
    tallness = film.pixel_aspect[1] / film.pixel_aspect[0]
    is_wide = film.width_px >= tallness * film.height_px
    horizontal = film.sensor_fit == "HORIZONTAL" or (film.sensor_fit == "AUTO" and is_wide)
    fitted_px = film.width_px if horizontal else tallness * film.height_px
    sensor_mm = film.sensor_height_mm if film.sensor_fit == "VERTICAL" else film.sensor_width_mm
    focal_px = film.lens_mm * fitted_px / sensor_mm
    across, down = film.shift_x * fitted_px, film.shift_y * fitted_px / tallness
    principal_px = (film.width_px / 2 - across, film.height_px / 2 + down)
    return (focal_px, focal_px / tallness), principal_px, film.width_px * sensor_mm / fitted_px


def camera_from_world(matrix_world: Matrix) -> Matrix:
    """Return the (4, 4) rigid transform of our world into our camera axes, from a Blender camera's matrix_world; its scale does not
    count.
    """
    columns = [[matrix_world[row][column] for row in range(3)] for column in range(3)]
    lengths = [sum(each * each for each in column) ** 0.5 for column in columns]
    axes = [_in_our_world([flip * each / length for each in column]) for column, length, flip in zip(columns, lengths, _FLIP, strict=True)]
    place = _in_our_world([matrix_world[row][3] for row in range(3)])
    return [[*axis, -sum(a * p for a, p in zip(axis, place, strict=True))] for axis in axes] + [[0.0, 0.0, 0.0, 1.0]]


def _in_our_world(vector: list[float]) -> list[float]:
    return [sum(m * v for m, v in zip(row, vector, strict=True)) for row in OUR_FROM_BLENDER]


def track_frame(number: int, time_s: float, matrix_world: Matrix, film: Film) -> dict[str, Any]:
    """One frame of the track, without focus."""
    focal_px, principal_px, sensor_width_mm = intrinsics(film)
    return {
        "frame": number,
        "time_s": time_s,
        "camera": {
            "width_px": film.width_px,
            "height_px": film.height_px,
            "focal_px": list(focal_px),
            "principal_px": list(principal_px),
            "camera_from_world": camera_from_world(matrix_world),
        },
        "focal_length_mm": film.lens_mm,
        "sensor_width_mm": sensor_width_mm,
    }


def lens_request(film: Film, focus: dict[str, float], lens: str = "", blades: int = 0, rotation_deg: float = 0.0) -> dict[str, Any]:
    """Return focus and lens as `mrbokeh serve` takes them.

    lens: a name, file or folder; "" for the opening of Blender's camera. Its lens stays where it is when it focuses, and its pupil is
    lens_mm / f_number wide: those are the image distance and pupil of a thin lens that is a little shorter and faster.
    """
    distance_m = focus["focus_distance_m"]
    if lens.lower().endswith(".onnx"):
        return {"lens": lens, "focus": distance_m}
    facts = {"focal_length_mm": film.lens_mm, "f_number": focus["f_number"], "sensor_width_mm": intrinsics(film)[2]}
    if lens:
        return {"lens": lens, "focus": distance_m, **facts}
    share = distance_m / (distance_m + film.lens_mm / 1000)
    opening = {"shape": "polygon", "blades": blades, "rotation_deg": rotation_deg} if blades >= 3 else {"shape": "disc"}
    thin = {**facts, "focal_length_mm": film.lens_mm * share, "f_number": focus["f_number"] * share}
    return {"lens": {**thin, "focus_distance_m": distance_m, "aperture": opening}}


# What follows needs Blender.


def film_of(scene: Any, camera: Any) -> Film:
    """The film of a camera object for a scene's render size."""
    render, data = scene.render, camera.data
    share = render.resolution_percentage / 100
    return Film(
        width_px=int(render.resolution_x * share),
        height_px=int(render.resolution_y * share),
        lens_mm=data.lens,
        sensor_width_mm=data.sensor_width,
        sensor_height_mm=data.sensor_height,
        sensor_fit=data.sensor_fit,
        shift_x=data.shift_x,
        shift_y=data.shift_y,
        pixel_aspect=(render.pixel_aspect_x, render.pixel_aspect_y),
    )


def check_scene(scene: Any) -> None:
    """Raise ValueError with one sentence if the scene cannot be exported correctly."""
    if scene.camera is None:
        raise ValueError("the scene has no camera: choose one in the scene's properties")
    if scene.camera.data.type != "PERSP":
        raise ValueError(f"expected a perspective camera, got {scene.camera.data.type}: mrbokeh's cameras are pinholes with a lens")
    if abs(scene.unit_settings.scale_length - 1.0) > 1e-6:
        raise ValueError(f"expected a unit scale of 1 (Blender units are metres), got {scene.unit_settings.scale_length:g}: apply it first")


def camera_track(scene: Any) -> dict[str, Any]:
    """The camera of every frame of the scene's range; leaves the scene at the frame where it was."""
    import bpy

    check_scene(scene)
    before, rate = scene.frame_current, scene.render.fps / scene.render.fps_base
    frames = []
    for number in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(number)
        camera = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrix = [list(row) for row in camera.matrix_world]
        time_s = (number - scene.frame_start) / rate
        frames.append({**track_frame(number, time_s, matrix, film_of(scene, camera)), **_focus(camera)})
    scene.frame_set(before)
    return {"format": FORMAT, "version": 1, "up": "-y", "frames_per_second": rate, "frames": frames}


def _focus(camera: Any) -> dict[str, float]:
    """Distance along the optical axis and f-number; a focus object goes before the distance."""
    focus = camera.data.dof
    distance_m = focus.focus_distance
    if focus.focus_object is not None:
        # The camera looks along its -z.
        to_object = focus.focus_object.matrix_world.translation - camera.matrix_world.translation
        distance_m = -to_object.dot(camera.matrix_world.to_3x3().col[2].normalized())
    return {"focus_distance_m": distance_m, "f_number": focus.aperture_fstop}


def set_up_render(scene: Any, folder: str) -> None:
    """Multilayer EXR with RGBA, Z, motion vectors and Cryptomatte of objects, unblurred: lens and shutter come later."""
    render, image = scene.render, scene.render.image_settings
    _multilayer(image)
    if hasattr(image, "use_exr_interleave"):
        # All in one part: Blender 5.0.1 cannot write several where pixels are not square.
        image.use_exr_interleave = True
    render.filepath = os.path.join(folder, "render", "")
    render.film_transparent = True
    render.use_motion_blur = False
    scene.camera.data.dof.use_dof = False
    for layer in scene.view_layers:
        layer.use_pass_combined = layer.use_pass_z = layer.use_pass_vector = layer.use_pass_cryptomatte_object = True
        layer.pass_cryptomatte_depth = 6


def _multilayer(image: Any, codec: str = "ZIP") -> None:
    if hasattr(image, "media_type"):
        # Since Blender 5.0 only formats of the medium can be chosen.
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_mode, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "RGBA", "32", codec


def export(scene: Any, folder: str, selected_only: bool = False, with_render: bool = True) -> None:
    """Write objects, track and render settings into `folder`, which is created."""
    import bpy

    track = camera_track(scene)
    os.makedirs(folder, exist_ok=True)
    bpy.ops.export_scene.gltf(
        filepath=os.path.join(folder, "scene.glb"),
        export_format="GLB",
        use_selection=selected_only,
        use_renderable=True,
        export_yup=True,
        export_apply=True,
        export_cameras=False,
        export_lights=True,
    )
    with open(os.path.join(folder, "camera_track.json"), "w", encoding="utf-8") as file:
        json.dump(track, file, indent=1)
    if with_render:
        set_up_render(scene, folder)


BLURRED = "mrbokeh blur"
"""Name of the image that holds the result, and of the node that shows it."""


def blur_render(scene: Any, lens: str = "") -> dict[str, Any]:
    """Blur what was rendered last; return the server's answer. Raises ValueError or Refused with one sentence."""
    import bpy

    check_blur(scene)
    sharp, out = (os.path.join(bpy.app.tempdir, name) for name in ("mrbokeh_sharp.exr", "mrbokeh_blurred.exr"))
    with _kept(scene.render.image_settings, ("media_type", "file_format", "color_mode", "color_depth", "exr_codec")):
        _multilayer(scene.render.image_settings, "NONE")
        try:
            bpy.data.images["Render Result"].save_render(sharp, scene=scene)
        except (KeyError, RuntimeError):
            raise ValueError("there is no render yet: render the image first (F12)") from None
    camera = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    opening = camera.data.dof
    asked = lens_request(film_of(scene, camera), _focus(camera), lens, opening.aperture_blades, math.degrees(opening.aperture_rotation))
    answer = ask({"what": "render", "picture": sharp, "out": out, "overwrite": True, **asked})
    os.remove(sharp)
    _show(scene, out)
    return answer


def check_blur(scene: Any) -> None:
    """Raise ValueError with one sentence if a render of the scene would be blurred wrongly."""
    check_scene(scene)
    render = scene.render
    if scene.camera.data.dof.use_dof:
        raise ValueError("the camera's own Depth of Field is on: switch it off and render again, so that nothing is blurred twice")
    if not any(layer.use_pass_z for layer in scene.view_layers):
        raise ValueError("the render has no depth: switch Z on (View Layer > Passes > Data) and render again")
    if render.pixel_aspect_x != render.pixel_aspect_y or (render.use_border and render.use_crop_to_border):
        raise ValueError("expected a whole picture with square pixels: set the pixel aspect to 1 and leave Crop to Render Region off")


@contextmanager
def _kept(settings: Any, names: tuple[str, ...]) -> Iterator[None]:
    """Put settings back as they were, in that order, for one may decide what others may be."""
    before = {name: getattr(settings, name) for name in names if hasattr(settings, name)}
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(settings, name, value)


def _show(scene: Any, path: str) -> None:
    """Make the picture the image BLURRED wherever that is shown, in the open Image Editors, and in a node of the compositor."""
    import bpy

    image, before = bpy.data.images.load(path), bpy.data.images.get(BLURRED)
    image.pack()  # Blender's temporary folder goes when it ends
    if before is not None:
        before.user_remap(image)
        bpy.data.images.remove(before)
    image.name = BLURRED
    # Since Blender 5.0 the compositor's nodes are a group of their own.
    has_group = hasattr(scene, "compositing_node_group")
    tree = scene.compositing_node_group if has_group else scene.node_tree if scene.use_nodes else None
    if tree is not None:
        node = tree.nodes.get(BLURRED) or tree.nodes.new("CompositorNodeImage")
        node.name, node.label, node.image = BLURRED, BLURRED, image
    for area in bpy.context.screen.areas if bpy.context.screen else ():
        if area.type == "IMAGE_EDITOR":
            area.spaces.active.image = image


_registered: list[Any] = []


def _operators() -> list[Any]:
    import bpy
    from bpy_extras.io_utils import ExportHelper

    class ExportMrbokeh(bpy.types.Operator, ExportHelper):  # type: ignore[misc]
        """Write objects, camera track and render settings for mrbokeh"""

        bl_idname = "export_scene.mrbokeh"
        bl_label = "Export to mrbokeh"
        filename_ext = ""
        selected_only: bpy.props.BoolProperty(name="Selected objects only", default=False)
        with_render: bpy.props.BoolProperty(name="Set up the render", description="EXR with Z, motion and Cryptomatte", default=True)

        def execute(self, context: Any) -> set[str]:
            try:
                export(context.scene, self.filepath, self.selected_only, self.with_render)
            except ValueError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
            return {"FINISHED"}

    class BlurMrbokeh(bpy.types.Operator):  # type: ignore[misc]
        """Blur the render by the camera's focus and f-stop, through a running `mrbokeh serve`"""

        bl_idname = "render.mrbokeh_blur"
        bl_label = "Blur the render"
        render_first: bpy.props.BoolProperty(name="Render first", description="With Z, without Blender's own depth of field", default=False)

        def execute(self, context: Any) -> set[str]:
            scene = context.scene
            try:
                if self.render_first:
                    check_scene(scene)
                    scene.camera.data.dof.use_dof = False
                    context.view_layer.use_pass_z = True
                    bpy.ops.render.render()
                answer = blur_render(scene, scene.mrbokeh_lens)
            except (ValueError, Refused) as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
            for warning in answer["warnings"]:
                self.report({"WARNING"}, warning)
            self.report({"INFO"}, "blurred in {:.1f} s: the image {!r}".format(answer["seconds"], BLURRED))
            return {"FINISHED"}

    class MrbokehPanel(bpy.types.Panel):  # type: ignore[misc]
        """Focus, f-stop and lens, and the button that blurs"""

        bl_idname = "IMAGE_PT_mrbokeh"
        bl_label = bl_category = "mrbokeh"
        bl_space_type, bl_region_type = "IMAGE_EDITOR", "UI"

        def draw(self, context: Any) -> None:
            layout, scene = self.layout, context.scene
            if scene.camera is None:
                layout.label(text="The scene has no camera")
                return
            focus = scene.camera.data.dof
            for owner, name in ((focus, "focus_object"), (focus, "focus_distance"), (focus, "aperture_fstop"), (scene, "mrbokeh_lens")):
                layout.prop(owner, name)
            layout.operator("render.mrbokeh_blur").render_first = False
            layout.operator("render.mrbokeh_blur", text="Render and blur").render_first = True

    return [ExportMrbokeh, BlurMrbokeh, MrbokehPanel]


def _menu(menu: Any, _context: Any) -> None:
    menu.layout.operator("export_scene.mrbokeh", text="mrbokeh (folder)")


def register() -> None:
    """Called by Blender when the add-on is switched on."""
    import bpy

    told = "A lens file, a bank of kernels or a network of mrbokeh, or a name of `mrbokeh lens list`; empty for the camera's own opening"
    bpy.types.Scene.mrbokeh_lens = bpy.props.StringProperty(name="Lens", description=told)
    for each in _operators():
        bpy.utils.register_class(each)
        _registered.append(each)
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    """Called by Blender when the add-on is switched off."""
    import bpy

    bpy.types.TOPBAR_MT_file_export.remove(_menu)
    while _registered:
        bpy.utils.unregister_class(_registered.pop())
    del bpy.types.Scene.mrbokeh_lens
