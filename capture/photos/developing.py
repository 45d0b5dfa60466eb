"""One photograph of any kind to linear light at the size asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture.photos.decoded_photo import DecodedPhoto, Photosites
from capture.photos.raw import RAW_SUFFIXES, decode_raw
from capture.photos.saturation import dilated, resized_share
from mrbokeh.images.image_io import ENCODED_SUFFIXES, read_image
from mrbokeh.images.picture_codec import linear_from_codes, stored_rgb

_LARGEST_HALF = 65504.0
_FULL = 1.0 - 1e-6


def is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES


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
    if path.suffix.lower() in ENCODED_SUFFIXES:
        return _encoded(path)
    rgb = read_image(path)
    height, width = rgb.shape[:2]
    finite = np.isfinite(rgb)
    remarks: tuple[str, ...] = ()
    if not finite.all():
        remarks = (f"{np.count_nonzero(~finite.all(axis=-1))} pixels were not finite: NaN became 0, infinity {_LARGEST_HALF:g}",)
        rgb = np.nan_to_num(rgb, nan=0.0, posinf=_LARGEST_HALF, neginf=0.0)
    return DecodedPhoto(rgb, None, np.zeros((height, width), np.float32), Photosites(width, height), saturation_level=None, remarks=remarks)


def _encoded(path: Path) -> DecodedPhoto:
    """Full is the largest code in any channel (TIFF of floats: 1)."""
    import cv2

    codes = stored_rgb(path)[..., :3]
    is_float = codes.dtype.kind == "f"
    rgb = codes.astype(np.float32) if is_float else linear_from_codes(codes, "srgb", path)
    red, green, blue = cv2.split(np.ascontiguousarray(codes))
    full = cv2.max(cv2.max(red, green), blue) >= (_FULL if is_float else np.iinfo(codes.dtype).max)
    photosites = Photosites(full.shape[1], full.shape[0], int(np.count_nonzero(full)))
    return DecodedPhoto(rgb, None, dilated(full).astype(np.float32), photosites, half_suffices=codes.dtype == np.uint8)


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
