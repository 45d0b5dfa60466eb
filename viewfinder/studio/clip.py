"""Clip: its first frame as the studio's photograph, the camera that was tracked, and the scene by which `mrbokeh video` films the same."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mrbokeh.commands._composite_layers import light_of
from mrbokeh.commands._composite_options import CompositeOptions, typed_height
from mrbokeh.commands._composited import placed
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.scene.staging.staged_scene import modified_s
from mrbokeh.shots.frame_sources import scene_track
from mrbokeh.solving.solved_camera import HIGH, KNOWN, SolvedCamera, write_solved_camera
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart
from mrbokeh.tracking.camera_track.formats import read_track
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.world_axes import turned_back, upright_camera
from mrbokeh.video.picture_source import open_source
from viewfinder.studio.command_line import options_of
from viewfinder.studio.photograph import MOST_PX, OpenedPhotograph
from viewfinder.studio.preview import finishing_by
from viewfinder.studio.state import Pair, StudioState

if TYPE_CHECKING:
    from mrbokeh.scene.staging.scene_description import Lighting

_MOST_PLACES = 400
_SHADOW_SIZE_M, _SHADOW_HEIGHTS = 2.0, 8.0
_NOTHING = "[[sun]]\ndirection = [0.0, 0.0, 1.0]\nirradiance = 0.0\n"
"""A sun without light says that the panorama has none to take out."""


@dataclass(frozen=True, eq=False)
class TrackedClip:
    """A clip of so many frames, and the cameras of its frames in the world of its track."""

    path: Path
    frames: int
    track: CameraTrack

    @property
    def first(self) -> Camera:
        """The camera of the first frame in the upright world."""
        return self.camera(0)

    def camera(self, frame: int) -> Camera:
        return upright_camera(self.track.at(frame).camera, self.track.up)


def tracked_clip(clip: Path, track: Path) -> TrackedClip:
    """Open a clip and the track of its camera; the last ones are kept. Raises InputError if they do not belong together."""
    return _tracked(clip, track, modified_s(clip), modified_s(track))


@lru_cache(maxsize=4)
def _tracked(clip: Path, track: Path, _changed_s: float, _track_changed_s: float) -> TrackedClip:
    source = open_source(clip)
    size_px = (source.info.width_px, source.info.height_px)
    cameras = scene_track(track, size_px, read_track(track).up).resized(*size_px)
    made = TrackedClip(clip, len(source.times_s), cameras)
    if not made.first.world_from_camera[1, 3] < 0.0:
        raise InputError(f"{track}: the camera of the first frame stands below the ground of its world: track with a board that lies on it")
    return made


def first_frame(clip: Path, track: Path, folder: Path) -> tuple[Path, Path]:
    """Write the first frame of a clip as a photograph, and its camera as of `mrbokeh capture solve`; return both files."""
    made, source = tracked_clip(clip, track), open_source(clip)
    rgb = next(iter(source.frames(0, 1, 1))).rgb
    camera, (height_px, width_px) = made.first, rgb.shape[:2]
    seen = SolvedCamera(width_px, height_px, camera.focal_px[0], KNOWN, camera_from_world=camera.camera_from_world[:3, :3], confidence=HIGH)
    folder.mkdir(parents=True, exist_ok=True)
    photo, solved = folder / f"{clip.stem}.first_frame.png", folder / f"{clip.stem}.track.camera.json"
    write_image(photo, rgb)
    write_solved_camera(solved, seen.standing(-float(camera.world_from_camera[1, 3])))
    return photo, solved


def path_px(state: StudioState) -> list[Pair]:
    """Return where the chosen object's foot is seen in the frames of the track, in pixels; beyond the frame too, but not behind it."""
    assert state.clip is not None and state.track is not None
    if state.at_px is None:
        return []
    made = tracked_clip(state.clip, state.track)
    foot_m = _foot_m(made.first, state.at_px)
    numbers = [each for each in made.track.numbers if each < made.frames]
    seen = [made.camera(each).project(foot_m[None]) for each in numbers[:: 1 + len(numbers) // _MOST_PLACES]]
    return [(round(float(xy[0, 0]), 1), round(float(xy[0, 1]), 1)) for xy, depth_m in seen if depth_m[0] > 0.0]


def _foot_m(camera: Camera, at_px: Pair) -> Float[np.ndarray, "3"]:
    """Return the place of the ground that an upright camera sees at a pixel. Raises InputError above the horizon."""
    eye_m = camera.world_from_camera[:3, 3]
    ray = camera.unproject(np.array(at_px), np.array(1.0)) - eye_m
    if ray[1] <= 1e-9:
        raise InputError(f"the pixel {at_px[0]:g},{at_px[1]:g} lies above the horizon of the track's ground: choose a lower one")
    return np.asarray(eye_m - eye_m[1] / ray[1] * ray, np.float64)


def clip_words(state: StudioState, opened: OpenedPhotograph, folder: Path) -> list[str]:
    """Write scene, light and lens of a complete state into a folder; return the words after `mrbokeh` that film it, but for --out.

    Raises InputError for a place that is no ground.
    """
    assert state.clip is not None and state.track is not None
    options = options_of(state)
    with apart():
        plate, _renderer, known_height_m = opened.upright(options, MOST_PX)
        small = opened.small(options, MOST_PX)
        finishing = finishing_by(opened, plate, small)
        plate, _placed = placed(plate, small, known_height_m)
        light = light_of(small.standing, plate, small.standing.first_px, None)
    files = {name: folder / f"{state.clip.stem}.{name}" for name in ("scene.toml", "light.exr", "lens.json")}
    text = _scene(state, options, plate, light, files["light.exr"])
    with atomic_path(files["scene.toml"]) as path:
        path.write_text(text, encoding="utf-8")
    learned = state.lens is not None and (state.lens.is_dir() or state.lens.suffix == ".onnx")
    if not learned:
        write_lens(files["lens.json"], plate.lens)
    lens = [str(state.lens), "--focus", f"{plate.lens.focus_distance_m:.6g}"] if learned else [str(files["lens.json"])]
    look = ["--grain", "auto"] if finishing.grain is not None and not finishing.grain.is_nothing else []
    look += ["--match-black", "auto"] if finishing.colour is not None and max(finishing.colour.black) > 0.0 else []
    look += [] if state.warmth_k is None else ["--match-white", f"{state.warmth_k:g}"]
    caught = ["--catch", "light"] if state.shadow != 0.0 else []
    return ["video", str(state.clip), "--scene", str(files["scene.toml"]), "--camera", str(state.track), "--lens", *lens, *caught, *look]


def _scene(state: StudioState, options: CompositeOptions, plate: Plate, light: "Lighting", panorama: Path) -> str:
    """Return the scene file of objects in the world of a clip's track, and write the panorama that lights them."""
    assert state.clip is not None and state.track is not None
    made = tracked_clip(state.clip, state.track)
    camera, up = made.first, made.track.up
    held = np.eye(3) if plate.world_from_camera is None else plate.world_from_camera
    # The studio's world looks along the view, that of the track wherever it likes: a turn about the vertical.
    turn = camera.world_from_camera[:3, :3] @ held.T
    turn_rad = math.atan2(float(turn[0, 2]), float(turn[2, 2]))
    feet_m = [_foot_m(camera, each.at_px) for each in state.objects]
    parts, heights_m = [f"up = {json.dumps(up)}\n"], []
    for number, (each, foot_m) in enumerate(zip(options.standing.each, feet_m, strict=True), 1):
        height = ""
        if each.height is not None:
            metres, in_pixels = typed_height(each.height)
            metres *= float(camera.project(foot_m[None])[1][0]) / camera.focal_px[1] if in_pixels else 1.0
            height = f"height_m = {metres:.9g}\n"
            heights_m.append(metres)
        name = f"name = {json.dumps(f'{each.glb.stem} {number}')}\nglb = {json.dumps(str(each.glb.absolute()))}\n"
        yaw_deg = each.turn + 180.0 + math.degrees(turn_rad)
        parts.append(f"[[object]]\n{name}position_m = {_numbers(turned_back(_triple(foot_m), up))}\nyaw_deg = {yaw_deg:.9g}\n{height}")
    if light.made is not None:
        environment, lights = light.made
        write_image(panorama, environment.radiance, half=False)
        where = f"rotation_deg = {math.degrees(turn_rad):.9g}\nexposure = {light.exposure:.9g}\n"
        parts.append(f"[light]\nenvironment = {json.dumps(panorama.name)}\n{where}")
        for one in lights:
            travels = turned_back(_triple(turn @ np.array(one.direction)), up)
            parts.append(f"[[sun]]\ndirection = {_numbers(travels)}\nirradiance = {_numbers(one.rgb)}\n")
        parts += [] if lights else [_NOTHING]
    if state.shadow != 0.0:
        low, high = np.min(feet_m, axis=0), np.max(feet_m, axis=0)
        size_m = max(_SHADOW_SIZE_M, _SHADOW_HEIGHTS * max(heights_m, default=0.0)) + float((high - low).max())
        parts.append(
            f"[shadow]\nsize_m = {size_m:.9g}\ncentre_m = {_numbers(turned_back(_triple((low + high) / 2.0), up))}\nstrength = 1.0\n"
        )
    return "\n".join(parts)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in values)
    return x, y, z


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{each:.9g}' for each in values)}]"


def clip_state(clip: Path, track: Path, folder: Path, before: StudioState) -> StudioState:
    """Return the state of a clip's first frame, with the object and the lens of another state. Raises InputError."""
    photo, camera = first_frame(clip, track, folder)
    return replace(StudioState(photo=photo, object=before.object, lens=before.lens), camera=camera, clip=clip, track=track)
