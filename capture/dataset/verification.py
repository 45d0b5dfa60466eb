"""Whether a data set is what its manifest says."""

from pathlib import Path

from capture.dataset.file_placing import record_of
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset, file_troubles
from mrbokeh.system.console import track


def verify(dataset: FocalStackDataset) -> list[str]:
    """What is wrong, one sentence each; [] where every file is there with its size and hash."""
    return [trouble for record in track(dataset.stacks, "verify") for trouble in file_troubles(dataset, record, _sha256)]


def _sha256(path: Path) -> str:
    return record_of(path).sha256
