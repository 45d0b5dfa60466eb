"""What a stage of the demo was last run with: whether it can be skipped, goes on where it stopped, or has to be made anew."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mrbokeh.system.atomic_files import read_json, write_json


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
        """Whether the stage would do the same today; a feeding stage that ran since has another name of its run."""
        return self.arguments == tuple(arguments) and dict(self.inputs) == dict(inputs)


def read_record(path: Path) -> Record | None:
    """None where the stage never began. Records of earlier versions hold for nothing."""
    if not path.is_file():
        return None
    document = read_json(path, "the record of a stage")
    known = {name: document[name] for name in ("inputs", "anew", "seconds") if name in document}
    return Record(str(document.get("run", "")), tuple(document["arguments"]), **known)


def write_record(path: Path, record: Record) -> None:
    write_json(path, vars(record) | {"arguments": list(record.arguments), "inputs": dict(record.inputs)})


def must_be_anew(record: Record | None, arguments: Sequence[str], inputs: Mapping[str, str]) -> bool:
    """Of a stage that has to run: whether what it left behind must be replaced. What an interrupted run has of today's goes on;
    one that was interrupted while it replaced may have left older parts."""
    if record is None:
        return False
    return record.anew or record.seconds is not None or not record.still_holds(arguments, inputs)
