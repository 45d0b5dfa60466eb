"""One photograph of any kind to linear light at the size asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture.photos.decoded_photo import DecodedPhoto, Photosites
from capture.photos.raw import RAW_SUFFIXES, decode_raw
from capture.photos.saturation import dilated, resized_share
from mrbokeh.image_io import ENCODED_SUFFIXES, read_image

_LARGEST_HALF = 65504.0
_FULL = 1.0 - 1e-6


def is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES


def stored_as_half(path: Path) -> bool:
    """Half is enough for 8-bit JPEG and WebP: their steps are 0.9 % near white and more below, those of half 0.1 % at most.

    14-bit RAW and 16-bit files have finer steps near white (0.006 %) than half (0.05 %), so they are kept as float.
    """
    return path.suffix.lower() in (".jpg", ".jpeg", ".webp")


def develop(
    path: Path, white_balance: tuple[float, float, float] | None, *, half_size: bool = False, max_width: int | None = None
) -> DecodedPhoto:
    """A photograph in linear light, the way up in which it is stored (EXIF orientation is not applied).

    RAW through `decode_raw` in camera RGB; PNG, TIFF, JPEG and WebP as sRGB, EXR and HDR as they are, both in Rec.709. Smaller
    sizes are area averages of light, and of the share that is saturated.
    """
    if is_raw(path):
        decoded = decode_raw(path, white_balance, half_size=half_size)
    else:
        decoded = _picture(path)
        if half_size:
            decoded = _no_wider(decoded, max(1, decoded.rgb.shape[1] // 2))
    return decoded if max_width is None else _no_wider(decoded, max_width)


def _picture(path: Path) -> DecodedPhoto:
    rgb = read_image(path)
    height, width = rgb.shape[:2]
    if path.suffix.lower() in ENCODED_SUFFIXES:
        full = np.any(rgb >= _FULL, axis=-1)
        return DecodedPhoto(rgb, None, dilated(full).astype(np.float32), Photosites(width, height, int(np.count_nonzero(full))))
    finite = np.isfinite(rgb)
    remarks: tuple[str, ...] = ()
    if not finite.all():
        remarks = (f"{np.count_nonzero(~finite.all(axis=-1))} pixels were not finite: NaN became 0, infinity {_LARGEST_HALF:g}",)
        rgb = np.nan_to_num(rgb, nan=0.0, posinf=_LARGEST_HALF, neginf=0.0)
    return DecodedPhoto(rgb, None, np.zeros((height, width), np.float32), Photosites(width, height), saturation_level=None, remarks=remarks)


def _no_wider(decoded: DecodedPhoto, width: int) -> DecodedPhoto:
    """Area averages in linear light, so that small lights keep their energy."""
    height_now, width_now = decoded.rgb.shape[:2]
    if width_now <= width:
        return decoded
    height = max(1, round(height_now * width / width_now))
    return replace(decoded, rgb=_reduced(decoded.rgb, width, height), saturated=resized_share(decoded.saturated, width, height))


def _reduced(rgb: Float32[np.ndarray, "height width 3"], width: int, height: int) -> Float32[np.ndarray, "new_height new_width 3"]:
    import cv2

    return cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
