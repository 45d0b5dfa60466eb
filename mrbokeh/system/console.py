"""Words and bars of a command on the terminal: progress with the time left, the line after Ctrl-C, and the names of its options.

On a terminal progress is drawn as bars, in a log as a plain line now and then, and so is work of which nobody knows how far it is.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from threading import Event, Thread
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from mrbokeh.system.messages import OF_NO_COMMAND, channel, resting, say_in_between

Item = TypeVar("Item")

LINE_EVERY_S, LINE_EVERY_SHARE = 10.0, 0.05
"""Time between lines: the longer of the two, the second a share of the time so far; a night of training is no thousand lines."""
WORTH_A_LINE_S = 2.0
"""Shortest task whose end is worth a line: a command that is done at once leaves no log of its parts."""


SILENT_S, SILENT_MORE = 20.0, 1.5
"""Longest time without a word in a log, and how many times as long the next may be."""


class Heartbeat:
    """Line in a log whenever a command has been silent for long. line: what it is at, or "" if that was told lately."""

    def __init__(self, line: Callable[[], str]) -> None:
        self._line = line

    def start(self) -> None:
        self._ended = Event()
        Thread(target=self._beat, args=(self._ended,), daemon=True).start()

    def stop(self) -> None:
        self._ended.set()

    def _beat(self, ended: Event) -> None:
        silent_s = SILENT_S
        while not ended.wait(silent_s):
            if line := self._line():
                say_in_between(line)
                silent_s *= SILENT_MORE


class PlainLines(Progress):
    """Progress of rich as plain lines: the first after LINE_EVERY_S, the last when a task is complete or the block ends."""

    def __init__(self, console: Console, **settings: Any) -> None:
        super().__init__(console=console, auto_refresh=False, **settings)
        self._told: dict[TaskID, tuple[float, float]] = {}
        self._ended: set[TaskID] = set()
        self._begun_with: dict[TaskID, float] = {}
        self._heartbeat = Heartbeat(self._silent_line)

    def add_task(self, description: str, *args: Any, **fields: Any) -> TaskID:
        with self._lock:  # the heartbeat's thread asks too
            task = super().add_task(description, *args, **fields)
            self._told[task] = self.get_time(), -1.0
            self._begun_with[task] = float(self._tasks[task].completed)  # not 0 where an earlier run is gone on with
        return task

    def advance(self, task_id: TaskID, advance: int | float = 1) -> None:
        super().advance(task_id, advance)
        self._tell(task_id)

    def update(self, task_id: TaskID, **changed: Any) -> None:
        super().update(task_id, **changed)
        self._tell(task_id)

    def start(self) -> None:
        """Draw nothing; lines are printed as tasks advance, or when they have not for long."""
        self._heartbeat.start()

    def stop(self) -> None:
        self._heartbeat.stop()
        for task in self.task_ids:
            self._tell(task, last=True)

    def _silent_line(self) -> str:
        """Return how far the newest task is, or "" if a line told it lately."""
        with self._lock:
            if not self._tasks:
                return ""
            task_id, now = max(self._tasks), self.get_time()
            task, (told_at, told) = self._tasks[task_id], self._told[task_id]
            if task.finished or now - told_at < SILENT_S:
                return ""
            self._told[task_id] = now, told
        return _line(task, now - (now if task.start_time is None else task.start_time), self._begun_with[task_id])

    def _tell(self, task_id: TaskID, last: bool = False) -> None:
        with self._lock:
            task, now, (told_at, told) = self._tasks[task_id], self.get_time(), self._told[task_id]
            began = now if task.start_time is None else task.start_time
            due = now - told_at >= max(LINE_EVERY_S, LINE_EVERY_SHARE * (now - began))
            # Where nobody knows the end, rich calls everything finished.
            ended = last or (bool(task.total) and task.finished and task_id not in self._ended)
            ended = ended and now - began >= WORTH_A_LINE_S
            if task.completed == told or not (due or ended):
                return
            self._told[task_id] = now, task.completed
            self._ended |= {task_id} if ended else set()
        line = _line(task, now - began, self._begun_with[task_id])
        channel().said(line)
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


def _line(task: Task, took_s: float, begun_with: float = 0.0) -> str:
    """Return a line such as "slices: 3 of 12, 0:01:30, about 0:04:30 left"."""
    line = f"{task.description}: {task.completed:.0f}{f' of {task.total:.0f}' if task.total else ''}, {timedelta(seconds=round(took_s))}"
    done = task.completed - begun_with
    if not task.total or done <= 0 or task.completed >= task.total:
        return line
    return f"{line}, about {timedelta(seconds=round(took_s / done * (task.total - task.completed)))} left"


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Open a block in which `add_task` and `advance` of rich draw bars on standard error, or print lines in a log."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, emoji=False)
    with resting(), Progress(*columns, console=console) if _can_erase(console) else PlainLines(console) as progress:
        yield progress


def track(items: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over items under one progress bar. total: needed if they have no length."""
    total = len(items) if total is None else total  # type: ignore[arg-type]
    with progress_bars() as progress:
        task: TaskID = progress.add_task(description, total=total)
        for item in items:
            yield item
            progress.advance(task)


