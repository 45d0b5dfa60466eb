"""A scene and its camera have to agree about what is up; what does not say so follows the scene."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.commands import composite, track, video
from mrbokeh.images.image_io import read_layer, write_image
from mrbokeh.optics.camera import camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.shots.frame_sources import scene_track
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame, TrackOptions
from tests.support.refusals import refused
from tests.support.stage_scenes import HEIGHT, ONE_CARD, WIDTH, camera, scene_file

SIZE = (WIDTH, HEIGHT)


def board_track() -> CameraTrack:
    return CameraTrack({0: TrackedFrame(camera()), 1: TrackedFrame(camera((0.05, 1.0, -0.1)))}, up="-z")


def test_a_track_that_agrees_is_taken_and_other_options_stay(tmp_path: Path) -> None:
    write_track(tmp_path / "track.json", board_track())
    found = scene_track(tmp_path / "track.json", SIZE, "-z")
    assert found.up == "-z" and found.numbers == [0, 1]
    # A .chan does not tell the size of its pictures: it is the plate's.
    write_track(tmp_path / "track.chan", board_track(), TrackOptions())
    assert scene_track(tmp_path / "track.chan", SIZE, "+y").size_px == SIZE
    refused("there is none", scene_track, tmp_path / "none.json", SIZE, "-z")


def test_a_camera_follows_the_scene_in_pictures_of_its_shape(tmp_path: Path) -> None:
    write_json(tmp_path / "camera.json", camera_to_json(camera()))
    for up in ("-z", "-y", "+y", "+z"):
        assert scene_track(tmp_path / "camera.json", SIZE, up).up == up
    # Stretched to the plate it would show objects too narrow; another size of the same shape is well.
    write_json(tmp_path / "camera.json", camera_to_json(camera()))
    assert scene_track(tmp_path / "camera.json", (2 * WIDTH, 2 * HEIGHT), "-z").size_px == SIZE
    with pytest.raises(InputError, match=rf"plate's shape \({HEIGHT}x{WIDTH}\), got one for {WIDTH}x{HEIGHT}"):
        scene_track(tmp_path / "camera.json", (HEIGHT, WIDTH), "-z")


@pytest.mark.parametrize(("name", "up"), [("colmap", "-y"), ("track.chan", r"\+y"), ("transforms.json", r"\+z"), ("track.json", "-z")])
def test_a_track_with_another_axis_is_told(tmp_path: Path, name: str, up: str) -> None:
    """Each format by its own convention: COLMAP's usual -y, Nuke's +y, nerfstudio's +z, ours as it states."""
    write_track(tmp_path / name, board_track())
    other = "-y" if up == "-z" else "-z"
    with pytest.raises(InputError, match=rf"{up} points up in this track.*, but {other} in the scene: .* write up = '{up}'") as told:
        scene_track(tmp_path / name, SIZE, other)
    assert ("most of COLMAP's maps" in str(told.value)) == (name == "colmap")
    assert str(told.value).endswith(f"--out-up={other}")


def run(app: object, *words: object) -> None:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)  # type: ignore[arg-type]
    assert result.exit_code == 0, result.output


def test_both_commands_refuse_and_what_the_sentence_says_helps(tmp_path: Path) -> None:
    """A card stands on a board, 1 m before the camera; the track comes back from COLMAP, whose folder says -y."""
    scene = scene_file(tmp_path, ONE_CARD)
    write_track(tmp_path / "colmap", board_track())
    write_lens(tmp_path / "pinhole.json", Lens(50.0, 5000.0, 1.0, 36.0))
    for number in (0, 1):
        write_image(tmp_path / f"plate.{number}.exr", np.full((HEIGHT, WIDTH, 3), 0.25, np.float32))
    clip = [tmp_path / "plate.%d.exr", "--rate", "25", "--workers", "1", "--virtual-only", "--out", tmp_path / "out.%d.exr"]
    photo = [tmp_path / "plate.0.exr", "--save-layer", tmp_path / "one.exr", "--out", tmp_path / "one.png"]
    filmed = ["--scene", scene, "--scene-renderer", "embree", "--lens", tmp_path / "pinhole.json", "--camera"]
    for app, words in ((video.app, clip), (composite.app, photo)):
        refused("points up in this track", run, app, *words, *filmed, tmp_path / "colmap")
    run(track.app, "convert", tmp_path / "colmap", tmp_path / "turned.json", "--out-up=-z")
    for app, words, out in ((video.app, clip, "out.0.exr"), (composite.app, photo, "one.exr")):
        run(app, *words, *filmed, tmp_path / "turned.json")
        alpha = read_layer(tmp_path / out).alpha
        # 0.2 m at 1 m and 150 px: 30 px high, standing on the board's corner 0.1 m below the axis, 15 px below the middle.
        rows = np.flatnonzero((alpha > 0.5).any(axis=1))
        assert len(rows) == pytest.approx(30, abs=1) and rows.mean() == pytest.approx(HEIGHT / 2 - 0.5, abs=1)
