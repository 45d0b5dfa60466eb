"""Meaning of a video's code values: its tags, defaults for missing ones, and the way to scene-linear Rec.709.

Transfer. A video tagged BT.709 (or BT.601, BT.2020, or not at all) is decoded by the inverse of the camera curve of BT.709 (the OETF),
so that the numbers are proportional to the light that fell on the sensor, which is what lens blur and "over" need. The display curve of
BT.1886 would give the light of the screen instead, with a contrast raised by a power of about 1.2. Writing uses the same curve, so that
reading and writing undo each other.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.images.color import XYZ_from_rec709, linear_to_srgb, rec709_from_XYZ, srgb_to_linear
from mrbokeh.system.errors import InputError

# Numbers of ITU-T H.273, which FFmpeg uses for its tags.
UNSPECIFIED = 2
LIMITED, FULL = 1, 2
_LUMA_OF_MATRIX = {1: (0.2126, 0.0722), 4: (0.30, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
_NAME_OF_TRANSFER = {1: "bt709", 4: "gamma22", 5: "gamma28", 6: "bt709", 8: "linear", 13: "srgb", 14: "bt709", 15: "bt709"}
_LINEAR = 8
_GAMMA = {"gamma22": 2.2, "gamma28": 2.8}
# x, y of red, green and blue; all with the white of D65.
_XY_OF_PRIMARIES = {
    5: ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06)),
    6: ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),
    7: ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
# The constants of BT.709, 1.099 and 0.018, with the digits of BT.2020, table 4, without which the curve has a step at the knee.
_SCALE, _KNEE = 1.09929682680944, 0.018053968510807
_ENTRIES = 16384
DECODE_TOP, ENCODE_TOP = 2.0, 1.25  # of code value and of linear light: beyond every code that a limited range can hold


@dataclass(frozen=True)
class VideoColor:
    """The meaning of a video's numbers, by H.273: `matrix` 1 is BT.709, 6 is BT.601; `code_range` 1 limited, 2 full."""

    matrix: int
    code_range: int
    transfer: int
    primaries: int

    @property
    def transfer_name(self) -> str:
        """Codes without a curve of H.273 are numbers that stay as they are."""
        return "linear" if self.transfer == UNSPECIFIED else _NAME_OF_TRANSFER[self.transfer]

    @property
    def luma_weights(self) -> tuple[float, float]:
        """Weights of red and blue in luma."""
        return _LUMA_OF_MATRIX[self.matrix]


BT709 = VideoColor(matrix=1, code_range=LIMITED, transfer=1, primaries=1)
UNNAMED = VideoColor(matrix=1, code_range=LIMITED, transfer=UNSPECIFIED, primaries=UNSPECIFIED)
"""Codes of a colour space that H.273 does not know, such as those of cameras."""
UNNAMED_RGB = VideoColor(matrix=0, code_range=FULL, transfer=UNSPECIFIED, primaries=UNSPECIFIED)
BT709_RGB = VideoColor(matrix=0, code_range=FULL, transfer=1, primaries=1)


def color_of(frame: Any, where: str, *, as_codes: bool = False) -> VideoColor:
    """The tags of a decoded PyAV frame; what is untagged is BT.709 from HD on, BT.601 below, limited range.

    The transfer and the primaries of an untagged video are those of BT.709 at every size. as_codes: code values stay as they are,
    whatever transfer and primaries the tags say; only matrix and range are theirs.
    """
    is_rgb = frame.format.is_rgb
    hd = frame.width >= 1280 or frame.height > 576
    matrix = 0 if is_rgb else frame.colorspace if frame.colorspace != UNSPECIFIED else 1 if hd else 6
    full = is_rgb or frame.color_range == FULL or (frame.color_range == 0 and frame.format.name.startswith("yuvj"))
    tagged = (1 if tag in (0, UNSPECIFIED) else int(tag) for tag in (frame.color_trc, frame.color_primaries))
    color = VideoColor(matrix, FULL if full else LIMITED, *((_LINEAR, 1) if as_codes else tagged))
    _require_known(color, is_rgb, where)
    return color


def _require_known(color: VideoColor, is_rgb: bool, where: str) -> None:
    hint = "convert it to BT.709 first, for instance with FFmpeg's zscale filter"
    if color.transfer in (16, 18):
        raise InputError(f"{where} is HDR video ({'PQ' if color.transfer == 16 else 'HLG'}), expected standard dynamic range: {hint}")
    if color.transfer not in _NAME_OF_TRANSFER:
        raise InputError(f"{where} has transfer characteristic {color.transfer} of H.273, which is not known here: {hint}")
    if not is_rgb and color.matrix not in _LUMA_OF_MATRIX:
        raise InputError(f"{where} has colour matrix {color.matrix} of H.273, which is not known here: {hint}")
    if color.primaries != 1 and color.primaries not in _XY_OF_PRIMARIES:
        raise InputError(f"{where} has colour primaries {color.primaries} of H.273, which are not known here: {hint}")


def linear_from_code(code: Float[np.ndarray, "*shape"], transfer: str) -> Float32[np.ndarray, "*shape"]:
    """Code values (0 black, 1 white) to linear light; the curves go on outside [0, 1]."""
    if transfer == "srgb":
        return srgb_to_linear(code)
    code = np.asarray(code, np.float64)
    if transfer == "bt709":
        knee = 4.5 * _KNEE
        linear = np.where(code < knee, code / 4.5, ((np.maximum(code, knee) + _SCALE - 1) / _SCALE) ** (1 / 0.45))
    else:
        linear = np.sign(code) * np.abs(code) ** _GAMMA.get(transfer, 1.0)
    return linear.astype(np.float32)


def code_from_linear(linear: Float[np.ndarray, "*shape"], transfer: str) -> Float32[np.ndarray, "*shape"]:
    """Linear light to code values: the inverse of `linear_from_code`."""
    if transfer == "srgb":
        return linear_to_srgb(linear)
    linear = np.asarray(linear, np.float64)
    if transfer == "bt709":
        code = np.where(linear < _KNEE, linear * 4.5, _SCALE * np.maximum(linear, _KNEE) ** 0.45 - (_SCALE - 1))
    else:
        code = np.sign(linear) * np.abs(linear) ** (1.0 / _GAMMA.get(transfer, 1.0))
    return code.astype(np.float32)


@lru_cache(maxsize=8)
def decode_table(transfer: str) -> Float32[np.ndarray, " entries"]:
    """`linear_from_code` at evenly spaced codes from 0 to DECODE_TOP."""
    return linear_from_code(np.linspace(0.0, DECODE_TOP, _ENTRIES), transfer)


@lru_cache(maxsize=8)
def encode_table(transfer: str) -> Float32[np.ndarray, " entries"]:
    """`code_from_linear` at evenly spaced linear values from 0 to ENCODE_TOP."""
    return code_from_linear(np.linspace(0.0, ENCODE_TOP, _ENTRIES), transfer)


def rec709_from_primaries(primaries: int) -> Float64[np.ndarray, "3 3"]:
    """Linear RGB of a video's primaries to linear Rec.709 (both with D65 white, so white stays white)."""
    if primaries == 1:
        return np.eye(3)
    columns = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in _XY_OF_PRIMARIES[primaries]]).T
    white = XYZ_from_rec709.sum(axis=1)
    return rec709_from_XYZ @ (columns * np.linalg.solve(columns, white))
