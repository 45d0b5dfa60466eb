"""Nuke's .chan: one line a frame with FRAME TX TY TZ RX RY RZ VFOV.

Y is up, the camera looks along -z; angles in degrees, the vertical angle of view last. The rotation order names the rotation that
is applied to points first: Nuke's own is ZXY, that is roll, then tilt, then pan. The file tells neither it nor the size of the
pictures; pixels are square and the principal point lies in the middle.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame, TrackOptions, lost
from mrbokeh.tracking.world_axes import from_opengl, rigid, to_opengl

_COLUMNS = "FRAME TX TY TZ RX RY RZ VFOV"
_UP = "+y"


def read(path: Path, options: TrackOptions) -> CameraTrack:
    """Read a .chan; options.size_px is needed. Raises InputError with the line that is wrong."""
    if options.size_px is None:
        raise InputError(f"{path}: a .chan does not tell the size of the pictures: give --size WIDTHxHEIGHT")
    frames: dict[int, TrackedFrame] = {}
    for line_number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = _values(line, f"{path}, line {line_number}")
        frame = round(values[0])
        if frame in frames:
            raise InputError(f"{path}, line {line_number}: frame {frame} comes twice")
        frames[frame] = TrackedFrame(_camera(values[1:], options.size_px, options.rotation_order))
    if not frames:
        raise InputError(f"{path} holds no frame: expected lines of {_COLUMNS}")
    return CameraTrack(frames, options.up or _UP, options.is_metric(True))


def write(path: Path, track: CameraTrack, options: TrackOptions) -> tuple[str, ...]:
    """Write a .chan with all digits. Returns what it cannot hold."""
    turned = track.with_up(options.up or _UP)
    lines = [_line(number, turned.frames[number].camera, options.rotation_order) for number in turned.numbers]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
    return lost(track)


def _values(line: str, where: str) -> list[float]:
    try:
        values = [float(each) for each in line.split()]
    except ValueError:
        values = []
    if len(values) != 8 or not np.isfinite(values).all() or not 0.0 < values[7] < 180.0:
        raise InputError(f"{where}: expected 8 numbers, {_COLUMNS} (in degrees, VFOV between 0 and 180), got {line.strip()!r}")
    return values


def _camera(values: Sequence[float], size_px: tuple[int, int], order: str) -> Camera:
    place, angles_deg, view_deg = values[:3], values[3:6], values[6]
    width_px, height_px = size_px
    focal_px = 0.5 * height_px / np.tan(np.deg2rad(view_deg) / 2.0)
    # Lower case stands for fixed axes, in the order of application.
    turn = Rotation.from_euler(order.lower(), _in_order(angles_deg, order), degrees=True)
    pose = from_opengl(rigid(turn.as_matrix(), np.asarray(place, np.float64)))
    return Camera(
        width_px=width_px,
        height_px=height_px,
        focal_px=(float(focal_px), float(focal_px)),
        principal_px=(width_px / 2.0, height_px / 2.0),
        camera_from_world=pose,
    )


def _in_order(xyz_deg: Sequence[float], order: str) -> list[float]:
    return [xyz_deg["XYZ".index(axis)] for axis in order]


def _line(number: int, camera: Camera, order: str) -> str:
    world_from_camera = to_opengl(camera.camera_from_world)
    angles_deg = _euler_deg(world_from_camera[:3, :3], order)
    view_deg = np.rad2deg(2.0 * np.arctan(0.5 * camera.height_px / camera.focal_px[1]))
    return " ".join([str(number), *(repr(float(value)) for value in (*world_from_camera[:3, 3], *angles_deg, view_deg))]) + "\n"


def _euler_deg(rotation: np.ndarray, order: str) -> list[float]:
    """Return angles of x, y, z. If the middle rotation is a right angle, many triples are one rotation: SciPy chooses, and would warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(rotation).as_euler(order.lower(), degrees=True)
    return [float(angles[order.index(axis)]) for axis in "XYZ"]
