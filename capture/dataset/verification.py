"""Whether a data set is what its manifest says."""

from pathlib import Path

from capture.dataset.file_placing import record_of
from mrbokeh.focal_stack_dataset import FocalStackDataset, StackRecord
from mrbokeh.progress import track


def verify(dataset: FocalStackDataset) -> list[str]:
    """What is wrong, one sentence each; [] where every file is there with its size and hash."""
    return [trouble for record in track(dataset.stacks, "verify") for trouble in _troubles(dataset.folder / record.name, record)]


def _troubles(folder: Path, record: StackRecord) -> list[str]:
    found = []
    for relative, expected in record.files.items():
        path = folder / relative
        if not path.is_file():
            found.append(f"{record.name}/{relative} is missing")
        elif path.stat().st_size != expected.bytes:
            found.append(f"{record.name}/{relative} has {path.stat().st_size} bytes, expected {expected.bytes}")
        elif record_of(path).sha256 != expected.sha256:
            found.append(f"{record.name}/{relative} has another content than when it was written")
    return found
