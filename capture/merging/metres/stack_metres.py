"""Metres for one stack whose focus distances nobody stated, from lengths and distances that the user knows.

Its dioptres are known up to D' = p + q D, for blur in pixels is the same with px_per_dioptre / q. The rule: what the photographs state
stays (a stated lens fixes q = 1, a stated focus distance counts as one more fact); the facts told fix the rest by least squares of their
relative errors; and where there is one fact, or all lie at one depth, the world is scaled as a whole (p = 0), which keeps the
proportions that are guessed.
The same holds where a slice is stated at infinity, which stays there: then one fact gives all.
Blur looks alike on both sides of the focus: where merging had to guess which end of the sweep is near, facts at two depths tell (q < 0).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import least_squares

from capture.merging.metres.known_metres import NEAREST_OPTION, Fact, stored_facts, with_known_nearest, write_changed_metres
from capture.merging.metres.relative_stack import FROM_DISTANCES
from mrbokeh.images.exr_io import read_exr
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import GROWTH, METRES, FocalStack, Slice
from mrbokeh.stacks.guessed_metres import (
    POSITION_ERROR,
    STATED_DISTANCE,
    TOLD,
    guesses,
    is_lens_guessed,
    is_near_first,
    is_view_guessed,
    metres_facts,
)
from mrbokeh.system.errors import InputError

_NEAR_PIXEL_PX = 2
_FARTHEST_SHARE = 0.01
"""Share of the picture's width: from no farther away a surface is taken for what is at a pixel, where nothing tells the depth there."""
_LEAST_CONFIDENCE = 0.1
_SURE_PX, _SURE_SHARE = 1.0, 0.05
"""A place is known whose position is known to so many pixels of blur, or that share of the range of the slices."""
_LEAST_SPREAD_PX = 3.0
"""Facts whose surfaces differ in blur by less lie at one depth: they cannot tell how deep the scene is."""
_CONTRADICTS = 0.1
_LEAST_DIOPTRES = 1e-6
_Unknowns = Callable[[Float[np.ndarray, " numbers"]], tuple[float, float]]


@dataclass(frozen=True)
class ScaledStack:
    """A stack with other metres. stack: as written. errors: by how much each fact told is missed, as a share."""

    stack: FocalStack
    errors: tuple[tuple[Fact, float], ...]


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
    """A solution D' = p + q D. deep: whether both rest on facts. directed: whether facts tell which end of the sweep is near."""

    p: float
    q: float
    deep: bool
    directed: bool


def apply_known_metres(stack: FocalStack, told: Sequence[Fact], overwrite: bool = False) -> ScaledStack:
    """Put the metres that follow from all facts told into stack.json and depth.exr. overwrite: earlier ones count no more.

    Raises InputError where the stack's metres are known already, or facts contradict one another.
    """
    depth_m = _told_depth_m(stack)
    facts = _with_earlier(stack, told, overwrite)
    camera, known = stack.camera, metres_facts(stack)
    if not known or camera is None or (known.get("known") and TOLD not in known):
        now = (f"{each} is {_Equation.of(each, depth_m, camera).metres(0.0, 1.0):.4g} m by them" for each in told if camera is not None)
        sizes = "; ".join(now)
        raise InputError(
            f"{stack.folder} knows its metres from its focus distances{' (' + sizes + ')' if sizes else ''}: to correct them state focus "
            f"distances in lens.toml and merge again, or find the scale of camera poses with --board or --distance"
        )
    if "gauge" not in known:
        raise InputError(f"{stack.folder} was made from another stack, with another lens: tell that stack, and make this one again")
    equations = [_Equation.of(each, depth_m, camera) for each in facts]
    found = _solution(equations, _stated_dioptres(stack), known["gauge"])
    changed = _rescaled(stack, found.p, found.q)
    gauge = dict(changed.metadata[METRES]["gauge"]) | {"offset_from": TOLD}
    gauge |= {} if gauge["scale_from"] == "lens" else {"scale_from": TOLD}
    if found.directed:
        gauge |= {"near_first_from": TOLD, "near_first_sure": True}
        changed = with_known_nearest(changed, found.q < 0.0)
    changed = replace(changed, metadata=changed.metadata | {METRES: _known_facts(stack, gauge, facts, found.deep)})
    _write(changed, found.p, found.q)
    return ScaledStack(changed, tuple((each.fact, each.error(found.p, found.q)) for each in equations))


