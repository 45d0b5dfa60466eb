"""A scene that a refused command has begun: it is taken away, so that a run with other photographs finds nothing of it."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from capture.stacks.disk_space import DiskFullError
from capture.stacks.session import FILE_NAME
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE_NAME
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.errors import InputError


@contextmanager
def taken_away_when_refused(scene: Path, is_kept: Callable[[Sequence[FocalStack]], bool]) -> Iterator[None]:
    """Take away what a block that raises InputError has put into a scene.

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


def _take_away(scene: Path, made: set[Path], *, with_folder: bool) -> None:
    for path in made:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    if with_folder:
        scene.rmdir()
