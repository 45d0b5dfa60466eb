"""Depth of every frame of a clip whose camera is tracked, kept in a folder beside the track: depth.000012.exr with Z and `confidence`.

Keyframes are evenly spread over the motion of the camera; what is swept of them serves all frames (`still_scene`).
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrbokeh.depth.views import DEPTH_NAME
from mrbokeh.depth.views.still_scene import PosedPicture, StillScene, apart_in_widths, cameras_digest
from mrbokeh.depth.views.view_points import common_points, in_view
from mrbokeh.distortion import LensDistortion
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.console import track as with_progress
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.video.image_sequence import numbered, written_frames
from mrbokeh.video.picture_source import PictureSource

_RECORD = "depth.json"
_VERSION = 1
_FIRST_LOOK = 24
_APART_WIDTHS = 0.06
_FEWEST, _MOST = 10, 90


@dataclass(frozen=True)
class ClipDepth:
    """Depth of the frames of a clip. folder: of the files. first_number: of the clip's frame 0, in files and track."""

    source: PictureSource
    track: CameraTrack
    folder: Path
    first_number: int = 0

    @property
    def pattern(self) -> Path:
        return self.folder / DEPTH_NAME

    def write(self, taken: Sequence[int], device: str | None = None) -> int:
        """Write those of the frames (counted from 0) that are not there yet, and return how many those were.

        What was made of another clip or track is replaced. device: of torch, for sweeps. Raises InputError if the camera stays in one
        place, if the track lacks one of the frames, or if the folder holds anything else.
        """
        record, tracked = self._record(), self._tracked()
        if lost := [self.first_number + index for index in taken if index not in tracked]:
            raise InputError(f"{self.source.path}: the track has no camera for {written_frames(lost)}: leave those out of --frames")
        stale = [] if self._recorded() == record else sorted(self.folder.glob("depth.*.exr"))
        if stale and not (self.folder / _RECORD).exists():
            raise InputError(f"{self.folder} holds files of something else ({stale[0].name}), where depth is to go: move them away")
        wanted = [index for index in taken if stale or not self._file(index).exists()]
        if not wanted:
            return 0
        scene = StillScene([picture.small() for picture in self._pictures(self._keyframes())], str(self.source.path), device)
        for path in stale:
            path.unlink()
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / _RECORD, record)
        pictures = self._pictures(wanted)
        for index, picture in zip(wanted, with_progress(pictures, "depth of frames", len(wanted)), strict=True):
            found = scene.depth_of(picture)
            write_exr(self._file(index), ExrPart({"Z": found.depth, "confidence": found.confidence.astype(np.float16)}))
        return len(wanted)

    def _file(self, index: int) -> Path:
        return numbered(self.pattern, self.first_number + index)

    def _recorded(self) -> dict[str, Any] | None:
        path = self.folder / _RECORD
        return read_json(path, "what depth was made from") if path.exists() else None

    def _record(self) -> dict[str, Any]:
        frames = self.track.frames
        files = dict.fromkeys(self.source.file_of(index) or self.source.path for index in range(len(self.source.times_s)))
        stamps = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in files if path.exists()]
        return {
            "version": _VERSION,
            "clip": hashlib.sha256(repr(stamps).encode()).hexdigest(),
            "track": cameras_digest((n, frames[n].camera, frames[n].coefficients) for n in self.track.numbers),
            "first_number": self.first_number,
        }

    def _tracked(self) -> list[int]:
        """Return the clip's frames that the track has, counted from 0."""
        found = [index for index in range(len(self.source.times_s)) if self.first_number + index in self.track.frames]
        if len(found) < 2:
            raise InputError(
                f"{self.source.path}: depth needs a track of its moving camera, but of its {len(self.source.times_s)} frames the track has "
                f"{len(found)} (it has frames {self.track.numbers[0]} to {self.track.numbers[-1]}): see --first-number"
            )
        return found

    def _frame(self, index: int) -> TrackedFrame:
        return self.track.frames[self.first_number + index]

    def _camera(self, index: int) -> Camera:
        camera, info = self._frame(index).camera, self.source.info
        same = (camera.width_px, camera.height_px) == (info.width_px, info.height_px)
        return camera if same else camera.resized(info.width_px, info.height_px)

    def _pictures(self, indices: Sequence[int]) -> Iterator[PosedPicture]:
        """Read frames in order; stretches between them that are long are not decoded."""
        for first, stop in _stretches(indices):
            wanted = {index for index in indices if first <= index < stop}
            for index, frame in enumerate(self.source.frames(first, stop), start=first):
                if index in wanted:
                    bent = LensDistortion.of("opencv", **self._frame(index).coefficients)
                    yield PosedPicture(np.ascontiguousarray(frame.rgb, np.float32), self._camera(index), bent)

    def _keyframes(self) -> list[int]:
        """Return frames evenly spread over the motion of the picture that the camera makes."""
        found = self._tracked()
        if len(found) <= _FEWEST:
            return found
        look = [found[k] for k in np.unique(np.linspace(0, len(found) - 1, _FIRST_LOOK).round().astype(int))]
        say(f"{self.source.path.name}: looking at {len(look)} of {len(found)} frames for points", err=True)
        small = [picture.small() for picture in self._pictures(look)]
        points = common_points([each.view for each in small])
        seen = [depth[inside] for inside, depth in (in_view(each.camera, points) for each in small)]
        depth = float(np.median(np.concatenate([*seen, np.zeros(0)]))) if len(points) else 1.0
        return chosen(found, self._motion(found, depth))

    def _motion(self, found: Sequence[int], depth: float) -> Float64[np.ndarray, " frames"]:
        """Return how far the picture has moved since the first of these frames, in its widths, at a depth."""
        cameras = [self._camera(index) for index in found]
        steps = [apart_in_widths(one, other, depth) for one, other in pairwise(cameras)]
        return np.concatenate([[0.0], np.cumsum(steps)])


def chosen(frames: Sequence[int], motion: Float64[np.ndarray, " frames"]) -> list[int]:
    """Return the frames at even steps of motion, the first and the last among them."""
    count = int(np.clip(round(motion[-1] / _APART_WIDTHS) + 1, _FEWEST, min(_MOST, len(frames))))
    along = motion + (motion[-1] + 1e-9) * 1e-3 * np.arange(len(motion)) / len(motion)  # a little of plain time where nothing moves
    places = np.searchsorted(along, np.linspace(along[0], along[-1], count)).clip(0, len(frames) - 1)
    return [frames[place] for place in np.unique(places)]


def _stretches(indices: Sequence[int], longest_gap: int = 24) -> list[tuple[int, int]]:
    """Return (first, stop) of runs of frames that are read without a break."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index - runs[-1][1] < longest_gap:
            runs[-1][1] = index + 1
        else:
            runs.append([index, index + 1])
    return [(first, stop) for first, stop in runs]
