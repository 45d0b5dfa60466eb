"""Photographs that do not belong among the slices of a stack: of another size, blown, twice the same, of another scene."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from capture.stacks.grouping import Photo
from capture.stacks.slice_looks import SliceLook, one_scene, same_photograph
from mrbokeh.system.errors import InputError

_BLOWN = 0.9
_OTHERS_WELL = 0.6
_BLACK = 0.002
_TIMES_AS_BRIGHT = 30.0
_SAME_FOCUS = 1e-3
_ASKED_OF_EACH = 6
_MOST_SCENES = 12
ALL_THE_SAME = "`mrbokeh capture ingest --group none` takes all"

Odd = dict[int, str]
"""The slices to leave out, by their index, and why."""


@dataclass(frozen=True)
class Candidate:
    """Developed photograph that might become a slice."""

    photo: Photo
    look: SliceLook


def odd_sizes(named: Sequence[tuple[str, tuple[int, int]]]) -> Odd:
    """Find those of another size than most. Raises InputError where no size is the usual one.

    named: file name, and width and height.
    """
    sizes = Counter(size for _, size in named)
    if len(sizes) < 2:
        return {}
    (usual, count), (_, next_count) = sizes.most_common(2)
    if count == next_count:
        listed = ", ".join(f"{name} {_size(size)}" for name, size in named[:6])
        more = " ..." if len(named) > 6 else ""
        raise InputError(
            f"the slices of a stack have one size, but of these {len(named)} photographs no size is the usual one ({listed}{more}): "
            f"put each stack into a folder of its own, or take away what does not belong"
        )
    odd = ((index, size) for index, (_, size) in enumerate(named) if size != usual)
    return {index: f"{_size(size)} px, but most of its stack have {_size(usual)} px" for index, size in odd}


def blown(candidates: Sequence[Candidate]) -> Odd:
    """Find those that are almost all saturated or black while the others are not."""
    odd = {}
    for index, each in enumerate(candidates):
        others = [other.look for at, other in enumerate(candidates) if at != index]
        if not others:
            continue
        if each.look.full >= _BLOWN and median(other.full for other in others) <= _OTHERS_WELL:
            odd[index] = f"{100 * each.look.full:.0f} % of it is saturated, unlike the rest of its stack"
        elif each.look.brightest <= min(_BLACK, median(other.brightest for other in others) / _TIMES_AS_BRIGHT):
            odd[index] = "it is almost black, unlike the rest of its stack"
    return odd


def duplicates(candidates: Sequence[Candidate]) -> Odd:
    """Find those that are all but identical with an earlier one, unless their files state another focus."""
    odd: Odd = {}
    for index, each in enumerate(candidates):
        kept = (other for at, other in enumerate(candidates[:index]) if at not in odd)
        twin = next((other for other in kept if _same_focus(each.photo, other.photo) and same_photograph(each.look, other.look)), None)
        if twin is not None:
            odd[index] = f"it is the same photograph as {twin.photo.path.name}"
    return odd


def other_scenes(candidates: Sequence[Candidate]) -> Odd:
    """Find those of another scene than most. Raises InputError where no scene has more than half of them."""
    scenes = sorted(_scenes([each.look for each in candidates]), key=len, reverse=True)
    if len(scenes) < 2:
        return {}
    if 2 * len(scenes[0]) <= len(candidates):
        first, second = (candidates[scene[0]].photo.path.name for scene in scenes[:2])
        raise InputError(
            f"these {len(candidates)} photographs show different scenes ({first} is unlike {second}): "
            f"put each stack into a folder of its own ({ALL_THE_SAME})"
        )
    return {index: f"it shows another scene than most of its stack ({ALL_THE_SAME})" for scene in scenes[1:] for index in scene}


def _scenes(looks: Sequence[SliceLook]) -> list[list[int]]:
    """Return indices that hang together: first each with the one before it, then what that leaves apart with some of every other scene.

    Many scenes are not compared: that is a folder of stacks, not a stack with one or two strange photographs.
    """
    scenes: list[list[int]] = []
    for index, look in enumerate(looks):
        if scenes and one_scene(looks[scenes[-1][-1]], look):
            scenes[-1].append(index)
        else:
            scenes.append([index])
    if len(scenes) > _MOST_SCENES:
        return scenes
    joined: list[list[int]] = []
    for scene in scenes:
        related = [other for other in joined if _hang_together(looks, scene, other)]
        joined = [other for other in joined if other not in related] + [sorted([*scene, *(each for other in related for each in other)])]
    return joined


def _hang_together(looks: Sequence[SliceLook], scene: Sequence[int], other: Sequence[int]) -> bool:
    """Compare the pairs that lie nearest to each other in the order of the slices: their blur differs least."""
    pairs = sorted(((first, second) for first in scene for second in other), key=lambda pair: abs(pair[0] - pair[1]))
    return any(one_scene(looks[first], looks[second]) for first, second in pairs[:_ASKED_OF_EACH])


def _same_focus(first: Photo, second: Photo) -> bool:
    """Tell whether two are focused alike as far as is stated; in dioptres, because of infinity."""
    distances_m = first.focus_distance_m, second.focus_distance_m
    if distances_m[0] is None or distances_m[1] is None:
        return distances_m[0] is distances_m[1]
    return abs(1.0 / distances_m[0] - 1.0 / distances_m[1]) <= _SAME_FOCUS


def _size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"
