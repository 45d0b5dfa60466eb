"""Project: the studio's state with all earlier ones, in a JSON file that is written aside and renamed at every change."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mrbokeh.optics.lens_library import FOLDER as LIBRARY
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from viewfinder.studio.state import StudioState, state_of

FORMAT, VERSION = "mrbokeh studio", 1
_EXPECTED = "a project file of `mrbokeh studio`"
_MOST_STORED = 500
"""States of the history that a file keeps: half a megabyte; while the studio runs there is no limit."""
_OF_LIBRARY = "library:"
"""Before the name of a lens of the library, which no folder beside the project may take the place of."""
_PATHS = ("photo", "clip", "track", "depth", "matte", "object", "lens", "camera")


@dataclass
class Project:
    """History of states, of which one is shown. path: of the file. objects, lenses: those that the page offers."""

    path: Path
    history: list[StudioState] = field(default_factory=lambda: [StudioState()])
    place: int = 0
    objects: list[Path] = field(default_factory=list)
    lenses: list[Path] = field(default_factory=list)

    @property
    def state(self) -> StudioState:
        return self.history[self.place]

    def add(self, state: StudioState) -> None:
        """Go on to a new state; what was undone is gone."""
        if state != self.state:
            self.history = [*self.history[: self.place + 1], state]
            self.place += 1

    def amend(self, change: Callable[[StudioState], StudioState]) -> None:
        """Complete the state that is shown, without a step in the history."""
        self.history[self.place] = change(self.state)

    def step(self, by: int) -> None:
        """Undo (-1) or redo (1). Raises InputError at the ends of the history."""
        if not 0 <= self.place + by < len(self.history):
            raise InputError("there is nothing to undo" if by < 0 else "there is nothing to redo: nothing was undone")
        self.place += by

    def offer(self, path: Path) -> None:
        """Offer an object (.glb, .gltf) or a lens on the page."""
        known = self.objects if path.suffix.lower() in (".glb", ".gltf") else self.lenses
        if path not in known:
            known.append(path)

    def write(self) -> None:
        """Write the file; paths within its folder are kept relative to it, so that the folder can be moved."""
        first = max(0, min(self.place, len(self.history) - _MOST_STORED))
        stored = self.history[first : first + _MOST_STORED]
        folder = self.path.absolute().parent
        document = {
            "format": FORMAT,
            "version": VERSION,
            "place": self.place - first,
            "states": [_by_paths(each, lambda path: _stored(path, folder)).document() for each in stored],
            "objects": [str(_stored(each, folder)) for each in self.objects],
            "lenses": [str(_stored(each, folder)) for each in self.lenses],
        }
        write_json(self.path, document)


def read_project(path: Path) -> Project:
    """Read a project file. Raises InputError if it is none, or names a file that is gone."""
    document = read_json(path, _EXPECTED)
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"expected {_EXPECTED} (version {VERSION}) at {path}, but it is another file: give its name to --project")
    folder = path.absolute().parent
    states, place = document.get("states"), document.get("place")
    if not isinstance(states, list) or not states or not isinstance(place, int) or not 0 <= place < len(states):
        raise InputError(f"expected {_EXPECTED} at {path}, but its states are damaged: begin anew without it")
    try:
        history = [_by_paths(state_of(each), lambda path: _found(path, folder)) for each in states]
        objects, lenses = ([_found(Path(each), folder) for each in document.get(name) or ()] for name in ("objects", "lenses"))
    except (InputError, TypeError) as error:
        raise InputError(f"expected {_EXPECTED} at {path}, but: {error}") from None
    there = {name: [each for each in files if each.exists()] for name, files in (("objects", objects), ("lenses", lenses))}
    project = Project(path, history, place, **there)
    for name in ("camera", "matte"):
        if (made := getattr(project.state, name)) is not None and not made.is_file():
            project.history[project.place] = replace(project.state, **{name: None})  # type: ignore[arg-type]
    named = [(name, getattr(project.state, name)) for name in _PATHS]
    for name, file in (*named, *(("object", each.object) for each in project.state.objects)):
        if file is not None and not (file.is_file() or (name in ("photo", "lens") and file.is_dir())):
            raise InputError(f"{path} has the {name} {file}, which is not there any more: put it back, or begin anew without the project")
    return project


def _by_paths(state: StudioState, change: Callable[[Path], Path]) -> StudioState:
    named: dict[str, Any] = {name: change(path) for name in _PATHS if (path := getattr(state, name)) is not None}
    named |= {name: tuple(replace(each, object=change(each.object)) for each in getattr(state, name)) for name in ("before", "after")}
    return replace(state, **named)


def _stored(path: Path, folder: Path) -> Path:
    whole = path.absolute()
    if whole.parent == LIBRARY:
        return Path(f"{_OF_LIBRARY}{path.stem}")
    return whole.relative_to(folder) if whole.is_relative_to(folder) else whole


def _found(path: Path, folder: Path) -> Path:
    """Return where a stored path leads, as one would type it from the working folder."""
    if str(path).startswith(_OF_LIBRARY):
        return LIBRARY / f"{str(path).removeprefix(_OF_LIBRARY)}.json"
    whole = path if path.is_absolute() else folder / path
    return Path(os.path.relpath(whole)) if whole.is_relative_to(Path.cwd()) else whole
