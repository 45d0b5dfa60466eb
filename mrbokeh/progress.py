"""Progress bars with the time left, the same everywhere; silent where nobody watches (no terminal)."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Item = TypeVar("Item")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A block in which `add_task` and `advance` of rich draw bars on standard error."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield progress


def track(items: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Go through items under one bar; total is needed where they have no length."""
    total = len(items) if total is None else total  # type: ignore[arg-type]
    with progress_bars() as progress:
        task: TaskID = progress.add_task(description, total=total)
        for item in items:
            yield item
            progress.advance(task)


def working(description: str) -> AbstractContextManager[object]:
    """A spinner on the terminal while something runs whose length nobody knows."""
    return Console(stderr=True).status(description)
