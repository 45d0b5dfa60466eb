"""What the bench keeps of a stack: measured once for the same photographs, program and peers, then read again."""

import hashlib
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from capture.report.picture_sharpness import SharpestSlices
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from tests.bench.real_crops import Crop, Place, worst_places, write_crops
from tests.bench.real_peers import features_of_slices, on_slices, peer_result
from tests.bench.real_sets import RealStack
from tests.bench.real_stack import Captured, Figures, Rgb, capture, covered_blocks, gate_facts, measured_where, unlike_share

ROOT = Path(__file__).resolve().parents[2]
OURS = "mrbokeh"
TOP_BAR = 1.5
REFOCUS, PEERS = "refocus", "peers"
"""What can be left out with --skip."""
LEFT_OUT_SET = "lytro_stacks/"
"""Slices are left out and made again in this set, for which there is a bar: 25 slices of 12 megapixels take half an hour."""
MOST_LEFT_OUT = 4


@dataclass(frozen=True)
class Shown:
    place: Place
    crops: list[Crop]


@dataclass(frozen=True)
class LeaveOneOut:
    """Medians in dB over MOST_LEFT_OUT inner slices of a stack; nearest: of the neighbouring slice. said: why there are none."""

    rendered_db: float | None = None
    with_residuals_db: float | None = None
    nearest_db: float | None = None
    said: str = ""


@dataclass(frozen=True)
class Focus:
    """correlation: of the dioptres of the slices with the stated ones."""

    correlation: float | None = None
    said: str = ""


@dataclass(frozen=True)
class StackResult:
    """failure: "" where the commands came to their end. costs: (CPU seconds, MB, exit code) by command. figures: by program, ours first."""

    name: str
    photographs: int
    failure: str
    costs: dict[str, tuple[float, float, int]]
    size: tuple[int, int] | None = None
    figures: dict[str, Figures] = field(default_factory=dict)
    gates: dict[str, Any] = field(default_factory=dict)
    refocus: LeaveOneOut | None = None
    focus: Focus | None = None
    shown: list[Shown] = field(default_factory=list)

    @property
    def ours(self) -> Figures | None:
        return self.figures.get(OURS)


@dataclass(frozen=True)
class Measuring:
    """cache: the folder for results, crops and what peers made. peers: version by name."""

    cache: Path
    peers: Mapping[str, str]
    leave_one_out: bool = True
    redo: bool = False

    def of(self, stack: RealStack) -> StackResult:
        """Measure a stack, or read what was measured before."""
        path = self.cache / "stacks" / f"{stack.file_name}.json"
        key = [stack.digest, program_digest(), dict(self.peers), self._leaves_out(stack)]
        kept = read_json(path, "a result of the bench") if path.is_file() and not self.redo else {}
        if kept.get("key") == key:
            return _from_json(kept["result"])
        with tempfile.TemporaryDirectory() as work:
            result = self._measured(stack, Path(work))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"key": key, "result": asdict(result)})
        return result

    def fused_path(self, stack: RealStack) -> Path:
        """Where the all-in-focus picture of a pair is kept, 8-bit, to be ranked."""
        return self.cache / "fused" / f"{stack.name.split('/')[-1]}.png"

    def crop_folder(self) -> Path:
        return self.cache / "crops"

    def _leaves_out(self, stack: RealStack) -> bool:
        return self.leave_one_out and stack.name.startswith(LEFT_OUT_SET)

    def _measured(self, stack: RealStack, work: Path) -> StackResult:
        captured = capture(stack, work)
        costs = {name: (cost.cpu_s, cost.memory_mb, cost.exit_code) for name, cost in captured.costs.items()}
        result = StackResult(stack.name, len(stack.photographs), captured.failure, costs)
        if not captured.merged:
            return result
        made = captured.stack()
        picture = made.all_in_focus()
        if stack.is_pair:
            self.fused_path(stack).parent.mkdir(parents=True, exist_ok=True)
            write_image(self.fused_path(stack), picture)
        result = replace(result, size=picture.shape[:2], gates=gate_facts(captured.scene), focus=_focus(stack, made))
        figures, shown = self._beside_peers(stack, captured, made, picture)
        return replace(result, figures=figures, shown=shown, refocus=_left_out(made) if self._leaves_out(stack) else None)

    def _beside_peers(self, stack: RealStack, captured: Captured, made: FocalStack, picture: Rgb) -> tuple[dict[str, Figures], list[Shown]]:
        sharpest = SharpestSlices.of(made.iter_rgb(), (made.slice_masks(index).valid for index in range(len(made))))
        own = sharpest.measure(picture)
        figures, pictures = (
            {OURS: Figures(own.lost, own.flat, own.top, *captured.making, unlike=unlike_share(made, picture))},
            {OURS: picture},
        )
        slices = features_of_slices(made.iter_rgb(), len(made)) if self.peers else []
        for name, version in self.peers.items():
            peer = peer_result(name, version, stack, self.cache)
            laid = on_slices(peer.picture, slices, picture.shape[:2]) if peer.picture else None
            if laid is None:
                figures[name] = Figures(None, None, None, peer.cpu_s, peer.memory_mb, peer.said or "its picture does not match the slices")
                continue
            measured = sharpest.measure(laid[0])
            lost, flat = measured_where(sharpest, measured, covered_blocks(laid[1]))
            figures[name], pictures[name] = Figures(lost, flat, measured.top, peer.cpu_s, peer.memory_mb), laid[0]
        places = worst_places(sharpest, own, picture, TOP_BAR)
        stems = [f"{stack.file_name}_{number}" for number in range(len(places))]
        crops = [write_crops(self.crop_folder(), stem, place, made.slice_rgb, pictures) for stem, place in zip(stems, places, strict=True)]
        return figures, [Shown(place, each) for place, each in zip(places, crops, strict=True)]


