"""Metres for one stack whose focus distances nobody stated, from lengths and distances that the user knows.

Its dioptres are known up to D' = p + q D, for blur in pixels is the same with px_per_dioptre / q. The rule: what the photographs state
stays (a stated lens fixes q = 1, a stated focus distance counts as one more fact); the facts told fix the rest by least squares of their
relative errors; and where facts lie at one depth only, the world is scaled as a whole (p = 0), which keeps proportions that are guessed.
Blur looks alike on both sides of the focus: where merging had to guess which end of the sweep is near, facts at two depths tell (q < 0).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import least_squares

from capture.merging.merged_pictures import write_depth_picture
from capture.views.lens_calibration import STATED_KEY
from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr, write_exr
from mrbokeh.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.guessed_metres import KEY, POSITION, POSITION_ERROR, guesses, is_lens_guessed, is_near_first, is_view_guessed, metres_facts
from mrbokeh.lens import Lens
from mrbokeh.stack_pictures import write_merge_sheet

FACTS = "told"
_SLICE_POSITION, _GROWTH = "blur_position_px", "px_per_dioptre"
_NEAR_PIXEL_PX = 2
_FARTHEST_SHARE = 0.01
"""Of the picture's width: from no farther away a surface is taken for what is at a pixel, where nothing tells the depth there."""
_LEAST_CONFIDENCE = 0.1
_SURE_PX, _SURE_SHARE = 1.0, 0.05
"""A place is known whose position is known to so many pixels of blur, or that share of the range of the slices."""
_LEAST_SPREAD_PX = 3.0
"""Facts whose surfaces differ in blur by less lie at one depth: they cannot tell how deep the scene is."""
_CONTRADICTS = 0.1
_LEAST_DIOPTRES = 1e-6


@dataclass(frozen=True)
class KnownLength:
    """metres between what is seen at two pixels."""

    x1: float
    y1: float
    x2: float
    y2: float
    metres: float

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        return (self.x1, self.y1), (self.x2, self.y2)

    def __str__(self) -> str:
        return f"the length of {self.metres:g} m from pixel {self.x1:g},{self.y1:g} to {self.x2:g},{self.y2:g}"


@dataclass(frozen=True)
class KnownDistance:
    """metres from the lens, along its axis, to what is seen at a pixel."""

    x: float
    y: float
    metres: float

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        return ((self.x, self.y),)

    def __str__(self) -> str:
        return f"the distance of {self.metres:g} m at pixel {self.x:g},{self.y:g}"


Fact = KnownLength | KnownDistance


@dataclass(frozen=True)
class Regauged:
    """stack: as written. errors: by how much each fact told is missed, as a share."""

    stack: FocalStack
    errors: tuple[tuple[Fact, float], ...]


def tell_metres(stack: FocalStack, told: Sequence[Fact], overwrite: bool = False) -> Regauged:
    """Put the metres that follow from all facts told into stack.json and depth.exr. overwrite: earlier ones count no more.

    Raises InputError where the stack's metres are known already, or facts contradict one another.
    """
    depth_m = _told_depth_m(stack)
    facts = _with_earlier(stack, told, overwrite)
    camera = stack.camera
    if not metres_facts(stack) or camera is None or (metres_facts(stack).get("known") and FACTS not in metres_facts(stack)):
        sizes = "; ".join(f"{each} is {_now(each, depth_m, camera):.4g} m by them" for each in told if camera is not None)
        raise InputError(
            f"{stack.folder} knows its metres from its focus distances{' (' + sizes + ')' if sizes else ''}: to correct them state focus "
            f"distances in lens.toml and merge again, or find the scale of camera poses with --board or --distance"
        )
    solving = _Solving(tuple(_Equation.of(each, depth_m, camera) for each in facts), _stated_dioptres(stack), metres_facts(stack)["gauge"])
    found = solving.solution()
    changed = _regauged(stack, found.p, found.q)
    gauge = dict(changed.metadata[KEY]["gauge"]) | {"offset_from": "told"}
    gauge |= {} if gauge["scale_from"] == "lens" else {"scale_from": "told"}
    if found.directed:
        gauge |= {"near_first_from": FACTS, "near_first_sure": True}
    changed = replace(changed, metadata=changed.metadata | {KEY: _told(stack, gauge, facts, found.deep)})
    _write(changed, found.p, found.q)
    return Regauged(changed, tuple((each.fact, each.error(found.p, found.q)) for each in solving.equations))


