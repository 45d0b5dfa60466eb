"""Registration of a focal stack: undoes focus breathing and small movements by one transform per slice.

Neighbours are matched coarsely by masked ECC and then by tracked corners; slices three apart by corners alone. All tracks
together give the transforms: similarities, or homographies where a camera in the hand has turned so far that a similarity leaves corners
clearly apart. The breathing of the lens is the prior: it rejects matches, stands in where none
holds, and is kept as it is where the camera did not move.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.registration.corner_tracks import CornerTracks, SliceStructure, distances_px, structure_of
from capture.merging.registration.pair_matching import (
    NOTICEABLE_PX,
    PairMatch,
    joint_transforms,
    match_from,
    match_neighbours,
)
from capture.merging.registration.plane_transforms import (
    Transform,
    about_centre,
    chained,
    farthest_corner_px,
    inverse,
    middle_of,
    moved,
    scale_of,
    scaled_about,
)
from capture.merging.registration.registration_file import Breathing, Pair, Registration, breathing_of
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_LAID_SCATTER_PX = 0.01
# Blur that differs at depth edges moves tracks by up to about this much over a stack; less is no movement of the camera.
LEAST_MOVEMENT_PX = 0.25
# Slices are moved if that brings corners nearer by this factor, or if it moves them by more than this share of half the diagonal.
CLEARLY_BETTER = 1.7
LARGEST_SEEMING_SHARE = 0.0075
# Besides neighbours, slices this far apart are matched: a longer lever stops drift, and more blur costs little yet.
_LONG_STRIDE = 3

Rgb = Float32[np.ndarray, "height width 3"]
Valid = Bool[np.ndarray, "height width"]


def register_stack(
    read_rgb: Callable[[int], Rgb],
    count: int,
    prior_scales: Sequence[float] | None = None,
    read_valid: Callable[[int], Valid] | None = None,
    unknown_scales: Collection[int] = (),
) -> Registration:
    """Register slices 0 to count - 1, neighbours in focus being neighbours in order.

    read_rgb: gives slice i; one picture is held at a time.
    prior_scales: expected magnification of each slice (image distances of the thin lens), where the lens is known.
    read_valid: where slice i has data that is not saturated; None is everywhere. Raises InputError if sizes differ.
    unknown_scales: slices whose prior is a guess (infinity by a sentinel), which pictures override.
    """
    matches, size_px = _matched(read_rgb, count, prior_scales, read_valid)
    scales = {pair: scale_of(match.target_from_source, middle_of(size_px)) for pair, match in matches.items() if match.tracks is not None}
    breathing = breathing_of(count, scales, prior_scales, unknown_scales)
    held = {pair: tracks for pair, match in matches.items() if (tracks := match.tracks) and breathing.allows(pair, scales[pair])}
    linked = with_links(count, held, matches, breathing, size_px)
    first_from_slice = joint_transforms(count, linked, size_px)
    settled, camera_moved = _settled(first_from_slice, breathing, held, size_px)
    if camera_moved and held:
        turned = joint_transforms(count, linked, size_px, perspective=True)
        settled = turned if _is_clearly_nearer(turned, settled, held) else settled
    reference, transforms = _to_narrowest(settled, size_px)
    correlations = tuple(matches[i, i + 1].correlation for i in range(count - 1))
    residuals_px = _residuals_px(transforms, {pair: matches[pair] for pair in held}, size_px)
    return Registration(
        reference=reference,
        reference_from_slice=transforms,
        correlations=correlations,
        residuals_px=residuals_px,
        size_px=size_px,
        breathing=breathing,
        camera_moved=camera_moved,
    )


def _matched(
    read_rgb: Callable[[int], Rgb], count: int, prior_scales: Sequence[float] | None, read_valid: Callable[[int], Valid] | None
) -> tuple[dict[Pair, PairMatch], tuple[int, int]]:
    """Match pairs (target, source) one and three slices apart; return the matches and the size of the slices."""
    far = max(1, min(_LONG_STRIDE, count - 1))
    matches: dict[Pair, PairMatch] = {}
    recent: dict[int, SliceStructure] = {}
    for j in track(range(count), "matching slices"):
        recent[j] = structure_of(read_rgb(j), None if read_valid is None else read_valid(j))
        _require_same_size(recent[max(j - 1, 0)], recent[j], j)
        if j >= 1:
            expected = 1.0 if prior_scales is None else prior_scales[j - 1] / prior_scales[j]
            matches[j - 1, j] = match_neighbours(recent[j - 1], recent[j], expected)
        if j >= far > 1:
            steps = [matches[i, i + 1].target_from_source for i in range(j - far, j)]
            matches[j - far, j] = match_from(recent[j - far], recent[j], reduce(chained, steps))
        recent.pop(j - far, None)
    return matches, recent[count - 1].size_px


def _require_same_size(one: SliceStructure, other: SliceStructure, index: int) -> None:
    if one.size_px != other.size_px:
        raise InputError(
            f"expected all slices of a stack to have one size, but slice {index} has {other.size_px[0]} x {other.size_px[1]} px "
            f"and the one before it {one.size_px[0]} x {one.size_px[1]} px: put photographs of different sizes into different stacks"
        )


def _settled(
    measured: Sequence[Transform], breathing: Breathing, held: Mapping[Pair, CornerTracks], size_px: tuple[int, int]
) -> tuple[Sequence[Transform], bool]:
    """Return (first_from_slice, whether the camera moved), with the lens's own breathing wherever pictures cannot tell it apart.

    First for all of the transforms, then for their scales alone, which drift most: depth edges pull all tracks the same way. Where no lens
    is known, slices that lie on one another as they are stay so: resampling blurs.
    """
    count = len(measured)
    if breathing.source != "lens":
        return ([np.eye(2, 3)] * count, False) if _fit_as_they_are(measured, held, size_px) else (measured, True)
    still = [about_centre(breathing.scale(0, i), *size_px) for i in range(count)]
    if _departure_px(measured, still, size_px) < LEAST_MOVEMENT_PX:
        return still, False
    pivot = np.concatenate([each.source_px for each in held.values()]).mean(axis=0)
    half_diagonal_px = 0.5 * float(np.hypot(*size_px))
    scales_px = [half_diagonal_px * abs(scale_of(measured[i]) / breathing.scale(0, i) - 1.0) for i in range(count)]
    if max(scales_px) >= LEAST_MOVEMENT_PX:
        return measured, True
    return [scaled_about(pivot, measured[i], breathing.scale(0, i)) for i in range(count)], True


def _fit_as_they_are(measured: Sequence[Transform], held: Mapping[Pair, CornerTracks], size_px: tuple[int, int]) -> bool:
    """Return whether corners lie about as well on one another in unmoved slices as in moved ones.

    Depth edges and uneven blur pull corners by half a pixel and more, all of them together, and so a fit always finds a little to move.
    """
    if not held or _departure_px(measured, [np.eye(2, 3)] * len(measured), size_px) > LARGEST_SEEMING_SHARE * 0.5 * np.hypot(*size_px):
        return False
    moved_px = [np.median(distances_px(tracks, chained(inverse(measured[i]), measured[j]))) for (i, j), tracks in held.items()]
    unmoved_px = [np.median(distances_px(tracks, np.eye(2, 3))) for tracks in held.values()]
    return bool(np.all(np.array(unmoved_px) <= CLEARLY_BETTER * np.array(moved_px)))


def _is_clearly_nearer(turned: Sequence[Transform], settled: Sequence[Transform], held: Mapping[Pair, CornerTracks]) -> bool:
    """Return whether homographies leave corners so much nearer that the camera has turned, and noise and depth edges do not explain it."""
    turned_px, settled_px = (_apart_px(each, held) for each in (turned, settled))
    return settled_px > max(NOTICEABLE_PX, CLEARLY_BETTER * turned_px)


def _apart_px(transforms: Sequence[Transform], held: Mapping[Pair, CornerTracks]) -> float:
    """Return how far the corners of the median pair lie apart in the median."""
    apart_px = [np.median(distances_px(tracks, chained(inverse(transforms[i]), transforms[j]))) for (i, j), tracks in held.items()]
    return float(np.median(apart_px))


def _to_narrowest(first_from_slice: Sequence[Transform], size_px: tuple[int, int]) -> tuple[int, tuple[Transform, ...]]:
    """Return (reference, reference_from_slice); the slice that needs the least enlargement sees the narrowest field."""
    reference = int(np.argmin([scale_of(transform, middle_of(size_px)) for transform in first_from_slice]))
    back = inverse(first_from_slice[reference])
    return reference, tuple(np.eye(2, 3) if i == reference else chained(back, each) for i, each in enumerate(first_from_slice))


def _departure_px(one: Sequence[Transform], other: Sequence[Transform], size_px: tuple[int, int]) -> float:
    return max(farthest_corner_px(a, b, *size_px) for a, b in zip(one, other, strict=True))


def _residuals_px(transforms: Sequence[Transform], held: Mapping[Pair, PairMatch], size_px: tuple[int, int]) -> tuple[float | None, ...]:
    """Return by how much each slice's pairs, taken alone, disagree with the joint result."""
    worst: list[float | None] = [None] * len(transforms)
    for (i, j), match in held.items():
        off_px = farthest_corner_px(match.target_from_source, chained(inverse(transforms[i]), transforms[j]), *size_px)
        for k in (i, j):
            worst[k] = max(off_px, worst[k] or 0.0)
    return tuple(worst)


