"""Recordings, read back from real files."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import probe, read_frames
from mrbokeh.video.color import code_from_linear
from tests.scenes.streaming_viewers import BARS, HEIGHT, WIDTH, bar_centres, bars, output
from viewfinder.frames import OutputFrame
from viewfinder.streaming.recording import Recorder, Recording, recording_path

# As a camera gives them: not evenly.
TIMES_S = [50.0, 50.033, 50.1, 50.101, 50.25]


def recorded(path: Path, frames: list[OutputFrame], transfer: str = "bt709") -> Recording:
    recorder = Recorder(transfer, waiting=len(frames))
    recorder.start(path)
    for frame in frames:
        recorder.show(frame)
    return recorder.stop()


@pytest.mark.parametrize(("name", "tolerance"), [("clip.mp4", 3), ("clip.mov", 2)])
def test_pictures_and_their_times_are_in_the_file(tmp_path: Path, name: str, tolerance: int) -> None:
    recording = recorded(tmp_path / name, [output(bars(), i, captured_s) for i, captured_s in enumerate(TIMES_S)])
    assert (recording.frame_count, recording.dropped, recording.note) == (5, 0, None)
    assert recording.duration_s == pytest.approx(0.25)
    frames = list(read_frames(recording.path))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.array(TIMES_S) - 50.0, atol=1e-5)
    # Codes of BT.709 go through linear light and back to where they were; limited range and the codec take 1 or 2.
    codes = 255 * code_from_linear(frames[-1].rgb[..., ::-1], "bt709")
    np.testing.assert_allclose(np.clip(np.rint(bar_centres(codes)), 0, 255), BARS.astype(int), atol=tolerance)


def test_light_is_what_is_kept_where_the_camera_has_another_curve(tmp_path: Path) -> None:
    """Code 188 of sRGB is linear 0.503."""
    grey = np.full((HEIGHT, WIDTH, 3), 188, np.uint8)
    recording = recorded(tmp_path / "grey.mp4", [output(grey, 0, 1.0)], "srgb")
    assert np.median(next(read_frames(recording.path)).rgb) == pytest.approx(0.503, abs=0.006)
    assert probe(recording.path).color.transfer_name == "bt709"


def test_a_file_appears_when_it_is_whole_and_none_is_overwritten(tmp_path: Path) -> None:
    path, recorder = tmp_path / "clip.mp4", Recorder("bt709")
    assert not recorder.wants_frame
    recorder.start(path)
    assert recorder.wants_frame
    recorder.show(output(bars(), 0, 1.0))
    with pytest.raises(InputError, match="one recording at a time"):
        recorder.start(tmp_path / "other.mp4")
    assert not path.exists()
    recorder.stop()
    assert path.exists()
    assert not recorder.wants_frame
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match="exists already"):
        recorder.start(path)
    with pytest.raises(InputError, match=r"\.mp4"):
        recorder.start(tmp_path / "clip.gif")
    with pytest.raises(InputError, match="none was started"):
        recorder.stop()
    recorder.show(output(bars(), 1, 2.0))
    # It can be used again.
    recorder.start(tmp_path / "second.mp4")
    recorder.show(output(bars(), 2, 3.0))
    assert recorder.stop().frame_count == 1


def test_a_recording_of_nothing_leaves_nothing(tmp_path: Path) -> None:
    recorder = Recorder("bt709")
    recorder.start(tmp_path / "clip.mp4")
    with pytest.raises(InputError, match="at least one picture"):
        recorder.stop()
    assert list(tmp_path.iterdir()) == []
    recorder.start(tmp_path / "clip.mp4")
    recorder.close()
    recorder.close()
    assert not any(thread.name == "recorder" for thread in threading.enumerate())


def test_stopped_before_the_first_picture_it_waits_for_one(tmp_path: Path) -> None:
    recorder = Recorder("bt709")
    recorder.start(tmp_path / "clip.mp4")
    late = threading.Timer(0.3, lambda: recorder.show(output(bars(), 0, 1.0)))
    late.start()
    assert recorder.stop().frame_count == 1
    late.join()


def test_repeated_captures_and_clocks_that_step_back_are_left_out(tmp_path: Path) -> None:
    frames = [output(bars(), i, captured_s) for i, captured_s in enumerate([5.0, 5.1, 5.1, 5.05, 5.2])]
    recording = recorded(tmp_path / "clip.mp4", frames)
    assert recording.frame_count == 3
    np.testing.assert_allclose([frame.time_s for frame in read_frames(recording.path)], [0.0, 0.1, 0.2], atol=1e-5)


def test_a_change_of_size_ends_the_file_with_what_was_there(tmp_path: Path) -> None:
    frames = [output(bars(), 0, 1.0), output(bars(), 1, 1.1), output(bars(160, 90), 2, 1.2), output(bars(160, 90), 3, 1.3)]
    recording = recorded(tmp_path / "clip.mp4", frames)
    assert recording.frame_count == 2
    assert "320x180" in str(recording.note)
    assert len(list(read_frames(recording.path))) == 2


def test_a_last_odd_row_and_column_are_left_out_of_mp4_only(tmp_path: Path) -> None:
    for name, size in (("odd.mp4", (160, 90)), ("odd.mov", (161, 91))):
        info = probe(recorded(tmp_path / name, [output(bars(161, 91), 0, 1.0)]).path)
        assert (info.width_px, info.height_px) == size


def test_pictures_that_come_too_fast_are_counted(tmp_path: Path) -> None:
    recorder = Recorder("bt709", waiting=2)
    recorder.start(tmp_path / "clip.mp4")
    for i in range(200):
        recorder.show(output(bars(), i, i / 30))
    recording = recorder.stop()
    assert recording.dropped > 0
    assert recording.frame_count + recording.dropped == 200


def test_a_disk_that_refuses_gives_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    recorder = Recorder("bt709")
    recorder.start(tmp_path / "file" / "clip.mp4")
    recorder.show(output(bars(), 0, 1.0))
    give_up_s = time.monotonic() + 10
    while recorder.wants_frame and time.monotonic() < give_up_s:
        time.sleep(0.01)
    with pytest.raises(InputError, match="could not be written"):
        recorder.stop()


def test_names_of_recordings_do_not_collide(tmp_path: Path) -> None:
    first = recording_path(tmp_path, ".mov")
    first.touch()
    assert recording_path(tmp_path, ".mov") != first
    assert first.suffix == ".mov"
