"""stack.json of an ingested stack: slices in their order, lens, camera, and in words what a reader should know."""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from capture.photos.photo_files import SkippedFile
from capture.stacks.grouping import Photo, in_focus_order
from capture.stacks.session import GIVEN, CameraChoice
from capture.stacks.slice_files import FOLDER, arrange_slices, bounded_focus_records, source_record
from capture.stacks.stack_ingest import PROCESS_VERSION, Development, FinishedSlice, StackWork
from mrbokeh.optics.camera import camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.system.errors import InputError

FEWEST_TO_MERGE = 2
_RAW_COLOUR = "linear white-balanced camera RGB; 1.0 is the white level of green at the exposure of the session"
_DEVELOPED_COLOUR = "scene-linear Rec.709; 1.0 is white"


@dataclass(frozen=True)
class StackReport:
    """Outcome for the photographs of one stack; kept counts slices of earlier runs.

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
    """Return a fingerprint of all that a stack depends on: files, what they and lens.toml tell, settings and the session's choice."""
    sources = [
        [source_record(photo.path), repr(photo.metadata), repr(replace(photo.sidecar, where="", focus_where=""))] for photo in photos
    ]
    text = json.dumps([PROCESS_VERSION, asdict(replace(development, white_balance=None)), asdict(choice), sources], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def finished_before(name: str, folder: Path, digest: str) -> StackReport | None:
    """Return the report of a stack that an earlier run made of the same files and settings (merged since or not), else None."""
    try:
        stack = read_focal_stack(folder)
    except InputError:
        return None
    if stack.metadata.get("ingest_digest") != digest or not all((folder / each.path).is_file() for each in stack.slices):
        return None
    skipped = tuple(SkippedFile(Path(each["source"]), each["reason"]) for each in stack.metadata["skipped"])
    width_px, height_px = stack.metadata["size_px"]
    return StackReport(
        name=name, stack=stack, size_px=(width_px, height_px), kept=len(stack), skipped=skipped, remarks=tuple(stack.metadata["remarks"])
    )


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
    return StackReport(
        name=name, stack=stack, size_px=(width_px, height_px), kept=work.kept, skipped=tuple(work.skipped), remarks=tuple(remarks)
    )


def _slice(path: Path, finished: FinishedSlice, focus: dict[str, Any] | None) -> Slice:
    """Describe a slice. focus: as metadata and sidecar tell now, for the slice itself may be of an earlier run."""
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


def lens_of_photo(photo: Photo, native_size_px: tuple[int, int]) -> tuple[Lens | None, str | None]:
    """Return the lens as it was focused for a photograph of native_size_px (width, height) before any reduction; or None and why."""
    focus_m, optics = photo.focus_distance_m, optics_of_photo(photo, native_size_px)
    missing = [name for name, value in (optics | {"focus_distances_m": focus_m}).items() if value is None]
    focal_length_mm, f_number, sensor_width_mm = optics.values()
    if focal_length_mm is None or f_number is None or sensor_width_mm is None or focus_m is None:
        return None, f"{photo.path.name} does not tell {', '.join(missing)}{_why_no_focus(photo)}"
    try:
        return Lens(
            focal_length_mm=focal_length_mm,
            f_number=f_number,
            focus_distance_m=focus_m,
            sensor_width_mm=sensor_width_mm,
            aperture=photo.sidecar.aperture,
        ), None
    except InputError as error:
        return None, f"{photo.path.name}: {error}"


def optics_of_photo(photo: Photo, native_size_px: tuple[int, int]) -> dict[str, float | None]:
    """Return focal_length_mm, f_number and sensor_width_mm, as far as they are known."""
    metadata, sensor_width_mm = photo.metadata, photo.sidecar.sensor_width_mm
    if sensor_width_mm is None and metadata.sensor is not None:
        sensor_width_mm = metadata.sensor.width_mm(*native_size_px)
    return {"focal_length_mm": metadata.focal_length_mm, "f_number": metadata.f_number, "sensor_width_mm": sensor_width_mm}


def _why_no_focus(photo: Photo) -> str:
    """Explain a stated distance that could not be used."""
    focus, focal_length_mm = photo.metadata.focus, photo.metadata.focal_length_mm
    if focus is None or photo.focus_distance_m is not None:
        return ""
    if focal_length_mm is None:
        return f" ({focus.source} counts from the film plane; the lens's distance follows once the focal length is known)"
    return f" ({focus.source} from the film plane is nearer than a thin lens of {focal_length_mm:g} mm can focus)"


def reference_index(focus_distances_m: Sequence[float | None]) -> int:
    """Return the slice with the narrowest field: the one focused nearest, so far as distances are known, else the first."""
    known = [(distance, index) for index, distance in enumerate(focus_distances_m) if distance is not None]
    return min(known)[1] if known else 0


def lens_text(lens: Lens | None) -> str:
    """Return a lens in a few words, for tables."""
    if lens is None:
        return "unknown"
    sides = [len(outline) for outline in lens_to_json(lens)["aperture"]["outlines"]]
    blades = f", {sides[0]} blades" if len(sides) == 1 and sides[0] < 32 else ""
    blades += ", central obstruction" if min(lens.aperture.weights) < 0 else ""
    return f"{lens.focal_length_mm:.4g} mm f/{lens.f_number:.3g}{blades}, sensor {lens.sensor_width_mm:.4g} mm"


def stack_remarks(work: StackWork, reference: Photo, lens: Lens | None, missing: str | None) -> list[str]:
    """Say in sentences what a reader should know. missing: why there is no lens."""
    photos = [each.photo for each in work.finished]
    if len(photos) < FEWEST_TO_MERGE:
        return [*work.remarks, f"a stack of 1 slice: merging needs at least {FEWEST_TO_MERGE}"]
    counted = Counter(remark for each in work.finished for remark in each.record["remarks"])
    remarks = [remark if count == 1 or count == len(photos) else f"{remark} ({count} slices)" for remark, count in counted.items()]
    remarks = [*work.remarks, *remarks, *_session_remarks(work)]
    if any((photo.metadata.orientation or 1) != 1 for photo in photos):
        remarks.append("EXIF asks to turn pictures of this stack: they are left as the sensor saw them, and turned for people to look at")
    remarks += _sidecar_remarks(photos)
    if lens is None:
        remarks.append(f"no lens: {missing}. Give what is missing in a lens.toml beside the photographs and ingest again")
    elif reference.sidecar.sensor_width_mm is None and (sensor := reference.metadata.sensor) is not None:
        doubt = f" ({sensor.doubt})" if sensor.doubt else ""
        remarks.append(f"sensor width {lens.sensor_width_mm:.4g} mm from {sensor.source}{doubt}")
    return remarks + lens_remarks(photos) + _order_remarks(photos)


def lens_remarks(photos: Sequence[Photo]) -> list[str]:
    """Say what speaks against one lens for all slices: differing focal lengths or f-numbers, partly unknown distances."""
    remarks = []
    for name, unit in (("focal_length_mm", " mm"), ("f_number", "")):
        values = sorted({round(value, 3) for photo in photos if (value := getattr(photo.metadata, name)) is not None})
        if len(values) > 1:
            listed = ", ".join(f"{value:g}{unit}" for value in values)
            remarks.append(f"{name} differs within the stack ({listed}): the reference's is used")
    unknown = [photo.path.name for photo in photos if photo.focus_distance_m is None]
    if unknown:
        remarks.append(
            f"no focus distance for {len(unknown)} of {len(photos)} slices ({', '.join(unknown[:4])}{' ...' if len(unknown) > 4 else ''}): "
            f"merging finds their blur in pixels and their order from the pictures, and guesses metres"
        )
    return remarks + sentinel_remarks(photos)


def sentinel_remarks(photos: Sequence[Photo]) -> list[str]:
    """Say that a camera's word for infinity is no distance, and how to give one."""
    told = [(photo.path.name, focus.source) for photo in photos if (focus := photo.metadata.focus) is not None and focus.is_sentinel]
    if not told:
        return []
    names = f"{', '.join(name for name, _ in told[:4])}{' ...' if len(told) > 4 else ''}"
    states, taken = ("states its focus", "its distance is") if len(told) == 1 else ("state their focus", "their distances are")
    return [
        f"{names} {states} by a sentinel ({told[0][1]}), which cameras write for all that is far: {taken} not known, taken as infinity "
        f"where nothing else tells, and left out where stated distances are weighed; a focus.csv overrides it"
    ]


def _order_remarks(photos: Sequence[Photo]) -> list[str]:
    """Say what a reader should check before merging."""
    remarks = []
    times = [photo.metadata.taken_at for photo in photos]
    known = [time for time in times if time is not None]
    if len(known) == len(times) and known != sorted(known) and any(photo.focus_distance_m is None for photo in photos):
        remarks.append(
            "slices are in the order of the file names, which is not that in which they were taken: merging sorts them by their focus "
            "where pictures tell it"
        )
    return remarks


def _session_remarks(work: StackWork) -> list[str]:
    """Say which scale the stack shares with the others of its scene, and where it does not."""
    remarks, choice, reference = [], work.choice, work.finished[0]
    if choice.white_balance is not None:
        multipliers = ",".join(f"{each:.4g}" for each in choice.white_balance)
        whose = "the one given" if choice.white_balance_source == GIVEN else f"the camera's of {choice.white_balance_source}"
        remarks.append(f"one white balance for all RAW of the scene: {whose}. For the same in other scenes: --white-balance {multipliers}")
    metadata, name = reference.record["metadata"], reference.photo.path.name
    if metadata["exposure_gain_session_from"] == "overlap":
        gain = metadata["exposure_gain_session"]
        remarks.append(f"{name} does not state its exposure: compared with {choice.reference_stack} the gain is {gain:.3g}")
    elif metadata["exposure_gain_session_from"] == "nothing" and work.folder.name != choice.reference_stack:
        remarks.append(f"{name} does not state its exposure: its radiance may be on another scale than that of {choice.reference_stack}")
    return remarks


def _sidecar_remarks(photos: Sequence[Photo]) -> list[str]:
    sidecar = photos[0].sidecar
    files = list(dict.fromkeys(Path(each).name for each in (sidecar.where, sidecar.focus_where) if each))
    if not files:
        return []
    unmatched = sidecar.unmatched_names([photo.path.name for photo in photos])
    note = f"; it names files that are not in this stack: {', '.join(unmatched)}" if unmatched else ""
    return [f"{' and '.join(files)} {'was' if len(files) == 1 else 'were'} read{note}"]
