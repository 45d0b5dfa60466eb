"""What joins slices that no tracks join: ECC's guess, else the breathing model."""

from collections.abc import Iterable, Mapping

import numpy as np

from capture.merging.breathing import Breathing, Pair
from capture.merging.corner_tracks import CornerTracks
from capture.merging.pair_matching import PairMatch
from capture.merging.plane_transforms import Transform, about_centre, middle_of, moved, scale_of

_LAID_SCATTER_PX = 0.01


def with_links(
    count: int, held: Mapping[Pair, CornerTracks], matches: Mapping[Pair, PairMatch], breathing: Breathing, size_px: tuple[int, int]
) -> dict[Pair, CornerTracks]:
    """The tracks of pairs that hold and, between neighbours that they leave unconnected, tracks that lie as they should.

    matches: of all neighbours; what ECC found counts where its scale is one that the model allows.
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
    """The neighbours that must be joined so that all slices hang together, and no more."""
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
    """The corners of the picture, as a transform moves them.

    They alone hold two groups of slices together: trusted like tracks, they would give way, and a group shrink to a point, where its own
    tracks disagree by nothing.
    """
    source_px = np.array([[x, y] for x in (0.0, size_px[0]) for y in (0.0, size_px[1])])
    return CornerTracks(moved(target_from_source, source_px), source_px, _LAID_SCATTER_PX)
