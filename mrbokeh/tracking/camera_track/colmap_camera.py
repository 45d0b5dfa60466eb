"""COLMAP's camera models (src/colmap/sensor/models.h) and ours; the centre of its first pixel lies at (0.5, 0.5), as ours does."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.options import TrackOptions
from mrbokeh.tracking.camera_track.tracked_frame import DISTORTION_NAMES, TrackedFrame
from mrbokeh.tracking.camera_track.world_axes import rigid

MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
"""By number: name and parameters. The others are fisheyes and prisms."""

MODEL_OF_NAME = {name: number for number, (name, _) in MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """model: a number of MODELS."""

    model: int
    width_px: int
    height_px: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """turn: quaternion (w, x, y, z); with shift it takes world points into camera axes. camera: key of its ColmapCamera."""

    name: str
    turn: tuple[float, ...]
    shift: tuple[float, ...]
    camera: int


def model_number(model: int | str, where: str) -> int:
    """Raises InputError for a camera that is no pinhole with distortion."""
    number = MODEL_OF_NAME.get(model, -1) if isinstance(model, str) else model
    if number not in MODELS:
        raise InputError(
            f"{where}: expected one of {', '.join(MODEL_OF_NAME)}, got COLMAP's camera model {model}: "
            f"undistort the pictures with `colmap image_undistorter` first"
        )
    return number


def tracked_frame(image: ColmapImage, camera: ColmapCamera, options: TrackOptions, where: str) -> TrackedFrame:
    _, names = MODELS[camera.model]
    if len(names) != len(camera.parameters):
        raise InputError(f"{where}: expected {len(names)} parameters of the camera ({', '.join(names)}), got {len(camera.parameters)}")
    told = dict(zip(names, camera.parameters, strict=True))
    focal_px = (told.get("fx", told.get("f", 0.0)), told.get("fy", told.get("f", 0.0)))
    pose = rigid(_rotation(image.turn, where), np.array(image.shift, np.float64))
    distortion = {name: told[name] for name in DISTORTION_NAMES if name in told} if options.keep_distortion else {}
    made = Camera(camera.width_px, camera.height_px, focal_px, (told["cx"], told["cy"]), pose)
    return TrackedFrame(made, distortion=distortion if any(distortion.values()) else None)


def colmap_camera(frame: TrackedFrame) -> ColmapCamera:
    """PINHOLE, OPENCV or FULL_OPENCV, whichever is enough."""
    told = {**dict.fromkeys(DISTORTION_NAMES, 0.0), **frame.coefficients}
    model = 1 if not frame.coefficients else 6 if any(told[name] for name in DISTORTION_NAMES[4:]) else 4
    values = dict(zip(("fx", "fy", "cx", "cy"), (*frame.camera.focal_px, *frame.camera.principal_px), strict=True)) | told
    return ColmapCamera(model, frame.camera.width_px, frame.camera.height_px, tuple(float(values[name]) for name in MODELS[model][1]))


def colmap_image(name: str, frame: TrackedFrame, camera: int) -> ColmapImage:
    pose = frame.camera.camera_from_world
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
    return ColmapImage(name, (w, x, y, z), tuple(pose[:3, 3].tolist()), camera)


def _rotation(turn: Sequence[float], where: str) -> Float64[np.ndarray, "3 3"]:
    w, x, y, z = turn
    length = float(np.linalg.norm(turn))
    if not 0.5 < length < 2.0:
        raise InputError(f"{where}: expected a quaternion of length 1, got {tuple(turn)}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()