def with_links(
    count: int, held: Mapping[Pair, CornerTracks], matches: Mapping[Pair, PairMatch], breathing: Breathing, size_px: tuple[int, int]
) -> dict[Pair, CornerTracks]:
    """Return the tracks of pairs that hold, joined by virtual tracks between neighbours that they leave unconnected.

    The virtual tracks are those of ECC's guess where its scale is one that the breathing model allows, else of that model. matches: of all
    neighbours.
    """
    pairs = dict(held)
    for pair in _missing_links(count, held):
        match = matches[pair]
        guessed = (
            match.tracks is None and match.guess_holds and breathing.allows(pair, scale_of(match.target_from_source, middle_of(size_px)))
        )
        link = match.target_from_source if guessed else about_centre(breathing.scale(*pair), *size_px)
        pairs[pair] = _laid_tracks(link, size_px)
    return pairs


def _missing_links(count: int, pairs: Iterable[Pair]) -> list[Pair]:
    """Return the neighbours that must be joined so that all slices are connected, and no more."""
    group = list(range(count))
    links = [(i, i + 1) for i in range(count - 1)]
    missing = []
    for pair in (*pairs, *links):
        one, other = (group[k] for k in pair)
        if one != other:
            group = [one if each == other else each for each in group]
            missing.append(pair)
    return [pair for pair in missing if pair not in set(pairs)]


def _laid_tracks(target_from_source: Transform, size_px: tuple[int, int]) -> CornerTracks:
    """Return the corners of the picture as tracks of a transform.

    They alone hold two groups of slices together: trusted like tracks, they would give way, and a group shrink to a point, where its own
    tracks disagree by nothing.
    """
    source_px = np.array([[x, y] for x in (0.0, size_px[0]) for y in (0.0, size_px[1])])
    return CornerTracks(moved(target_from_source, source_px), source_px, _LAID_SCATTER_PX)
