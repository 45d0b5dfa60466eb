"""ClipSolve: cameras and points of a clip as they were solved, before they stand anywhere, and the folder in which they are kept.

A folder holds a sparse model (`capture.poses.sparse_model`) whose views are all frames, and solve.json with the rest. The key says of which
clip and by which settings it was solved; a solve of another key is not read.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.poses.sparse_model import SparseModel, read_sparse_model, write_sparse_model
from mrbokeh.system.atomic_files import read_json, write_json

SPACE, FLAT, TURNING = "space", "flat", "turning"
SOLVE_NAME = "solve.json"
_KEY_NAME = "solved_from.json"


@dataclass(frozen=True)
class FrameFit:
    """How a frame fits. residual_px: median over its features that rest. fitting: the share of all that the camera explains."""

    residual_px: float
    fitting: float


@dataclass(frozen=True)
class ClipSolve:
    """A clip solved.

    kind: SPACE (a path through space), FLAT (before a flat scene) or TURNING (at one place; its points are FAR). model: its views are all
    frames with a pose, named by `view_name`; lengths are in a unit of its own. times_s: of all frames of the clip. keyframes: frames whose
    pictures are kept. fits: by frame. why: in one sentence, what was chosen. focal_sigma: relative, None if it is not known.
    """

    kind: str
    model: SparseModel
    times_s: tuple[float, ...]
    keyframes: tuple[int, ...]
    fits: dict[int, FrameFit]
    why: str
    parallax_deg: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def residual_px(self) -> float:
        """Return the median over the frames."""
        return float(np.median([each.residual_px for each in self.fits.values()]))

    @property
    def lost(self) -> tuple[int, ...]:
        return tuple(number for number in range(len(self.times_s)) if number not in self.fits)


def begin_solving(folder: Path, key: dict[str, Any]) -> bool:
    """Note of what a folder is about to hold a solve. Returns whether what is in it may serve: it is of the same clip and settings."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / _KEY_NAME
    same = path.exists() and read_json(path, "a note of what was solved") == key
    if not same:
        (folder / SOLVE_NAME).unlink(missing_ok=True)
        write_json(path, key)
    return same


def write_solve(folder: Path, solve: ClipSolve) -> None:
    write_sparse_model(folder / "solve", solve.model)
    kept = {name: value for name, value in vars(solve).items() if name != "model"}
    write_json(folder / SOLVE_NAME, kept | {"fits": {str(number): asdict(each) for number, each in solve.fits.items()}})


def read_solve(folder: Path) -> ClipSolve | None:
    """Return the solve kept in a folder, None if it holds none."""
    if not (folder / SOLVE_NAME).exists():
        return None
    kept = read_json(folder / SOLVE_NAME, "a solved clip")
    fits = {int(number): FrameFit(**each) for number, each in kept.pop("fits").items()}
    kept |= {name: tuple(kept[name]) for name in ("times_s", "keyframes", "warnings")}
    return ClipSolve(model=read_sparse_model(folder / "solve"), fits=fits, **kept)
