"""Depth of a clip's frames found from the clip itself and the track of its moving camera, kept in a folder beside the track."""

import re
from collections.abc import Sequence
from pathlib import Path
from time import monotonic

from mrbokeh.depth.views import DEPTH_NAME
from mrbokeh.system.atomic_files import writing_alone
from mrbokeh.system.channel import say
from mrbokeh.system.console import kept_when_interrupted
from mrbokeh.video.picture_source import PictureSource


def found_depth_files(camera: Path, clip: Path) -> Path:
    """Return the pattern of the files that hold the depth of a tracked clip. camera: its track."""
    return _folder(camera, clip) / DEPTH_NAME


def _folder(camera: Path, clip: Path) -> Path:
    """Return where the depth of a tracked clip is kept: beside the track."""
    name = re.sub(r"\W+", "_", re.sub(r"%0?\d*d|#+", "", clip.stem)).strip("_")
    return camera.resolve().with_name(f"{camera.stem}_{name}_depth")


def find_depth(source: PictureSource, camera: Path, taken: Sequence[int], first_number: int) -> None:
    """Find the depth of the frames that are taken, as far as it is not kept from an earlier run."""
    from mrbokeh.depth.views.clip_depth import ClipDepth
    from mrbokeh.tracking.camera_track.formats import read_track
    from mrbokeh.tracking.camera_track.track import TrackOptions

    size_px, folder = (source.info.width_px, source.info.height_px), _folder(camera, source.path)
    track = read_track(camera, TrackOptions(size_px=size_px))
    if not track.metric:
        say(f"the lengths of {camera.name} may not be metres: depth is in its unit, as places in a scene and Z of layers have to be")
    found = ClipDepth(source, track, folder, first_number)
    began_s = monotonic()
    with writing_alone(folder), kept_when_interrupted(f"finished depth is kept in {folder}"):
        made = found.write(taken)
    if made:
        took_s = (monotonic() - began_s) / made
        say(f"depth of {made} frames lies in {folder} ({took_s:.1f} s a frame); what moves by itself has that of what is behind it")
