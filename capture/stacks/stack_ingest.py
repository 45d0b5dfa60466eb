"""The slices of one focal stack: develop each photograph, even out its exposure, write it; go on where an earlier run stopped."""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from capture.photos.developing import develop, is_raw, stored_as_half
from capture.photos.libraw import WhiteBalance
from capture.photos.photo_files import SkippedFile
from capture.photos.raw import DecodedPhoto, camera_white_balance
from capture.stacks.exposure import ExposureGain, LowFrequency, evened_out, low_frequency
from capture.stacks.grouping import Photo
from capture.stacks.slice_files import FOLDER, find_slices, source_record, write_slice
from capture.stacks.slice_metadata import slice_metadata
from mrbokeh.errors import InputError

# To be raised when the same photograph would become another slice, so that old slices are made again.
PROCESS_VERSION = 1


@dataclass(frozen=True)
class Development:
    """How photographs are developed. white_balance: multipliers of red, green, blue, or None for the camera's."""

    white_balance: WhiteBalance | None = None
    half_size: bool = False
    max_width: int | None = None


@dataclass(frozen=True)
class FinishedSlice:
    """A slice on disk. record: what it was made from ("request") and what came out ("size_px", "metadata", ...)."""

    photo: Photo
    path: Path
    record: dict[str, Any]


@dataclass
class StackWork:
    """The slices of a stack while they are made; one picture is in memory at a time.

    white_balance: one for the whole stack, None where no photograph is RAW. The first photograph that can be developed
    is the reference of the exposure.
    """

    folder: Path
    development: Development
    white_balance: WhiteBalance | None
    white_balance_source: str = ""
    existing: dict[str, tuple[Path, dict[str, Any]]] = field(default_factory=dict)
    finished: list[FinishedSlice] = field(default_factory=list)
    skipped: list[SkippedFile] = field(default_factory=list)
    kept: int = 0
    _reference: LowFrequency | None = None

    def add(self, photo: Photo) -> None:
        """Make the slice of a photograph, or find it made; what cannot be developed is named and left out."""
        try:
            request = self._request(photo)
            # Taken out, so that two copies of one photograph do not claim the same slice.
            found = self.existing.pop(json.dumps(request, sort_keys=True), None)
            if found is not None:
                self.kept += 1
                self.finished.append(FinishedSlice(photo, *found))
            else:
                self.finished.append(self._made(photo, request))
        except InputError as error:
            self.skipped.append(SkippedFile(photo.path, str(error).replace(str(photo.path), "it", 1)))

    def leave_odd_sizes_out(self) -> bool:
        """A stack has one size, the one that most of its slices have; others are named and left out. True if the first is."""
        sizes = Counter(tuple(each.record["size_px"]) for each in self.finished)
        if len(sizes) < 2:
            return False
        first, usual = self.finished[0], sizes.most_common(1)[0][0]
        for each in [one for one in self.finished if tuple(one.record["size_px"]) != usual]:
            width, height = each.record["size_px"]
            self.skipped.append(SkippedFile(each.photo.path, f"{width}x{height} px, but most of its stack have {usual[0]}x{usual[1]} px"))
            self.finished.remove(each)
        return self.finished[0] is not first

    def _request(self, photo: Photo) -> dict[str, Any]:
        """Everything that the pixels of the slice depend on."""
        reference = self.finished[0].photo if self.finished else photo
        return {
            **source_record(photo.path),
            "version": PROCESS_VERSION,
            "white_balance": list(self.white_balance) if self.white_balance and is_raw(photo.path) else None,
            "half_size": self.development.half_size,
            "max_width": self.development.max_width,
            "exposure_reference": reference.path.name,
            "stated_gain": _stated_gain(reference, photo),
        }

    def _made(self, photo: Photo, request: dict[str, Any]) -> FinishedSlice:
        decoded = self._developed(photo)
        gain = self._gain(decoded, request["stated_gain"])
        rgb = decoded.rgb if gain.total == 1.0 else decoded.rgb * decoded.rgb.dtype.type(gain.total)
        record = {
            "request": request,
            "size_px": [rgb.shape[1], rgb.shape[0]],
            "native_size_px": [decoded.saturated.shape[1], decoded.saturated.shape[0]],
            "metadata": slice_metadata(photo, decoded, gain),
            "remarks": [*decoded.remarks, *_gain_remarks(photo, gain)],
        }
        # Slices get their numbers when all are there: an unreadable photograph must leave no gap.
        fingerprint = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:12]
        path = self.folder / FOLDER / f"made_{len(self.finished):03d}_{fingerprint}.exr"
        write_slice(path, rgb, record, half=stored_as_half(photo.path))
        return FinishedSlice(photo, path, record)

    def _developed(self, photo: Photo) -> DecodedPhoto:
        return develop(photo.path, self.white_balance, half_size=self.development.half_size, max_width=self.development.max_width)

    def _gain(self, decoded: DecodedPhoto, stated: float | None) -> ExposureGain:
        """Relative to the reference, which is developed again if an earlier run made its slice."""
        if not self.finished:
            self._reference = low_frequency(decoded.rgb, decoded.saturated)
            return ExposureGain()
        if self._reference is None:
            reference = self._developed(self.finished[0].photo)
            self._reference = low_frequency(reference.rgb, reference.saturated)
        return evened_out(self._reference, low_frequency(decoded.rgb, decoded.saturated), stated)


def stack_work(folder: Path, photos: Sequence[Photo], development: Development, *, overwrite: bool) -> StackWork:
    """The work on a stack, with the white balance chosen and the slices of earlier runs found."""
    existing = {} if overwrite else {json.dumps(record["request"], sort_keys=True): (path, record) for path, record in find_slices(folder)}
    white_balance, source = _white_balance(photos, development)
    return StackWork(folder, development, white_balance, source, existing)


def _white_balance(photos: Sequence[Photo], development: Development) -> tuple[WhiteBalance | None, str]:
    """The one asked for, else the camera's of the first RAW (by name) that opens, and whose it is; None without RAW."""
    for photo in (each for each in photos if is_raw(each.path)):
        try:
            return development.white_balance or camera_white_balance(photo.path), photo.path.name
        except InputError:
            continue
    return None, ""


def _stated_gain(reference: Photo, photo: Photo) -> float | None:
    """The ratio of their exposures according to metadata, None where one does not tell."""
    wanted, own = reference.metadata.relative_exposure, photo.metadata.relative_exposure
    return wanted / own if wanted and own else None


def _gain_remarks(photo: Photo, gain: ExposureGain) -> list[str]:
    if not gain.was_limited or gain.measured is None:
        return []
    return [
        f"{photo.path.name} looks {1.0 / gain.measured:.2f} times as bright as its metadata and the other slices let expect; "
        f"only {1.0 / gain.residual:.2f} of that was evened out"
    ]
