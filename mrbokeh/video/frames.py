"""Conversion of stored video frames (PyAV) to pictures: linear light, 8-bit codes for a preview, alpha; and back.

FFmpeg scales chroma and bit depth; the step between luma-chroma and RGB is ours, because FFmpeg's (swscale 9) goes through truncated 8
bit whatever the depth, and is half an 8-bit step too dark in the mean.
"""

from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.images.color import convert
from mrbokeh.video.color import (
    DECODE_TOP,
    ENCODE_TOP,
    LIMITED,
    VideoColor,
    decode_table,
    encode_table,
    linear_from_code,
    rec709_from_primaries,
)
from mrbokeh.video.encodings import Encoding


def has_alpha(frame: Any) -> bool:
    """Return whether a frame holds coverage, even if it is opaque everywhere."""
    return any(component.is_alpha for component in frame.format.components)


def stored_alpha(frame: Any) -> Float32[np.ndarray, "height width"]:
    """Return the coverage of a frame that has some, in [0, 1], the way up in which it is stored; it uses the full range of codes."""
    bits = next(component.bits for component in frame.format.components if component.is_alpha)
    plane = _with_plane(frame, bits).planes[-1]
    codes = np.frombuffer(plane, np.uint8 if bits == 8 else "<u2").reshape(frame.height, -1)[:, : frame.width]
    return codes / np.float32((1 << bits) - 1)


def _with_plane(frame: Any, bits: int) -> Any:
    """A frame whose last plane is the coverage alone, in little-endian numbers."""
    name, alpha = frame.format.name, frame.format.components[-1]
    if alpha.plane == len(frame.format.components) - 1 and not name.endswith("be"):
        return frame
    planar = "gbrap" if frame.format.is_rgb else "yuva444p"
    return frame.reformat(format=planar if bits == 8 else f"{planar}{bits}le")


