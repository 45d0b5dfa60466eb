"""Depth that phones keep in their photographs: Google's in JPEG (`google_depth`) and Apple's in HEIC and JPEG (`apple_depth`)."""

from pathlib import Path

from mrbokeh.depth.apple_depth import apple_photo
from mrbokeh.depth.google_depth import google_photo
from mrbokeh.depth.phone_photo import PhonePhoto
from mrbokeh.images.heif import is_heif
from mrbokeh.images.xmp import jpeg_xmp


def read_phone_photo(path: Path, near_far_m: tuple[float, float] | None = None) -> PhonePhoto | None:
    """Read a phone's depth; None if the file holds neither Google's nor Apple's.

    near_far_m: replaces the file's nearest and farthest distance, which often have no unit. Raises InputError if it is damaged or of an
    unknown format.
    """
    if is_heif(path):
        return apple_photo(b"", path, near_far_m)
    data = path.read_bytes() if path.suffix.lower() in (".jpg", ".jpeg") else b""
    return google_photo(jpeg_xmp(data, path), path, near_far_m) or apple_photo(data, path, near_far_m)
