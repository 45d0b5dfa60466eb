"""Choices that all stacks of a scene share, kept in SCENE/session.json: one white balance and one exposure scale for each camera.

A network learns one lens from many stacks, so equal light must be equal numbers in all of them. The choice is made once,
by the first call of ingest, and later calls into the same scene reuse it.
"""

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from capture.photos.developing import is_raw
from capture.photos.libraw import WhiteBalance
from capture.photos.photo_metadata import StatedExposure
from capture.photos.raw import camera_white_balance
from capture.stacks.grouping import Photo, PhotoGroup, in_focus_order
from capture.stacks.slice_files import DiskFullError
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE_NAME
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FILE_NAME = "session.json"
FORMAT = "mrbokeh-capture-session"
VERSION = 1
GIVEN = "given"
_SAME = 1e-3


@dataclass(frozen=True)
class CameraChoice:
    """Choices for all photographs of one camera in a scene.

    white_balance: multipliers of red, green, blue, green being 1, or None without RAW; its source: the file it came from, or "given".
    exposure: the one to which all slices are brought, or None where no photograph states it.
    reference_stack, reference_source: the stack and the file that set the scale.
    """

    white_balance: WhiteBalance | None = None
    white_balance_source: str = ""
    exposure: StatedExposure | None = None
    reference_stack: str = ""
    reference_source: str = ""


@dataclass
class Session:
    """Choices of a scene, by camera model ("" where it is unknown)."""

    scene: Path
    cameras: dict[str, CameraChoice] = field(default_factory=dict)

    def choice_for(self, photos: Sequence[Photo]) -> CameraChoice:
        return self.cameras.get(camera_of(photos), CameraChoice())


def open_session(scene: Path, groups: Sequence[PhotoGroup], white_balance: WhiteBalance | None, *, overwrite: bool) -> Session:
    """Return the session of a scene with what these photographs add to it, written back. white_balance: the one asked for, or None.

    overwrite: choose anew, unless the scene has stacks that are not made again now: they share the old choice.
    Raises InputError if the white balance asked for is not the one that the scene has.
    """
    others = {path.parent.name for path in scene.glob(f"*/{STACK_FILE_NAME}")} - {group.name for group in groups}
    session = Session(scene) if overwrite and not others else read_session(scene)
    before = dict(session.cameras)
    for camera in dict.fromkeys(camera_of(group.photos) for group in groups):
        own = [group for group in groups if camera_of(group.photos) == camera]
        session.cameras[camera] = _completed(session.cameras.get(camera, CameraChoice()), own, white_balance)
        _require_same(scene, session.cameras[camera], white_balance)
    if session.cameras != before and any(choice != CameraChoice() for choice in session.cameras.values()):
        write_session(session)
    return session


def read_session(scene: Path) -> Session:
    """Read the session of a scene; an empty one where there is none yet."""
    path = scene / FILE_NAME
    if not path.is_file():
        return Session(scene)
    document = read_json(path, "the session of a scene")
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(
            f"{path}: expected format {FORMAT!r} version {VERSION}, got {document.get('format')!r} version {document.get('version')!r}: "
            f"delete it and ingest all photographs of the scene again with --overwrite"
        )
    return Session(scene, {camera: _choice(choice) for camera, choice in document["cameras"].items()})


def write_session(session: Session) -> None:
    cameras = {camera: asdict(choice) for camera, choice in session.cameras.items()}
    write_json(session.scene / FILE_NAME, {"format": FORMAT, "version": VERSION, "cameras": cameras})


def camera_of(photos: Sequence[Photo]) -> str:
    """Return the model that took most of the photographs, "" where none says."""
    named = Counter(photo.metadata.camera_model for photo in photos if photo.metadata.camera_model)
    return named.most_common(1)[0][0] if named else ""


@contextmanager
def undone_when_refused(scene: Path, is_kept: Callable[[Sequence[FocalStack]], bool]) -> Iterator[None]:
    """Take away what a block that raises InputError has put into a scene, so that a run with other photographs finds nothing of it.

    All stays where the scene was begun before, where its new stacks (by name) are to be kept, and where a full disk stopped the work: that
    can go on.
    """
    before = set(scene.iterdir()) if scene.is_dir() else None
    try:
        yield
    except DiskFullError:
        raise
    except InputError:
        made = set(scene.iterdir()) - (before or set()) if scene.is_dir() else set()
        stacks = [read_focal_stack(each) for each in sorted(made) if (each / STACK_FILE_NAME).is_file()]
        if scene / FILE_NAME in made and not is_kept(stacks):
            _take_away(scene, made, with_folder=before is None)
        raise


def _choice(document: dict[str, Any]) -> CameraChoice:
    balance, exposure = document["white_balance"], document["exposure"]
    read = {
        "white_balance": None if balance is None else (float(balance[0]), float(balance[1]), float(balance[2])),
        "exposure": None if exposure is None else StatedExposure(**exposure),
    }
    return CameraChoice(**document | read)


def _completed(choice: CameraChoice, groups: Sequence[PhotoGroup], wanted: WhiteBalance | None) -> CameraChoice:
    """Fill the gaps of a choice: the white balance of the first RAW that opens, the exposure of the first slice."""
    if choice.white_balance is None:
        model = camera_of([photo for group in groups for photo in group.photos])
        own = (photo for group in groups for photo in group.photos if photo.metadata.camera_model in (model, None, ""))
        balance, source = _white_balance(own, wanted)
        choice = replace(choice, white_balance=balance, white_balance_source=source)
    if not choice.reference_stack:
        in_order = [(photo, group.name) for group in groups for photo in in_focus_order(group.photos)]
        photo, stack = next(((photo, stack) for photo, stack in in_order if photo.metadata.exposure), in_order[0])
        choice = replace(choice, exposure=photo.metadata.exposure, reference_stack=stack, reference_source=photo.path.name)
    return choice


def _white_balance(photos: Iterable[Photo], wanted: WhiteBalance | None) -> tuple[WhiteBalance | None, str]:
    for photo in (each for each in photos if is_raw(each.path)):
        try:
            own = camera_white_balance(photo.path)
        except InputError:
            continue
        return (wanted, GIVEN) if wanted is not None else (own, photo.path.name)
    return None, ""


def _require_same(scene: Path, choice: CameraChoice, wanted: WhiteBalance | None) -> None:
    if wanted is None or choice.white_balance is None:
        return
    if max(abs(a / b - 1.0) for a, b in zip(wanted, choice.white_balance, strict=True)) > _SAME:
        has, asked = (",".join(f"{each:.4g}" for each in balance) for balance in (choice.white_balance, wanted))
        raise InputError(
            f"all stacks of {scene} share the white balance {has} (from {choice.white_balance_source}), but {asked} was asked for: leave "
            f"--white-balance out, give another --out, or ingest all photographs of the scene with --overwrite"
        )


def _take_away(scene: Path, made: set[Path], *, with_folder: bool) -> None:
    for path in made:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    if with_folder:
        scene.rmdir()