@contextmanager
def working(description: str) -> Iterator[None]:
    """Show a spinner on the terminal while something of unknown length runs."""
    console = Console(stderr=True, emoji=False)
    with ExitStack() as shown:
        if _can_erase(console):
            shown.enter_context(resting())
            shown.enter_context(_spinner(description, console))
        yield


def begin(command: str) -> None:
    """Whenever the command neither says nor shows anything, let a spinner turn on the terminal, or tell a log that it is at work."""
    console, began_s = Console(stderr=True, emoji=False), time.monotonic()
    if channel() is OF_NO_COMMAND:
        return
    if not _can_erase(console):
        channel().spinner = Heartbeat(lambda: f"{command}: at work, {timedelta(seconds=round(time.monotonic() - began_s))}")
    elif sys.stdout.isatty():  # not over the page of a pager
        channel().spinner = _spinner(command, console)
    if channel().spinner:
        channel().spinner.start()


def _can_erase(console: Console) -> bool:
    """Return whether a console takes back what it drew: a terminal that is not dumb, and not a log whose colours are forced."""
    return console.is_interactive and console.file.isatty()


def _spinner(description: str, console: Console) -> Progress:
    columns = SpinnerColumn(), TextColumn("{task.description} ..."), TimeElapsedColumn()
    spinner = Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False)
    spinner.add_task(description, total=None)
    return spinner


@contextmanager
def kept_when_interrupted(kept: str, overwrite: bool = False) -> Iterator[None]:
    """Let Ctrl-C end in one line that says what was kept and how to continue.

    kept: such as "finished slices are kept in scene/". overwrite: the command would start again instead of continuing.
    """
    try:
        yield
    except KeyboardInterrupt:
        again = "with --overwrite it begins again" if overwrite else "the same command goes on from there"
        channel().kept = channel().kept or f"stopped: {kept}; {again}"
        raise


FLAGS = {
    "image": "--psf-picture",
    "vignetting": "--no-vignetting",
    "focus_distance_m": "--focus",
    "focal_length_mm": "--focal-length",
    "sensor_width_mm": "--sensor-width",
    "sensor_height_mm": "--sensor-height",
    "image_width_px": "--image-width",
    "nearest_m": "--near",
    "farthest_m": "--far",
    "diameter_px": "--diameter",
    "motion_px": "--longest-motion",
    "frame_rate": "--rate",
}


def flag(name: str) -> str:
    """Return the option that sets a parameter: --focus for `focus_distance_m`; names that FLAGS lacks are spelled out."""
    return FLAGS.get(name, spelled_out(name))


def spelled_out(name: str) -> str:
    """Return --focus-distance-m for `focus_distance_m`."""
    return "--" + name.replace("_", "-")
