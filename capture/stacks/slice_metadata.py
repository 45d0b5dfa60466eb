"""What stack.json keeps of each photograph: shooting data, focus as stated, exposure and white balance as applied."""

from typing import Any

from capture.photos.decoded_photo import DecodedPhoto
from capture.photos.photo_metadata import PhotoMetadata
from capture.stacks.exposure import ExposureGain
from capture.stacks.grouping import Photo


def slice_metadata(photo: Photo, decoded: DecodedPhoto, gain: ExposureGain) -> dict[str, Any]:
    """JSON-ready metadata of a slice. Distances that may be infinite are given in dioptres (1/m), for which JSON has numbers.

    saturated_fraction: share of the photosites that were full. saturation_level: the value of a full grey in the slice.
    """
    metadata = photo.metadata
    level = decoded.saturation_level
    return {
        "exposure_time_s": metadata.exposure_time_s,
        "iso": metadata.iso,
        "f_number": metadata.f_number,
        "focal_length_mm": metadata.focal_length_mm,
        "taken_at": metadata.taken_at.isoformat() if metadata.taken_at else None,
        "camera_model": metadata.camera_model,
        "lens_model": metadata.lens_model,
        "orientation": metadata.orientation,
        "lens_position": metadata.lens_position,
        "focus": focus_record(metadata),
        "white_balance": None if decoded.white_balance is None else list(decoded.white_balance),
        "exposure_gain": gain.total,
        "exposure_gain_session": gain.session,
        "exposure_gain_session_from": gain.session_from,
        "exposure_gain_stated": gain.stated,
        "exposure_gain_measured": None if gain.measured is None else gain.stated * gain.measured,
        "saturated_fraction": decoded.photosites.full_fraction if level is not None else None,
        "saturation_level": None if level is None else level * gain.total,
    }


def focus_record(metadata: PhotoMetadata) -> dict[str, Any] | None:
    """The focus distance as the file stated it, and counted from the lens; intervals are what the statement may stand for.

    The lens's are None where its focal length is unknown or no lens of that length focuses so near. sentinel: nothing is known of this
    distance but what the rest of the stack tells (`capture.stacks.sentinel_focus`).
    """
    focus = metadata.focus
    if focus is None:
        return None
    distance_m, interval_m = metadata.focus_distance_m, metadata.focus_interval_m
    return {
        "source": focus.source,
        "origin": focus.origin,
        "sentinel": focus.is_sentinel,
        "stated_dioptre": 1.0 / focus.distance_m,
        "interval_dioptre": [1.0 / focus.farthest_m, 1.0 / focus.nearest_m],
        "hiatus_mm": metadata.hiatus_mm,
        "lens_dioptre": None if distance_m is None else 1.0 / distance_m,
        "lens_interval_dioptre": None if interval_m is None else [1.0 / interval_m[1], 1.0 / interval_m[0]],
    }
