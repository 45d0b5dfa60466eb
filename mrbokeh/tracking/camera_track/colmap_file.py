"""A folder with a COLMAP model, text or binary, as a CameraTrack.

Its world has no axis that points up by rule; most maps begin with a camera held upright, whose -y that is. Its unit is open. Camera models
are those of src/colmap/sensor/models.h; the centre of its first pixel lies at (0.5, 0.5), as ours does.

points3D.bin is not opened, for poses do not need it. Counts in binary files are believed only as far as the file reaches: a file that was
cut off ends in a sentence, not in all memory.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import DISTORTION_NAMES, CameraTrack, TrackedFrame, TrackOptions, frame_numbers, lost, picture_name
from mrbokeh.tracking.world_axes import rigid

MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
"""Name and parameters by number. The others are fisheyes and prisms."""

MODEL_OF_NAME = {name: number for number, (name, _) in MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """Camera of a COLMAP model; model: a number of MODELS."""

    model: int
    width_px: int
    height_px: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """Posed picture; turn (quaternion w, x, y, z) and shift take world points into camera axes. camera: key of its ColmapCamera."""

    name: str
    turn: tuple[float, ...]
    shift: tuple[float, ...]
    camera: int


def model_number(model: int | str, where: str) -> int:
    """Return the number of a camera model. Raises InputError for a camera that is no pinhole with distortion."""
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
    made = Camera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        focal_px=focal_px,
        principal_px=(told["cx"], told["cy"]),
        camera_from_world=pose,
    )
    return TrackedFrame(made, distortion=distortion if any(distortion.values()) else None)


def colmap_camera(frame: TrackedFrame) -> ColmapCamera:
    """Return the camera as PINHOLE, OPENCV or FULL_OPENCV, whichever is enough."""
    told = {**dict.fromkeys(DISTORTION_NAMES, 0.0), **frame.coefficients}
    model = 1 if not frame.coefficients else 6 if any(told[name] for name in DISTORTION_NAMES[4:]) else 4
    values = dict(zip(("fx", "fy", "cx", "cy"), (*frame.camera.focal_px, *frame.camera.principal_px), strict=True)) | told
    return ColmapCamera(model, frame.camera.width_px, frame.camera.height_px, tuple(float(values[name]) for name in MODELS[model][1]))


def colmap_image(name: str, frame: TrackedFrame, camera: int) -> ColmapImage:
    from scipy.spatial.transform import Rotation

    pose = frame.camera.camera_from_world
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
    return ColmapImage(name, (w, x, y, z), tuple(pose[:3, 3].tolist()), camera)


def _rotation(turn: Sequence[float], where: str) -> Float64[np.ndarray, "3 3"]:
    from scipy.spatial.transform import Rotation

    w, x, y, z = turn
    length = float(np.linalg.norm(turn))
    if not 0.5 < length < 2.0:
        raise InputError(f"{where}: expected a quaternion of length 1, got {tuple(turn)}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT_BYTES = 24  # x, y as doubles and the number of the point in 64 bits


@dataclass
class _Reader:
    path: Path
    content: bytes
    place: int = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        self._require(layout.size)
        values = layout.unpack_from(self.content, self.place)
        self.place += layout.size
        return values

    def name(self) -> str:
        end = self.content.find(b"\0", self.place)
        if end < 0:
            self._require(len(self.content))
        text = self.content[self.place : end].decode("utf-8", errors="replace")
        self.place = end + 1
        return text

    def skip(self, count: int) -> None:
        self._require(count)
        self.place += count

    def _require(self, count: int) -> None:
        if self.place + count > len(self.content):
            raise InputError(f"{self.path} is cut off: copy it again, or run COLMAP again")


def _read_binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    reader = _Reader(path, path.read_bytes())
    cameras = {}
    for _ in range(*reader.take(_COUNT)):
        number, model, width_px, height_px = reader.take(_CAMERA)
        parameters = MODELS[model_number(model, str(path))][1]
        cameras[number] = ColmapCamera(model, width_px, height_px, reader.take(struct.Struct(f"<{len(parameters)}d")))
    return cameras


def _read_binary_images(path: Path) -> list[ColmapImage]:
    reader = _Reader(path, path.read_bytes())
    images = []
    for _ in range(*reader.take(_COUNT)):
        _, *values, camera = reader.take(_IMAGE)
        name = reader.name()
        reader.skip(reader.take(_COUNT)[0] * _POINT_BYTES)
        images.append(ColmapImage(name, tuple(values[:4]), tuple(values[4:]), camera))
    return images


def _write_binary(folder: Path, cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> None:
    """Write the model as .bin, with an empty points3D.bin, without which COLMAP opens no model."""
    camera_bytes = b"".join(
        _CAMERA.pack(number, each.model, each.width_px, each.height_px) + struct.pack(f"<{len(each.parameters)}d", *each.parameters)
        for number, each in cameras.items()
    )
    image_bytes = b"".join(
        _IMAGE.pack(number, *each.turn, *each.shift, each.camera) + each.name.encode() + b"\0" + _COUNT.pack(0)
        for number, each in enumerate(images, 1)
    )
    for name, count, content in (
        ("points3D.bin", 0, b""),
        ("cameras.bin", len(cameras), camera_bytes),
        ("images.bin", len(images), image_bytes),
    ):
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(_COUNT.pack(count) + content)


def _read_text_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read lines of CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""
    cameras = {}
    for line, where in _lines(path):
        if not line:
            continue
        parts = line.split()
        try:
            number, width_px, height_px = int(parts[0]), int(parts[2]), int(parts[3])
            parameters = tuple(float(each) for each in parts[4:])
        except (IndexError, ValueError):
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r}") from None
        cameras[number] = ColmapCamera(model_number(parts[1], where), width_px, height_px, parameters)
    return cameras


def _read_text_images(path: Path) -> list[ColmapImage]:
    """Read lines of IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each with a line of its points, which may be empty."""
    images = []
    for index, (line, where) in enumerate(_lines(path)):
        if index % 2:
            continue
        parts = line.split(maxsplit=9)
        try:
            values = [float(each) for each in parts[1:8]]
            images.append(ColmapImage(parts[9], tuple(values[:4]), tuple(values[4:]), int(parts[8])))
        except (IndexError, ValueError):
            if not line:
                continue
            raise InputError(f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r}") from None
    return images


def _write_text(folder: Path, cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> None:
    """Write the model as .txt, with an empty points3D.txt, without which COLMAP opens no model."""
    camera_lines = [
        " ".join([str(number), MODELS[each.model][0], str(each.width_px), str(each.height_px), *map(repr, each.parameters)])
        for number, each in cameras.items()
    ]
    image_lines = [
        " ".join([str(number), *map(repr, (*each.turn, *each.shift)), str(each.camera), each.name]) + "\n"
        for number, each in enumerate(images, 1)
    ]
    for name, lines in (("points3D.txt", []), ("cameras.txt", camera_lines), ("images.txt", image_lines)):
        with atomic_path(folder / name) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield (text, where it is) of all lines but comments, with the empty ones: those may be an image without points."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"expected text in {path}, but it is not") from None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield line.strip(), f"{path}, line {number}"


_UP = "-y"
_KINDS = {
    ".bin": (_read_binary_cameras, _read_binary_images, _write_binary),
    ".txt": (_read_text_cameras, _read_text_images, _write_text),
}
"""Functions that read (cameras, images) and write the files of each suffix."""


def read(folder: Path, options: TrackOptions) -> CameraTrack:
    """Read a model, binary before text. Frames are numbered by the names of the pictures."""
    found = [suffix for suffix in _KINDS if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images"))]
    if not found:
        raise InputError(f"expected a COLMAP model in {folder}: cameras.bin and images.bin, or both as .txt")
    (read_cameras, read_images, _), cameras_path, images_path = (
        _KINDS[found[0]],
        folder / f"cameras{found[0]}",
        folder / f"images{found[0]}",
    )
    cameras, images = read_cameras(cameras_path), read_images(images_path)
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
    """Write a model in which frames with the same intrinsics share a camera."""
    turned = track.with_up(options.up or _UP)
    numbers_of: dict[ColmapCamera, int] = {}
    images = []
    for number in turned.numbers:
        frame = turned.frames[number]
        camera = numbers_of.setdefault(colmap_camera(frame), len(numbers_of) + 1)
        images.append(colmap_image(picture_name(number), frame, camera))
    _KINDS[suffix][2](folder, {number: camera for camera, number in numbers_of.items()}, images)
    return lost(track, ("lens distortion", "principal points off the middle", "pixels that are not square"))
