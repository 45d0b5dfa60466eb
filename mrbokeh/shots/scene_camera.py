"""The camera of a scene file: a track whose world points up as the scene's does."""

from pathlib import Path

from mrbokeh.optics.camera import have_same_shape
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import format_of_file, read_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackOptions


def scene_track(path: Path, size_px: tuple[int, int], scene_up: str) -> CameraTrack:
    """size_px: (width, height) of the plate. scene_up: what points up in the world of the scene, in which its objects are placed.

    A file of one camera does not say what is up, so it is the scene's. Any other track has an axis of its own; where that is another
    one, places of objects and poses of the camera are not of one world, and no turn can tell which of them is meant: InputError. So it is
    where the track's pictures have another shape than the plate.
    """
    is_single = _is_single_camera(path)
    track = read_track(path, TrackOptions(up=scene_up, size_px=size_px) if is_single else TrackOptions(size_px=size_px))
    if not have_same_shape(track.size_px, size_px):
        raise InputError(
            f"{path}: expected a camera for pictures of the plate's shape ({size_px[0]}x{size_px[1]}), got one for "
            f"{track.size_px[0]}x{track.size_px[1]}: was it made for another clip, or for one that is turned or cropped?"
        )
    if not is_single and track.up != scene_up:
        raise InputError(
            f"{path}: {track.up} points up in this track{_remark(path)}, but {scene_up} in the scene: where the scene's places are the "
            f"track's, write up = {track.up!r} into the scene file, else turn the track: "
            f"mrbokeh track convert {path.name} turned.json --out-up={scene_up}"
        )
    return track


def _is_single_camera(path: Path) -> bool:
    if not path.exists() or format_of_file(path) != "json":
        return False
    document = read_json(path, "a camera track")
    return isinstance(document, dict) and "camera_from_world" in document


def _remark(path: Path) -> str:
    """What is no more than usual may be stated otherwise."""
    return " (as in most of COLMAP's maps; state another by --up in that conversion)" if format_of_file(path) == "colmap" else ""