def tell_nearest(stack: FocalStack, first: bool) -> FocalStack:
    """Put what the user knows of the sweep's direction into stack.json and depth.exr: that its first (or last) slice is the nearest.

    Turned in the middle of its planes of focus, or so that a stated distance and lengths told of one depth stay. Raises InputError where
    stated focus distances, or lengths and distances at several depths, say it already.
    """
    if not stack.merged:
        raise InputError(f"{stack.folder} is not merged: run `mrbokeh capture merge {stack.folder}` first")
    gauge, stated = metres_facts(stack).get("gauge"), _stated_dioptres(stack)
    if not gauge or gauge.get("near_first_from") in (FACTS, "stated distances") or len(stated) > 1:
        raise InputError(f"{stack.folder} knows its nearest slice from its distances: --nearest is for stacks that have to guess it")
    turned = is_near_first(stack) != first
    p, q = _turn(stack, stated) if turned else (0.0, 1.0)
    changed = _regauged(stack, p, q)
    known = dict(changed.metadata[KEY]["gauge"]) | {"near_first_from": "--nearest", "near_first_sure": True}
    changed = replace(changed, metadata=changed.metadata | {KEY: dict(changed.metadata[KEY]) | {"gauge": known}})
    _write(changed, p, q)
    return changed


def _turn(stack: FocalStack, stated: Float[np.ndarray, " slices"]) -> tuple[float, float]:
    """p and q below 0 of the stack turned; what is stated or told stays at its dioptres."""
    facts, dioptres = metres_facts(stack), [1.0 / each for each in stack.focus_distances_m if each]
    depth_m = _told_depth_m(stack)
    told = [1.0 / _depth_at(depth_m, *pixel) for each in facts.get(FACTS, ()) for pixel in _fact(each).pixels]
    kept, ends = [*stated, *told], min(dioptres) + max(dioptres)
    if not kept:
        return ends, -1.0
    if facts["gauge"]["scale_from"] == "lens":
        return 2.0 * float(np.mean(kept)), -1.0
    factor = float(np.mean(kept)) / (ends - float(np.mean(kept)))
    return ends * factor, -factor


def lines_of(done: Regauged) -> list[str]:
    """Say what was found, for people."""
    distances_m = [each for each in done.stack.focus_distances_m if each is not None]
    facts = metres_facts(done.stack)
    lines = [f"{done.stack.folder}: focused from {min(distances_m):.4g} m to {max(distances_m):.4g} m, {facts['why']}"]
    guessed = guesses(done.stack)
    lines += [f"{done.stack.folder}: still guessed: {guessed}"] if guessed else []
    off = [f"{fact} by {100 * error:+.1f} %" for fact, error in done.errors if abs(error) > _CONTRADICTS]
    return [*lines, f"warning: what was told disagrees: {', '.join(off)}: look at the pixels and measure again"] if off else lines


def parse_length(text: str) -> KnownLength:
    return KnownLength(*_numbers(text, 5, "--ruler", "X1,Y1,X2,Y2,METRES such as 310,220,480,224,0.05"))


def parse_known_distance(text: str) -> KnownDistance:
    return KnownDistance(*_numbers(text, 3, "--distance-at", "X,Y,METRES such as 310,220,0.35"))


def _numbers(text: str, count: int, option: str, expected: str) -> list[float]:
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all() or numbers[-1] <= 0.0 or (count == 5 and numbers[:2] == numbers[2:4]):
        raise InputError(f"{option}: expected {expected}, got {text!r}")
    return numbers


def _with_earlier(stack: FocalStack, told: Sequence[Fact], overwrite: bool) -> tuple[Fact, ...]:
    """Facts of earlier calls, and the new ones in place of those at the same pixels."""
    earlier = [] if overwrite else [_fact(each) for each in metres_facts(stack).get(FACTS, ())]
    return tuple({each.pixels: each for each in (*earlier, *told)}.values())


def _fact(document: Mapping[str, float]) -> Fact:
    return KnownLength(**document) if "x1" in document else KnownDistance(**document)


@dataclass(frozen=True)
class _Equation:
    """A fact, with the directions (x / z, y / z, 1) and the dioptres, as they are now, of what is at its pixels."""

    fact: Fact
    rays: Float[np.ndarray, "pixels 3"]
    dioptres: Float[np.ndarray, " pixels"]

    @classmethod
    def of(cls, fact: Fact, depth_m: Float32[np.ndarray, "height width"], camera: Camera) -> "_Equation":
        rays = [camera.unproject(np.array(each), np.array(1.0)) for each in fact.pixels]
        return cls(fact, np.array(rays), np.array([1.0 / _depth_at(depth_m, *each) for each in fact.pixels]))

    def metres(self, p: float, q: float) -> float:
        depth_m = 1.0 / np.maximum(p + q * self.dioptres, _LEAST_DIOPTRES)
        points_m = self.rays * depth_m[:, None]
        return float(depth_m[0]) if len(points_m) == 1 else float(np.linalg.norm(points_m[0] - points_m[1]))

    def error(self, p: float, q: float) -> float:
        return self.metres(p, q) / self.fact.metres - 1.0


