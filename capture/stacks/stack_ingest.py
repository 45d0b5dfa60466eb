"""Slices of one focal stack: develop each photograph, even out its exposure, write it; go on where an earlier run stopped.

Photographs that do not belong are named and left out: of another size, blown, twice the same, of another scene.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture.photos.developing import develop, is_raw
from capture.photos.libraw import WhiteBalance
from capture.photos.photo_files import SkippedFile
from capture.photos.raw import DecodedPhoto
from capture.stacks.exposure import ExposureGain, LowFrequency, gain_to_reference, gain_to_session, stated_gain
from capture.stacks.grouping import Photo
from capture.stacks.session import CameraChoice
from capture.stacks.slice_files import FOLDER, DiskFullError, find_slices, slice_metadata, source_record, write_slice
from capture.stacks.slice_looks import SliceLook, look_at, look_of, one_scene, same_photograph
from mrbokeh.images.camera_rgb import Matrix3x3, matrix3x3, read_slice
from mrbokeh.images.color import convert
from mrbokeh.system.errors import InputError

_BLOWN = 0.9
_OTHERS_WELL = 0.6
_BLACK = 0.002
_TIMES_AS_BRIGHT = 30.0
_SAME_FOCUS = 1e-3
_ASKED_OF_EACH = 6
_MOST_SCENES = 12
ALL_THE_SAME = "`mrbokeh capture ingest --group none` takes all"

Odd = dict[int, str]
"""The slices to leave out, by their index, and why."""
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
        """Name and leave out slices that do not belong. True if the first is left out.

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


@dataclass(frozen=True)
class Candidate:
    """Developed photograph that might become a slice."""

    photo: Photo
    look: SliceLook


def odd_sizes(named: Sequence[tuple[str, tuple[int, int]]]) -> Odd:
    """Find those of another size than most. Raises InputError where no size is the usual one.

    named: file name, and width and height.
    """
    sizes = Counter(size for _, size in named)
    if len(sizes) < 2:
        return {}
    (usual, count), (_, next_count) = sizes.most_common(2)
    if count == next_count:
        listed = ", ".join(f"{name} {_size(size)}" for name, size in named[:6])
        more = " ..." if len(named) > 6 else ""
        raise InputError(
            f"the slices of a stack have one size, but of these {len(named)} photographs no size is the usual one ({listed}{more}): "
            f"put each stack into a folder of its own, or take away what does not belong"
        )
    odd = ((index, size) for index, (_, size) in enumerate(named) if size != usual)
    return {index: f"{_size(size)} px, but most of its stack have {_size(usual)} px" for index, size in odd}


def blown(candidates: Sequence[Candidate]) -> Odd:
    """Find those that are almost all saturated or black while the others are not."""
    odd = {}
    for index, each in enumerate(candidates):
        others = [other.look for at, other in enumerate(candidates) if at != index]
        if not others:
            continue
        if each.look.full >= _BLOWN and median(other.full for other in others) <= _OTHERS_WELL:
            odd[index] = f"{100 * each.look.full:.0f} % of it is saturated, unlike the rest of its stack"
        elif each.look.brightest <= min(_BLACK, median(other.brightest for other in others) / _TIMES_AS_BRIGHT):
            odd[index] = "it is almost black, unlike the rest of its stack"
    return odd


def duplicates(candidates: Sequence[Candidate]) -> Odd:
    """Find those that are all but identical with an earlier one, unless their files state another focus."""
    odd: Odd = {}
    for index, each in enumerate(candidates):
        kept = (other for at, other in enumerate(candidates[:index]) if at not in odd)
        twin = next((other for other in kept if _same_focus(each.photo, other.photo) and same_photograph(each.look, other.look)), None)
        if twin is not None:
            odd[index] = f"it is the same photograph as {twin.photo.path.name}"
    return odd


def other_scenes(candidates: Sequence[Candidate]) -> Odd:
    """Find those of another scene than most. Raises InputError where no scene has more than half of them."""
    scenes = sorted(_scenes([each.look for each in candidates]), key=len, reverse=True)
    if len(scenes) < 2:
        return {}
    if 2 * len(scenes[0]) <= len(candidates):
        first, second = (candidates[scene[0]].photo.path.name for scene in scenes[:2])
        raise InputError(
            f"these {len(candidates)} photographs show different scenes ({first} is unlike {second}): "
            f"put each stack into a folder of its own ({ALL_THE_SAME})"
        )
    return {index: f"it shows another scene than most of its stack ({ALL_THE_SAME})" for scene in scenes[1:] for index in scene}


def _scenes(looks: Sequence[SliceLook]) -> list[list[int]]:
    """Return indices that hang together: first each with the one before it, then what that leaves apart with some of every other scene.

    Many scenes are not compared: that is a folder of stacks, not a stack with one or two strange photographs.
    """
    scenes: list[list[int]] = []
    for index, look in enumerate(looks):
        if scenes and one_scene(looks[scenes[-1][-1]], look):
            scenes[-1].append(index)
        else:
            scenes.append([index])
    if len(scenes) > _MOST_SCENES:
        return scenes
    joined: list[list[int]] = []
    for scene in scenes:
        related = [other for other in joined if _hang_together(looks, scene, other)]
        joined = [other for other in joined if other not in related] + [sorted([*scene, *(each for other in related for each in other)])]
    return joined


def _hang_together(looks: Sequence[SliceLook], scene: Sequence[int], other: Sequence[int]) -> bool:
    """Compare the pairs that lie nearest to each other in the order of the slices: their blur differs least."""
    pairs = sorted(((first, second) for first in scene for second in other), key=lambda pair: abs(pair[0] - pair[1]))
    return any(one_scene(looks[first], looks[second]) for first, second in pairs[:_ASKED_OF_EACH])


def _same_focus(first: Photo, second: Photo) -> bool:
    """Tell whether two are focused alike as far as is stated; in dioptres, because of infinity."""
    distances_m = first.focus_distance_m, second.focus_distance_m
    if distances_m[0] is None or distances_m[1] is None:
        return distances_m[0] is distances_m[1]
    return abs(1.0 / distances_m[0] - 1.0 / distances_m[1]) <= _SAME_FOCUS


def _size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"
