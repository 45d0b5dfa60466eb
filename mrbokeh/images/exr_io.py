"""OpenEXR files: parts of named channels, half or float, to and from NumPy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

Channels = dict[str, Float[np.ndarray, "height width"]]


@dataclass(frozen=True)
class ExrPart:
    """One picture of an EXR file.

    channels: name to (H, W) float16 or float32, all of the size of the display window.
    attributes: further header entries: numbers, strings, and chromaticities (CIE x, y of red, green, blue and white).
    """

    channels: Channels
    name: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def stacked(self, names: Sequence[str]) -> Float[np.ndarray, "height width channels"]:
        """Return the named channels as one (H, W, C) float32 array."""
        return np.stack(self.planes(names), axis=-1).astype(np.float32)

    def planes(self, names: Sequence[str]) -> list[Float[np.ndarray, "height width"]]:
        """Return the named channels, each (H, W) as the file has it; InputError where one is missing."""
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise InputError(f"expected the EXR channels {list(names)}, but {missing} are missing; the part has {sorted(self.channels)}")
        return [self.channels[name] for name in names]


def read_exr(path: Path | str) -> list[ExrPart]:
    """All flat parts of an EXR file; data windows are placed into their display windows, with 0 outside.

    Raises InputError when the file is not EXR, is damaged or holds only deep parts.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise InputError(f"expected an EXR file at {path}, but there is none")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            is_deep = any(part.type() in (OpenEXR.deepscanline, OpenEXR.deeptile) for part in file.parts)
            flat = [part for part in file.parts if part.type() in (OpenEXR.scanlineimage, OpenEXR.tiledimage)]
            parts = [_part_from_openexr(part) for part in flat]
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None
    if not parts and is_deep:
        raise InputError(f"{path} holds no flat picture (deep EXR): flatten it first")
    if not parts:
        raise InputError(f"{path} cannot be read as EXR: its pixels are missing or damaged, copy or render it again")
    return parts


def write_exr(path: Path | str, parts: Sequence[ExrPart] | ExrPart, *, compress: bool = True) -> None:
    """Write one or more parts with ZIP compression; float16 channels are stored as half, float32 as float.

    compress: False for float32 planes of photographs, which ZIP makes a tenth smaller in ten times the time.
    """
    import OpenEXR

    parts = [parts] if isinstance(parts, ExrPart) else list(parts)
    several = len(parts) > 1
    converted = []
    for index, part in enumerate(parts):
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION if compress else OpenEXR.NO_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            **part.attributes,
        }
        channels = {name: np.ascontiguousarray(pixels) for name, pixels in part.channels.items()}
        name = part.name or (f"part{index}" if several else "")
        converted.append(OpenEXR.Part(header, channels, name) if name else OpenEXR.Part(header, channels))
    with atomic_path(path) as temporary:
        OpenEXR.File(converted).write(str(temporary))


def _part_from_openexr(part: Any) -> ExrPart:
    header = part.header
    data_min, display_min = header["dataWindow"][0], header["displayWindow"][0]
    size = tuple((header["displayWindow"][1] - display_min + 1)[::-1].tolist())
    offset_y, offset_x = (data_min - display_min)[::-1].tolist()
    channels = {name: _placed(channel.pixels, size, offset_y, offset_x) for name, channel in part.channels.items()}
    told = {key: value for key, value in header.items() if isinstance(value, (int, float, str)) or key == "chromaticities"}
    attributes = {key: value for key, value in told.items() if key != "name"}
    return ExrPart(channels, str(header.get("name", "")), attributes)


def _placed(pixels: np.ndarray, size: tuple[int, ...], offset_y: int, offset_x: int) -> np.ndarray:
    """A data window within its display window; what lies outside the display window is cut off."""
    if pixels.dtype == np.uint32:
        pixels = pixels.astype(np.float32)
    if pixels.shape == size and (offset_y, offset_x) == (0, 0):
        return pixels
    placed = np.zeros(size, pixels.dtype)
    top, left = max(offset_y, 0), max(offset_x, 0)
    cut = pixels[top - offset_y : size[0] - offset_y, left - offset_x : size[1] - offset_x]
    placed[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return placed
