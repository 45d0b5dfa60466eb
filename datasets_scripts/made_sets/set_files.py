"""Parts that scripts share: files of data sets, made piece by piece, so that an interrupted run goes on where it stopped, the manifest of
focal stacks, and how a mistake is told.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from jaxtyping import Float32

from mrbokeh.optics.camera import Camera, camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME as MANIFEST
from mrbokeh.stacks.focal_stack_dataset import FileRecord, FocalStackDataset, Part, RadianceRange, StackRecord, write_focal_stack_dataset
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

LICENCE = (
    "These pictures are computed from scenes that a program of this project makes up; no photograph, model or texture of anybody is in "
    "them. Use them as you like (CC0 1.0)."
)
_QUANTILES = ("0.5", "0.99", "0.999", "0.9999")
PLAN_NAME = "plan.json"
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what was made with other settings.")]


@contextmanager
def mistakes_told() -> Iterator[None]:
    """Tell a mistake of the user in one sentence and end with 2."""
    try:
        yield
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None


@dataclass(frozen=True)
class Job:
    """Files that are made together."""

    paths: tuple[Path, ...]
    make: Callable[[], None]

    @property
    def done(self) -> bool:
        return all(path.is_file() for path in self.paths)


def make_missing(jobs: Iterable[Job], description: str) -> int:
    """Make the files that are not there and return how many jobs ran."""
    waiting = [job for job in jobs if not job.done]
    for job in track(waiting, description):
        job.make()
    return len(waiting)


def claim_set(out: Path, document: dict[str, object], files: Iterable[Path], overwrite: bool) -> None:
    """Do as `claim_folder` for a data set, whose plan.json says how it was begun; a folder with anything else in it is refused."""
    plan = out / PLAN_NAME
    if not overwrite and not plan.exists() and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} holds something else than a data set that was begun here: give the name of a new folder")
    claim_folder(plan, document, files, overwrite)
    if overwrite:
        (out / MANIFEST).unlink(missing_ok=True)


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


def distant_camera(lens: Lens, width_px: int, height_px: int) -> Camera:
    """Return the camera of the lens focused at infinity: the field of view of sets whose film keeps its distance."""
    return camera_of_lens(lens.focused_at(float("inf")), width_px, height_px)


def even_in_dioptres(nearest_m: float, farthest_m: float, count: int) -> tuple[float, ...]:
    """Return distances, near to far, evenly in dioptres: the steps of blur are equal."""
    return tuple(float(each) for each in 1.0 / np.linspace(1.0 / nearest_m, 1.0 / farthest_m, count))


def slice_name(index: int) -> str:
    return f"slice_{index:02d}.exr"


def focus_index(depth_m: Float32[np.ndarray, "height width"], distances_m: Sequence[float]) -> Float32[np.ndarray, "height width"]:
    """Return the fractional index of the slice that is sharpest at each pixel, linear in dioptres."""
    dioptres = 1.0 / np.asarray(distances_m)
    order = np.argsort(dioptres)
    return np.interp(1.0 / depth_m, dioptres[order], order.astype(np.float64)).astype(np.float32)


def write_dataset(out: Path, licence: str, records: tuple[StackRecord, ...], metadata: dict[str, Any]) -> FocalStackDataset:
    """Write licence and manifest of finished stacks. The radiance scale is the largest radiance: nothing is cut off."""
    (out / "LICENCE.txt").write_text(licence + "\n", encoding="utf-8")
    scale = max(each.radiance.largest for each in records)
    dataset = FocalStackDataset(folder=out, licence=licence, radiance_scale=scale, stacks=records, metadata=metadata)
    write_focal_stack_dataset(dataset)
    return dataset


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
