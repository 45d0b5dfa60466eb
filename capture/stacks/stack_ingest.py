"""Slices of one focal stack: develop each photograph, even out its exposure, write it; go on where an earlier run stopped."""

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture.photos.developing import develop, is_raw
from capture.photos.libraw import WhiteBalance
from capture.photos.photo_files import SkippedFile
from capture.photos.raw import DecodedPhoto
from capture.stacks.exposure import ExposureGain, LowFrequency, gain_to_reference, gain_to_session, stated_gain
from capture.stacks.grouping import Photo
from capture.stacks.odd_slices import Candidate, Odd, blown, duplicates, odd_sizes, other_scenes
from capture.stacks.session import CameraChoice
from capture.stacks.slice_files import FOLDER, DiskFullError, find_slices, slice_metadata, source_record, write_slice
from capture.stacks.slice_looks import SliceLook, look_at, look_of
from mrbokeh.images.camera_rgb import Matrix3x3, matrix3x3, read_slice
from mrbokeh.images.color import convert
from mrbokeh.system.errors import InputError

# To be raised when the same photograph would become another slice, so that old slices are made again.
PROCESS_VERSION = 4
_MADE = "made_"


@dataclass(frozen=True)
class Development:
    """Settings of developing. white_balance: multipliers of red, green, blue, or None for the session's."""

    white_balance: WhiteBalance | None = None
    half_size: bool = False
    max_width: int | None = None


@dataclass(frozen=True)
class FinishedSlice:
    """Slice on disk. record: what it was made from ("request") and what came out ("size_px", "metadata", ...)."""

    photo: Photo
    path: Path
    record: dict[str, Any]


