"""Saves: finished pictures made by exactly the command line that the page shows, each in a process of its own."""

import asyncio
import contextlib
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrbokeh.commands._composite_options import CompositeOptions
from mrbokeh.system.errors import InputError
from viewfinder.studio.command_line import words_of

FORMATS = {"png": ".png", "jpeg": ".jpg", "tiff": ".tif", "exr": ".exr"}
"""Suffixes by the names of formats on the page: PNG and TIFF have 16 bits, EXR is linear and holds all layers."""
CLIP = "clip"
_SUFFIXES = FORMATS | {CLIP: ".mp4"}
_ENDS_S = 3.0
_MOST_AT_ONCE, _MOST_KEPT = 2, 50


@dataclass
class Save:
    """A picture under way. state: "running", "done", "failed" or "cancelled". sentence: the command's last words."""

    number: int
    out: Path
    command: str
    words: list[str]
    state: str = "running"
    sentence: str = ""
    began_s: float = field(default_factory=time.monotonic)
    took_s: float = 0.0
    process: asyncio.subprocess.Process | None = None

    def told(self) -> dict[str, Any]:
        """Return what the page shows of it."""
        seconds = self.took_s or time.monotonic() - self.began_s
        shown = {"number": self.number, "name": self.out.name, "path": str(self.out.absolute()), "command": self.command}
        return shown | {"state": self.state, "sentence": self.sentence, "seconds": round(seconds, 1)}


class Saves:
    """Saves of one studio. folder: where the pictures go. changed: told whenever one of them changes."""

    def __init__(self, folder: Path, changed: Callable[[], None]) -> None:
        self.folder, self._changed = folder, changed
        self._saves: list[Save] = []
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def format(self) -> str:
        """Name of the format that was chosen last."""
        suffix = self._saves[-1].out.suffix if self._saves else FORMATS["png"]
        return next(name for name, each in _SUFFIXES.items() if each == suffix)

    def told(self) -> list[dict[str, Any]]:
        """Return the saves, newest first."""
        return [each.told() for each in reversed(self._saves)]

    def free_name(self, photo: Path, suffix: str) -> Path:
        """Return the name that the next picture of a photograph gets."""
        taken = {each.out for each in self._saves if each.state == "running"}
        for number in range(1, 10_000):
            out = self.folder / f"{photo.stem}_mrbokeh{'' if number == 1 else f'_{number}'}{suffix}"
            if not out.exists() and out not in taken:
                return out
        raise InputError(f"there are 9999 pictures of {photo.name} in {self.folder}: move some away")

    def start(self, options: CompositeOptions, kind: Any) -> Save:
        """Start to make a picture in a format of FORMATS. Raises InputError if that cannot be."""
        if not isinstance(kind, str) or kind not in FORMATS:
            raise InputError(f"expected a format out of {', '.join(FORMATS)}, got {kind!r}")
        out = self.free_name(options.photo, FORMATS[kind])
        return self._begin(out, words_of(options, out))

    def clip_words(self, clip: Path, words: list[str]) -> list[str]:
        """Return the words of `mrbokeh video` with the file that the next clip gets."""
        return [*words, "--out", str(self.free_name(clip, _SUFFIXES[CLIP]))]

    def start_clip(self, clip: Path, words: list[str]) -> Save:
        """Start to film a clip by words without --out. Raises InputError if that cannot be."""
        words = self.clip_words(clip, words)
        return self._begin(Path(words[-1]), words)

    def _begin(self, out: Path, words: list[str]) -> Save:
        if sum(each.state == "running" for each in self._saves) >= _MOST_AT_ONCE:
            raise InputError(f"{_MOST_AT_ONCE} pictures are being made already: wait for one of them, or cancel it")
        number = self._saves[-1].number + 1 if self._saves else 1
        save = Save(number=number, out=out, command=shlex.join(["mrbokeh", *words]), words=words)
        self._saves = [*self._saves, save][-_MOST_KEPT:]
        task = asyncio.get_running_loop().create_task(self._run(save))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return save

    def cancel(self, number: Any) -> None:
        """Stop a picture that is being made; nothing of it is left."""
        save = self._numbered(number)
        if save.state == "running":
            save.state = "cancelled"
            self._changed()
            _interrupt(save.process)

    def finished(self, number: Any) -> Path:
        """Return the file of a save that is done."""
        save = self._numbered(number)
        if save.state != "done" or not save.out.is_file():
            raise InputError(f"picture {save.number} is not there: it is {save.state}{'' if save.state != 'done' else ' but was moved'}")
        return save.out

    async def close(self) -> None:
        """Stop all that is under way, and wait for it."""
        for save in self._saves:
            if save.state == "running":
                save.state = "cancelled"
                _interrupt(save.process)
        if self._tasks:
            await asyncio.wait(list(self._tasks), timeout=_ENDS_S)

    def _numbered(self, number: Any) -> Save:
        found = next((each for each in self._saves if each.number == number and not isinstance(number, bool)), None)
        if found is None:
            raise InputError(f"there is no picture number {str(number)[:20]}: the newest ones are listed on the page")
        return found

    async def _run(self, save: Save) -> None:
        """Run the command; its last line is its result, or the sentence of its refusal."""
        command = [sys.executable, "-m", "mrbokeh.cli", *save.words]
        quiet = os.environ | {"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "10000"}
        both = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.STDOUT, "stdin": asyncio.subprocess.DEVNULL}
        try:
            process = save.process = await asyncio.create_subprocess_exec(*command, env=quiet, start_new_session=True, **both)  # type: ignore[arg-type]
        except OSError as error:
            self._end(save, "failed", f"the command could not be started ({error.strerror}): run it in a terminal")
            return
        if save.state == "cancelled":
            _interrupt(process)
        self._changed()
        assert process.stdout is not None
        async for line in process.stdout:
            if words := line.decode("utf-8", "replace").strip():
                save.sentence = words.removeprefix("error: ")
                self._changed()
        code = await process.wait()
        self._end(save, "cancelled" if save.state == "cancelled" else "done" if code == 0 else "failed", save.sentence)

    def _end(self, save: Save, state: str, sentence: str) -> None:
        save.state, save.sentence, save.took_s = state, sentence, time.monotonic() - save.began_s
        self._changed()


def _interrupt(process: asyncio.subprocess.Process | None) -> None:
    """Stop a command as Ctrl-C does, so that it removes what is half written."""
    if process is not None and process.returncode is None:
        with contextlib.suppress(ProcessLookupError, ValueError):
            process.send_signal(signal.SIGINT if os.name != "nt" else signal.SIGTERM)
