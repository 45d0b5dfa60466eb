"""`mrbokeh capture ingest`: photographs, RAW or developed, into the focal stacks of a scene.

SCENE/NAME/stack.json and slices/00.exr, 01.exr, ...: linear camera RGB, ordered by focus distance, nearest first, where
all distances are known, else by file name. Nothing is rotated or cropped; the slices are not registered yet.
SCENE/session.json: the white balance and the exposure that all stacks share.

What ingest did, for people: a table of stacks, remarks below it, and the files that were left out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.table import Table

from capture.photos.developing import is_raw
from capture.photos.metadata import read_metadata_of
from capture.photos.photo_files import PhotoFolder, SkippedFile, find_photos, no_photographs
from capture.photos.raw import read_raw_metadata
from capture.photos.sidecar import sidecar_of
from capture.stacks.grouping import Grouping, Photo, PhotoGroup, group_photos, in_focus_order, why_aside
from capture.stacks.session import CameraChoice, Session, open_session, undone_when_refused
from capture.stacks.slice_files import reporting_full_disk
from capture.stacks.stack_description import FEWEST_TO_MERGE, StackReport, finish_stack, finished_before, ingest_digest, lens_text
from capture.stacks.stack_ingest import Development, StackWork, stack_work
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import is_lens_guessed, stated_distances_m
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, show, warn


@dataclass(frozen=True)
class IngestSettings:
    """Settings of a call.

    grouping: what makes a stack. sidecar: a lens.toml or focus.csv for all photographs, in place of those beside them.
    """

    grouping: Grouping = Grouping.folder
    development: Development = field(default_factory=Development)
    sidecar: Path | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class IngestReport:
    """Stacks of a call, and the files that belong to none. no_photographs: what else lies beside the photographs."""

    stacks: tuple[StackReport, ...]
    skipped: tuple[SkippedFile, ...]
    no_photographs: tuple[Path, ...]


def ingest(given: Sequence[Path], scene: Path, settings: IngestSettings | None = None) -> IngestReport:
    """Make or complete the stacks of a scene. Unusable files are reported and left out; InputError where nothing is usable."""
    with undone_when_refused(Path(scene), bool):
        return _ingested(given, Path(scene), settings or IngestSettings())


def _ingested(given: Sequence[Path], scene: Path, settings: IngestSettings) -> IngestReport:
    folders, skipped = find_photos(given, scene)
    with progress_bars() as progress:
        reading = progress.add_task("metadata", total=sum(len(each.paths) for each in folders))
        advance = lambda: progress.advance(reading)  # noqa: E731
        labelled = [(each.label, photos_of_folder(each, settings.sidecar, advance)) for each in folders]
        groups = group_photos(labelled, settings.grouping)
        developing = progress.add_task("developing", total=sum(len(each.photos) for each in groups))
        with reporting_full_disk(scene):
            session = open_session(scene, groups, settings.development.white_balance, overwrite=settings.overwrite)
            reports = [ingest_group(group, session, settings, lambda: progress.advance(developing)) for group in groups]
    skipped = _without_their_raw(skipped, reports)
    if not any(report.stack for report in reports):
        problems = [f"{report.name}: {report.problem}" for report in reports if report.problem]
        raise InputError(
            "; ".join(problems) or _nothing_usable(given, [*skipped, *(each for report in reports for each in report.skipped)])
        )
    return IngestReport(tuple(reports), tuple(skipped), tuple(no_photographs(given, folders, settings.sidecar)))


def photos_of_folder(folder: PhotoFolder, sidecar_path: Path | None = None, advance: Callable[[], None] = lambda: None) -> list[Photo]:
    """Return the photographs of a folder with their shooting data, lens.toml and focus.csv taken into account."""
    sidecar = sidecar_of(folder.folder, folder.top, sidecar_path)
    found = zip(folder.paths, read_metadata_of(folder.paths, advance), strict=True)
    metadata = [own.filled_from(read_raw_metadata(photo)) if is_raw(photo) else own for photo, own in found]
    merged = sidecar.applied([each.name for each in folder.paths], metadata)
    return [Photo(each, data, sidecar) for each, data in zip(folder.paths, merged, strict=True)]


def ingest_group(group: PhotoGroup, session: Session, settings: IngestSettings, advance: Callable[[], None] = lambda: None) -> StackReport:
    """Make or complete the stack of a scene that a group is; `advance` is called after each photograph."""
    choice = session.choice_for(group.photos)
    digest = ingest_digest(in_focus_order(group.photos) + list(group.aside), settings.development, choice)
    before = None if settings.overwrite else finished_before(group.name, session.scene / group.name, digest)
    if before is not None:
        for _ in group.photos:
            advance()
        return before
    work = _developed(group, choice, session, settings, advance)
    if len(work.finished) < min(FEWEST_TO_MERGE, len(group.aside)):
        work = _developed_aside(group, work, session, settings)
    else:
        work.skipped += why_aside(group)
    try:
        if work.finished and work.leave_out_odd_slices(sizes_only=settings.grouping is Grouping.none):
            work = work.with_another_reference()
    except InputError as error:
        work.give_up()
        return StackReport(group.name, None, skipped=tuple(work.skipped), problem=str(error))
    return finish_stack(group.name, work, digest)


def _developed(
    group: PhotoGroup, choice: CameraChoice, session: Session, settings: IngestSettings, advance: Callable[[], None] = lambda: None
) -> StackWork:
    """Develop all photographs of a group that can be developed."""
    work = stack_work(session.scene / group.name, settings.development, choice, overwrite=settings.overwrite)
    work.remarks = group.remarks
    for photo in in_focus_order(group.photos):
        work.add(photo)
        advance()
    return work


def _developed_aside(group: PhotoGroup, unusable: StackWork, session: Session, settings: IngestSettings) -> StackWork:
    """Make a stack of what other cameras took, where too little of the usual one's photographs can be used."""
    unusable.give_up()
    left_out = [SkippedFile(each.photo.path, "too few photographs of its camera can be used") for each in unusable.finished]
    remark = f"{len(group.aside)} photographs of other cameras are taken, because too few of the usual one's can be used"
    other = PhotoGroup(group.name, group.aside, remarks=(*group.remarks, remark))
    own_session = open_session(session.scene, [other], settings.development.white_balance, overwrite=False)
    work = _developed(other, own_session.choice_for(other.photos), session, settings)
    work.skipped += [*unusable.skipped, *left_out]
    return work


