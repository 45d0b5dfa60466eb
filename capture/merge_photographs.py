"""`mrbokeh.merge`: a focus stack merged in one call, from files or arrays to arrays."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float32

from capture.merging.merge import merge_stack
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestSettings, ingest
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import FILE_NAME
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Merged:
    """A merged focus stack.

    all_in_focus: (H, W, 3) linear Rec.709. focus_index: (H, W) the (fractional) slice in which each pixel is sharp, in the order of
    their focus. confidence: (H, W) in [0, 1]. depth_m: (H, W) metres, which are guesses unless metres_known. folder: of the stack, for
    `mrbokeh.composite` and `mrbokeh.read_focal_stack`, or None where none was asked for.
    """

    all_in_focus: Float32[np.ndarray, "height width 3"]
    focus_index: Plane
    confidence: Plane
    depth_m: Plane
    metres_known: bool
    folder: Path | None


def merge(photographs: str | Path | Sequence[str | Path | np.ndarray], out: str | Path | None = None) -> Merged:
    """Merge photographs of one scene at several focus distances, in any order, from a tripod or by hand.

    photographs: a folder, or files (RAW, TIFF, PNG, JPEG, EXR), or linear arrays (H, W, 3) of one size. out: a new folder to keep the
    FocalStack in. Raises InputError if they do not make one stack, or if out holds one.

    >>> merged = mrbokeh.merge("desk/")
    """
    if isinstance(photographs, (str, Path)):
        given: list[str | Path | np.ndarray] = [photographs]
    else:
        given = list(photographs) if np.iterable(photographs) else []
        _require_several(given, photographs)
    if out is not None and Path(out).exists() and not Path(out).is_dir():
        raise InputError(f"out: expected the name of a folder, but {out} is a file: give another")
    if out is not None and (before := sorted(Path(out).rglob(FILE_NAME))):
        raise InputError(f"out: expected a new folder, but {before[0].parent} is a stack: read it (read_focal_stack), or give another")
    with TemporaryDirectory() as temporary, nullcontext(temporary) if out is None else nullcontext(str(out)) as scene:
        files = [_file_of(each, Path(temporary) / "arrays", index) for index, each in enumerate(given)]
        report = ingest(files, Path(scene), IngestSettings(Grouping.none))
        stacks = [each.stack for each in report.stacks if each.stack is not None]
        if len(stacks) != 1:
            raise InputError(f"expected photographs of one focus stack, got {len(stacks)} stacks: merge one at a time")
        made = merge_stack(stacks[0])
        return Merged(
            all_in_focus=made.all_in_focus(),
            focus_index=made.focus_index(),
            confidence=made.depth_confidence(),
            depth_m=made.depth_m(),
            metres_known=made.metres_known,
            folder=None if out is None else made.folder,
        )


def _require_several(given: Sequence[str | Path | np.ndarray], photographs: object) -> None:
    """Raise InputError unless there are two or more, or one that is a folder. photographs: what they are from."""
    if len(given) < 2 and not any(isinstance(each, (str, Path)) and Path(each).is_dir() for each in given):
        got = len(given) if np.iterable(photographs) else type(photographs).__name__
        raise InputError(f"photographs: expected two or more of one scene at several focus distances, or a folder, got {got}")


def _file_of(given: str | Path | np.ndarray, folder: Path, index: int) -> Path:
    if isinstance(given, (str, Path)):
        return Path(given)
    rgb = np.asarray(given)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype.kind != "f":
        raise InputError(
            f"photographs: expected linear light as floats of shape (height, width, 3), got {rgb.dtype} {rgb.shape}: read files with "
            f"mrbokeh.read_picture"
        )
    folder.mkdir(exist_ok=True)
    path = folder / f"{index:04d}.exr"
    write_image(path, rgb.astype(np.float32), half=False)
    return path
