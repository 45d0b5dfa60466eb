"""Comparison of every method on every unseen slice: scores, costs, a focus pull, tables and sheets of pictures.

Costs are time, and memory beyond what the process held before.

A focus pull measures flicker: second differences in time along the pull against those of the truth. If a stack is a fine pull itself,
its slices are the truth. Otherwise frames are made between the focus distances of two neighbouring slices and compared with the
polygon renderer, the fast twin of the scatter reference (its own flicker there is that of the reference to 3 %: 2.7e-4, rms of the
second difference over 4, on the desk of the demo).
"""

import ctypes
import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_metrics import flicker
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.data.dataset import PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.stacks import ChosenSlices, Seen, stack_name
from training.evaluation.methods import Method, renderer_method
from training.evaluation.report import Sheets, write_numbers, write_table
from training.evaluation.scores import Evaluation, Perceptual, Score, SliceScorer
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice

Result = TypeVar("Result")
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")
_FORGET_PEAK = "5"
FRAMES = 8
FINE_STEP_PX = 1.5
LEAST_FRAMES = 5
REFERENCE_RENDERER = "polygon"
Image = Float32[np.ndarray, "height width 3"]


def _give_back() -> None:
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):
        return


def _status_kib(name: str) -> int:
    line = next(each for each in _STATUS.read_text(encoding="ascii").splitlines() if each.startswith(f"{name}:"))
    return int(line.split()[1])


@dataclass(frozen=True)
class FocusPull:
    """A focus pull. frames: the focus moving by even steps. truth: (H, W, 3) of each, masked as by `shown`; against: its name, in words."""

    frames: tuple[UnseenSlice, ...]
    truth: tuple[Image, ...]
    against: str

    def flicker_of(self, method: Method) -> float:
        """Return the flicker in radiance, 0 for a result as calm as the truth (mrbokeh.images.image_metrics.flicker)."""
        return flicker([shown(method.blur(frame), frame) for frame in self.frames], self.truth)


def shown(picture: Image, frame: UnseenSlice) -> Image:
    """Blacken pixels that do not count, in the results as in the truth."""
    return picture * frame.pair.weight[..., None]


