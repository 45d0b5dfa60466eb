"""The gain that brings a stack to the exposure of its session: as metadata state it, else as the pictures of both overlap."""

from pathlib import Path

from capture.photos.decoded_photo import DecodedPhoto
from capture.photos.photo_metadata import PhotoMetadata, StatedExposure
from capture.stacks.exposure import ExposureGain, overlap_gain
from capture.stacks.gain_fit import LowFrequency, low_frequency
from mrbokeh.images.camera_rgb import read_slice
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.system.errors import InputError


def stated_gain(wanted: StatedExposure | None, metadata: PhotoMetadata) -> float | None:
    """Return the gain from a photograph's exposure to another according to metadata, None where they do not tell."""
    own = metadata.exposure
    return own.gain_to(wanted) if wanted and own else None


def gain_to_session(decoded: DecodedPhoto, light: LowFrequency, stated: float | None, scale_stack: Path | None) -> ExposureGain:
    """Return the gain for the reference of a stack. scale_stack: the stack that set the scale, None where it is this one.

    EXR and HDR that state nothing are left alone: their numbers are light already.
    """
    if stated is not None:
        return ExposureGain(session=stated)
    other = None if scale_stack is None or decoded.saturation_level is None else _light_of_stack(scale_stack)
    measured = None if other is None else overlap_gain(other, light)
    return ExposureGain(session_from="nothing") if measured is None else ExposureGain(session=measured, session_from="overlap")


def _light_of_stack(folder: Path) -> LowFrequency | None:
    """The large areas of a stack's first slice; None where it is not there (any more)."""
    try:
        stack = read_focal_stack(folder)
        path = stack.folder / stack.slices[0].metadata.get("ingested", stack.slices[0].path)
        rgb, masks = read_slice(path)
        return low_frequency(rgb, masks.saturated, stack.rec709_from_camera)
    except InputError:
        return None
