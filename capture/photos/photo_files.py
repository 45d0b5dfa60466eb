"""Files that are photographs: folders are searched, files that are named are taken, RAW goes before the JPEG of the same shot."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.photos.raw import RAW_SUFFIXES
from capture.photos.sidecar import FOCUS_FILE, LENS_FILE
from mrbokeh.images.heif import has_heif, heif_advice, is_heif
from mrbokeh.images.image_io import ENCODED_SUFFIXES, LINEAR_SUFFIXES
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE_NAME
from mrbokeh.system.errors import InputError

PHOTO_SUFFIXES = (*RAW_SUFFIXES, *ENCODED_SUFFIXES, *LINEAR_SUFFIXES)


@dataclass(frozen=True)
class SkippedFile:
    """File that was left out, and why, in words. raw: taken in its place, or None."""

    path: Path
    reason: str
    raw: Path | None = None


@dataclass(frozen=True)
class PhotoFolder:
    """Photographs of one folder in the order of their names; top: the folder that the user named, which contains it."""

    folder: Path
    top: Path
    paths: tuple[Path, ...]

    @property
    def label(self) -> str:
        """Return the folder's name with those of its parents below `top`, as a name for a stack."""
        below = self.folder.relative_to(self.top).parts
        name = "_".join(below) or self.folder.name or "stack"
        return re.sub(r"[^\w.-]+", "_", name).strip("._") or "stack"


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts IMG_9 before IMG_10, and numbers before words."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", path.name) if part]


def find_photos(given: Sequence[Path], scene: Path) -> tuple[list[PhotoFolder], list[SkippedFile]]:
    """Find photographs under the given files and folders, folder by folder, and what was left out. The scene itself is not searched."""
    found: dict[Path, Path] = {}
    skipped: list[SkippedFile] = []
    for path in (Path(each).resolve() for each in given):
        if path == Path(scene).resolve():
            raise InputError(f"the photographs lie in {scene}, where the scene was to be made: give another folder with --out")
        if not path.exists():
            raise InputError(f"expected photographs or folders of photographs, but there is nothing at {path}")
        if path.is_dir():
            photos, results = _photos_under(path, Path(scene).resolve())
            found |= {each: path for each in photos if each not in found}
            skipped += results
        elif _is_unread_heif(path):
            skipped.append(SkippedFile(path, heif_advice()))
        elif path.suffix.lower() in PHOTO_SUFFIXES:
            found.setdefault(path, path.parent)
        else:
            skipped.append(SkippedFile(path, f"not a photograph by its suffix {path.suffix or '(none)'}"))
    folders: dict[Path, list[Path]] = {}
    for path in sorted(found, key=natural_key):
        folders.setdefault(path.parent, []).append(path)
    result = []
    for folder in sorted(folders):
        kept, doubles = _raw_before_jpeg(folders[folder])
        skipped += doubles
        result.append(PhotoFolder(folder, found[folders[folder][0]], tuple(kept)))
    return result, skipped


def no_photographs(given: Sequence[Path], folders: Sequence[PhotoFolder], sidecar: Path | None = None) -> list[Path]:
    """Find files that lie beside photographs in folders that were searched and are none, without hidden files and sidecars."""
    searched = [Path(each).resolve() for each in given if Path(each).is_dir()]
    looked_in = [each.folder for each in folders if any(each.folder.is_relative_to(top) for top in searched)]
    read = {folder / name for folder in looked_in for name in (LENS_FILE, FOCUS_FILE)} | ({sidecar.resolve()} if sidecar else set())
    beside = sorted((path for folder in looked_in for path in folder.iterdir() if path not in read), key=natural_key)
    return [path for path in beside if path.is_file() and not path.name.startswith(".") and path.suffix.lower() not in PHOTO_SUFFIXES]


def _is_unread_heif(path: Path) -> bool:
    return is_heif(path) and not has_heif()


def _photos_under(top: Path, scene: Path) -> tuple[list[Path], list[SkippedFile]]:
    """Find photographs below a folder, without hidden files, our own scene and other focal stacks' folders.

    Beside photographs, EXR and HDR files are taken for somebody's results and left out. HEIC is left out where its extra is missing.
    """
    candidates = [path for path in top.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file()]
    stacks = {path.parent for path in top.rglob(STACK_FILE_NAME)} | {scene}
    visible = [path for path in candidates if not any(part.startswith(".") for part in path.relative_to(top).parts)]
    ours = [path for path in visible if not stacks.intersection(path.parents)]
    photos = [path for path in ours if not _is_unread_heif(path)]
    unread = [SkippedFile(path, heif_advice()) for path in sorted(set(ours) - set(photos))]
    results = [path for path in photos if path.suffix.lower() in LINEAR_SUFFIXES]
    if len(results) == len(photos):
        return photos, unread
    reason = "EXR and HDR files are left out where there are photographs too; name it to take it all the same"
    return [path for path in photos if path not in results], [*unread, *(SkippedFile(path, reason) for path in sorted(results))]


def _raw_before_jpeg(paths: list[Path]) -> tuple[list[Path], list[SkippedFile]]:
    """Leave out the JPEG where a camera has stored RAW and JPEG of the same shot side by side."""
    raw = {path.stem: path for path in paths if path.suffix.lower() in RAW_SUFFIXES}
    doubles = {path for path in paths if path.suffix.lower() not in RAW_SUFFIXES and path.stem in raw}
    skipped = [SkippedFile(path, f"the same shot as {raw[path.stem].name}, which is RAW", raw[path.stem]) for path in sorted(doubles)]
    return [path for path in paths if path not in doubles], skipped