def _planes(frame: Any, count: int = 3) -> list[np.ndarray]:
    """The stored numbers of the first planes, (H, W) each; they live as long as the frame."""
    dtype = np.dtype(np.uint8) if frame.format.components[0].bits == 8 else np.dtype("<u2")
    planes = [frame.planes[i] for i in range(count)]
    return [np.frombuffer(p, dtype).reshape(p.height, p.line_size // dtype.itemsize)[:, : p.width] for p in planes]


def _full_chroma(frame: Any, color: VideoColor, size: tuple[int, int] | None = None) -> tuple[list[np.ndarray], int]:
    """Luma and chroma planes of full resolution and the bits of their codes; range and matrix stay untouched.

    Where chroma or the size has to be interpolated the codes are shifted up to 16 bit, to keep what lies between two of
    them. Elsewhere they stay as they are: FFmpeg would not shift but stretch 8 bit to 16 if nothing else is to be done.
    """
    from av.video.reformatter import Interpolation

    width, height = size or (frame.width, frame.height)
    if len(frame.format.components) < 3:
        return _grey_planes(frame, width, height), frame.format.components[0].bits
    whole = frame.format.chroma_width(width) == width and frame.format.chroma_height(height) == height
    stored_bits = frame.format.components[0].bits if whole and (width, height) == (frame.width, frame.height) else 16
    pixel_format = "yuv444p" if stored_bits == 8 else f"yuv444p{stored_bits}le"
    matrix = {6: 5}.get(color.matrix, color.matrix)  # swscale's own number of BT.601 is 5
    same = {"src_colorspace": matrix, "dst_colorspace": matrix, "src_color_range": color.code_range, "dst_color_range": color.code_range}
    how = Interpolation.BICUBIC | Interpolation.ACCURATE_RND
    scaled = frame.reformat(width=width, height=height, format=pixel_format, interpolation=how, **same)
    # Copied, for the planes live no longer than their frame.
    return [plane.copy() for plane in _planes(scaled)], stored_bits


def _grey_planes(frame: Any, width: int, height: int) -> list[np.ndarray]:
    """Return a picture without chroma with neutral chroma; FFmpeg would take it for full range, whatever its tag says."""
    bits = frame.format.components[0].bits
    pixel_format = frame.format.name.replace("ya16be", "gray16le").replace("ya16", "gray16").replace("ya8", "gray")
    luma = _planes(frame.reformat(width=width, height=height, format=pixel_format), 1)[0].copy()
    neutral = np.full_like(luma, 128 << (bits - 8))
    return [luma, neutral, neutral]


def _code_scale(
    color: VideoColor, bits: int, stored_bits: int
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float, float, float]]:
    """Return (zeros, gains, matrix) of `_frames_numba` for codes of `bits`, shifted up to `stored_bits` (H.273, 8.3)."""
    unit = 2.0 ** (stored_bits - 8)
    if color.code_range == LIMITED:
        zeros, gains = (16 * unit, 128 * unit), (1 / (219 * unit), 1 / (224 * unit))
    else:
        largest = float(((1 << bits) - 1) << (stored_bits - bits))
        zeros, gains = (0.0, 128 * unit), (1 / largest, 1 / largest)
    red, blue = color.luma_weights
    green = 1 - red - blue
    matrix = (2 * (1 - red), -2 * (1 - blue) * blue / green, -2 * (1 - red) * red / green, 2 * (1 - blue))
    return zeros, gains, matrix


def _rgb_codes(frame: Any, size: tuple[int, int] | None = None) -> tuple[list[np.ndarray], int]:
    """Red, green and blue planes of an RGB frame as they are stored, and their bits.

    Alpha goes along where there is some: without it FFmpeg (swscale 9.5) leaves parts of rows unwritten above 8 bits.
    """
    from av.video.reformatter import Interpolation

    bits = max(8, frame.format.components[0].bits)
    width, height = size or (frame.width, frame.height)
    planes = "gbrap" if has_alpha(frame) else "gbrp"
    pixel_format = planes if bits == 8 else f"{planes}{bits}le"
    planar = frame.reformat(width=width, height=height, format=pixel_format, interpolation=Interpolation.BICUBIC)
    green, blue, red = (plane.copy() for plane in _planes(planar))
    return [red, green, blue], bits


def linear_rgb(frame: Any, color: VideoColor) -> Float32[np.ndarray, "height width 3"]:
    """The frame as linear Rec.709."""
    rgb = _linear_of_rgb(frame, color) if frame.format.is_rgb else _linear_of_luma_chroma(frame, color)
    return rgb if color.primaries == 1 else convert(rgb, rec709_from_primaries(color.primaries))


def _linear_of_rgb(frame: Any, color: VideoColor) -> Float32[np.ndarray, "height width 3"]:
    planes, bits = _rgb_codes(frame)
    of_every_code = linear_from_code(np.arange(1 << bits) / ((1 << bits) - 1), color.transfer_name)
    return of_every_code[np.dstack(planes)]


def _linear_of_luma_chroma(frame: Any, color: VideoColor) -> Float32[np.ndarray, "height width 3"]:
    from mrbokeh.video._frames_numba import linear_from_planes

    (y, cb, cr), stored_bits = _full_chroma(frame, color)
    zeros, gains, matrix = _code_scale(color, frame.format.components[0].bits, stored_bits)
    table = decode_table(color.transfer_name)
    return linear_from_planes(y, cb, cr, zeros, gains, matrix, table, (len(table) - 1) / DECODE_TOP)


def display_bgr(frame: Any, color: VideoColor, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
    """The frame scaled to a size (width, height), its code values in 8 bit, blue first; primaries stay as they are."""
    from mrbokeh.video._frames_numba import bgr8_from_planes

    if frame.format.is_rgb:
        planes, bits = _rgb_codes(frame, size)
        return np.dstack([plane >> (bits - 8) for plane in planes[::-1]]).astype(np.uint8)
    (y, cb, cr), stored_bits = _full_chroma(frame, color, size)
    zeros, gains, matrix = _code_scale(color, frame.format.components[0].bits, stored_bits)
    return bgr8_from_planes(y, cb, cr, zeros, gains, matrix)


def encoded_frame(picture: Float32[np.ndarray, "height width channels"], encoding: Encoding, color: VideoColor) -> Any:
    """A PyAV frame of linear light (H, W, 3), tagged; of an encoding with alpha also (H, W, 4), premultiplied.

    What is stored beside alpha is the straight colour (not multiplied), as editing programs expect of ProRes 4444.
    """
    import av

    picture = np.asarray(picture, np.float32)
    frame = av.VideoFrame(picture.shape[1], picture.shape[0], encoding.pixel_format)
    planes = _stored_planes(_straight(picture), encoding, color)
    if encoding.alpha:
        planes.append(_alpha_codes(picture, encoding.bits))
    for target, plane in zip(_planes(frame, len(planes)), planes, strict=True):
        target[:] = plane
    frame.colorspace, frame.color_range = color.matrix, color.code_range
    frame.color_trc, frame.color_primaries = color.transfer, color.primaries
    return frame


def _straight(picture: Float32[np.ndarray, "height width channels"]) -> Float32[np.ndarray, "height width 3"]:
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:]
    return np.divide(picture[..., :3], alpha, out=np.zeros_like(picture[..., :3]), where=alpha > 0)


def _alpha_codes(picture: Float32[np.ndarray, "height width channels"], bits: int) -> np.ndarray:
    """Coverage uses the full range of codes, whatever colour does."""
    largest = (1 << bits) - 1
    if picture.shape[2] == 3:
        return np.full(picture.shape[:2], largest, np.uint16)
    return np.rint(np.clip(picture[..., 3], 0.0, 1.0) * largest)


def _stored_planes(rgb: Float32[np.ndarray, "height width 3"], encoding: Encoding, color: VideoColor) -> list[np.ndarray]:
    """Integer planes in the order of the pixel format: green, blue, red or luma and chroma of limited range."""
    from mrbokeh.video._frames_numba import codes_from_linear, planes_from_linear

    table = encode_table(color.transfer_name)
    per_linear = (len(table) - 1) / ENCODE_TOP
    if color.matrix == 0:
        largest = float((1 << encoding.bits) - 1)
        return [codes_from_linear(np.ascontiguousarray(rgb[..., i]), largest, table, per_linear) for i in (1, 2, 0)]
    floor, ceiling = (1 - 16) / 219, (254 - 16) / 219
    luma, *chroma = planes_from_linear(rgb, *color.luma_weights, floor, ceiling, table, per_linear)
    unit = 1 << (encoding.bits - 8)
    chroma = [_subsampled(plane, encoding.pixel_format) for plane in chroma]
    planes = [16 + 219 * luma, *(128 + 224 * plane for plane in chroma)]
    return [np.clip(np.rint(plane * unit), unit, 255 * unit - 1) for plane in planes]


def _subsampled(plane: Float32[np.ndarray, "height width"], pixel_format: str) -> Float32[np.ndarray, "rows columns"]:
    """Chroma at the places of MPEG-2 and H.264: on every second column, halfway between two rows (4:2:0)."""
    if "444" in pixel_format:
        return plane
    left = np.concatenate([plane[:, :1], plane[:, :-1]], axis=1)
    right = np.concatenate([plane[:, 1:], plane[:, -1:]], axis=1)
    columns = ((left + 2 * plane + right) / 4)[:, ::2]
    return columns if "422" in pixel_format else (columns[::2] + columns[1::2]) / 2
