"""Photographs of a shoot: saving one whole or not at all, its metadata, and the check that the focus came back at the end.

Blur shows in the energy of fine detail. Over the tiles of the picture, the second slice differs from the first in a pattern of
gains and losses. The first slice is shot again at the end; the amount of that pattern in it is its focus error as a fraction of
the gap between two slices: positive towards the second, negative away from it. Blur of less than a pixel does not show, so errors
below half a gap are underestimated by up to one half; without an error, noise gives less than 0.01.
"""

from dataclasses import asdict, dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from capture.merging.focus_volume import focus_energy
from capture.photos.developing import develop, is_raw
from capture.photos.metadata import read_metadata
from capture.photos.photo_files import PHOTO_SUFFIXES
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.raw import read_raw_metadata
from capture.stacks.slice_files import focus_record
from capture.tether.camera_driver import CameraError, Shot
from capture.tether.watched_folder import is_whole
from mrbokeh.images.color import luminance
from mrbokeh.system.atomic_files import atomic_path

# EXIF rounds exposure times; a third of a stop is 26 %.
_SAME_EXPOSURE = 0.03
WIDTH_PX = 960
LARGEST_FOCUS_ERROR = 0.15
LARGEST_SHIFT_PX = 2.0
LARGEST_BRIGHTNESS_ERROR = 0.02
_TILES = (16, 24)
_FLOOR = 0.05
Rgb = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class SavedShot:
    """A photograph of a shoot and its shooting data."""

    path: Path
    shot: Shot
    metadata: PhotoMetadata

    def record(self) -> dict[str, Any]:
        """Return what the log keeps: JSON-ready, distances in metres as `focus_distance_m` from the lens, None if unknown."""
        metadata = self.metadata
        return {
            "file": self.path.name,
            "camera_name": self.shot.name,
            "bytes": len(self.shot.data),
            "steps": self.shot.steps,
            "stated": {
                "focus": focus_record(metadata),
                "focus_dioptre": None if metadata.focus_distance_m is None else 1.0 / metadata.focus_distance_m,
                "focal_length_mm": metadata.focal_length_mm,
                "f_number": metadata.f_number,
                "exposure_time_s": metadata.exposure_time_s,
                "iso": metadata.iso,
                "sensor": None if metadata.sensor is None else metadata.sensor.source,
            },
        }


def save_shot(shot: Shot, folder: Path, stem: str) -> SavedShot:
    """Write a shot under a stem with the suffix the camera gave it. Raises CameraError if it did not arrive whole."""
    suffix = PurePath(shot.name).suffix.lower()
    if suffix not in PHOTO_SUFFIXES:
        raise CameraError(f"the camera sent {shot.name}, which is no photograph: set it to RAW")
    path = folder / f"{stem}{suffix}"
    with atomic_path(path) as temporary:
        temporary.write_bytes(shot.data)
        if not is_whole(temporary):
            raise CameraError(f"{shot.name} did not arrive whole ({len(shot.data)} bytes): run the same command again")
        metadata = read_metadata(temporary)
        metadata = metadata.filled_from(read_raw_metadata(temporary)) if is_raw(temporary) else metadata
    return SavedShot(path, shot, metadata)


def require_same_exposure(first: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise CameraError if two records state different exposures: the camera chose by itself."""
    for name in ("exposure_time_s", "iso", "f_number"):
        kept, new = first["stated"][name], now["stated"][name]
        if kept and new and abs(new / kept - 1.0) > _SAME_EXPOSURE:
            raise CameraError(
                f"{now['camera_name']} was exposed otherwise than the first slice ({name} {new:g}, not {kept:g}) and is not taken: "
                f"set the camera to manual exposure with a fixed ISO and run the same command again"
            )


@dataclass(frozen=True)
class ReturnCheck:
    """Comparison of the first slice with its repetition at the end.

    focus_error: fraction of a slice's gap, None if there is only one slice. shift_px: in pixels of the photograph.
    brightness: mean light of the repetition over that of the first.
    """

    focus_error: float | None
    shift_px: float
    brightness: float

    @property
    def warnings(self) -> list[str]:
        found = []
        if self.focus_error is not None and abs(self.focus_error) > LARGEST_FOCUS_ERROR:
            found.append(
                f"the focus did not come back: slice 0 shot again is off by {self.focus_error:+.2f} of the gap to slice 1. "
                f"Somebody touched the ring, or the play is larger than --backlash: shoot again"
            )
        if self.shift_px > LARGEST_SHIFT_PX:
            found.append(f"the camera moved: slice 0 shot again is shifted by {self.shift_px:.1f} px (registration can undo it)")
        if abs(self.brightness - 1.0) > LARGEST_BRIGHTNESS_ERROR:
            found.append(f"the light changed: slice 0 shot again is {self.brightness:.2f} times as bright")
        return found

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"warnings": self.warnings}


def check_return(first: Path, repeated: Path, second: Path | None) -> ReturnCheck:
    """Compare photographs of one size. second: the slice next to the first, None if there is only one."""
    reference, scale = _reduced(first)
    again = _reduced(repeated)[0]
    error = None if second is None else focus_error(reference, again, _reduced(second)[0])
    before, after = (np.sqrt(luminance(each)).astype(np.float64) for each in (reference, again))
    (shift_x, shift_y), _ = cv2.phaseCorrelate(before, after, _window(again))
    return ReturnCheck(error, float(np.hypot(shift_x, shift_y)) * scale, float(again.mean() / max(float(reference.mean()), 1e-9)))


def focus_error(first: Rgb, repeated: Rgb, second: Rgb) -> float:
    """Return how far from `first` towards `second` the focus of `repeated` is: least squares over the logarithms of tile energies."""
    start, now, end = (_log_energies(each) for each in (first, repeated, second))
    way = end - start
    return float((way * (now - start)).sum() / max(float((way * way).sum()), 1e-12))


def _reduced(path: Path) -> tuple[Rgb, float]:
    """Return the photograph at most WIDTH_PX wide, and the original pixels per pixel of it."""
    decoded = develop(path, None, half_size=is_raw(path), max_width=WIDTH_PX)
    return decoded.rgb, decoded.photosites.width / decoded.rgb.shape[1]


def _log_energies(rgb: Rgb) -> Float64[np.ndarray, "rows columns"]:
    tiles = cv2.resize(focus_energy(rgb), _TILES[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    # Where there is no detail, noise must not count.
    return np.log(tiles + _FLOOR * float(tiles.mean()) + 1e-12)


def _window(rgb: Rgb) -> Float64[np.ndarray, "height width"]:
    height, width = rgb.shape[:2]
    return cv2.createHanningWindow((width, height), cv2.CV_64F)