class _Solution(NamedTuple):
    """D' = p + q D. deep: whether both rest on facts. directed: whether facts tell which end of the sweep is near."""

    p: float
    q: float
    deep: bool
    directed: bool


@dataclass(frozen=True)
class _Solving:
    """stated: dioptres of slices whose focus the photographs state. gauge: of the stack, as merging or an earlier call left it."""

    equations: tuple[_Equation, ...]
    stated: Float[np.ndarray, " slices"]
    gauge: Mapping[str, Any]

    def solution(self) -> _Solution:
        """Of least squares; q is below 0 where the facts tell that what was taken for near is far."""
        seen = np.array([*(each.dioptres.mean() for each in self.equations), *self.stated])
        # What each fact would make of its own dioptres alone.
        alone = np.array([*(each.dioptres.mean() * each.metres(0.0, 1.0) / each.fact.metres for each in self.equations), *self.stated])
        deep = float(np.ptp(np.concatenate([seen, *(each.dioptres for each in self.equations)]))) * self.gauge["px_per_dioptre"]
        if self.gauge["scale_from"] != "lens" and deep < _LEAST_SPREAD_PX:
            return _Solution(0.0, float(np.exp(np.mean(np.log(alone / seen)))), deep=False, directed=False)
        apart = float(np.ptp(seen)) * self.gauge["px_per_dioptre"] >= _LEAST_SPREAD_PX
        slope = float(np.polyfit(seen, alone, 1)[0]) if apart else 1.0
        sign = -1.0 if slope < 0.0 and not self.gauge.get("near_first_sure", True) else 1.0
        if self.gauge["scale_from"] == "lens":
            p, q = self._least(lambda x: (float(x[0]), sign), [float(np.mean(alone - sign * seen))])
            return _Solution(p, q, deep=True, directed=apart)
        size = abs(slope) if slope * sign > 0.0 else float(np.mean(alone) / np.mean(seen))
        start = [float(np.mean(alone) - sign * size * np.mean(seen)), np.log(size)]
        p, q = self._least(lambda x: (float(x[0]), sign * float(np.exp(x[1]))), start)
        return _Solution(p, q, deep=True, directed=apart and slope * sign > 0.0)

    def _least(self, of: Callable[[Float[np.ndarray, " numbers"]], tuple[float, float]], start: list[float]) -> tuple[float, float]:
        def off(numbers: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, " facts"]:
            p, q = of(numbers)
            told = [np.log1p(each.error(p, q)) for each in self.equations]
            return np.array([*told, *np.log(np.maximum(p + q * self.stated, _LEAST_DIOPTRES) / self.stated)])

        return of(least_squares(off, start, x_scale="jac").x)


def _told_depth_m(stack: FocalStack) -> Float32[np.ndarray, "height width"]:
    """Depth where the slices tell it, by its confidence or the error of its position in blur; nan elsewhere."""
    depth_m, told = stack.depth_m(), stack.depth_valid(_LEAST_CONFIDENCE)
    channels, gauge = read_exr(stack.depth_path)[0].channels, metres_facts(stack).get("gauge")
    if gauge and POSITION_ERROR in channels:
        range_px = gauge["px_per_dioptre"] * np.ptp([1.0 / each for each in stack.focus_distances_m if each is not None])
        told |= channels[POSITION_ERROR] < max(_SURE_PX, _SURE_SHARE * range_px)
    return np.where(told & np.isfinite(depth_m), depth_m, np.float32(np.nan))


def _depth_at(depth_m: Float32[np.ndarray, "height width"], x: float, y: float) -> float:
    height, width = depth_m.shape
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"pixel {x:g},{y:g} lies outside the picture of {width}x{height} px: read it off the all-in-focus picture")
    for radius_px in range(_NEAR_PIXEL_PX, max(round(_FARTHEST_SHARE * width), _NEAR_PIXEL_PX) + 1):
        rows, columns = (slice(max(int(at) - radius_px, 0), int(at) + radius_px + 1) for at in (y, x))
        if np.isfinite(depth_m[rows, columns]).any():
            return float(np.nanmedian(depth_m[rows, columns]))
    raise InputError(f"nothing at pixel {x:g},{y:g} tells how far away it is: choose a place with texture")