def apply_known_nearest(stack: FocalStack, first: bool) -> FocalStack:
    """Put what the user knows of the sweep's direction into stack.json and depth.exr: that its first (or last) slice is the nearest.

    Turned in the middle of its planes of focus, or so that a stated distance and lengths told of one depth stay. Raises InputError where
    stated focus distances, or lengths and distances at several depths, say it already.
    """
    if not stack.merged:
        raise InputError(f"{stack.folder} is not merged: run `mrbokeh capture merge {stack.folder}` first")
    gauge, stated = metres_facts(stack).get("gauge"), _stated_dioptres(stack)
    by_distances = len(stated) > 1 or 0.0 in stated
    if not gauge or gauge.get("near_first_from") in (TOLD, FROM_DISTANCES) or by_distances:
        raise InputError(f"{stack.folder}: which slice is nearest is already known; --nearest is for stacks that have to guess it")
    turned = is_near_first(stack) != first
    p, q = _turn(stack, stated) if turned else (0.0, 1.0)
    changed = with_known_nearest(_rescaled(stack, p, q), turned)
    facts = changed.metadata[METRES]
    known = {"near_first_from": NEAREST_OPTION, "near_first_sure": True}
    changed = replace(changed, metadata=changed.metadata | {METRES: facts | {"gauge": facts["gauge"] | known}})
    _write(changed, p, q)
    return changed


def lines_of(done: ScaledStack) -> list[str]:
    """Return lines that tell people what was found."""
    distances_m = [each for each in done.stack.focus_distances_m if each is not None]
    facts = metres_facts(done.stack)
    lines = [f"{done.stack.folder}: focused from {min(distances_m):.4g} m to {max(distances_m):.4g} m from the lens, {facts['why']}"]
    guessed = guesses(done.stack)
    lines += [f"{done.stack.folder}: still guessed: {guessed}"] if guessed else []
    off = [f"{fact} by {100 * error:+.1f} %" for fact, error in done.errors if abs(error) > _CONTRADICTS]
    return [*lines, f"warning: what was told disagrees: {', '.join(off)}: look at the pixels and measure again"] if off else lines


def _turn(stack: FocalStack, stated: Float[np.ndarray, " slices"]) -> tuple[float, float]:
    """Return p and q below 0 that turn the stack; what is stated or told stays at its dioptres."""
    facts, dioptres = metres_facts(stack), [1.0 / each for each in stack.focus_distances_m if each]
    depth_m = _told_depth_m(stack)
    told = [1.0 / _depth_at(depth_m, *pixel) for each in stored_facts(stack) for pixel in each.pixels]
    kept, ends = [*stated, *told], min(dioptres) + max(dioptres)
    if not kept:
        return ends, -1.0
    if facts["gauge"]["scale_from"] == "lens":
        return 2.0 * float(np.mean(kept)), -1.0
    factor = float(np.mean(kept)) / (ends - float(np.mean(kept)))
    return ends * factor, -factor


def _with_earlier(stack: FocalStack, told: Sequence[Fact], overwrite: bool) -> tuple[Fact, ...]:
    """Return facts of earlier calls, and the new ones in place of those at the same pixels."""
    earlier = [] if overwrite else stored_facts(stack)
    return tuple({each.pixels: each for each in (*earlier, *told)}.values())


def _solution(equations: Sequence[_Equation], stated: Float[np.ndarray, " slices"], gauge: Mapping[str, Any]) -> _Solution:
    """Solve by least squares; q is below 0 where the facts tell that what was taken for near is far.

    stated: dioptres of slices whose focus the photographs state. gauge: of the stack, as merging or an earlier call left it.
    """
    finite = stated[stated > 0.0]
    seen = np.array([*(each.dioptres.mean() for each in equations), *finite])
    # What each fact would make of its own dioptres alone.
    alone = np.array([*(each.dioptres.mean() * each.metres(0.0, 1.0) / each.fact.metres for each in equations), *finite])
    deep = float(np.ptp(np.concatenate([seen, *(each.dioptres for each in equations)]))) * gauge["px_per_dioptre"]
    at_infinity, by_lens = len(finite) < len(stated), gauge["scale_from"] == "lens"
    if not by_lens and (at_infinity or deep < _LEAST_SPREAD_PX or len(seen) < 2):
        return _Solution(0.0, float(np.exp(np.mean(np.log(alone / seen)))), deep=at_infinity, directed=False)
    apart = float(np.ptp(seen)) * gauge["px_per_dioptre"] >= _LEAST_SPREAD_PX
    slope = float(np.polyfit(seen, alone, 1)[0]) if apart else 1.0
    sign = -1.0 if slope < 0.0 and not gauge.get("near_first_sure", True) else 1.0
    if by_lens:
        p, q = _least_squares(equations, finite, lambda x: (float(x[0]), sign), [float(np.mean(alone - sign * seen))])
        return _Solution(p, q, deep=True, directed=apart)
    size = abs(slope) if slope * sign > 0.0 else float(np.mean(alone) / np.mean(seen))
    start = [float(np.mean(alone) - sign * size * np.mean(seen)), np.log(size)]
    p, q = _least_squares(equations, finite, lambda x: (float(x[0]), sign * float(np.exp(x[1]))), start)
    return _Solution(p, q, deep=True, directed=apart and slope * sign > 0.0)


