"""Desk: what all pages of one studio share: the project, the opened photograph, its solved camera, and news of every change."""

import asyncio
import logging
import re
import shlex
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart, say
from viewfinder.studio.project import Project
from viewfinder.studio.saving import Saves
from viewfinder.studio.state import DrawnLine, Pair, Stroke, StudioState, state_of

if TYPE_CHECKING:
    from mrbokeh.solving.solved_camera import SolvedCamera
    from viewfinder.studio.brush import Brush
    from viewfinder.studio.photograph import OpenedPhotograph

_log = logging.getLogger(__name__)

LARGEST = {"photo": 300 << 20, "object": 200 << 20}
"""Bytes of what is dropped on the page."""
_OBJECTS = (".glb",)
_KEPT_PHOTOGRAPHS = 6
_TELL_TILT = "set below how far the camera looks down, or draw lines along edges"
_BESIDE = 0.15
"""How far beside another an object is added, in widths of the photograph."""


class Desk:
    """Shared state of one studio. All methods belong to the event loop's thread; what takes long is done in others."""

    def __init__(self, project: Project, pictures: Path) -> None:
        self.project, self.saves = project, Saves(pictures, self.tell_all)
        self.uploads = pictures / "studio_files"
        self.problem = ""
        self.busy = ""
        self._number = 0
        self._changed = asyncio.Event()
        self._opened: dict[tuple[Path | None, Path | None, int | None], OpenedPhotograph] = {}
        self._cameras: dict[Path, dict[str, Any]] = {}
        self._drawn: tuple[object, dict[str, Any]] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._tools = asyncio.Lock()
        self._filming = asyncio.Lock()
        self._filmed: tuple[StudioState, list[str], list[Pair]] | None = None
        self._metres_typed = False
        self._brush: tuple[Path, Brush] | None = None

    @property
    def state(self) -> StudioState:
        return self.project.state

    @property
    def photograph(self) -> "OpenedPhotograph | None":
        """The opened photograph of the state, None while there is none."""
        return self._opened.get((self.state.photo, self.state.depth, self.state.slice))

    @property
    def number(self) -> int:
        """Number of the newest news."""
        return self._number

    def tell_all(self) -> None:
        """Let every page know that something changed."""
        self._number += 1
        self._changed.set()
        self._changed = asyncio.Event()

    async def news_after(self, number: int, wait_s: float) -> None:
        """Wait until there is news after a number, or for so long."""
        if self._number <= number:
            changed = self._changed
            try:
                await asyncio.wait_for(changed.wait(), wait_s)
            except TimeoutError:
                return

    def start(self) -> None:
        """Open the photograph of the state, if there is one."""
        if self.state.photo is not None:
            self._begin(self._open())

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await self.saves.close()

    def changed_state(self, changes: Any) -> StudioState:
        """Return the state with changes of a page, which may name only files that are offered. Raises InputError."""
        if not isinstance(changes, Mapping):
            raise InputError(f"expected the changes of the state as names and values, got {type(changes).__name__}")
        document = self.state.document() | {str(name): value for name, value in changes.items()}
        state = state_of(document)
        known = self._known_files()
        stack = None if self.photograph is None else self.photograph.stack
        if state.slice is not None and state.slice != self.state.slice and (stack is None or state.slice >= len(stack)):
            raise InputError(f"there is no picture {state.slice} of a focal stack here: load the page again")
        named = [(name, getattr(state, name)) for name in known]
        for name, path in (*named, *(("object", each.object) for each in state.objects)):
            if path is not None and path not in known[name]:
                raise InputError(f"the page may choose only what it was offered, but {name} is {str(path)[:60]!r}: drop the file on it")
        return state

    def _known_files(self) -> dict[str, list[Path | None]]:
        """Return the files that the page may choose: what was offered, what is in use, and the camera that was found."""
        found = self._cameras.get(self.state.photo, {}).get("file") if self.state.photo is not None else None
        return {
            "object": [*self.project.objects],
            "lens": [*self.project.lenses],
            "photo": [self.state.photo],
            "clip": [self.state.clip],
            "track": [self.state.track],
            "depth": [self.state.depth],
            "matte": [self.state.matte],
            "camera": [self.state.camera, Path(found) if found else None],
        }

    async def change(self, changes: Any, *, metres_typed: bool = False) -> None:
        """Take changes of a page over, complete what follows from them, and keep the project.

        metres_typed: heights are known in metres, which stay when the scale of the ground is found; else objects keep their size in the
        picture. Raises InputError.
        """
        before, state, opened = self.state, self.changed_state(changes), self.photograph
        self._metres_typed = metres_typed
        if state.measured not in (None, before.measured):
            await asyncio.to_thread(_require_measured, state, opened)
        if opened is not None and opened.stack is not None and state.focus_at_px is not None:
            state = replace(state, slice=opened.slice_in_focus(*state.focus_at_px), focus_at_px=None)
        self.project.add(state)
        self._keep()
        if state.slice != before.slice and self.photograph is None:
            await self._open()
        if state.lines != before.lines:
            await self._by_hand()
        await self._complete()

    async def _by_hand(self) -> None:
        """Give the state the camera of its drawn lines, or without any that of the picture's own."""
        async with self._tools:
            state, opened = self.state, self.photograph
            if opened is None or state.photo is None:
                return
            found = self._cameras.get(state.photo, {})
            if state.lines:
                self.busy = "looking for the camera of the lines"
                self.tell_all()
                file = _free(self.uploads / f"{state.photo.stem}.drawn.camera.json")
                try:
                    found = await asyncio.to_thread(_camera_of_lines, opened, state.lines, file)
                finally:
                    self.busy = ""
                    self.tell_all()
                self._drawn = (state.photo, state.lines), found
            # Lines that tell no camera yet leave the one that is there.
            if (self.state.photo, self.state.lines) == (state.photo, state.lines) and (found.get("file") or not state.lines):
                camera = Path(found["file"]) if state.lines or found.get("is_sure") else None
                self.project.amend(lambda state: replace(state, camera=camera, pitch_deg=None, roll_deg=None))
            self._keep()

    async def add_object(self, path: Any) -> None:
        """Add an object that the page was offered, beside the chosen one. Raises InputError."""
        if path not in map(str, self.project.objects):
            raise InputError(f"the page may choose only what it was offered, but object is {str(path)[:60]!r}: drop the file on it")
        opened, state = self.photograph, self.state
        beside_px = 0.0
        if opened is not None and state.at_px is not None:
            beside_px = _BESIDE * opened.size_px[0] * (1.0 if state.at_px[0] < (1.0 - 2.0 * _BESIDE) * opened.size_px[0] else -1.0)
        self.project.add(state.with_object(Path(path), beside_px))
        self._keep()
        await self._complete()

    async def paint(self, stroke: Stroke) -> None:
        """Add a stroke of the brush to what is told to be in front; strokes come one after the other. Raises InputError."""
        from viewfinder.studio.brush import Brush

        async with self._tools:
            opened = self.photograph
            if opened is None:
                raise InputError("there is no photograph to paint on yet: drop one on the page")
            if self._brush is None or self._brush[0] != opened.path:
                self._brush = opened.path, Brush(opened.path, opened.stack, has_depth=opened.has_depth)
            self.uploads.mkdir(parents=True, exist_ok=True)
            while self.state.photo == opened.path:
                before, path = self.state.matte, _free(self.uploads / f"{opened.path.stem}_in_front.png")
                await asyncio.to_thread(self._brush[1].paint, before, stroke, path)
                # What was cleared or undone meanwhile stays so.
                if self.state.photo == opened.path and self.state.matte == before:
                    self.project.add(replace(self.state, matte=_short(path)))
                    self._keep()
                    return

    async def sun_by(self, pixels: tuple[Pair, ...]) -> str:
        """Take the sun to stand where a shadow says (`sun_by_pixels`); return that in words. Raises InputError."""
        from viewfinder.studio.photograph import sun_by_pixels

        if (opened := self.photograph) is None:
            raise InputError("there is no photograph with a shadow yet: drop one on the page")
        sun_deg, said = await asyncio.to_thread(sun_by_pixels, self.state, opened, pixels)
        if self.photograph is not opened:
            raise InputError("another photograph was opened meanwhile: point at a shadow in that")
        self.project.add(replace(self.state, sun_deg=sun_deg, plain=False))
        self._keep()
        return said

    async def step(self, by: Any) -> None:
        """Undo or redo."""
        if by not in (-1, 1):
            raise InputError(f"expected a step of -1 or 1, got {str(by)[:20]!r}")
        self.project.step(int(by))
        self._keep()
        if self.state.photo is not None and self.photograph is None:
            self._begin(self._open())

    async def upload(self, kind: str, name: str, body: AsyncIterator[bytes]) -> None:
        """Keep a file that was dropped on the page, if it is what it should be. Raises InputError."""
        if kind not in LARGEST:
            raise InputError(f"expected a photograph or an object (photo, object), got {kind[:20]!r}")
        if kind == "object" and Path(name).suffix.lower() not in _OBJECTS:
            raise InputError(f"{name[:80]!r} is no GLB file: export the object as .glb (glTF binary) and drop that")
        self.uploads.mkdir(parents=True, exist_ok=True)
        path = _free(self.uploads / _harmless(name))
        try:
            await _received(path, body, LARGEST[kind])
            await asyncio.to_thread(_require_glb if kind == "object" else self._require_photograph, path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        if kind == "object":
            self.project.offer(path)
            await self.add_object(str(path))
        else:
            self.project.add(StudioState(photo=path, object=self.state.object, lens=self.state.lens))
            self._keep()
            self._begin(self._open())

    def _require_photograph(self, path: Path) -> None:
        from viewfinder.studio.photograph import open_photograph

        with apart():
            open_photograph(path)

    def _keep(self) -> None:
        """Write the project and tell the pages."""
        try:
            self.project.write()
            self.problem = ""
        except OSError as error:
            why = f"the project could not be kept in {self.project.path} ({error.strerror})"
            self.problem = f"{why}: make room, or the last changes are lost"
        self.tell_all()
        if self.state.clip is not None:
            self._begin(self.film())

    async def film(self) -> None:
        """Write the scene of a clip's state, so that `mrbokeh video` films what is shown."""
        async with self._filming:
            state, opened = self.state, self.photograph
            if state.clip is None or opened is None or not state.is_complete or (self._filmed is not None and self._filmed[0] == state):
                return
            try:
                words, seen = await asyncio.to_thread(_filmed, state, opened, self.uploads)
            except (InputError, OSError) as error:
                self.problem = str(error)
            else:
                self._filmed = state, words, seen
        self.tell_all()

    def clip_told(self) -> dict[str, Any] | None:
        """Return a clip's name, the command that films it, and where the chosen object's foot is seen in it; None for a photograph."""
        if self.state.clip is None:
            return None
        if self._filmed is None or self._filmed[0] != self.state:
            return {"name": self.state.clip.name, "command": None, "path_px": []}
        words = self.saves.clip_words(self.state.clip, self._filmed[1])
        return {"name": self.state.clip.name, "command": shlex.join(["mrbokeh", *words]), "path_px": self._filmed[2]}

    async def save_clip(self) -> None:
        """Start to film the clip. Raises InputError if there is none, or nothing stands in it."""
        await self.film()
        if self.state.clip is None or self._filmed is None or self._filmed[0] != self.state:
            raise InputError(self.problem or "there is nothing to film yet: open a clip with the track of its camera, and place an object")
        self.saves.start_clip(self.state.clip, self._filmed[1])

    def _begin(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _open(self) -> None:
        """Open the state's photograph, or its slice of a stack, then look for its camera."""
        state = self.state
        path, depth = state.photo, state.depth
        assert path is not None
        self.busy = "opening the photograph"
        self.tell_all()
        try:
            opened, camera = await asyncio.to_thread(_opened_photograph, path, depth, state.slice)
            while len(self._opened) >= _KEPT_PHOTOGRAPHS:
                del self._opened[next(iter(self._opened))]
            self._opened[path, depth, opened.slice if opened.stack else state.slice] = opened
            if opened.stack is not None:
                self._cameras.setdefault(path, {})
                if (self.state.photo, self.state.depth, self.state.slice) == (path, depth, state.slice):
                    self.project.amend(lambda state: replace(state, slice=opened.slice))
                    self._keep()
            if state.clip is not None:
                self._cameras.setdefault(path, {})
            self.busy = "looking for the camera in the picture's lines" if path not in self._cameras else ""
            self.tell_all()
            if path not in self._cameras:
                self._cameras[path] = await asyncio.to_thread(
                    _camera_found, camera, self.uploads / f"{path.stem}.camera.json", "picture's straight", _TELL_TILT
                )
                self._take_camera(path)
            await self._complete()
            await self.film()
        except InputError as error:
            self.problem = str(error)
        except Exception as error:
            _log.exception("opening the photograph failed")
            self.problem = f"this is a fault of mrbokeh ({type(error).__name__}); the terminal says more"
        self.busy = ""
        self.tell_all()

    def _take_camera(self, path: Path) -> None:
        """Give the state the camera of the picture's lines, if it is still that photograph's and nobody chose how it was held."""
        state, found = self.state, self._cameras[path]
        opened = self.photograph
        is_free = (
            state.camera is None
            and state.pitch_deg is None
            and state.roll_deg is None
            and opened is not None
            and not opened.has_depth
            and opened.plate.world_from_camera is None
        )
        if state.photo == path and is_free and found.get("is_sure"):
            self.project.amend(lambda state: replace(state, camera=Path(found["file"])))
            self._keep()

    async def _complete(self) -> None:
        """Give a complete state the metres that follow from it, once its camera was looked for."""
        opened, before = self.photograph, self.state
        if opened is None or before.photo not in self._cameras or not (before.is_complete or before.measured):
            return
        completed = await asyncio.to_thread(_completed, before, opened, self._metres_typed)
        if completed != before and self.state == before:
            self.project.amend(lambda _state: completed)
            self._keep()

    def camera_told(self) -> dict[str, Any] | None:
        """Return what the picture's lines tell of its camera, or why they do not; None while they are looked at."""
        if self.state.lines:
            if self._drawn is not None and self._drawn[0] == (self.state.photo, self.state.lines):
                return self._drawn[1]
            told = "The camera is that of the drawn lines." if self.state.camera else "The drawn lines tell no camera: draw more."
            return {"told": told} | ({"file": str(self.state.camera)} if self.state.camera else {})
        return None if self.state.photo is None else self._cameras.get(self.state.photo)


def _opened_photograph(
    path: Path, depth: Path | None, slice_index: int | None
) -> "tuple[OpenedPhotograph, Callable[[], SolvedCamera | str]]":
    """Return the photograph, and what looks for its camera: it returns the camera, or the sentence why there is none."""
    from viewfinder.studio.photograph import open_photograph, solved

    with apart() as words:
        opened, rgb = open_photograph(path, depth, slice_index)
    for warning in words.warnings:
        say(f"warning: {warning}", err=True)

    def camera() -> "SolvedCamera | str":
        try:
            return solved(replace(opened.told, rgb=rgb))
        except InputError as error:
            return str(error)

    return opened, camera


def _filmed(state: StudioState, opened: "OpenedPhotograph", folder: Path) -> tuple[list[str], list[Pair]]:
    """Write a clip's scene; return the words that film it, and the path of the chosen object's foot through its frames."""
    from viewfinder.studio.clip import clip_words, path_px

    return clip_words(state, opened, folder), path_px(state)


def _require_measured(state: StudioState, opened: "OpenedPhotograph | None") -> None:
    """Raise InputError if something of known height cannot tell how high the camera stands."""
    from viewfinder.studio.photograph import measured_height_m

    if opened is None or opened.has_depth or state.plain:
        raise InputError("a known height tells how far level ground is, but depth tells that here already, or Plain is on: leave it out")
    measured_height_m(state, opened)


def _completed(state: StudioState, opened: "OpenedPhotograph", metres_typed: bool) -> StudioState:
    """Return the state with the camera's height by something measured, and with its tilt and metres."""
    from viewfinder.studio.photograph import measured_height_m

    if state.measured is not None and not opened.has_depth and not state.plain:
        with suppress(InputError):
            height_m, before_m = measured_height_m(state, opened), state.camera_height_m
            kept = state.scaled(height_m / before_m) if before_m not in (None, height_m) and not metres_typed else state
            state = replace(kept, camera_height_m=height_m)
    return placed_state(state, opened)


def placed_state(state: StudioState, opened: "OpenedPhotograph") -> StudioState:
    """Return the state with its tilt and metres; as it is, where they cannot be told, which the preview then says."""
    from viewfinder.studio.photograph import placed

    with apart():
        try:
            return placed(state, opened)
        except InputError:
            return state


def _camera_of_lines(opened: "OpenedPhotograph", lines: tuple[DrawnLine, ...], path: Path) -> dict[str, Any]:
    """Return what is told of the camera of drawn lines, and its file where they tell it."""
    from viewfinder.studio.photograph import solved_by_hand

    def look() -> "SolvedCamera | str":
        try:
            return solved_by_hand(opened, lines)
        except InputError as error:
            return str(error)

    return _camera_found(look, path, "drawn", "draw more lines along edges, upright and level ones")


def _camera_found(look: "Callable[[], SolvedCamera | str]", path: Path, kind: str, advice: str) -> dict[str, Any]:
    """Look for a camera; return what is told of it, and its file. is_sure: whether it is taken without being asked for.

    kind: of the lines, in words. advice: what to do where they tell none.
    """
    from mrbokeh.solving.solved_camera import LOW, write_solved_camera

    camera = look()
    if isinstance(camera, str):
        return {"told": f"{camera.partition(': give ')[0]}: {advice}."}
    write_solved_camera(path, camera)
    sd = f" ± {camera.pitch_sd_deg:.1f}" if camera.pitch_sd_deg > 0.05 else ""
    way, rolled = "up" if camera.pitch_deg > 0 else "down", f", turned by {camera.roll_deg:.1f}°" if abs(camera.roll_deg) > 0.5 else ""
    told = f"By the {kind} lines the camera looks {way} by {abs(camera.pitch_deg):.1f}{sd}°{rolled}"
    told += f", {camera.focal_length_35mm:.0f} mm on full frame ({camera.confidence} confidence)."
    return {"told": told, "file": str(_short(path)), "is_sure": camera.confidence != LOW}


def _short(path: Path) -> Path:
    """Return a path from the working folder where it lies in it."""
    whole = path.absolute()
    return whole.relative_to(Path.cwd()) if whole.is_relative_to(Path.cwd()) else whole


def _require_glb(path: Path) -> None:
    """Raise InputError if a file holds no object that can be drawn."""
    from mrbokeh.scene.gltf.gltf_loader import GltfAsset

    if path.read_bytes()[:4] != b"glTF":
        raise InputError(f"{path.name} is no GLB file (it does not begin with glTF): export the object as .glb")
    if not GltfAsset(path).scene_at(0.0).drawn_meshes:
        raise InputError(f"{path.name} holds nothing that can be drawn: export its meshes too")


def _harmless(name: str) -> str:
    """Return the name of a dropped file without folders and odd characters."""
    kept = re.sub(r"[^\w.-]+", "_", Path(name.replace("\\", "/")).name).lstrip(".-")
    return kept[-80:] or "dropped"


def _free(path: Path) -> Path:
    """Return the path, or one with a number if that exists."""
    numbered = (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in range(2, 100_000))
    return path if not path.exists() else next(each for each in numbered if not each.exists())


async def _received(path: Path, body: AsyncIterator[bytes], most: int) -> None:
    """Write what comes into a file. Raises InputError if it is empty or larger than allowed."""
    size = 0
    with path.open("xb") as file:
        async for part in body:
            size += len(part)
            if size > most:
                raise InputError(f"{path.name} is larger than the {most >> 20} MB that the studio takes: give it on the command line")
            file.write(part)
    if size == 0:
        raise InputError(f"{path.name} is empty: drop another file")