@lru_cache(maxsize=1)
def program_digest() -> str:
    """Of the sources that make a picture: results of another program are measured again."""
    found = hashlib.sha256()
    for folder in ("capture", "mrbokeh"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            found.update(path.read_bytes())
    return found.hexdigest()[:16]


def _focus(stack: RealStack, made: FocalStack) -> Focus | None:
    """The solved positions beside the stated ones, where the files did not tell the program."""
    if stack.stated_dioptres is None:
        return None
    stated = {path.name: dioptres for path, dioptres in zip(stack.photographs, stack.stated_dioptres, strict=True)}
    known = [each for each in made.slices if each.focus_distance_m is not None]
    if len(known) < 3:
        return Focus(said="no focus positions were solved")
    solved = np.array([1.0 / float(each.focus_distance_m or np.inf) for each in known])
    told = np.array([stated[each.metadata["source"]] for each in known])
    said = "from the files' metadata, not solved" if made.metres_known else f"solved for {len(known)} of {len(stack.photographs)} slices"
    return Focus(float(np.corrcoef(solved, told)[0, 1]), said)


def _left_out(made: FocalStack) -> LeaveOneOut:
    from mrbokeh.renderers.choose import lens_and_renderer
    from tests.support.left_out_slices import leave_one_out

    started = time.process_time()
    try:
        slices = list(leave_one_out(made, lens_and_renderer(None, None)[1], MOST_LEFT_OUT))
    except InputError as refused:
        return LeaveOneOut(said=str(refused))
    if not slices:
        return LeaveOneOut(said="fewer than 3 slices")
    rendered, full, nearest = (
        float(median(getattr(each, name) for each in slices)) for name in ("rendered_db", "with_residuals_db", "nearest_slice_db")
    )
    return LeaveOneOut(rendered, full, nearest, f"{len(slices)} slices, {time.process_time() - started:.0f} CPU s")


def _from_json(found: dict[str, Any]) -> StackResult:
    shown = [Shown(Place(*each["place"]), [Crop(**crop) for crop in each["crops"]]) for each in found["shown"]]
    figures = {name: Figures(**each) for name, each in found["figures"].items()}
    refocus = LeaveOneOut(**found["refocus"]) if found["refocus"] else None
    focus = Focus(**found["focus"]) if found["focus"] else None
    return StackResult(**found | {"shown": shown, "figures": figures, "refocus": refocus, "focus": focus})
