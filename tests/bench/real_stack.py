"""One real stack through `mrbokeh capture`, each command a process of its own, and what came out beside its slices."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.ghosts import UNLIKE, unlike_slices
from capture.report.picture_sharpness import SharpestSlices, Sharpness, inner_blocks
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.system.atomic_files import read_json
from tests.bench.process_cost import Cost, attempted, mrbokeh_command
from tests.bench.real_sets import RealStack

Rgb = Float32[np.ndarray, "height width 3"]
BlockMask = Bool[np.ndarray, "rows columns"]

TIMEOUT_S = 3600.0
STAGES = ("ingest", "merge", "process")
"""`process` comes last, over what is there: it makes what is left, which is the report. Together they are `capture process`."""


@dataclass(frozen=True)
class Figures:
    """The measures of capture.report.picture_sharpness of one picture, and what it cost to make. said: why there are none."""

    lost: float | None = None
    flat: float | None = None
    top: float | None = None
    cpu_s: float | None = None
    memory_mb: float | None = None
    said: str = ""
    unlike: float | None = None


@dataclass(frozen=True)
class Captured:
    """costs: of each command that ran; the last one failed where exit_code is not 0. scene: what it left."""

    scene: Path
    costs: dict[str, Cost]

    @property
    def failure(self) -> str:
        """The command that failed, its exit code and its last line; "" where all went well."""
        name, cost = list(self.costs.items())[-1]
        return f"capture {name}: exit {cost.exit_code}: {cost.last_line}" if cost.exit_code else ""

    @property
    def making(self) -> tuple[float, float]:
        """CPU seconds of ingest and merge together, and the larger memory in MB: what a peer does too."""
        made = [cost for name, cost in self.costs.items() if name != "process"]
        return sum(cost.cpu_s for cost in made), max(cost.memory_mb for cost in made)

    @property
    def merged(self) -> bool:
        """Whether there is a picture to measure: a failed report does not take it away."""
        return "process" in self.costs

    def stack(self) -> FocalStack:
        return find_focal_stacks(self.scene)[0]


def capture(stack: RealStack, work: Path) -> Captured:
    """Run ingest, merge and the rest of `capture process` on copies of the photographs, nothing set by hand."""
    photographs, scene = linked(stack.photographs, work / stack.file_name), work / "scene"
    shutil.rmtree(scene, ignore_errors=True)
    costs: dict[str, Cost] = {}
    for stage in STAGES:
        inputs = (scene,) if stage == "merge" else (photographs, "--out", scene)
        costs[stage] = attempted(mrbokeh_command("capture", stage, *inputs), TIMEOUT_S)
        if costs[stage].exit_code:
            break
    return Captured(scene, costs)


def linked(photographs: Sequence[Path], folder: Path) -> Path:
    """A folder that holds these photographs and nothing else."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in photographs:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def gate_facts(scene: Path) -> dict[str, Any]:
    """What the report says: passed, how many gates were judged of how many, which failed."""
    if not (scene / "report.json").is_file():
        return {}
    report = read_json(scene / "report.json", "a report")
    verdicts = {gate["name"]: gate["verdict"] for gate in report["gates"]}
    judged = [name for name, verdict in verdicts.items() if verdict != "absent"]
    failed = [name for name in judged if verdicts[name] == "failed"]
    return {"passed": report["passed"], "judged": len(judged), "gates": len(verdicts), "failed": failed}


def covered_blocks(covered: Bool[np.ndarray, "height width"]) -> BlockMask:
    """Blocks whose pixels a picture covers all, laid out as those of `block_detail`."""
    return np.asarray(inner_blocks(covered).all(axis=(1, 3)))


def unlike_share(made: FocalStack, picture: Rgb) -> float:
    """Return the share of our picture that is unlike every slice: ghosts. A peer's lies on the slices too coarsely for that."""
    seen = ((rgb, made.slice_masks(index).valid) for index, rgb in enumerate(made.iter_rgb()))
    return float((unlike_slices(picture, seen) > UNLIKE).mean())


def measured_where(sharpest: SharpestSlices, measured: Sharpness, known: BlockMask) -> tuple[float, float]:
    """(lost, flat) of the blocks that a picture covers: a peer that crops its result has not lost what it left out."""
    textured, flat = sharpest.textured & known, sharpest.flat & known
    lost = float((measured.lost_blocks & known).sum() / max(int(textured.sum()), 1))
    return lost, float(np.percentile(measured.kept[flat], 95.0)) if flat.any() else 0.0
