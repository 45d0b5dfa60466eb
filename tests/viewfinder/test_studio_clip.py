"""The studio over a clip: objects are placed in its first frame, and `mrbokeh video` films them where the track of the camera says."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.images.color import srgb_codes
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.video.picture_source import open_source
from tests.support.command_line import mrbokeh
from tests.support.live_clip import LiveClip, write_live_clip
from tests.support.made_studio import ALIEN, CAKE
from viewfinder.studio.clip import clip_state, clip_words, path_px
from viewfinder.studio.command_line import options_of
from viewfinder.studio.photograph import open_photograph, placed
from viewfinder.studio.preview import preview_of
from viewfinder.studio.running import StudioOptions, project_of
from viewfinder.studio.state import StudioState

WIDTH, HEIGHT, FRAMES = 320, 240, 5
FOOT_M = np.array([0.10, 0.13, 0.0])


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[LiveClip, Path]:
    """A traced, hand-held clip of a board on a table, there and back, and the exact track of its camera."""
    folder = tmp_path_factory.mktemp("clip")
    made = write_live_clip(folder, WIDTH, HEIGHT, FRAMES)
    track = folder / "track.json"
    write_track(track, CameraTrack({number: TrackedFrame(each) for number, each in enumerate(made.cameras)}))
    return made, track


def state_of_clip(clip: tuple[LiveClip, Path], folder: Path, **changes: object) -> StudioState:
    """The cake on the board, 5 cm high."""
    made, track = clip
    state = clip_state(made.path, track, folder, StudioState(object=CAKE))
    x_px, y_px = made.cameras[0].project(FOOT_M[None])[0][0]
    return replace(state, at_px=(float(x_px), float(y_px)), height="0.05", matched=False, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "changes",
    [{"turn_deg": 30.0}, {"sun_deg": (-60.0, 35.0), "exposure": 1.4, "warmth_k": 9000.0}],
    ids=["soft", "sun"],
)
@pytest.mark.slow
def test_the_filmed_clip_begins_with_the_preview_and_follows_the_track(
    clip: tuple[LiveClip, Path], tmp_path: Path, changes: dict[str, object]
) -> None:
    """The first frame is the studio's picture; in all frames the cake stands where the exact cameras see its place on the board."""
    made, _track = clip
    state = state_of_clip(clip, tmp_path, **changes)
    assert state.photo is not None
    opened, _rgb = open_photograph(state.photo)
    state = placed(state, opened)
    assert state.camera_height_m == pytest.approx(-made.cameras[0].world_from_camera[2, 3], rel=1e-3), (
        "of a board, whose z points into the table"
    )
    preview = srgb_codes(preview_of(opened, options_of(state), KeptParts()).rgb, np.uint8).astype(float)
    words = [*clip_words(state, opened, tmp_path), "--out", str(tmp_path / "out.mkv")]
    done = mrbokeh(*words)
    assert done.returncode == 0, done.stdout + done.stderr
    frames = [srgb_codes(each.rgb, np.uint8).astype(float) for each in open_source(tmp_path / "out.mkv").frames(0, len(made.plates), 1)]
    plates = [each[..., ::-1].astype(float) for each in made.plates]
    changed = np.abs(preview - plates[0]).max(axis=2) > 12
    assert changed.sum() > 300
    apart = np.abs(frames[0] - preview).max(axis=2)
    assert np.median(apart[changed]) < 3 and (apart > 25).sum() < 0.1 * changed.sum(), "but for pixels on rims"
    seen = path_px(state)
    assert len(seen) == len(made.plates)
    moved = np.ptp(np.array(seen), axis=0)
    assert moved.max() > 4.0, "the hand moves"
    for frame, plate, camera, foot_px in zip(frames, plates, made.cameras, seen, strict=True):
        np.testing.assert_allclose(foot_px, camera.project(FOOT_M[None])[0][0], atol=0.3)
        cake = cv2.morphologyEx((np.abs(frame - plate).max(axis=2) > 40).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
        middle_m = FOOT_M + np.array([0.0, 0.0, -0.025])
        middle_px = camera.project(middle_m[None])[0][0]
        columns = np.nonzero(cake.any(axis=0))[0]
        assert columns.min() < middle_px[0] < columns.max()


def test_a_clip_is_opened_by_its_track_and_both_are_kept(clip: tuple[LiveClip, Path], tmp_path: Path) -> None:
    made, track = clip
    project = project_of(StudioOptions(made.path, (ALIEN,), camera=track, pictures=tmp_path))
    assert (project.state.clip, project.state.track) == (made.path, track) and project.state.camera is not None
    assert project.path.name == "board.studio.json"
    project.write()
    again = project_of(StudioOptions(made.path, camera=track, pictures=tmp_path))
    assert len(again.history) == 1 and again.state.camera == project.state.camera, "opened again where it was"
    with pytest.raises(InputError, match=r"give --camera TRACK"):
        project_of(StudioOptions(made.path.rename(tmp_path / "clip.mp4"), pictures=tmp_path))
    (tmp_path / "clip.mp4").rename(made.path)
    with pytest.raises(InputError, match="give that as PHOTO"):
        project_of(StudioOptions(None, camera=track, pictures=tmp_path / "other"))
    below = {0: TrackedFrame(made.cameras[0].resized(WIDTH, HEIGHT))}
    write_track(tmp_path / "below.json", CameraTrack(below, up="+z"))
    with pytest.raises(InputError, match="below the ground"):
        clip_state(made.path, tmp_path / "below.json", tmp_path, StudioState())
