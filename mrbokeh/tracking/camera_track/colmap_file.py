"""A folder with a COLMAP model, text or binary, as a CameraTrack.

Its world has no axis that points up by rule; most maps begin with a camera held upright, whose -y that is. Its unit is open.
"""

from pathlib import Path

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track import colmap_binary, colmap_text
from mrbokeh.tracking.camera_track.colmap_camera import ColmapCamera, colmap_camera, colmap_image, tracked_frame
from mrbokeh.tracking.camera_track.options import TrackOptions, lost
from mrbokeh.tracking.camera_track.picture_names import frame_numbers, picture_name
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.camera_track.world_axes import with_up

_UP = "-y"
_KINDS = {".bin": colmap_binary, ".txt": colmap_text}


def is_model(folder: Path) -> bool:
    return any((folder / f"images{suffix}").is_file() for suffix in _KINDS)


def read(folder: Path, options: TrackOptions) -> CameraTrack:
    """Binary goes before text. Frames are numbered by the names of the pictures."""
    found = [suffix for suffix in _KINDS if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))]
    if not found:
        raise InputError(f"expected a COLMAP model in {folder}: cameras.bin and images.bin, or both as .txt")
    kind, cameras_path, images_path = _KINDS[found[0]], folder / f"cameras{found[0]}", folder / f"images{found[0]}"
    cameras, images = kind.read_cameras(cameras_path), kind.read_images(images_path)
    if missing := {each.camera for each in images} - set(cameras):
        raise InputError(f"{images_path} names cameras {sorted(missing)}, which {cameras_path.name} does not hold: copy both again")
    if not images:
        raise InputError(f"{images_path} holds no image: COLMAP placed none")
    made = [tracked_frame(each, cameras[each.camera], options, f"{images_path}, {each.name}") for each in images]
    numbers = frame_numbers([each.name for each in images])
    return CameraTrack(dict(zip(numbers, made, strict=True)), options.up or _UP, options.is_metric(False))


def write_text(folder: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    return _write(folder, track, options, ".txt")


def write_binary(folder: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    return _write(folder, track, options, ".bin")


def _write(folder: Path, track: CameraTrack, options: TrackOptions, suffix: str) -> tuple[str, ...]:
    """Frames with the same intrinsics share a camera."""
    turned = with_up(track, options.up or _UP)
    numbers_of: dict[ColmapCamera, int] = {}
    images = []
    for number in turned.numbers:
        frame = turned.frames[number]
        camera = numbers_of.setdefault(colmap_camera(frame), len(numbers_of) + 1)
        images.append(colmap_image(picture_name(number), frame, camera))
    _KINDS[suffix].write(folder, {number: camera for camera, number in numbers_of.items()}, images)
    return lost(track, ("lens distortion", "principal points off the middle", "pixels that are not square"))
