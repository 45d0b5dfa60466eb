"""Stages of the demo: commands of `mrbokeh` run one after the other, each skipped when it is done already."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from mrbokeh.atomic_files import read_json, write_json
from mrbokeh.errors import InputError


@dataclass(frozen=True)
class Stage:
    """One command: its name, what it is for, its arguments after `mrbokeh`, and the files it must leave behind.

    when_stale: further arguments for when its input has changed since it last ran, such as --overwrite; without them a
    command goes on where an interrupted run stopped.
    """

    name: str
    purpose: str
    arguments: tuple[str, ...]
    outputs: tuple[Path, ...]
    when_stale: tuple[str, ...] = ()

    @property
    def command_line(self) -> str:
        return " ".join(("mrbokeh", *self.arguments))


@dataclass(frozen=True)
class Done:
    """A finished stage and how long it took when it ran."""

    stage: Stage
    seconds: float
    skipped: bool


def run_stages(stages: list[Stage], out: Path, console: Console) -> list[Done]:
    """Run what is not done; a stage whose predecessor ran is run again, so that no result is older than its input."""
    results: list[Done] = []
    for number, stage in enumerate(stages, 1):
        console.print(f"[bold]{number}/{len(stages)} {stage.purpose}[/]")
        recorded = _recorded_seconds(stage, out)
        stale = any(not done.skipped and _feeds(done.stage, stage) for done in results)
        if recorded is not None and not stale:
            console.print("  done already")
            results.append(Done(stage, recorded, skipped=True))
            continue
        console.print(f"  {stage.command_line}", highlight=False, markup=False, soft_wrap=True)
        results.append(Done(stage, _run(stage, stale, out), skipped=False))
    return results


def _feeds(earlier: Stage, later: Stage) -> bool:
    """An output of the earlier stage, or a folder around it, is named by the later one."""
    named = [Path(argument) for argument in later.arguments]
    return any(path == output or path in output.parents for output in earlier.outputs for path in named)


def _record(stage: Stage, out: Path) -> Path:
    return out / ".stages" / f"{stage.name}.json"


def _recorded_seconds(stage: Stage, out: Path) -> float | None:
    """How long the stage took when it was run with the same arguments and left all its outputs; None where it was not."""
    if not _record(stage, out).is_file() or not all(path.exists() for path in stage.outputs):
        return None
    record = read_json(_record(stage, out), "the record of a finished stage")
    return float(record["seconds"]) if record["arguments"] == list(stage.arguments) else None


def _run(stage: Stage, stale: bool, out: Path) -> float:
    _record(stage, out).unlink(missing_ok=True)
    start = time.perf_counter()
    code = _exit_code([sys.executable, "-m", "mrbokeh.cli", *stage.arguments, *(stage.when_stale if stale else ())])
    seconds = time.perf_counter() - start
    missing = [str(path) for path in stage.outputs if not path.exists()]
    if code != 0 or missing:
        raise InputError(
            f"the stage {stage.name!r} failed (exit code {code}, missing {missing or 'nothing'}); see its message above. "
            f"Its command was: {stage.command_line}"
        )
    write_json(_record(stage, out), {"arguments": list(stage.arguments), "seconds": seconds})
    return seconds


def _exit_code(command: list[str]) -> int:
    """Run a command that may be interrupted: Ctrl-C reaches it too, and it gets the time to keep what it has."""
    interrupted: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: interrupted.append(number))
    try:
        code = subprocess.Popen(command, env=os.environ | {"PYTHONSAFEPATH": "1"}).wait()
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted or code in (130, -signal.SIGINT):
        raise KeyboardInterrupt
    return code
