"""Shots: what `mrbokeh check` opens: one picture, numbered pictures in a folder, the slices of a focal stack, or a film."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.checks.checked_picture import LOSSLESS_FILM, LOSSY_FILM, CheckedPicture, Storage, read_picture
from mrbokeh.images.image_io import INTEGER_SUFFIXES, LINEAR_SUFFIXES
from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack
from mrbokeh.system.errors import InputError

_PICTURES = INTEGER_SUFFIXES + LINEAR_SUFFIXES
_LOSSLESS_CODECS = ("ffv1", "png", "huffyuv", "ffvhuff", "rawvideo")
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


@dataclass(frozen=True)
class Shot:
    """numbers: of the pictures as their names state them, or None for a film, where nobody knows before it is read.

    missing: numbers that should be there. is_sequence: pictures follow one another in time. pictures: a fresh pass over them; one
    that cannot be read comes as the sentence that says why.
    """

    path: Path
    numbers: tuple[int, ...] | None
    missing: tuple[int, ...]
    is_sequence: bool
    pictures: Callable[[], Iterator[CheckedPicture | str]]


def open_shot(path: Path) -> Shot:
    """Raises InputError where there is nothing to check."""
    if not path.exists():
        raise InputError(f"expected a picture, a folder of pictures, a focal stack or a film at {path}, but there is nothing")
    if path.is_dir():
        return _stack(path) if (path / FILE_NAME).is_file() else _numbered(path)
    if path.suffix.lower() in _PICTURES:
        return Shot(path, (0,), (), False, lambda: iter([read_picture(path)]))
    return _film(path)


def _numbered(folder: Path) -> Shot:
    files = sorted(each for each in folder.iterdir() if each.suffix.lower() in _PICTURES and not each.name.startswith("."))
    if not files:
        raise InputError(f"{folder} holds no pictures ({', '.join(_PICTURES)}): give the folder of a sequence or of a focal stack")
    found = [_NUMBER.search(each.stem) for each in files]
    if len({each.suffix.lower() for each in files}) > 1 or any(each is None for each in found):
        raise InputError(
            f"{folder}: expected pictures of one format with numbers in their names (shot.0001.exr), got {files[0].name} and others"
        )
    by_number = dict(sorted((int(match.group()), file) for match, file in zip(found, files, strict=True) if match))
    if len(by_number) < len(files):
        raise InputError(f"{folder}: {len(files)} pictures share {len(by_number)} numbers: keep one sequence per folder")
    missing = tuple(sorted(set(range(min(by_number), max(by_number) + 1)) - set(by_number)))
    return Shot(folder, tuple(by_number), missing, True, lambda: _read(list(by_number.values())))


def _stack(folder: Path) -> Shot:
    paths = [folder / each.path for each in read_focal_stack(folder).slices]
    missing = tuple(index for index, path in enumerate(paths) if not path.is_file())
    present = [index for index in range(len(paths)) if index not in missing]
    return Shot(folder, tuple(present), missing, False, lambda: _read([paths[index] for index in present]))


def _read(paths: list[Path]) -> Iterator[CheckedPicture | str]:
    for path in paths:
        try:
            yield read_picture(path)
        except InputError as error:
            yield str(error)


def _film(path: Path) -> Shot:
    from mrbokeh.video.clip import probe

    probe(path)
    return Shot(path, None, (), True, lambda: _frames(path))


def _frames(path: Path) -> Iterator[CheckedPicture]:
    from mrbokeh.video.clip import read_frames

    storage = _film_storage(path)
    for number, frame in enumerate(read_frames(path)):
        yield CheckedPicture(f"frame {number}", frame.rgb, storage, time_s=frame.time_s)


def _film_storage(path: Path) -> Storage:
    import av

    with av.open(str(path)) as container:
        return LOSSLESS_FILM if container.streams.video[0].codec_context.name in _LOSSLESS_CODECS else LOSSY_FILM
