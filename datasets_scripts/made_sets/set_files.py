"""Files of data sets: those still missing, made piece by piece, so that an interrupted run goes on where it stopped, and the manifest's
record of a focal stack.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FileRecord, Part, RadianceRange, StackRecord
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

LICENCE = (
    "These pictures are computed from scenes that a program of this project makes up; no photograph, model or texture of anybody is in "
    "them. Use them as you like (CC0 1.0)."
)
_QUANTILES = ("0.5", "0.99", "0.999", "0.9999")


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


def slice_name(index: int) -> str:
    return f"slice_{index:02d}.exr"


def focus_index(depth_m: Float32[np.ndarray, "height width"], distances_m: Sequence[float]) -> Float32[np.ndarray, "height width"]:
    """Return the fractional index of the slice that is sharpest at each pixel, linear in dioptres."""
    dioptres = 1.0 / np.asarray(distances_m)
    order = np.argsort(dioptres)
    return np.interp(1.0 / depth_m, dioptres[order], order.astype(np.float64)).astype(np.float32)


def stack_record(out: Path, name: str, part: Part) -> StackRecord:
    """Measure one finished stack; every picture is read once."""
    stack = read_focal_stack(out / name)
    depth_m = stack.depth_m()
    largest_px = max(float(np.abs(stack.coc_px(index, depth_m)).max()) for index in range(len(stack)))
    paths = [FILE_NAME, *(each.path for each in stack.slices), stack.all_in_focus_path.name, stack.depth_path.name]
    files = {path: _file_record(stack.folder / path) for path in paths}
    return StackRecord(
        name=name,
        part=part,
        slices=len(stack),
        width_px=depth_m.shape[1],
        height_px=depth_m.shape[0],
        largest_coc_px=largest_px,
        radiance=_radiance_range(stack),
        excluded_shares={"any": 0.0},
        files=files,
    )


def _radiance_range(stack: FocalStack) -> RadianceRange:
    """Return the largest radiance and, for each quantile, that of the picture in which it is largest."""
    peaks = [rgb.max(axis=2) for rgb in (stack.all_in_focus(), *stack.iter_rgb())]
    quantiles = {each: max(float(np.quantile(peak, float(each))) for peak in peaks) for each in _QUANTILES}
    return RadianceRange(max(float(peak.max()) for peak in peaks), quantiles)


def _file_record(path: Path) -> FileRecord:
    with path.open("rb") as file:
        return FileRecord(hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)
