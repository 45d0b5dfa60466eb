"""cameras.bin and images.bin of a COLMAP model; points3D.bin is not opened, for poses do not need it.

Counts in these files are believed only as far as the file reaches: a file that was cut off ends in a sentence, not in all memory.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.colmap_camera import MODELS, ColmapCamera, ColmapImage, model_number

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


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    reader = _Reader(path, path.read_bytes())
    cameras = {}
    for _ in range(*reader.take(_COUNT)):
        number, model, width_px, height_px = reader.take(_CAMERA)
        parameters = MODELS[model_number(model, str(path))][1]
        cameras[number] = ColmapCamera(model, width_px, height_px, reader.take(struct.Struct(f"<{len(parameters)}d")))
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    reader = _Reader(path, path.read_bytes())
    images = []
    for _ in range(*reader.take(_COUNT)):
        _, *values, camera = reader.take(_IMAGE)
        name = reader.name()
        reader.skip(reader.take(_COUNT)[0] * _POINT_BYTES)
        images.append(ColmapImage(name, tuple(values[:4]), tuple(values[4:]), camera))
    return images


def write(folder: Path, cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> None:
    """Also an empty points3D.bin, without which COLMAP opens no model."""
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