def focus_pull(stack: FocalStack, frames: int = FRAMES) -> FocusPull:
    """Return the stack itself if it is fine, else `frames` between the two slices in its middle."""
    pairs = PairSet([stack], WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    order = sorted(range(len(stack)), key=lambda index: 1.0 / (stack.slices[index].focus_distance_m or np.inf))
    if is_fine(stack):
        slices = tuple(unseen_slice(pairs, index) for index in order)
        return FocusPull(slices, tuple(shown(each.pair.target, each) for each in slices), "its own slices")
    return _made_pull([unseen_slice(pairs, index) for index in order[(len(order) - 1) // 2 :][:2]], frames)


def is_fine(stack: FocalStack) -> bool:
    """Tell whether a stack has enough slices and its circles of confusion change by at most FINE_STEP_PX between slices."""
    dioptres = np.sort([1.0 / (each.focus_distance_m or np.inf) for each in stack.slices])
    if len(dioptres) < LEAST_FRAMES:
        return False
    width_px = stack.depth_m().shape[1]
    return float(np.diff(dioptres).max()) * stack.coc_px_per_dioptre(0, width_px) <= FINE_STEP_PX


def _made_pull(ends: Sequence[UnseenSlice], frames: int) -> FocusPull:
    """Make even steps in dioptres from the first slice's focus to the last's; the lens and the mask are the first's."""
    dioptres = np.linspace(1.0 / ends[0].lens.focus_distance_m, 1.0 / ends[-1].lens.focus_distance_m, frames)
    moving = tuple(ends[0].focused_at(float(1.0 / each) if each > 0 else np.inf) for each in dioptres)
    reference = renderer_method(REFERENCE_RENDERER)
    truth = tuple(shown(reference.blur(frame), frame) for frame in moving)
    return FocusPull(moving, truth, f"the {REFERENCE_RENDERER} renderer between {ends[0].label} and {ends[-1].index}")


def flickers(methods: Sequence[Method], pull: FocusPull) -> dict[str, float]:
    return {each.name: pull.flicker_of(each) for each in track(methods, "focus pull")}


@dataclass(frozen=True)
class Extras:
    """Measurements besides the scores. lpips: a distance, or None. pull_frames: of the focus pull, 0 for none."""

    lpips: Perceptual | None = None
    pull_frames: int = FRAMES
    memory: bool = True


@dataclass(frozen=True)
class Unseen:
    """Data that no network was trained on: whole stacks, or, with slices, some slices held out of stacks that networks were trained on."""

    stacks: tuple[FocalStack, ...]
    slices: ChosenSlices = field(default_factory=dict)

    @property
    def words(self) -> str:
        return "slices held out of one stack, not an unseen view" if self.slices else "slices of stacks not trained on"

    def pairs(self) -> PairSet:
        return PairSet(self.stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=self.slices)


def compare(methods: Sequence[Method], unseen: Unseen, out: Path, extras: Extras | None = None) -> Evaluation:
    """Evaluate all methods on all unseen slices; write evaluation.md, .csv and .png and evaluation_crops.png into `out`.

    A focus pull needs a whole stack, so there is none if slices of it were trained on.
    """
    extras = extras or Extras()
    sheets = Sheets(methods, len(unseen.pairs()))
    result = scored(methods, unseen, extras, sheets)
    against = ""
    if extras.pull_frames and not unseen.slices:
        pull = focus_pull(unseen.stacks[0], extras.pull_frames)
        result, against = replace(result, flicker=flickers(methods, pull)), pull.against
    write_table(out / "evaluation.md", result, against, unseen.words)
    write_numbers(out / "evaluation.csv", result.scores)
    sheets.write(out)
    return result


def scored(methods: Sequence[Method], unseen: Unseen, extras: Extras, sheets: Sheets | None = None) -> Evaluation:
    """Return the scores alone. Time and memory are those of methods that have run before: the first picture of each is made twice."""
    pairs = unseen.pairs()
    scores: list[Score] = []
    memory = {}
    for index in track(range(len(pairs)), "evaluate"):
        seen = unseen_slice(pairs, index)
        if index == 0:
            memory = {each.name: _warmed_up(each, seen, extras.memory) for each in methods}
        results = {each.name: timed(partial(each.blur, seen)) for each in methods}
        scorer = SliceScorer(seen, extras.lpips)
        scores += [scorer.score(name, picture, seconds) for name, (picture, seconds) in results.items()]
        if sheets is not None:
            sheets.note(index, seen, {name: picture for name, (picture, _) in results.items()})
    networks, gaussians = (tuple(each.name for each in methods if each.kind == kind) for kind in ("network", "Gaussian"))
    return Evaluation(
        scores=tuple(scores),
        networks=networks,
        rivals=gaussians,
        flicker={},
        peak_memory_mib={name: each for name, each in memory.items() if not np.isnan(each)},
    )


def unseen_of(stacks: Sequence[FocalStack], seen: Sequence[Seen]) -> Unseen:
    """Return the stacks that no network was trained on; without any, the slices that all networks held out.

    Raises InputError if nothing is left.
    """
    slices = {stack_name(stack): sorted(set.intersection(*(each.unseen_slices(stack) for each in seen))) for stack in stacks}
    whole = tuple(stack for stack in stacks if len(slices[stack_name(stack)]) == len(stack))
    if whole:
        return Unseen(whole)
    left = tuple(stack for stack in stacks if slices[stack_name(stack)])
    if not left:
        raise InputError(
            f"the networks were trained on every slice of these stacks ({', '.join(slices)}): give a scene with a stack they have not "
            f"seen, or train again on one stack of at least 3 slices, of which `mrbokeh train fit` holds some out"
        )
    return Unseen(left, {stack_name(stack): slices[stack_name(stack)] for stack in left})


def _warmed_up(method: Method, seen: UnseenSlice, memory: bool) -> float:
    """Run a first picture, which compiles, and return the memory of a second one."""
    method.blur(seen)
    return peak_memory_mib(partial(method.blur, seen)) if memory else float("nan")


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """Return (the result, seconds)."""
    started_s = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started_s


def peak_memory_mib(work: Callable[[], object]) -> float:
    """Return the rise of the process's memory while `work` runs; nan on systems other than Linux.

    Memory used before, such as the weights of a network, does not count; freed memory is given back to the system first.
    """
    _give_back()
    try:
        _RESET.write_text(_FORGET_PEAK, encoding="ascii")
        before_kib = _status_kib("VmRSS")
        work()
        return (_status_kib("VmHWM") - before_kib) / 1024.0
    except OSError:
        return float("nan")
