"""How two slices lie to each other: a first guess by masked ECC, then tracked corners from small pictures to large ones."""

from dataclasses import dataclass, replace

import numpy as np

from capture.merging.corner_tracks import CornerTracks, track_corners
from capture.merging.joint_transforms import joint_transforms
from capture.merging.masked_ecc import match_coarsely
from capture.merging.plane_transforms import Transform, about_centre, at_level
from capture.merging.slice_structure import DetailLevel, SliceStructure
from capture.merging.track_fit import AGREEING_PX, distances_px, similarity_of_tracks, typical_px

FEWEST_AGREEING = 24
LEAST_SHARE_AGREEING = 0.5
# Finer detail is believed even at so many times the standard error: it lies in the depths that both slices show sharp, while
# the outlines of large discs move with more than the camera (depth edges, pupils off the axis).
_FINER_IS_WORTH = 2.0
# Where a similarity leaves half of the corners farther apart than this, and a homography brings them nearer by this factor, the camera
# has turned.
NOTICEABLE_PX = 0.1
_CLEARLY_BETTER = 1.4


@dataclass(frozen=True)
class PairMatch:
    """target_from_source of two slices.

    tracks: of the size of picture that locates the slice best; None where too few agree on one similarity.
    correlation: of the small pictures (ECC), 0 where none was computed.
    guess_holds: where there are no tracks, target_from_source is what ECC found, else only what was expected.
    """

    target_from_source: Transform
    tracks: CornerTracks | None
    correlation: float = 0.0
    guess_holds: bool = False


def match_neighbours(target: SliceStructure, source: SliceStructure, expected_scale: float = 1.0) -> PairMatch:
    """Two slices of which nothing is known but the scale that the lens should give."""
    expected = about_centre(expected_scale, *target.size_px)
    coarse = match_coarsely(target, source, expected)
    match = match_from(target, source, coarse.target_from_source if coarse.holds else expected)
    return replace(match, correlation=coarse.correlation, guess_holds=coarse.holds)


def match_from(target: SliceStructure, source: SliceStructure, start: Transform) -> PairMatch:
    """Two slices that lie within a few pixels of `start`.

    The larger the pictures, the finer the detail, until defocus and noise leave too little that both show: the largest size
    is kept at which corners agree and the standard error (scatter over the root of their number) does not grow much.
    """
    best, least_error_px = PairMatch(start, None), np.inf
    for of_target, of_source in zip(target.levels, source.levels, strict=True):
        found = _tracked(of_target, of_source, best.target_from_source, is_first_guess=best.tracks is None)
        if found is None:
            break
        transform, tracks, agreeing = found
        error_px = tracks.scatter_px / np.sqrt(agreeing)
        if error_px >= _FINER_IS_WORTH * least_error_px:
            break
        best, least_error_px = PairMatch(transform, tracks), min(error_px, least_error_px)
    return best


def _tracked(
    target: DetailLevel, source: DetailLevel, start: Transform, is_first_guess: bool
) -> tuple[Transform, CornerTracks, int] | None:
    """(target_from_source, tracks, how many agree) in pixels of the slices; None where too few agree."""
    tracks = track_corners(target, source, at_level(start, target.level), is_first_guess)
    if len(tracks) < FEWEST_AGREEING:
        return None
    found = similarity_of_tracks(tracks)
    off_px = distances_px(tracks, found)
    if np.median(off_px) > NOTICEABLE_PX:
        turned = joint_transforms(2, {(0, 1): tracks}, target.detail.shape[::-1], perspective=True)[1]
        turned_px = distances_px(tracks, turned)
        if np.median(off_px) > _CLEARLY_BETTER * np.median(turned_px):
            found, off_px = turned, turned_px
    agreeing = int(np.count_nonzero(off_px < AGREEING_PX))
    if agreeing < max(FEWEST_AGREEING, LEAST_SHARE_AGREEING * len(tracks)):
        return None
    weighed = replace(tracks, scatter_px=typical_px(off_px))
    return at_level(found, -target.level), weighed.enlarged(2.0**target.level), agreeing
