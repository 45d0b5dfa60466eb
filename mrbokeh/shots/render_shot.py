"""Rendering of a shot from beginning to end: an executor renders the missing segments, then they are joined.

Finished segments lie in a folder beside the result, with a manifest of their settings; a segment is never rendered twice.
"""

import hashlib
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from mrbokeh import __version__
from mrbokeh.shots.executors import Executor, Progress
from mrbokeh.shots.segment_task import SegmentTask
from mrbokeh.shots.shot import MANIFEST, Segment, Shot
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.video.image_sequence import NumberedFiles, is_pattern


def render_shot(shot: Shot, executor: Executor, *, overwrite: bool = False, progress: Progress = lambda _: None) -> str:
    """Render a shot; return what became of the sound.

    Raises InputError if the result exists, or parts of another run do, unless overwrite. progress: is told of frames as they are made,
    and at once of those that an interrupted run left finished.
    """
    shot.target.require_new(shot, overwrite or shot.was_begun)
    folder = PartsFolder.opened(shot, overwrite)
    missing = folder.missing
    progress(sum(segment.frame_count for segment in shot.segments) - sum(segment.frame_count for segment in missing))
    executor.run([SegmentTask(shot, segment, folder.path, executor.threads) for segment in missing], progress)
    note = shot.target.join(shot, folder.path)
    folder.remove()
    return note


@dataclass(frozen=True, eq=False)
class PartsFolder:
    """Folder OUT.parts of finished segments, from the first segment until the result is whole; its manifest says what they were made
    with.
    """

    path: Path
    shot: Shot

    @classmethod
    def opened(cls, shot: Shot, overwrite: bool = False) -> "PartsFolder":
        """The folder of this shot, with what an interrupted run left in it.

        Raises InputError where it was left by a run with other settings, unless overwrite, which begins anew.
        """
        folder = cls(shot.parts_path, shot)
        manifest, settings = folder.path / MANIFEST, settings_of(shot)
        if manifest.is_file():
            before = read_json(manifest, "the manifest of finished segments")["settings"]
            changed = sorted(name for name in {*before, *settings} if before.get(name) != settings.get(name))
            if changed and not overwrite and folder.holds_parts:
                raise InputError(
                    f"{folder.path} holds finished segments of a run with other settings ({', '.join(changed)}): "
                    f"run with the same to go on, or --overwrite to begin anew"
                )
            if changed:
                folder.remove()
        write_json(manifest, {"settings": settings, "segments": [list(segment) for segment in shot.segments]})
        return folder

    @property
    def missing(self) -> list[Segment]:
        return [segment for segment in self.shot.segments if not self.shot.target.part(self.path, segment).exists()]

    @property
    def holds_parts(self) -> bool:
        """Whether finished parts are there: half files and signs of workers have other names."""
        return any(each.stem.isdigit() for each in self.path.iterdir())

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)


def settings_of(shot: Shot) -> dict[str, str]:
    """Return all that the parts depend on, by name; files with their size and the time of their last change."""
    recipe: Any = shot.recipe
    of_recipe = (
        {each.name: repr(getattr(recipe, each.name)) for each in fields(recipe)} if is_dataclass(recipe) else {"recipe": repr(recipe)}
    )
    return {
        "version": __version__,
        "clip": _stamps([shot.source.path]),
        "input space": "" if shot.source.space is None else f"{shot.source.space} {_stamps(shot.source.space.files)}",
        "frames": f"{shot.start}:{shot.stop} by {shot.segment_frames} at {shot.source.info.frame_rate}",
        **of_recipe,
        "files": _stamps(recipe.files),
        **shot.target.settings,
    }


def _stamps(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        for file in NumberedFiles.found(path).files if is_pattern(path) else [path]:
            try:
                status = file.stat()
            except OSError:
                raise InputError(f"expected a file at {file}, but there is none: check the name") from None
            digest.update(f"{file}|{status.st_size}|{status.st_mtime_ns}\n".encode())
    return f"{', '.join(path.name for path in paths)} {digest.hexdigest()[:16]}"
