"""A shot onto the disk: whole or not at all, and what its metadata tells about it."""

from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from capture.photos.developing import is_raw
from capture.photos.metadata import read_metadata
from capture.photos.photo_files import PHOTO_SUFFIXES
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.raw import read_raw_metadata
from capture.stacks.slice_metadata import focus_record
from capture.tether.camera_driver import CameraError, Shot
from capture.tether.whole_photo import is_whole
from mrbokeh.system.atomic_files import atomic_path

# EXIF rounds exposure times; a third of a stop is 26 %.
_SAME_EXPOSURE = 0.03


@dataclass(frozen=True)
class SavedShot:
    """A photograph of a shoot and its shooting data."""

    path: Path
    shot: Shot
    metadata: PhotoMetadata

    def record(self) -> dict[str, Any]:
        """What the log keeps: JSON-ready, distances in metres as `focus_distance_m` from the lens, None where unknown."""
        metadata = self.metadata
        return {
            "file": self.path.name,
            "camera_name": self.shot.name,
            "bytes": len(self.shot.data),
            "steps": self.shot.steps,
            "stated": {
                "focus": focus_record(metadata),
                "focus_dioptre": _dioptre(metadata.focus_distance_m),
                "focal_length_mm": metadata.focal_length_mm,
                "f_number": metadata.f_number,
                "exposure_time_s": metadata.exposure_time_s,
                "iso": metadata.iso,
                "sensor": None if metadata.sensor is None else metadata.sensor.source,
            },
        }


def save_shot(shot: Shot, folder: Path, stem: str) -> SavedShot:
    """Write a shot under a stem with the suffix the camera gave it. Raises CameraError where it did not arrive whole."""
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
    """Raise CameraError where two records state different exposures: the camera chose by itself."""
    for name in ("exposure_time_s", "iso", "f_number"):
        kept, new = first["stated"][name], now["stated"][name]
        if kept and new and abs(new / kept - 1.0) > _SAME_EXPOSURE:
            raise CameraError(
                f"{now['camera_name']} was exposed otherwise than the first slice ({name} {new:g}, not {kept:g}) and is not taken: "
                f"set the camera to manual exposure with a fixed ISO and run the same command again"
            )


def _dioptre(distance_m: float | None) -> float | None:
    return None if distance_m is None else 1.0 / distance_m