def _least_squares(
    equations: Sequence[_Equation], stated: Float[np.ndarray, " slices"], of: _Unknowns, start: list[float]
) -> tuple[float, float]:
    """Return p and q of the least relative errors. of: p and q of the unknown numbers. stated: dioptres above 0."""

    def off(numbers: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, " facts"]:
        p, q = of(numbers)
        told = [np.log1p(each.error(p, q)) for each in equations]
        return np.array([*told, *np.log(np.maximum(p + q * stated, _LEAST_DIOPTRES) / stated)])

    return of(least_squares(off, start, x_scale="jac").x)


def _told_depth_m(stack: FocalStack) -> Float32[np.ndarray, "height width"]:
    """Return depth where the slices tell it, by its confidence or the error of its position in blur; nan elsewhere."""
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


def _stated_dioptres(stack: FocalStack) -> Float[np.ndarray, " slices"]:
    """Return dioptres of the slices that state their focus, as they lie in the stack's present ones, which agree with them."""
    told = [each.focus_distance_m for each in stack.slices if each.metadata.get(STATED_DISTANCE) is not None]
    return np.array([1.0 / each for each in told if each], np.float64)


def _known_facts(stack: FocalStack, gauge: Mapping[str, Any], facts: Sequence[Fact], deep: bool) -> dict[str, Any]:
    """Return what is known of the stack's metres when all facts are told."""
    guessed = []
    if not deep:
        guessed.append("how deep the scene is for its distance, as all that was told lies at one depth")
    if is_view_guessed(stack):
        guessed.append("the field of view, so that distances stand beside lengths in a guessed proportion")
    count = f"{len(facts)} known lengths and distances" if len(facts) > 1 else str(facts[0])
    told = [asdict(each) for each in facts]
    return {"known": True, "why": f"metres rest on {count}", "guessed": "; ".join(guessed) or None, TOLD: told, "gauge": dict(gauge)}


def _rescaled(stack: FocalStack, p: float, q: float) -> FocalStack:
    """Return the stack with dioptres p + q D; what its metres rest on is left to the caller."""
    slices = tuple(_rescaled_slice(stack, each, p, q) for each in stack.slices)
    distances_m = [float(each.focus_distance_m or 0.0) for each in slices]
    gauge = dict(metres_facts(stack)["gauge"])
    gauge |= {"px_per_dioptre": gauge["px_per_dioptre"] / abs(q), "offset_dioptres": p + q * gauge["offset_dioptres"]}
    gauge |= {"near_first": distances_m[0] < distances_m[-1]}
    facts = dict(metres_facts(stack)) | {"gauge": gauge}
    return replace(stack, slices=slices, lens=_lens_at(stack, distances_m), metadata=stack.metadata | {METRES: facts})


def _rescaled_slice(stack: FocalStack, each: Slice, p: float, q: float) -> Slice:
    dioptres = p + q / float(each.focus_distance_m or np.inf)
    if dioptres < 0.0:
        raise InputError(f"{stack.folder}: by what was told {each.path} is focused beyond infinity: check what you told and tell it again")
    growth = {GROWTH: each.metadata[GROWTH] / abs(q)} if GROWTH in each.metadata else {}
    return replace(each, focus_distance_m=1.0 / dioptres if dioptres else float("inf"), metadata=each.metadata | growth)


def _lens_at(stack: FocalStack, distances_m: list[float]) -> Lens | None:
    """Return the lens: a stated one keeps its length; a nominal one is scaled like the world, so that it sees the same and can focus."""
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
    """Write the stack, and its depth with dioptres p + q D."""
    dioptres = np.maximum(p + q / stack.depth_m().astype(np.float64), _LEAST_DIOPTRES)
    write_changed_metres(stack, (1.0 / dioptres).astype(np.float32), turned=q < 0.0)
