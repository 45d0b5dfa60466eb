"""OpenEXR files to and from NumPy: parts of named channels, half or float, and the primaries that a header states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.images.color import XYZ_from_rec709, convert, rec709_from_XYZ
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

Channels = dict[str, Float[np.ndarray, "height width"]]

_MAGIC = b"\x76\x2f\x31\x01"


@dataclass(frozen=True)
class ExrPart:
    """Picture of an EXR file: one part with its channels.

    channels: name to (H, W) float16 or float32, all of the size of the display window, with overscan more by `margins_px`.
    attributes: further header entries: numbers, strings, and chromaticities (CIE x, y of red, green, blue and white).
    header: all entries as OpenEXR gives them. origin_px: (x, y) of the display window. margins_px: left, top, right, bottom.
    """

    channels: Channels
    name: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    header: Mapping[str, Any] = field(default_factory=dict)
    origin_px: tuple[int, int] = (0, 0)
    margins_px: tuple[int, int, int, int] = (0, 0, 0, 0)

    def stacked(self, names: Sequence[str]) -> Float[np.ndarray, "height width channels"]:
        """Return the named channels as one (H, W, C) float32 array."""
        return np.stack(self.planes(names), axis=-1).astype(np.float32)

    def planes(self, names: Sequence[str]) -> list[Float[np.ndarray, "height width"]]:
        """Return the named channels, each (H, W) as the file has it; InputError where one is missing."""
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise InputError(f"expected the EXR channels {list(names)}, but {missing} are missing; the part has {sorted(self.channels)}")
        return [self.channels[name] for name in names]


def read_exr(path: Path | str, *, overscan: bool = False) -> list[ExrPart]:
    """Read all flat parts of an EXR file; data windows are placed into their display windows, with 0 outside.

    overscan: keep what lies around the display window. Raises InputError when the file is not EXR, is damaged or holds only deep parts.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise InputError(f"expected an EXR file at {path}, but there is none")
    with open(path, "rb") as file:
        if (begins := file.read(4)) and begins != _MAGIC:
            raise InputError(f"{path} cannot be read as EXR: its first bytes are of another kind of file; render or convert it to EXR")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            is_deep = any(part.type() in (OpenEXR.deepscanline, OpenEXR.deeptile) for part in file.parts)
            flat = [part for part in file.parts if part.type() in (OpenEXR.scanlineimage, OpenEXR.tiledimage)]
            parts = [_part_from_openexr(part, overscan) for part in flat]
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None
    if not parts and is_deep:
        raise InputError(f"{path} holds no flat picture (deep EXR): flatten it first")
    if not parts:
        raise InputError(f"{path} cannot be read as EXR: its pixels are missing or damaged, copy or render it again")
    return parts


def header_of(path: Path | str) -> dict[str, Any]:
    """Return the header entries of the first part of an EXR file that holds R, else of its first."""
    headers = headers_of(path)
    return next((each for each in headers if any(channel.name == "R" for channel in each["channels"])), headers[0])


def headers_of(path: Path | str) -> list[dict[str, Any]]:
    """Return the header entries of all parts of an EXR file, without reading its pixels. Raises InputError where it is none."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            return [dict(part.header) for part in file.parts]
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None


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


def _part_from_openexr(part: Any, overscan: bool) -> ExrPart:
    header = part.header
    (data_min, data_max), (display_min, display_max) = header["dataWindow"], header["displayWindow"]
    over = np.maximum([display_min - data_min, data_max - display_max], 0) if overscan else np.zeros((2, 2), np.int64)
    size = tuple((display_max - display_min + 1 + over.sum(axis=0))[::-1].tolist())
    offset_y, offset_x = (data_min - display_min + over[0])[::-1].tolist()
    channels = {name: _placed(channel.pixels, size, offset_y, offset_x) for name, channel in part.channels.items()}
    told = {key: value for key, value in header.items() if isinstance(value, (int, float, str)) or key == "chromaticities"}
    attributes = {key: value for key, value in told.items() if key != "name"}
    left, top, right, bottom = over.ravel().tolist()
    return ExrPart(
        channels=channels,
        name=str(header.get("name", "")),
        attributes=attributes,
        header=dict(header),  # OpenEXR empties its own when the file is closed
        origin_px=(int(display_min[0]), int(display_min[1])),
        margins_px=(left, top, right, bottom),
    )


def _placed(pixels: np.ndarray, size: tuple[int, ...], offset_y: int, offset_x: int) -> np.ndarray:
    """Place a data window in its display window; pixels outside the display window are dropped."""
    if pixels.dtype == np.uint32:
        pixels = pixels.astype(np.float32)
    if pixels.shape == size and (offset_y, offset_x) == (0, 0):
        return pixels
    placed = np.zeros(size, pixels.dtype)
    top, left = max(offset_y, 0), max(offset_x, 0)
    cut = pixels[top - offset_y : size[0] - offset_y, left - offset_x : size[1] - offset_x]
    placed[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return placed


ATTRIBUTE = "chromaticities"
SPACE_NAME, INTEROP_ID = "oiio:ColorSpace", "colorInteropID"
"""Header entries of a colour space: the name by which OpenColorIO knows it, and that of the Color Interop Forum (OpenEXR 3.4)."""
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""CIE x, y of red, green, blue and white (D65), ITU-R BT.709; what EXR takes where a file states nothing."""

BT2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
"""Primaries and white of ITU-R BT.2020, which holds nearly all colours of real things."""

AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
"""Primaries and white of ACES2065-1 (SMPTE ST 2065-1)."""

AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
"""Primaries and white of ACEScg (S-2014-004)."""

P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
"""Primaries of SMPTE RP 431-2 with the white of displays."""

INTEROP_IDS: dict[tuple[float, ...], str] = {
    REC709: "lin_rec709_scene",
    BT2020: "lin_rec2020_scene",
    AP0: "lin_ap0_scene",
    AP1: "lin_ap1_scene",
    P3_D65: "lin_p3d65_scene",
}

STATED_REC709 = {ATTRIBUTE: REC709, INTEROP_ID: INTEROP_IDS[REC709], SPACE_NAME: "lin_rec709"}
"""Header entries of pictures as they are here."""

# Cone responses that the Bradford transform scales (Lam 1985; CIE 160:2004).
_CONES_FROM_XYZ = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# Programs write D65 with four to six digits.
_SAME_XY = 1e-4
# Digits with which configurations of colour spaces state their matrices.
_SAME_MATRIX = 1e-3
# Of real colour spaces it is below 10; three primaries on one line, rounded to float32, have 1e6 and more.
_LARGEST_CONDITION = 1e4


def stated_primaries(part: ExrPart, parts: Sequence[ExrPart] = ()) -> tuple[float, ...] | None:
    """Return the primaries (x, y of red, green, blue, white) that a part states. parts: others of its file, which may state them for it."""
    stated = (each.attributes.get(ATTRIBUTE) for each in (part, *parts))
    return next((each for each in stated if isinstance(each, tuple)), None)


def in_rec709(
    rgb: Float32[np.ndarray, "*batch 3"], primaries: tuple[float, ...] | None, path: Path | str
) -> Float32[np.ndarray, "*batch 3"]:
    """Convert RGB of stated primaries to linear Rec.709 with D65 white; Rec.709, no primaries, NaN and infinite pixels stay as they are.

    path: the file, for the error. Raises InputError where the primaries are no colour space.
    """
    if primaries is None or np.abs(np.subtract(primaries, REC709)).max() < _SAME_XY:
        return rgb
    matrix = rec709_from_chromaticities(primaries)
    if matrix is None:
        raise InputError(
            f"{path}: expected primaries that span a colour space (EXR attribute {ATTRIBUTE}: x, y of red, green, blue and white), got "
            f"{', '.join(f'{each:g}' for each in primaries)}: correct the attribute, or remove it if the picture is Rec.709"
        )
    finite = np.isfinite(rgb).all(axis=-1, keepdims=True)
    if finite.all():
        return convert(rgb, matrix)
    return np.where(finite, convert(np.where(finite, rgb, np.float32(0.0)), matrix), rgb)


def rec709_from_chromaticities(chromaticities: Sequence[float]) -> Float64[np.ndarray, "3 3"] | None:
    """Return the matrix to linear Rec.709 from RGB of stated primaries; a white other than D65 is adapted (Bradford), so rows sum to 1.

    chromaticities: CIE x, y of red, green, blue and white; they may lie outside of real colours, as those of cameras do.
    None where they are no colour space: primaries on one line, white without luminance.
    """
    XYZ_from_rgb = _xyz_matrix(np.asarray(chromaticities, np.float64).reshape(4, 2))
    return None if XYZ_from_rgb is None else rec709_from_matrix(XYZ_from_rgb)


def rec709_from_matrix(XYZ_from_rgb: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"] | None:
    """Return the matrix to linear Rec.709 from RGB whose XYZ are known; its white is adapted to D65 (Bradford). None without a white."""
    ours, theirs = (_CONES_FROM_XYZ @ matrix.sum(axis=1) for matrix in (XYZ_from_rec709, XYZ_from_rgb))
    if theirs.min() <= 0:
        return None
    adapted = np.linalg.solve(_CONES_FROM_XYZ, (ours / theirs)[:, None] * _CONES_FROM_XYZ)
    return rec709_from_XYZ @ adapted @ XYZ_from_rgb


def known_primaries(rec709_from_rgb: Float64[np.ndarray, "3 3"]) -> tuple[float, ...] | None:
    """Return the primaries of the public standard whose matrix to linear Rec.709 this is; None if it is none of them."""
    for primaries in (REC709, BT2020, AP0, AP1, P3_D65):
        if np.abs(_known(rec709_from_chromaticities(primaries)) - rec709_from_rgb).max() < _SAME_MATRIX:
            return primaries
    return None


def _xyz_matrix(xy: Float[np.ndarray, "4 2"]) -> Float64[np.ndarray, "3 3"] | None:
    """Return XYZ from RGB, whose primaries add up to a white of Y = 1 (OpenEXR, technical introduction); a primary's y may be 0."""
    if not np.isfinite(xy).all() or xy[3, 1] <= 0:
        return None
    xyz = np.column_stack([xy, 1.0 - xy.sum(axis=1)]).T
    columns, white = xyz[:, :3], xyz[:, 3] / xy[3, 1]
    if np.linalg.matrix_rank(columns) < 3:
        return None
    XYZ_from_rgb = columns * np.linalg.solve(columns, white)
    return XYZ_from_rgb if np.linalg.cond(XYZ_from_rgb) < _LARGEST_CONDITION else None


def _known(matrix: Float64[np.ndarray, "3 3"] | None) -> Float64[np.ndarray, "3 3"]:
    assert matrix is not None
    return matrix


BT2020_from_rec709 = np.linalg.inv(_known(rec709_from_chromaticities(BT2020)))
ACESCG_from_rec709 = np.linalg.inv(_known(rec709_from_chromaticities(AP1)))