@dataclass
class StackWork:
    """Slices of a stack while they are made; one picture is in memory at a time.

    choice: white balance and exposure, which the stack shares with all others of its scene. The first photograph that can
    be developed is the reference for the exposure of the rest, and its primaries are those of the stack.
    """

    folder: Path
    development: Development
    choice: CameraChoice = field(default_factory=CameraChoice)
    existing: dict[str, tuple[Path, dict[str, Any]]] = field(default_factory=dict)
    finished: list[FinishedSlice] = field(default_factory=list)
    skipped: list[SkippedFile] = field(default_factory=list)
    kept: int = 0
    remarks: tuple[str, ...] = ()
    _reference: LowFrequency | None = None
    _looks: dict[Path, SliceLook] = field(default_factory=dict)

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
        except DiskFullError:
            raise
        except InputError as error:
            self.skipped.append(SkippedFile(photo.path, str(error).replace(str(photo.path), "it", 1)))

    def leave_out_odd_slices(self, *, sizes_only: bool) -> bool:
        """Name and leave out slices that do not belong (`capture.stacks.odd_slices`). True if the first is left out.

        Raises InputError if no more than half of the slices belong together.
        """
        first = self.finished[0]
        self._leave_out(odd_sizes([(each.photo.path.name, tuple(each.record["size_px"])) for each in self.finished]))
        for odd in () if sizes_only else (blown, duplicates, other_scenes):
            self._leave_out(odd([Candidate(each.photo, self._look(each)) for each in self.finished]))
        return self.finished[0] is not first

    def _leave_out(self, odd: Odd) -> None:
        self.skipped += [SkippedFile(self.finished[index].photo.path, reason) for index, reason in odd.items()]
        self.finished = [each for index, each in enumerate(self.finished) if index not in odd]

    def with_another_reference(self) -> "StackWork":
        """Even out the slices again, relative to the first of them, after the one that gave the exposure was left out."""
        again = stack_work(self.folder, self.development, self.choice, overwrite=False)
        again.skipped, again.remarks = [*self.skipped], self.remarks
        for each in self.finished:
            again.add(each.photo)
        return again

    def give_up(self) -> None:
        """Take away the slices that this call has made, and folders that are empty then."""
        for each in self.finished:
            if each.path.name.startswith(_MADE):
                each.path.unlink(missing_ok=True)
        for folder in (self.folder / FOLDER, self.folder):
            with suppress(OSError):  # it holds something, or is not there
                folder.rmdir()

    def _look(self, finished: FinishedSlice) -> SliceLook:
        """Return how a slice looked before its exposure was evened out; it is read where an earlier run made it."""
        if finished.path not in self._looks:
            metadata, matrix = finished.record["metadata"], finished.record["rec709_from_camera"]
            gain = np.float32(metadata["exposure_gain"])
            rgb, masks = read_slice(finished.path)
            primaries = None if matrix is None else matrix3x3(matrix)
            self._looks[finished.path] = look_at(rgb / gain, masks.saturated, primaries, metadata["saturated_fraction"] or 0.0)
        return self._looks[finished.path]

    def _request(self, photo: Photo) -> dict[str, Any]:
        """Return everything that the pixels of the slice depend on."""
        reference = self.finished[0].photo if self.finished else photo
        return {
            **source_record(photo.path),
            "version": PROCESS_VERSION,
            "white_balance": list(self.choice.white_balance) if self.choice.white_balance and is_raw(photo.path) else None,
            "half_size": self.development.half_size,
            "max_width": self.development.max_width,
            "exposure_reference": reference.path.name,
            "session_gain": stated_gain(self.choice.exposure, reference.metadata),
            "stated_gain": stated_gain(reference.metadata.exposure, photo.metadata),
        }

    @property
    def rec709_from_camera(self) -> Matrix3x3 | None:
        """Return the matrix from the RGB of the finished slices; None where that is Rec.709."""
        matrix = self.finished[0].record["rec709_from_camera"]
        return None if matrix is None else matrix3x3(matrix)

    def _made(self, photo: Photo, request: dict[str, Any]) -> FinishedSlice:
        decoded = self._developed(photo)
        look = look_of(decoded)
        primaries = self.rec709_from_camera if self.finished else decoded.rec709_from_camera
        gain = self._gain(decoded, look.light, request)
        rgb = converted_to_primaries(decoded, primaries)
        if gain.total != 1.0:
            rgb = rgb * np.float32(gain.total)
        record = {
            "request": request,
            "size_px": [rgb.shape[1], rgb.shape[0]],
            "native_size_px": [decoded.photosites.width, decoded.photosites.height],
            "rec709_from_camera": primaries,
            "metadata": slice_metadata(photo, decoded, gain),
            "remarks": [*decoded.remarks, *_gain_remarks(photo, gain)],
        }
        # Slices get their numbers when all are there: an unreadable photograph must leave no gap.
        fingerprint = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:12]
        path = self.folder / FOLDER / f"{_MADE}{len(self.finished):03d}_{fingerprint}.exr"
        self._looks[path] = look
        write_slice(path, rgb, decoded.saturated, primaries, record, half=decoded.half_suffices)
        return FinishedSlice(photo, path, record)

    def _developed(self, photo: Photo) -> DecodedPhoto:
        return develop(photo.path, self.choice.white_balance, half_size=self.development.half_size, max_width=self.development.max_width)

    def _gain(self, decoded: DecodedPhoto, light: LowFrequency, request: dict[str, Any]) -> ExposureGain:
        """Measure the gain to the reference, which is developed again if an earlier run made its slice."""
        if not self.finished:
            self._reference = light
            return gain_to_session(decoded, light, request["session_gain"], self._scale_stack())
        if self._reference is None:
            self._reference = look_of(self._developed(self.finished[0].photo)).light
        base = self.finished[0].record["metadata"]
        gain = gain_to_reference(self._reference, light, request["stated_gain"])
        return replace(gain, session=base["exposure_gain_session"], session_from=base["exposure_gain_session_from"])

    def _scale_stack(self) -> Path | None:
        """Return the stack that set the scale of the session, unless it is this one."""
        name = self.choice.reference_stack
        return self.folder.parent / name if name and name != self.folder.name else None


def stack_work(folder: Path, development: Development, choice: CameraChoice, *, overwrite: bool) -> StackWork:
    """Return the work on a stack, with the slices of earlier runs found. Raises InputError if those were made in another size."""
    made = [] if overwrite else find_slices(folder)
    for _, record in made:
        for name in ("max_width", "half_size"):
            before, now = record["request"].get(name), getattr(development, name)
            if before != now:
                option = "--" + name.replace("_", "-")
                raise InputError(f"{folder} was ingested with {option} {before}, now it is {now}: give the same, or --overwrite")
    existing = {json.dumps(record["request"], sort_keys=True): (path, record) for path, record in made}
    return StackWork(folder, development, choice, existing)


def converted_to_primaries(decoded: DecodedPhoto, rec709_from_camera: Matrix3x3 | None) -> Float32[np.ndarray, "height width 3"]:
    """Return the photograph in the RGB that rec709_from_camera leads from: developed pictures and RAW can share a stack."""
    if decoded.rec709_from_camera == rec709_from_camera:
        return decoded.rgb
    wanted, own = (np.eye(3) if each is None else np.array(each) for each in (rec709_from_camera, decoded.rec709_from_camera))
    return convert(decoded.rgb, np.linalg.solve(wanted, own))


def _gain_remarks(photo: Photo, gain: ExposureGain) -> list[str]:
    if not gain.was_limited or gain.measured is None:
        return []
    return [
        f"{photo.path.name} looks {1.0 / gain.measured:.2f} times as bright as its metadata and the other slices let expect; "
        f"only {1.0 / gain.residual:.2f} of that was evened out"
    ]
