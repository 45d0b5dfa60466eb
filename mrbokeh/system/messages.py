"""Channel of a command's words: for people, as one object for programs (--json), in a log with times (--log).

Commands call `say` for what is good to know, `tell` and `show` for what they are for, which --quiet leaves, `warn` and `guess`. With --json
all words go to standard error.
"""

import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock
from typing import Any

LOG_TIME = "%Y-%m-%d %H:%M:%S"


@dataclass
class Channel:
    """Way of a command's words, and what --json says of it.

    inputs: by option; outputs: files and folders that were finished; kept: what is left after Ctrl-C. spinner: what turns on the terminal
    while the command says nothing, or, in a log, the heartbeat that tells that it is at work; None outside a command.
    """

    quiet: bool = False
    log: Any = None
    command: str = ""
    kept: str = ""
    inputs: dict[str, Any] = field(default_factory=dict)
    outputs: list[Path] = field(default_factory=list)
    known: dict[str, Any] = field(default_factory=dict)
    guessed: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    started_s: float = field(default_factory=time.monotonic)
    spinner: Any = None

    def said(self, text: str) -> None:
        """Put a text into the log, each line with its time."""
        for line in text.splitlines() if self.log else ():
            print(time.strftime(LOG_TIME), line, file=self.log, flush=True)

    def written(self) -> list[Path]:
        """Return what was written and is still there; of a folder that came whole not the files in it."""
        there = [path for path in dict.fromkeys(self.outputs) if path.exists()]
        return [path for path in there if not any(folder in path.parents for folder in there)]

    def document(self, exit_code: int, error: str) -> dict[str, Any]:
        """Return what --json prints."""
        written = self.written()
        return _plain(
            ({"error": error} if error else {})
            | {
                "command": self.command,
                "inputs": {name: value for name, value in self.inputs.items() if value not in written},
                "outputs": written,
                "known": self.known,
                "guessed": self.guessed,
                "figures": self.figures,
                "warnings": self.warnings,
                "seconds": round(time.monotonic() - self.started_s, 3),
                "exit_code": exit_code,
            }
        )


class _Warnings(logging.Handler):
    """Handler of modules that only log."""

    def emit(self, record: logging.LogRecord) -> None:
        warn(record.getMessage())


_channel = OF_NO_COMMAND = Channel()
_apart: ContextVar[Channel | None] = ContextVar("apart", default=None)
_terminal, _resting = RLock(), 0
"""How many blocks, of all threads, have the terminal to themselves."""
_UNFINISHED: set[Path] = set()
"""Temporary files and folders under way, which a process that leaves at once removes."""


def channel() -> Channel:
    """Return the channel of the command that runs, or that of this thread's block `apart`."""
    return _apart.get() or _channel


@contextmanager
def opened() -> Iterator[Channel]:
    """Open a new channel for the block."""
    global _channel
    before, _channel, handler = _channel, Channel(), _Warnings(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        yield _channel
    finally:
        logging.getLogger().removeHandler(handler)
        end_spinner()
        if _channel.log:
            _channel.log.close()
        _channel = before


@contextmanager
def apart() -> Iterator[Channel]:
    """Open a quiet channel for what this thread says in the block, as a server that answers several at once does."""
    token = _apart.set(Channel(quiet=True))
    try:
        yield channel()
    finally:
        _apart.reset(token)


@contextmanager
def object_on_stdout(wanted: bool) -> Iterator[Any]:
    """Send what is printed in the block to standard error, if wanted; yield what is standard output outside of it."""
    out = sys.stdout
    with redirect_stdout(sys.stderr if wanted else out):
        yield out


def write_object(file: Any, exit_code: int, error: str) -> None:
    print(json.dumps(channel().document(exit_code, error), indent=2), file=file, flush=True)


@contextmanager
def resting() -> Iterator[None]:
    """Stop the command's spinner, or the heartbeat of its log, in the block, which writes itself."""
    global _resting
    with _terminal:
        _resting += 1
        if _resting == 1 and _channel.spinner:
            _channel.spinner.stop()
    try:
        yield
    finally:
        with _terminal:
            _resting -= 1
            if _resting == 0 and _channel.spinner:
                _channel.spinner.start()


def end_spinner() -> None:
    """Stop the command's spinner, or the heartbeat of its log, for good."""
    spinner, _channel.spinner = _channel.spinner, None
    if spinner:
        spinner.stop()


def say(text: str, err: bool = False) -> None:
    """Say what is good to know. err: on standard error, as progress and warnings are."""
    channel().said(text)
    if not channel().quiet:
        with resting():
            print(text, file=sys.stderr if err else sys.stdout, flush=True)


def say_in_between(text: str) -> None:
    """Say on standard error, from another thread, what a log should know while the command is silent."""
    channel().said(text)
    print(text, file=sys.stderr, flush=True)


def tell(text: str, known: Mapping[str, Any] | None = None, **figures: Any) -> None:
    """Say what the command is for. known, figures: for --json, what the result rests on and what was measured; units in their names."""
    channel().said(text)
    channel().known |= known or {}
    channel().figures |= figures
    with resting():
        print(text, flush=True)


def show(renderable: Any, **figures: Any) -> None:
    """Show a table of rich, as `tell` does a line."""
    from rich.console import Console

    channel().figures |= figures
    console, logged = Console(highlight=False, emoji=False), Console(width=200, force_terminal=False, emoji=False)
    with resting():
        console.print(renderable, soft_wrap=not console.is_terminal)
    with logged.capture() as text:
        logged.print(renderable, soft_wrap=True)
    channel().said(text.get())


def warn(text: str) -> None:
    """Say that something may not be as the user wants it; within a command once."""
    said = channel()
    if said is OF_NO_COMMAND or text not in said.warnings:
        said.warnings.append(text)
        say(f"warning: {text}", err=True)


def guess(text: str, short: str = "") -> None:
    """Say once what is guessed. short: what is said in its place, where the whole of it was said before, by another command."""
    if text and text not in channel().guessed:
        channel().guessed.append(text)
        say(short or text)


def unfinished(temporary: Path) -> None:
    """Note a temporary file or folder that is being filled."""
    _UNFINISHED.add(temporary)


def finished(temporary: Path, path: Path | None) -> None:
    """Note that a temporary has become the result `path`, or nothing. Results in the temporary folder of another are not counted."""
    _UNFINISHED.discard(temporary)
    if path is not None and not any(folder in path.parents for folder in tuple(_UNFINISHED)):
        channel().outputs.append(path)


def remove_unfinished() -> None:
    """Remove what is half written, for a process that leaves at once."""
    for path in tuple(_UNFINISHED):
        with suppress(OSError):
            shutil.rmtree(path) if path.is_dir() else os.unlink(path)


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it: paths and infinities as text, NaN as null, arrays as lists."""
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None if value != value else ("inf" if value > 0 else "-inf")
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
