"""Stages of the demo: commands of `mrbokeh` run one after the other, skipped if their records say that they are done already."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from uuid import uuid4

from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say


@dataclass(frozen=True)
class Record:
    """One run of a stage.

    run: its own name. inputs: the run of every stage that fed it, by the stage's name.
    anew: whether it was told to replace what was there. seconds: how long it took; None while it is not finished.
    """

    run: str
    arguments: tuple[str, ...]
    inputs: Mapping[str, str] = field(default_factory=dict)
    anew: bool = False
    seconds: float | None = None

    def still_holds(self, arguments: Sequence[str], inputs: Mapping[str, str]) -> bool:
        """Return whether the stage would do the same today; a feeding stage that ran since has another name of its run."""
        return self.arguments == tuple(arguments) and dict(self.inputs) == dict(inputs)


def read_record(path: Path) -> Record | None:
    """Read the record of a stage; None if it never began. Records of earlier versions hold for nothing."""
    if not path.is_file():
        return None
    document = read_json(path, "the record of a stage")
    known = {name: document[name] for name in ("inputs", "anew", "seconds") if name in document}
    return Record(str(document.get("run", "")), tuple(document["arguments"]), **known)


def write_record(path: Path, record: Record) -> None:
    write_json(path, vars(record) | {"arguments": list(record.arguments), "inputs": dict(record.inputs)})


def must_be_anew(record: Record | None, arguments: Sequence[str], inputs: Mapping[str, str]) -> bool:
    """Return whether a stage that has to run must replace what it left behind.

    An interrupted run with the same arguments goes on; one that was interrupted while it replaced may have left older parts.
    """
    if record is None:
        return False
    return record.anew or record.seconds is not None or not record.still_holds(arguments, inputs)


@dataclass(frozen=True)
class Stage:
    """One command: its name, what it is for, its arguments after `mrbokeh`, and the files it must leave behind.

    when_stale: further arguments for when its input has changed since it last ran, such as --overwrite; without them a
    command goes on where an interrupted run stopped.
    optional: the demo goes on without it where it fails; optional stages that it feeds are left out then.
    """

    name: str
    purpose: str
    arguments: tuple[str, ...]
    outputs: tuple[Path, ...]
    when_stale: tuple[str, ...] = ()
    optional: bool = False

    @property
    def command_line(self) -> str:
        return " ".join(("mrbokeh", *self.arguments))

    def feeds(self, later: "Stage") -> bool:
        """Return whether the later stage names an output of this one, or a folder around it."""
        named = [Path(argument) for argument in later.arguments]
        return any(path == output or path in output.parents for output in self.outputs for path in named)

    def missing(self) -> list[str]:
        return [str(path) for path in self.outputs if not path.exists()]


@dataclass(frozen=True)
class Done:
    """A finished stage and how long it took when it ran; an optional one may have failed."""

    stage: Stage
    seconds: float
    skipped: bool
    failed: bool = False
    run: str = ""


def run_stages(stages: list[Stage], out: Path) -> list[Done]:
    """Run what is not done; a stage whose predecessor ran is run again, so that no result is older than its input.

    Raises InputError where a stage fails that is not optional.
    """
    results: list[Done] = []
    for number, stage in enumerate(stages, 1):
        say(f"{number}/{len(stages)} {stage.purpose}")
        results.append(_done(stage, results, out))
    return results


def _done(stage: Stage, before: Sequence[Done], out: Path) -> Done:
    feeding = [done for done in before if done.stage.feeds(stage)]
    if stage.optional and any(done.failed for done in feeding):
        say("  left out, for it needs what failed")
        return Done(stage, 0.0, skipped=True, failed=True)
    inputs = {done.stage.name: done.run for done in feeding if not done.failed}
    record = read_record(_record_path(stage, out))
    if record is not None and record.seconds is not None and record.still_holds(stage.arguments, inputs) and not stage.missing():
        say("  done already")
        return Done(stage, record.seconds, skipped=True, run=record.run)
    say(f"  {stage.command_line}")
    return _run(stage, Record(uuid4().hex, stage.arguments, inputs, must_be_anew(record, stage.arguments, inputs)), out)


def _record_path(stage: Stage, out: Path) -> Path:
    return out / ".stages" / f"{stage.name}.json"


def _run(stage: Stage, record: Record, out: Path) -> Done:
    write_record(_record_path(stage, out), record)
    start = time.perf_counter()
    code = _exit_code([sys.executable, "-m", "mrbokeh.cli", *stage.arguments, *(stage.when_stale if record.anew else ())])
    seconds = time.perf_counter() - start
    missing = stage.missing()
    if code == 0 and not missing:
        write_record(_record_path(stage, out), replace(record, seconds=seconds))
        return Done(stage, seconds, skipped=False, run=record.run)
    if not stage.optional:
        raise InputError(
            f"the stage {stage.name!r} failed (exit code {code}, missing {missing or 'nothing'}); see its message above. "
            f"Its command was: {stage.command_line}"
        )
    say("  failed; the demo goes on without it")
    return Done(stage, seconds, skipped=False, failed=True)


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