def _without_their_raw(skipped: Sequence[SkippedFile], reports: Sequence[StackReport]) -> list[SkippedFile]:
    """Tell how to take a picture beside RAW that turned out to be unusable: it might be wanted after all."""
    unusable = {each.path.resolve() for report in reports for each in report.skipped}
    return [
        replace(each, reason=f"{each.reason} but cannot be used: copy {each.raw.name} again, or move it elsewhere to take this one")
        if each.raw is not None and each.raw.resolve() in unusable
        else each
        for each in skipped
    ]


def _nothing_usable(given: Sequence[Path], skipped: Sequence[SkippedFile]) -> str:
    where = ", ".join(str(each) for each in given)
    if not skipped:
        return f"expected photographs (RAW, JPEG, HEIC, PNG, TIFF, WebP, EXR, HDR) in {where}, but found none"
    reasons = "; ".join(f"{each.path.name}: {each.reason}" for each in skipped[:5])
    return f"none of the {len(skipped)} files in {where} could be used: {reasons}{' ...' if len(skipped) > 5 else ''}"


_MOST_NAMED = 5


def print_report(report: IngestReport) -> None:
    """Print one line for each stack, then remarks and skipped files with their reasons."""
    table = Table("stack", "slices", "size", "focus (from the lens)", "lens", "skipped")
    for each in report.stacks:
        table.add_row(*_cells(each))
    show(table, stacks=[{"stack": each.name, "problem": each.problem, "remarks": list(each.remarks)} for each in report.stacks])
    for each in report.stacks:
        for remark in each.remarks:
            say(f"{each.name}: {remark}")
        if each.problem:
            warn(f"no stack {each.name}: {each.problem}")
    for skipped in (*report.skipped, *(one for each in report.stacks for one in each.skipped)):
        warn(f"skipped {skipped.path.name}: {skipped.reason}")
    if report.no_photographs:
        say(f"not photographs, left out: {_some_names(report.no_photographs)}")


def _some_names(paths: Sequence[Path]) -> str:
    """Name the first few, and say how many there are."""
    more = f" ... ({len(paths)} files)" if len(paths) > _MOST_NAMED else ""
    return ", ".join(each.name for each in paths[:_MOST_NAMED]) + more


def focus_text(stack: FocalStack) -> str:
    """Return the range of the focus distances that are stated: "0.4 .. 2.1 m", "... inf", "unknown"."""
    known = [distance for distance in stated_distances_m(stack) if distance is not None]
    if not known:
        return "unknown"
    ends = [f"{distance:.4g}" if math.isfinite(distance) else "inf" for distance in (min(known), max(known))]
    partly = "" if len(known) == len(stack) else f" ({len(known)} of {len(stack)} known)"
    return f"{' .. '.join(dict.fromkeys(ends))} m{partly}"


def _cells(report: StackReport) -> tuple[str, ...]:
    skipped = str(len(report.skipped) or "")
    if report.stack is None or report.size_px is None:
        return report.name, "none", "", "", "", skipped
    kept = f" ({report.kept} from before)" if report.kept else ""
    size = f"{report.size_px[0]}x{report.size_px[1]}"
    lens = None if is_lens_guessed(report.stack) else report.stack.lens
    return report.name, f"{len(report.stack)}{kept}", size, focus_text(report.stack), lens_text(lens), skipped
