"""Slices whose camera stated infinity by a sentinel: taken as infinity to start from, but not known.

How far they may be off follows from the stack alone: such a slice comes after all those that state real distances, since a camera
writes the sentinel for what lies beyond its last code. So its distance lies anywhere from the farthest real one to infinity. The
hyperfocal distance would be a narrower bound, but depends on what blur one calls sharp and on nothing that the camera has said.
A distance of a lens.toml or focus.csv is no sentinel, `inf` included.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from capture.photos.photo_metadata import PhotoMetadata
from capture.stacks.slice_metadata import focus_record
from mrbokeh.stacks.focal_stack import FocalStack


def bounded_focus_records(metadata: Sequence[PhotoMetadata]) -> list[dict[str, Any] | None]:
    """`focus_record` of the photographs of a stack; intervals of sentinels reach from infinity to the farthest real distance from the
    lens, and are None where there is none.
    """
    known_m = [distance for each in metadata if not _by_sentinel(each) and (distance := each.focus_distance_m) and math.isfinite(distance)]
    interval = [0.0, 1.0 / max(known_m)] if known_m else None
    bounded = {"interval_dioptre": interval, "lens_interval_dioptre": interval}
    records = ((each, focus_record(each)) for each in metadata)
    return [record | bounded if record is not None and _by_sentinel(each) else record for each, record in records]


def _by_sentinel(metadata: PhotoMetadata) -> bool:
    return metadata.focus is not None and metadata.focus.is_sentinel


def stated_by_sentinel(stack: FocalStack) -> Bool[np.ndarray, " slices"]:
    """The slices whose camera stated no distance but a sentinel, whatever a calibration has found since."""
    return np.array([bool((each.metadata.get("focus") or {}).get("sentinel", False)) for each in stack.slices], bool)