def _now(fact: Fact, depth_m: Float32[np.ndarray, "height width"], camera: Camera) -> float:
    return _Equation.of(fact, depth_m, camera).metres(0.0, 1.0)


def _stated_dioptres(stack: FocalStack) -> Float[np.ndarray, " slices"]:
    """Of the slices that state their focus; as they lie in the stack's present dioptres, which agree with them."""
    told = [each.focus_distance_m for each in stack.slices if each.metadata.get(STATED_KEY) is not None]
    return np.array([1.0 / each for each in told if each], np.float64)


def _told(stack: FocalStack, gauge: Mapping[str, Any], facts: Sequence[Fact], deep: bool) -> dict[str, Any]:
    """The stack's facts about metres, as they are now."""
    guessed = []
    if not deep:
        guessed.append("how deep the scene is for its distance, as all that was told lies at one depth")
    if is_view_guessed(stack):
        guessed.append("the field of view, so that distances stand beside lengths in a guessed proportion")
    count = f"{len(facts)} known lengths and distances" if len(facts) > 1 else str(facts[0])
    told = [asdict(each) for each in facts]
    return {"known": True, "why": f"metres rest on {count}", "guessed": "; ".join(guessed) or None, FACTS: told, "gauge": dict(gauge)}


def _regauged(stack: FocalStack, p: float, q: float) -> FocalStack:
    """The stack with dioptres p + q D; what its metres rest on is left to the caller."""
    slices = tuple(_regauged_slice(stack, each, p, q) for each in stack.slices)
    distances_m = [float(each.focus_distance_m or 0.0) for each in slices]
    gauge = dict(metres_facts(stack)["gauge"])
    gauge |= {"px_per_dioptre": gauge["px_per_dioptre"] / abs(q), "offset_dioptres": p + q * gauge["offset_dioptres"]}
    gauge |= {"nearest_m": min(distances_m), "farthest_m": max(distances_m)}
    gauge |= {"near_first": distances_m[0] < distances_m[-1]}
    facts = dict(metres_facts(stack)) | {"gauge": gauge}
    return replace(stack, slices=slices, lens=_lens_at(stack, distances_m), metadata=stack.metadata | {KEY: facts})


def _regauged_slice(stack: FocalStack, each: Slice, p: float, q: float) -> Slice:
    dioptres = p + q / float(each.focus_distance_m or np.inf)
    if dioptres <= 0.0:
        raise InputError(f"{stack.folder}: by what was told {each.path} is focused beyond infinity: check what you told and tell it again")
    metadata = dict(each.metadata)
    if _GROWTH in metadata:
        metadata[_GROWTH] /= abs(q)
    if _SLICE_POSITION in metadata:
        metadata[_SLICE_POSITION] *= np.sign(q)
    return replace(each, focus_distance_m=1.0 / dioptres, metadata=metadata)


def _lens_at(stack: FocalStack, distances_m: list[float]) -> Lens | None:
    """A stated lens keeps its length; a nominal one is scaled like the world, so that it can focus there and sees the same."""
    lens = stack.lens
    if lens is None or not is_lens_guessed(stack):
        return None if lens is None else lens.focused_at(distances_m[stack.reference])
    factor = min(distances_m) / min(float(old) for old in stack.focus_distances_m if old is not None)
    return replace(
        lens,
        focal_length_mm=lens.focal_length_mm * factor,
        sensor_width_mm=lens.sensor_width_mm * factor,
        sensor_height_mm=None if lens.sensor_height_mm is None else lens.sensor_height_mm * factor,
        focus_distance_m=distances_m[stack.reference],
    )


def _write(stack: FocalStack, p: float, q: float) -> None:
    """Depth with dioptres p + q D, its picture, and stack.json."""
    part = read_exr(stack.depth_path)[0]
    dioptres = np.maximum(p + q / part.channels["Z"].astype(np.float64), _LEAST_DIOPTRES)
    turned = {POSITION: -part.channels[POSITION]} if q < 0.0 and POSITION in part.channels else {}
    write_exr(stack.depth_path, replace(part, channels=dict(part.channels) | {"Z": (1.0 / dioptres).astype(np.float32)} | turned))
    write_focal_stack(stack)
    write_depth_picture(stack)
    write_merge_sheet(stack)
