"""One photograph of any kind to linear light at the size asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture.photos.raw import RAW_SUFFIXES, DecodedPhoto, decode_raw
from mrbokeh.image_io import INTEGER_SUFFIXES, read_image

_LARGEST_HALF = 65504.0
_FULL = 1.0 - 1e-6


def is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES


def stored_as_half(path: Path) -> bool:
    """Half is enough for 8-bit JPEG: its steps are 0.9 % near white and more below, those of half 0.1 % at most.

    14-bit RAW and 16-bit files have finer steps near white (0.006 %) than half (0.05 %), so they are kept as float.
    """
    return path.suffix.lower() in (".jpg", ".jpeg")


def develop(
    path: Path, white_balance: tuple[float, float, float] | None, *, half_size: bool = False, max_width: int | None = None
) -> DecodedPhoto:
    """A photograph in scene-linear Rec.709, the way up in which it is stored (EXIF orientation is not applied).

    RAW through `decode_raw`; PNG, TIFF and JPEG as sRGB; EXR and HDR as they are. Smaller sizes are area averages of light.
    """
    if is_raw(path):
        decoded = decode_raw(path, white_balance, half_size=half_size)
    else:
        decoded = _picture(path)
        if half_size:
            decoded = replace(decoded, rgb=_no_wider(decoded.rgb, max(1, decoded.rgb.shape[1] // 2)))
    return decoded if max_width is None else replace(decoded, rgb=_no_wider(decoded.rgb, max_width))


def _picture(path: Path) -> DecodedPhoto:
    rgb = read_image(path)
    if path.suffix.lower() in INTEGER_SUFFIXES:
        return DecodedPhoto(rgb, np.any(rgb >= _FULL, axis=-1))
    finite = np.isfinite(rgb)
    remarks: tuple[str, ...] = ()
    if not finite.all():
        remarks = (f"{np.count_nonzero(~finite.all(axis=-1))} pixels were not finite: NaN became 0, infinity {_LARGEST_HALF:g}",)
        rgb = np.nan_to_num(rgb, nan=0.0, posinf=_LARGEST_HALF, neginf=0.0)
    return DecodedPhoto(rgb, np.zeros(rgb.shape[:2], bool), saturation_level=None, remarks=remarks)


def _no_wider(rgb: Float32[np.ndarray, "height width 3"], width: int) -> Float32[np.ndarray, "new_height new_width 3"]:
    """Area averages in linear light, so that small lights keep their energy."""
    import cv2

    height_now, width_now = rgb.shape[:2]
    if width_now <= width:
        return rgb
    return cv2.resize(rgb, (width, max(1, round(height_now * width / width_now))), interpolation=cv2.INTER_AREA)
