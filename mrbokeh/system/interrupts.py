"""Ctrl-C in a command whose work is kept: what there is, and how to go on, in one line; exit code 130, as shells have it."""

from collections.abc import Iterator
from contextlib import contextmanager

import typer

INTERRUPTED = 130
"""Exit code of what was stopped by Ctrl-C, as shells have it."""


@contextmanager
def kept_when_interrupted(kept: str, overwrite: bool = False) -> Iterator[None]:
    """kept: what is there to go on with and where, such as "finished slices are kept in scene/". overwrite: begins anew all the same."""
    try:
        yield
    except KeyboardInterrupt:
        again = "with --overwrite it begins again" if overwrite else "the same command goes on from there"
        typer.echo(f"stopped: {kept}; {again}", err=True)
        raise typer.Exit(INTERRUPTED) from None
