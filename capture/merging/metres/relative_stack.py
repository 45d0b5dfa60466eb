"""Merged stacks whose focus distances nobody stated: blur as solved from the slices, in metres that are guessed and say so.

Circles of confusion need no metres: positions in pixels of blur are affine in dioptres. Two numbers make dioptres of them, a scale and an
offset. Stated distances, or the focal length, f-number and sensor of the lens, tell one or both; what remains is put so that the farthest
plane of focus is twice as far as the nearest, and without any of that they lie at 2 m and 1 m.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from capture.merging.depth_edges import with_edges_of_light
from capture.merging.depth_from_focus import FocusMap
from capture.merging.metres.focus_order import Contours, Direction, focus_order
from capture.merging.metres.relative_focus import RelativeFocus, solve_relative_focus
from capture.merging.registration.registered_slices import IngestedSlices, RegisteredSlices, source_path
from mrbokeh.images.camera_rgb import half_of
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.optics.camera import camera_from_json, camera_of_lens, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.stacks.focal_stack import GROWTH, GROWTH_WIDTH, METRES, FocalStack, Slice
from mrbokeh.stacks.guessed_metres import POSITION, POSITION_ERROR, SLICE_POSITION, SLICE_POSITION_ERROR, STATED_BEFORE, STATED_DISTANCE

ORDER = "order_by_focus"
"""Key in a stack's metadata: said in words that its slices were put in the order of their focus, which their names are not."""
GIVEN_INDEX = "given_index"
FROM_DISTANCES = "stated distances"
"""Source of a direction that these tell."""
_NEAREST_DIOPTRES, _FARTHEST_DIOPTRES = 1.0, 0.5
_FAR_OVER_NEAR = 2.0
_LEAST_DIOPTRES = 1e-3
_LEAST_RANGE_PX = 0.5
_NEAREST_SHARE = 0.8
"""Share of the reciprocal of the focal length: nearer a lens is not taken to focus."""
_LENS_FACTS = ("focal_length_mm", "f_number", "sensor_width_mm")
_SENSOR_MM, _FOCAL_LENGTH_MM = 36.0, 35.0

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Gauge:
    """Conversion of pixels of blur, for positions that grow towards the camera: dioptres = offset_dioptres + position_px / px_per_dioptre.

    scale_from, offset_from: "distances", "lens" or "guess".
    """

    px_per_dioptre: float
    offset_dioptres: float
    scale_from: str
    offset_from: str

    def dioptres(self, positions_px: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        return np.maximum(self.offset_dioptres + np.asarray(positions_px) / self.px_per_dioptre, _LEAST_DIOPTRES)

    @property
    def known(self) -> bool:
        return "guess" not in (self.scale_from, self.offset_from)


def as_stated(stack: FocalStack) -> FocalStack:
    """Return the stack without anything that an earlier merge guessed, its slices in the order in which they came."""
    stack = _in_given_order(stack)
    if STATED_BEFORE not in stack.metadata:
        return stack
    kept: Mapping[str, Any] = stack.metadata[STATED_BEFORE]
    metadata = {key: value for key, value in stack.metadata.items() if key not in (STATED_BEFORE, METRES)}
    return replace(
        stack,
        slices=tuple(_stated_slice(each) for each in stack.slices),
        lens=None if kept["lens"] is None else lens_from_json(kept["lens"], str(stack.folder)),
        camera=None if kept["camera"] is None else camera_from_json(kept["camera"]),
        metadata=metadata,
    )


def in_focus_order(stack: FocalStack, ingested: IngestedSlices) -> FocalStack:
    """Return the stack with its slices, as ingested, sorted by their focus where pictures say that they came in another order."""
    if stack.is_metric:
        return stack
    found = focus_order(lambda index: ingested.read(stack.folder / source_path(stack.slices[index]))[0], len(stack))
    if found == tuple(range(len(stack))):
        return stack
    slices = tuple(replace(stack.slices[i], metadata=stack.slices[i].metadata | {GIVEN_INDEX: i}) for i in found)
    names = ", ".join(str(each.metadata.get("source", each.path)) for each in slices)
    why = f"the slices were not in the order of their focus and have been put in it, as the pictures tell: {names}"
    reference = found.index(stack.reference)
    return replace(stack, slices=slices, reference=reference, metadata=stack.metadata | {ORDER: why})


def with_solved_blur(merged: FocalStack, slices: RegisteredSlices, all_in_focus: Rgb, focus: FocusMap) -> FocalStack:
    """Solve the blur of registered slices and write it to depth.exr; the stack that comes back has it and guessed metres."""
    index, confidence = focus.focus_index, focus.confidence
    contours = Contours.of(index)
    passing = lambda: contours.watching(slices.stored())  # noqa: E731
    relative = solve_relative_focus(passing, all_in_focus, index, confidence, len(merged), slices.valid, slices.saturated)
    scales, as_given = [each.scale for each in merged.slices], ORDER not in merged.metadata
    direction = stated_direction(merged, relative) or contours.direction(relative.positions_px, scales, as_given)
    size_px = all_in_focus.shape[1], all_in_focus.shape[0]
    gauge = gauge_of(merged, nearness_px(relative.positions_px, direction), size_px)
    guessed = with_guessed_metres(merged, relative, direction, gauge, size_px)
    focus = with_edges_of_light(focus, all_in_focus, near_first=direction.near_first)
    write_relative_depth(guessed, focus, relative.with_index(index, focus.focus_index), direction, gauge)
    return guessed


def with_guessed_metres(
    stated: FocalStack, relative: RelativeFocus, direction: Direction, gauge: Gauge, size_px: tuple[int, int]
) -> FocalStack:
    """Return the merged stack, in which nothing is guessed yet, with all focus distances, a camera and a lens that blurs as solved.

    size_px: (width, height).
    """
    positions_px = nearness_px(relative.positions_px, direction)
    found = zip(gauge.dioptres(positions_px), stated.focus_distances_m, strict=True)
    distances_m = [1.0 / float(dioptres) if stated_m is None else stated_m for dioptres, stated_m in found]
    growth = gauge.px_per_dioptre
    slices = tuple(
        replace(
            each,
            focus_distance_m=distance_m,
            metadata=each.metadata
            | {
                STATED_DISTANCE: "inf" if each.focus_distance_m == float("inf") else each.focus_distance_m,
                SLICE_POSITION: float(position),
                SLICE_POSITION_ERROR: float(error),
                # Blur grows alike in all registered slices, so less in those that registration enlarged.
                GROWTH: growth / each.scale,
                GROWTH_WIDTH: size_px[0],
            },
        )
        for each, distance_m, position, error in zip(stated.slices, distances_m, positions_px, relative.errors_px, strict=True)
    )
    lens = _nominal_lens(stated, size_px, growth, distances_m[stated.reference], min(distances_m))
    before = {
        "lens": None if stated.lens is None else lens_to_json(stated.lens),
        "camera": None if stated.camera is None else camera_to_json(stated.camera),
    }
    facts = {"known": gauge.known, "why": _why(gauge, stated), "gauge": _gauge_json(gauge, direction)}
    metadata = stated.metadata | {METRES: facts, STATED_BEFORE: before}
    return replace(stated, slices=slices, lens=lens, camera=stated.camera or camera_of_lens(lens, *size_px), metadata=metadata)


def gauge_of(stated: FocalStack, positions_px: Float[np.ndarray, " slices"], size_px: tuple[int, int]) -> Gauge:
    """Return scale and offset from what is known, else guessed. positions_px: growing towards the camera."""
    told = [(float(p), 1.0 / d) for p, d in zip(positions_px, stated.focus_distances_m, strict=True) if d is not None]
    spread_px = max(float(np.ptp(positions_px)), _LEAST_RANGE_PX)
    farthest_px = float(np.min(positions_px))
    if len(told) >= 2 and np.ptp([p for p, _ in told]) > _LEAST_RANGE_PX:
        slope, offset = np.polyfit([p for p, _ in told], [d for _, d in told], 1)
        if slope > 0:
            return Gauge(1.0 / float(slope), float(offset), "distances", "distances")
    growth = _stated_growth(stated, size_px[0])
    if growth is not None and told:
        return Gauge(growth, float(np.mean([d - p / growth for p, d in told])), "lens", "distances")
    if growth is not None and _focuses(stated, _FAR_OVER_NEAR / (_FAR_OVER_NEAR - 1.0) * spread_px / growth):
        return Gauge(growth, spread_px / growth / (_FAR_OVER_NEAR - 1.0) - farthest_px / growth, "lens", "guess")
    if told:
        # The farthest plane is at D, the nearest at twice that; the stated one lies between them as its position does.
        shares = [1.0 + (_FAR_OVER_NEAR - 1.0) * (p - farthest_px) / spread_px for p, _ in told]
        farthest = float(np.mean([d / share for (_, d), share in zip(told, shares, strict=True)]))
        if farthest < _LEAST_DIOPTRES:
            # At infinity: twice that is no depth to guess. Where the slices lie is known, how deep they go is as if nothing were.
            growth = spread_px / (_NEAREST_DIOPTRES - _FARTHEST_DIOPTRES)
            return Gauge(growth, float(np.mean([d - p / growth for p, d in told])), "guess", "distances")
        growth = spread_px / ((_FAR_OVER_NEAR - 1.0) * farthest)
        return Gauge(growth, farthest - farthest_px / growth, "guess", "distances")
    growth = spread_px / (_NEAREST_DIOPTRES - _FARTHEST_DIOPTRES)
    return Gauge(growth, _FARTHEST_DIOPTRES - farthest_px / growth, "guess", "guess")


def stated_direction(stack: FocalStack, relative: RelativeFocus) -> Direction | None:
    """Return the direction that two or more stated distances tell, or one at infinity, beyond which nothing lies; else None."""
    told = [(p, 1.0 / d) for p, d in zip(relative.positions_px, stack.focus_distances_m, strict=True) if d is not None]
    if len({d for _, d in told}) > 1:
        slope = np.polyfit([p for p, _ in told], [d for _, d in told], 1)[0]
        return Direction(near_first=bool(slope < 0), source=FROM_DISTANCES, sure=True)
    middle_px = 0.5 * (relative.positions_px[0] + relative.positions_px[-1])
    far_last = {bool(p > middle_px) for p, d in told if d == 0.0}
    return Direction(near_first=far_last.pop(), source=FROM_DISTANCES, sure=True) if len(far_last) == 1 else None


def nearness_px(positions_px: Float[np.ndarray, "*batch"], direction: Direction) -> Float[np.ndarray, "*batch"]:
    """Return positions that grow towards the camera, as dioptres do."""
    return -positions_px if direction.near_first else positions_px


def write_relative_depth(stack: FocalStack, focus: FocusMap, relative: RelativeFocus, direction: Direction, gauge: Gauge) -> None:
    """Write depth.exr of a stack of `with_guessed_metres`: with Z in its metres, and where surfaces lie in pixels of blur."""
    position_px = nearness_px(relative.focus_px, direction).astype(np.float32)
    channels = {
        "focus_index": focus.focus_index,
        "confidence": half_of(focus.confidence),
        "Z": (1.0 / gauge.dioptres(position_px)).astype(np.float32),
        POSITION: position_px,
        POSITION_ERROR: half_of(relative.error_px),
    }
    write_exr(stack.depth_path, ExrPart(channels), compress=False)


def _stated_slice(each: Slice) -> Slice:
    ours = (STATED_DISTANCE, SLICE_POSITION, SLICE_POSITION_ERROR, GROWTH, GROWTH_WIDTH)
    stated = each.metadata.get(STATED_DISTANCE)
    metadata = {key: value for key, value in each.metadata.items() if key not in ours}
    return replace(each, focus_distance_m=None if stated is None else float(stated), metadata=metadata)


def _in_given_order(stack: FocalStack) -> FocalStack:
    if ORDER not in stack.metadata:
        return stack
    order = sorted(range(len(stack)), key=lambda index: stack.slices[index].metadata[GIVEN_INDEX])
    slices = tuple(
        replace(each, metadata={key: value for key, value in each.metadata.items() if key != GIVEN_INDEX})
        for each in (stack.slices[index] for index in order)
    )
    metadata = {key: value for key, value in stack.metadata.items() if key != ORDER}
    return replace(stack, slices=slices, reference=order.index(stack.reference), metadata=metadata)


def _stated_growth(stated: FocalStack, width_px: int) -> float | None:
    """Return the pixels of blur per dioptre of the lens that the photographs state, focused far away; None where they state none."""
    facts = _stated_lens(stated)
    if facts is None:
        return None
    return width_px / facts["sensor_width_mm"] * facts["focal_length_mm"] ** 2 / facts["f_number"] / 1000.0


def _focuses(stated: FocalStack, dioptres: float) -> bool:
    """Return whether the stated lens can be focused so near at all."""
    facts = _stated_lens(stated)
    return facts is not None and dioptres * facts["focal_length_mm"] < _NEAREST_SHARE * 1000.0


def _stated_lens(stated: FocalStack) -> dict[str, float] | None:
    """Return focal_length_mm, f_number and sensor_width_mm, where all are known."""
    if stated.lens is not None:
        return {name: getattr(stated.lens, name) for name in _LENS_FACTS}
    facts = stated.metadata.get("optics") or {}
    return {name: float(facts[name]) for name in _LENS_FACTS} if all(facts.get(name) for name in _LENS_FACTS) else None


def _nominal_lens(stated: FocalStack, size_px: tuple[int, int], growth: float, focus_m: float, nearest_m: float) -> Lens:
    facts = _stated_lens(stated)
    if facts is not None and _focuses(stated, 1.0 / nearest_m):
        lens = stated.lens or Lens(facts["focal_length_mm"], facts["f_number"], focus_m, facts["sensor_width_mm"])
        return lens.focused_at(focus_m)
    sensor_mm = _SENSOR_MM * min(1.0, size_px[0] / size_px[1])
    guess = Lens(min(_FOCAL_LENGTH_MM, _NEAREST_SHARE * 1000.0 * nearest_m), 1.0, focus_m, sensor_mm)
    return replace(guess, f_number=guess.coc_px_per_dioptre(size_px[0]) / growth)


def _why(gauge: Gauge, stated: FocalStack) -> str:
    told = sum(each is not None for each in stated.focus_distances_m)
    blur = "blur in pixels is solved from the slices"
    match gauge.scale_from, gauge.offset_from:
        case "distances", _:
            return f"{blur}, metres are those of {told} of {len(stated)} stated focus distances"
        case "lens", "distances":
            return f"{blur}, metres follow from the stated lens and {told} of {len(stated)} focus distances"
        case "lens", _:
            return f"{blur} and the lens is stated, but no focus distance: how far away all lies is a guess"
        case _, "distances":
            return f"{blur} and one focus distance is stated; how deep the scene is remains a guess"
    return f"{blur}; no focus distance is stated: the nearest plane of focus is put at 1 m and the farthest at 2 m"


def _gauge_json(gauge: Gauge, direction: Direction) -> dict[str, Any]:
    return {
        "px_per_dioptre": gauge.px_per_dioptre,
        "offset_dioptres": gauge.offset_dioptres,
        "scale_from": gauge.scale_from,
        "offset_from": gauge.offset_from,
        "near_first": direction.near_first,
        "near_first_from": direction.source,
        "near_first_sure": direction.sure,
        "near_first_z": direction.z,
    }
