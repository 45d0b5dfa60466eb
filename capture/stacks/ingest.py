"""`mrbokeh capture ingest`: photographs, RAW or developed, into the focal stacks of a scene.

SCENE/NAME/stack.json and slices/00.exr, 01.exr, ...: linear camera RGB, ordered by focus distance, nearest first, where
all distances are known, else by file name. Nothing is rotated or cropped; the slices are not registered yet.
SCENE/session.json: the white balance and the exposure that all stacks share.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from capture.photos.developing import is_raw
from capture.photos.metadata import read_metadata_of
from capture.photos.photo_files import PhotoFolder, SkippedFile, find_photos
from capture.photos.raw import read_raw_metadata
from capture.photos.sidecar import sidecar_of
from capture.stacks.disk_space import told_when_full
from capture.stacks.grouping import Grouping, Photo, PhotoGroup, group_photos, in_focus_order, of_one_camera
from capture.stacks.session import Session, open_session
from capture.stacks.stack_description import StackReport, finish_stack, finished_before, ingest_digest
from capture.stacks.stack_ingest import Development, StackWork, stack_work
from mrbokeh.errors import InputError
from mrbokeh.progress import progress_bars


@dataclass(frozen=True)
class IngestSettings:
    """grouping: what makes a stack. sidecar: a lens.toml or focus.csv for all photographs instead of those beside them."""

    grouping: Grouping = Grouping.folder
    development: Development = field(default_factory=Development)
    sidecar: Path | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class IngestReport:
    """All stacks of a call, and the files that belong to none."""

    stacks: tuple[StackReport, ...]
    skipped: tuple[SkippedFile, ...]


def ingest(given: Sequence[Path], scene: Path, settings: IngestSettings | None = None) -> IngestReport:
    """Make or complete the stacks of a scene. Unusable files are reported and left out; InputError where nothing is usable."""
    settings, scene = settings or IngestSettings(), Path(scene)
    folders, skipped = find_photos(given, scene)
    with progress_bars() as progress:
        reading = progress.add_task("metadata", total=sum(len(each.paths) for each in folders))
        advance = lambda: progress.advance(reading)  # noqa: E731
        labelled = [(each.label, photos_of_folder(each, settings.sidecar, advance)) for each in folders]
        groups = group_photos(labelled, settings.grouping)
        developing = progress.add_task("developing", total=sum(len(each.photos) for each in groups))
        with told_when_full(scene):
            session = open_session(scene, groups, settings.development.white_balance, overwrite=settings.overwrite)
            reports = [ingest_group(group, session, settings, lambda: progress.advance(developing)) for group in groups]
    skipped = _without_their_raw(skipped, reports)
    if not any(report.stack for report in reports):
        raise InputError(_nothing_usable(given, [*skipped, *(each for report in reports for each in report.skipped)]))
    return IngestReport(tuple(reports), tuple(skipped))


def photos_of_folder(folder: PhotoFolder, sidecar_path: Path | None = None, advance: Callable[[], None] = lambda: None) -> list[Photo]:
    """The photographs of a folder with their shooting data, lens.toml and focus.csv taken into account."""
    sidecar = sidecar_of(folder.folder, folder.top, sidecar_path)
    found = zip(folder.paths, read_metadata_of(folder.paths, advance), strict=True)
    metadata = [own.filled_from(read_raw_metadata(photo)) if is_raw(photo) else own for photo, own in found]
    merged = sidecar.applied([each.name for each in folder.paths], metadata)
    return [Photo(each, data, sidecar) for each, data in zip(folder.paths, merged, strict=True)]


def ingest_group(group: PhotoGroup, session: Session, settings: IngestSettings, advance: Callable[[], None] = lambda: None) -> StackReport:
    """Make or complete the stack of a scene that a group is; `advance` is called after each photograph."""
    folder = session.scene / group.name
    chosen, strangers = (list(group.photos), []) if settings.grouping is Grouping.none else of_one_camera(group.photos)
    photos, choice = in_focus_order(chosen), session.choice_for(chosen)
    digest = ingest_digest(photos, settings.development, choice)
    before = None if settings.overwrite else finished_before(group.name, folder, digest)
    if before is not None:
        for _ in photos:
            advance()
        return before
    work = stack_work(folder, settings.development, choice, overwrite=settings.overwrite)
    work.skipped += strangers
    for photo in photos:
        work.add(photo)
        advance()
    if work.leave_odd_sizes_out():
        work = _with_another_reference(work)
    return finish_stack(group.name, work, digest)


def _with_another_reference(work: StackWork) -> StackWork:
    """The slice that gave the exposure was left out: even out the others again, relative to the first of them."""
    again = stack_work(work.folder, work.development, work.choice, overwrite=False)
    again.skipped += work.skipped
    for each in work.finished:
        again.add(each.photo)
    return again


def _without_their_raw(skipped: Sequence[SkippedFile], reports: Sequence[StackReport]) -> list[SkippedFile]:
    """A picture beside RAW that turned out to be unusable might be wanted after all: it is not taken, but it is said."""
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
        return f"expected photographs (RAW, JPEG, PNG, TIFF, WebP, EXR) in {where}, but found none"
    reasons = "; ".join(f"{each.path.name}: {each.reason}" for each in skipped[:5])
    return f"none of the {len(skipped)} files in {where} could be used: {reasons}{' ...' if len(skipped) > 5 else ''}"
