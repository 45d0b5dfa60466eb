"""Depth of the frames of a tracked clip: kept files, keyframes, what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.depth.views.clip_depth import ClipDepth, chosen
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import write_image
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.video.picture_source import open_source
from tests.support.plane_sweep_scenes import TracedViews, card, traced, wall
from tests.support.video_files import video

FIRST = 1001
PLACES_M = tuple((0.05 * k - 0.1, 0.02 * (-1.0) ** k, 0.0) for k in range(5))


@pytest.fixture(scope="module")
def views() -> TracedViews:
    return traced((wall(1.6), card(0.8, -0.1, 0.12)), PLACES_M)


@pytest.fixture
def clip(tmp_path: Path, views: TracedViews) -> Path:
    """Numbered pictures from 1001, and track.json beside them."""
    for number, rgb in enumerate(views.rgb, start=FIRST):
        write_image(tmp_path / f"plate.{number}.exr", rgb)
    write_track(tmp_path / "track.json", track_of(views))
    return tmp_path / "plate.%04d.exr"


def track_of(views: TracedViews) -> CameraTrack:
    return CameraTrack({number: TrackedFrame(view.camera) for number, view in enumerate(views.views, start=FIRST)}, "-y")


def test_depth_is_kept_by_frame_numbers_and_made_once(clip: Path, views: TracedViews) -> None:
    clip_depth = ClipDepth(open_source(clip, "25"), track_of(views), clip.parent / "depth", FIRST)
    assert clip_depth.write([1, 2]) == 2
    found = {path.name: read_exr(path)[0].channels for path in sorted(clip_depth.folder.glob("*.exr"))}
    assert list(found) == ["depth.001002.exr", "depth.001003.exr"]
    assert (np.abs(found["depth.001003.exr"]["Z"] / views.depth_m[2] - 1.0) < 0.02).mean() > 0.9
    assert {"Z", "confidence"} == set(found["depth.001003.exr"])
    assert clip_depth.write([1, 2]) == 0
    with pytest.raises(InputError, match="no camera for 1006"):
        replace(clip_depth, first_number=FIRST + 2).write([0, 3])
    other = replace(clip_depth, track=replace(clip_depth.track, frames={n: clip_depth.track.frames[n] for n in range(FIRST, FIRST + 4)}))
    assert other.write([1]) == 1
    assert [path.name for path in clip_depth.folder.glob("*.exr")] == ["depth.001002.exr"], "depth of another track goes"
    still = CameraTrack(dict.fromkeys(range(FIRST, FIRST + 5), clip_depth.track.frames[FIRST]), "-y")
    with pytest.raises(InputError, match="moves sideways"):
        replace(clip_depth, track=still).write([1])
    assert [path.name for path in clip_depth.folder.glob("*.exr")] == ["depth.001002.exr"], "what there is stays where nothing new is made"


def test_files_of_others_are_left_alone(clip: Path, views: TracedViews) -> None:
    (clip.parent / "mine").mkdir()
    (clip.parent / "mine" / "depth.beauty.exr").touch()
    with pytest.raises(InputError, match=r"something else \(depth.beauty.exr\)"):
        ClipDepth(open_source(clip, "25"), track_of(views), clip.parent / "mine", FIRST).write([1])


def test_keyframes_lie_evenly_along_the_motion() -> None:
    """Half of the clip rests: of its first 50 frames hardly one is taken, of the 50 in motion every fifth."""
    motion = np.concatenate([np.zeros(50), np.arange(1, 51) * 0.012])
    taken = chosen(range(100), motion)
    assert taken[0] == 0
    assert taken[-1] == 99
    assert sum(each < 50 for each in taken) <= 2
    assert set(np.diff([each for each in taken if each >= 52])) <= {4, 5, 6}
    assert len(chosen(range(5), np.arange(5.0))) == 5


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("--layer", "layer.exr", "--depth", "auto"), "--camera TRACK"),
        (("--layer", "layer.exr", "--depth", "auto", "--camera", "track.json", "--disparity", "1:9"), "neither --disparity"),
        (("--layer", "layer.exr", "--depth", "auto", "--camera", "track.json", "--first-number", "1"), "--first-number"),
    ],
)
def test_what_gives_no_depth_is_told(clip: Path, given: tuple[str, ...], told: str) -> None:
    inside = [str(clip.parent / each) if each.endswith((".exr", ".json")) else each for each in given]
    write_image(clip.parent / "layer.exr", np.zeros((112, 160, 3), np.float32))
    with pytest.raises(InputError, match=told):
        video(clip, "--rate", "25", *inside, "--out", clip.parent / "out.%04d.exr")
