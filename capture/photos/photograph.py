"""A photograph for compositing: developed to Rec.709, turned upright, with its lens and exposure from its metadata."""

from pathlib import Path

import numpy as np

from capture.photos.developing import develop, is_raw
from capture.photos.metadata import read_metadata
from capture.photos.photo_metadata import PhotoMetadata
from mrbokeh.images.color import convert
from mrbokeh.images.exif import cut_from_px, known_orientation, quarter_turns, stored_orientation, upright
from mrbokeh.stacks.photograph import Photograph


def read_photograph(path: Path) -> Photograph:
    """White balance is the camera's own; EXR and HDR are taken as they are."""
    decoded, metadata = develop(path, None), read_metadata(path)
    rgb = decoded.rgb if decoded.rec709_from_camera is None else convert(decoded.rgb, np.array(decoded.rec709_from_camera))
    orientation = known_orientation(metadata.orientation or stored_orientation(path))
    turns = quarter_turns(orientation)
    stored_height_px, stored_width_px = rgb.shape[:2]
    sensor_width_mm = _sensor_width_mm(metadata, decoded.photosites.width, decoded.photosites.height)
    if sensor_width_mm is not None and turns % 2:
        sensor_width_mm *= stored_height_px / stored_width_px
    # A camera set to another shape cuts its JPEG only, and RAW has margins.
    whole_px = None if is_raw(path) else cut_from_px((stored_width_px, stored_height_px), metadata.taken_size_px)
    return Photograph(
        upright(rgb, orientation),
        metadata.focal_length_mm,
        metadata.f_number,
        metadata.focus_distance_m,
        sensor_width_mm,
        metadata.exposure_time_s,
        metadata.iso,
        orientation,
        whole_px[::-1] if whole_px is not None and turns % 2 else whole_px,
    )


def _sensor_width_mm(metadata: PhotoMetadata, width_px: int, height_px: int) -> float | None:
    return None if metadata.sensor is None else metadata.sensor.width_mm(width_px, height_px)
