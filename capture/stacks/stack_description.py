"""stack.json of an ingested stack: slices in their order, lens, camera, and in words what a reader should know."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from capture.photos.photo_files import SkippedFile
from capture.stacks.grouping import Photo, in_focus_order
from capture.stacks.sentinel_focus import bounded_focus_records
from capture.stacks.session import CameraChoice
from capture.stacks.slice_files import FOLDER, arrange_slices, source_record
from capture.stacks.stack_ingest import PROCESS_VERSION, Development, FinishedSlice, StackWork
from capture.stacks.stack_lens import camera_of_lens, lens_of_photo, optics_of_photo, reference_index
from capture.stacks.stack_remarks import stack_remarks
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.system.errors import InputError

_RAW_COLOUR = "linear white-balanced camera RGB; 1.0 is the white level of green at the exposure of the session"
_DEVELOPED_COLOUR = "scene-linear Rec.709; 1.0 is white"


@dataclass(frozen=True)
class StackReport:
    """What became of the photographs of one stack; kept counts slices of earlier runs.

    stack: None where no photograph was usable, or where they do not belong together: problem says why.
    """

    name: str
    stack: FocalStack | None
    size_px: tuple[int, int] | None = None
    kept: int = 0
    skipped: tuple[SkippedFile, ...] = ()
    remarks: tuple[str, ...] = ()
    problem: str = ""


def ingest_digest(photos: Sequence[Photo], development: Development, choice: CameraChoice) -> str:
    """A fingerprint of all that a stack depends on: the files, what they and lens.toml tell, the settings and the session's choice."""
    sources = [
        [source_record(photo.path), repr(photo.metadata), repr(replace(photo.sidecar, where="", focus_where=""))] for photo in photos
    ]
    text = json.dumps([PROCESS_VERSION, asdict(replace(development, white_balance=None)), asdict(choice), sources], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def finished_before(name: str, folder: Path, digest: str) -> StackReport | None:
    """The report of a stack that an earlier run made of the same files and settings (merged since or not), else None."""
    try:
        stack = read_focal_stack(folder)
    except InputError:
        return None
    if stack.metadata.get("ingest_digest") != digest or not all((folder / each.path).is_file() for each in stack.slices):
        return None
    skipped = tuple(SkippedFile(Path(each["source"]), each["reason"]) for each in stack.metadata["skipped"])
    width_px, height_px = stack.metadata["size_px"]
    return StackReport(name, stack, (width_px, height_px), len(stack), skipped, tuple(stack.metadata["remarks"]))


def finish_stack(name: str, work: StackWork, digest: str) -> StackReport:
    """Number the slices and write stack.json; a report without a stack where there are none."""
    if not work.finished:
        return StackReport(name, None, skipped=tuple(work.skipped))
    was_merged = _was_merged(work.folder)
    order = in_focus_order([each.photo for each in work.finished])
    finished = sorted(work.finished, key=lambda each: order.index(each.photo))
    # While slices change places there is no stack.json that could promise the wrong ones.
    (work.folder / FILE_NAME).unlink(missing_ok=True)
    paths = arrange_slices(work.folder, [each.path for each in finished])
    focus = bounded_focus_records([each.photo.metadata for each in finished])
    slices = tuple(_slice(*each) for each in zip(paths, finished, focus, strict=True))
    reference = reference_index([each.focus_distance_m for each in slices])
    chosen = finished[reference]
    width_px, height_px = chosen.record["size_px"]
    native_width_px, native_height_px = chosen.record["native_size_px"]
    lens, missing = lens_of_photo(chosen.photo, (native_width_px, native_height_px))
    optics = optics_of_photo(chosen.photo, (native_width_px, native_height_px))
    remarks = stack_remarks(work, chosen.photo, lens, missing)
    if was_merged:
        remarks.append("the stack changed since it was merged: merge it again")
    stack = FocalStack(
        folder=work.folder,
        slices=slices,
        lens=lens,
        camera=None if lens is None else camera_of_lens(lens, width_px, height_px),
        reference=reference,
        metadata=_stack_metadata(work, digest, remarks) | {"optics": optics},
        rec709_from_camera=work.rec709_from_camera,
    )
    write_focal_stack(stack)
    return StackReport(name, stack, (width_px, height_px), work.kept, tuple(work.skipped), tuple(remarks))


def _slice(path: Path, finished: FinishedSlice, focus: dict[str, Any] | None) -> Slice:
    """focus: as metadata and sidecar tell now, for the slice itself may be of an earlier run."""
    record = finished.record
    source = {key: record["request"][key] for key in ("source", "source_size_bytes", "source_mtime_ns")}
    metadata = source | record["metadata"] | {"focus": focus}
    return Slice(f"{FOLDER}/{path.name}", finished.photo.focus_distance_m, metadata=metadata)


def _stack_metadata(work: StackWork, digest: str, remarks: Sequence[str]) -> dict[str, Any]:
    return {
        "ingest_digest": digest,
        "colour": _RAW_COLOUR if work.rec709_from_camera else _DEVELOPED_COLOUR,
        "white_balance": None if work.choice.white_balance is None else list(work.choice.white_balance),
        "session_reference": f"{work.choice.reference_stack}/{work.choice.reference_source}",
        "exposure_reference": work.finished[0].photo.path.name,
        "size_px": work.finished[0].record["size_px"],
        "skipped": [{"source": str(each.path), "reason": each.reason} for each in work.skipped],
        "remarks": list(remarks),
    }


def _was_merged(folder: Path) -> bool:
    try:
        return read_focal_stack(folder).merged
    except InputError:
        return False
