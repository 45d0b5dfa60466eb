"""Files that a data set still lacks, made piece by piece, so that an interrupted run goes on where it stopped."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Job:
    """Files that are made together."""

    paths: tuple[Path, ...]
    make: Callable[[], None]

    @property
    def done(self) -> bool:
        return all(path.is_file() for path in self.paths)


def claim_folder(description: Path, document: dict[str, object], files: Iterable[Path], overwrite: bool) -> None:
    """Go on only in a folder that is empty or was made with the same settings: `description`, written first, says which.

    files: all that will be made there. Those that exist already are deleted if `overwrite` asks for that. Raises InputError where
    the description is another one, and where files stand without one.
    """
    folder, made = description.parent, [path for path in files if path.exists()]
    if overwrite:
        for path in (*made, description):
            path.unlink(missing_ok=True)
    elif description.exists():
        if read_json(description, f"the settings of a data set ({description.name})") != document:
            raise InputError(f"{folder} was made with other settings: choose another folder, or --overwrite to replace its files")
    elif made:
        raise InputError(f"{folder} holds files without a {description.name}: choose another folder, or --overwrite to replace them")
    write_json(description, document)
