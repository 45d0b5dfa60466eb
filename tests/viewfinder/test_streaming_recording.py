"""Takes: what is in the files, and that nothing is lost where the process is killed, the disk is full or the picture changes its size."""

import errno
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from mrbokeh.video.clip import probe, read_frames
from mrbokeh.video.color import code_from_linear
from tests.support.refusals import refused
from tests.support.streaming_viewers import BARS, HEIGHT, WIDTH, bar_centres, bars, noise, output
from tests.support.waiting import wait_until
from viewfinder.frames import OutputFrame
from viewfinder.streaming import recording as of_recording
from viewfinder.streaming import take_file
from viewfinder.streaming.recording import Recorder, Recording, recording_path
from viewfinder.streaming.take_file import TakeFile, playable_bytes, recover_takes, under_way

# As a camera gives them: not evenly.
TIMES_S = [50.0, 50.033, 50.1, 50.101, 50.25]


def recorder_of(said: list[str], transfer: str = "bt709", waiting: int = 1000) -> Recorder:
    return Recorder(lambda: transfer, said.append, waiting=waiting)


def recorded(path: Path, frames: list[OutputFrame], transfer: str = "bt709") -> Recording:
    recorder = recorder_of([], transfer)
    recorder.start(path)
    for frame in frames:
        recorder.show(frame)
    return recorder.stop()


@pytest.mark.parametrize(("name", "tolerance"), [("clip.mp4", 3), ("clip.mov", 2)])
def test_pictures_and_their_times_are_in_the_file(tmp_path: Path, name: str, tolerance: int) -> None:
    recording = recorded(tmp_path / name, [output(bars(), i, captured_s) for i, captured_s in enumerate(TIMES_S)])
    assert (recording.frame_count, recording.dropped, recording.note) == (5, 0, None)
    assert recording.duration_s == pytest.approx(0.25)
    frames = list(read_frames(recording.parts[0]))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.array(TIMES_S) - 50.0, atol=1e-5)
    # Codes of BT.709 go through linear light and back to where they were; limited range and the codec take 1 or 2.
    codes = 255 * code_from_linear(frames[-1].rgb[..., ::-1], "bt709")
    np.testing.assert_allclose(np.clip(np.rint(bar_centres(codes)), 0, 255), BARS.astype(int), atol=tolerance)
    # Light is what is kept where the camera has another curve: code 188 of sRGB is linear 0.503.
    [grey] = recorded(tmp_path / f"grey_{name}", [output(np.full((HEIGHT, WIDTH, 3), 188, np.uint8), 0, 1.0)], "srgb").parts
    assert np.median(next(read_frames(grey)).rgb) == pytest.approx(0.503, abs=0.006) and probe(grey).color.transfer_name == "bt709"


def test_a_file_has_its_name_when_it_is_whole_and_none_is_overwritten(tmp_path: Path) -> None:
    path, recorder = tmp_path / "clip.mp4", recorder_of([])
    assert not recorder.wants_frame
    recorder.start(path)
    assert recorder.wants_frame
    recorder.show(output(bars(), 0, 1.0))
    refused("one recording at a time", recorder.start, tmp_path / "other.mp4")
    assert not path.exists()
    recorder.stop()
    assert not recorder.wants_frame and list(tmp_path.iterdir()) == [path]
    for start, sentence in ((path, "exists already"), (tmp_path / "clip.gif", r"\.mp4"), (tmp_path / "clip.mkv", r"\.mov")):
        refused(sentence, recorder.start, start)
    refused("none was started", recorder.stop)
    recorder.show(output(bars(), 1, 2.0))
    # It can be used again; stopped before the first picture it waits for one.
    recorder.start(tmp_path / "second.mp4")
    late = threading.Timer(0.1, lambda: recorder.show(output(bars(), 2, 3.0)))
    late.start()
    assert recorder.stop().frame_count == 1
    first = recording_path(tmp_path, ".mov")
    first.touch()
    assert recording_path(tmp_path, ".mov") != first and first.suffix == ".mov"


def test_a_recording_of_nothing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viewfinder.streaming.recording._FIRST_PICTURE_S", 0.05)
    recorder = recorder_of([])
    recorder.start(tmp_path / "clip.mp4")
    refused("at least one picture", recorder.stop)
    assert list(tmp_path.iterdir()) == []
    recorder.start(tmp_path / "clip.mp4")
    for _ in range(2):
        recorder.close()
    assert not any(thread.name == "recorder" for thread in threading.enumerate())


def test_repeated_captures_and_clocks_that_step_back_are_left_out(tmp_path: Path) -> None:
    frames = [output(bars(), i, captured_s) for i, captured_s in enumerate([5.0, 5.1, 5.1, 5.05, 5.2])]
    recording = recorded(tmp_path / "clip.mp4", frames)
    assert recording.frame_count == 3
    np.testing.assert_allclose([frame.time_s for frame in read_frames(recording.parts[0])], [0.0, 0.1, 0.2], atol=1e-5)


def test_a_change_of_size_goes_on_in_a_new_part_of_the_take(tmp_path: Path) -> None:
    sizes = [(320, 180), (320, 180), (160, 90), (160, 90), (160, 90), (320, 180)]
    said: list[str] = []
    recorder = recorder_of(said)
    recorder.start(tmp_path / "clip.mp4")
    for i, size in enumerate(sizes):
        recorder.show(output(bars(*size), i, 1 + i / 10))
    recording = recorder.stop()
    assert [each.name for each in recording.parts] == ["clip.mp4", "clip-2.mp4", "clip-3.mp4"] and recording.note is None
    assert [(len(list(read_frames(each))), probe(each).width_px) for each in recording.parts] == [(2, 320), (3, 160), (1, 320)]
    assert sorted(tmp_path.iterdir()) == sorted(recording.parts)
    assert said == ["saved clip.mp4 and clip-2.mp4 and clip-3.mp4 (0 s)"]


def test_a_change_of_the_curve_is_followed(tmp_path: Path) -> None:
    """A browser camera tells its curve with its first picture, after the recorder was made."""
    transfers = ["bt709"]
    recorder = Recorder(lambda: transfers[-1])
    transfers.append("srgb")
    recorder.start(tmp_path / "clip.mp4")
    recorder.show(output(np.full((HEIGHT, WIDTH, 3), 188, np.uint8), 0, 1.0))
    [path] = recorder.stop().parts
    assert np.median(next(read_frames(path)).rgb) == pytest.approx(0.503, abs=0.006), "code 188 of sRGB"


def test_a_last_odd_row_and_column_are_left_out_of_mp4_only(tmp_path: Path) -> None:
    for name, size in (("odd.mp4", (160, 90)), ("odd.mov", (161, 91))):
        info = probe(recorded(tmp_path / name, [output(bars(161, 91), 0, 1.0)]).parts[0])
        assert (info.width_px, info.height_px) == size


def test_pictures_that_come_too_fast_are_counted(tmp_path: Path) -> None:
    recorder = recorder_of([], waiting=2)
    recorder.start(tmp_path / "clip.mp4")
    for i in range(200):
        recorder.show(output(bars(), i, i / 30))
    recording = recorder.stop()
    assert recording.dropped > 0 and recording.frame_count + recording.dropped == 200


def test_a_folder_that_refuses_gives_a_sentence_and_the_next_press_works(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    said: list[str] = []
    recorder = recorder_of(said)
    recorder.start(tmp_path / "file" / "clip.mp4")
    recorder.show(output(bars(), 0, 1.0))
    wait_until(lambda: not recorder.wants_frame)
    assert "clip.mp4 could not be written" in said[0]
    # Nobody stopped it: the button starts the next one.
    recorder.start(tmp_path / "next.mp4")
    recorder.show(output(bars(), 1, 2.0))
    assert recorder.stop().parts == (tmp_path / "next.mp4",)


def refusing_after(bytes_: int, written: list[int]) -> Callable[[Any, memoryview], int]:
    """A disk with so much room: it takes a part of what is one too many, as a file system does, and refuses the rest."""
    put = TakeFile._put

    def limited(self: TakeFile, data: memoryview) -> int:
        room = bytes_ - sum(written)
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = put(self, data[:room])
        written.append(taken)
        return taken

    return limited


@pytest.mark.parametrize("name", ["clip.mp4", pytest.param("clip.mov", marks=pytest.mark.slow)])
def test_a_full_disk_ends_the_take_keeps_it_and_the_next_press_works(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said, written = list[str](), list[int]()
    recorder = recorder_of(said)
    with monkeypatch.context() as patched:
        patched.setattr(TakeFile, "_put", refusing_after(3_000_000, written))
        recorder.start(tmp_path / name)
        for i in range(120):
            recorder.show(output(noise(i), i, i / 30))
        wait_until(lambda: not recorder.wants_frame)
        recording = recorder.stop()
    assert recording.note == "no space left on device" and said == [recording.sentence]
    frames = list(read_frames(tmp_path / name))
    # Half a second in fragments is lost, and what the encoder had not written, in all less than a second; 120 pictures did not fit.
    assert recording.frame_count - 31 < len(frames) < 120 and frames[-1].time_s == pytest.approx(recording.duration_s, abs=0.1)
    assert sum(written) == 3_000_000 and list(tmp_path.iterdir()) == [tmp_path / name]
    assert recorded(tmp_path / f"next_{name}", [output(bars(), 0, 1.0)]).frame_count == 1
    recorder.start(tmp_path / f"again_{name}")
    recorder.show(output(bars(), 1, 2.0))
    assert recorder.stop().note is None


def test_a_disk_that_is_full_at_the_end_is_told_of_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """40 pictures of noise are more than a fragment: the last one does not fit."""
    [whole] = recorded(tmp_path / "whole.mp4", [output(noise(i), i, i / 30) for i in range(40)]).parts
    monkeypatch.setattr(TakeFile, "_put", refusing_after(whole.stat().st_size - 100_000, []))
    recording = recorded(tmp_path / "clip.mp4", [output(noise(i), i, i / 30) for i in range(40)])
    assert recording.note == "no space left on device" and 10 <= len(list(read_frames(recording.parts[0]))) < 40


def test_the_disk_is_looked_at_before_it_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2 MB more than the reserve is less than five minutes of noise, of which a second has more than 1 MB."""
    free = [of_recording.RESERVE_BYTES + 2_000_000]
    monkeypatch.setattr(of_recording, "free_bytes", lambda _folder: free[0])
    monkeypatch.setattr(of_recording, "_LOOK_S", 0.01)
    said: list[str] = []
    recorder = recorder_of(said)
    recorder.start(tmp_path / "clip.mp4")

    def feed(first: int) -> None:
        for i in range(first, first + 40):
            recorder.show(output(noise(i), i, i / 30))

    feed(0)
    wait_until(lambda: said)
    assert said[0].startswith("the disk will be full in ") and said[0].endswith(" minutes of this recording: make room")
    wait_until(lambda: recorder.take is not None and recorder.take.room_s < 20.0)
    free[0] = of_recording.RESERVE_BYTES - 1
    feed(40)
    wait_until(lambda: not recorder.wants_frame)
    recording = recorder.stop()
    assert recording.note == "the disk is full" and len(said) == 2
    # It was ended as every other one is: a plain file, whose pictures are all there.
    assert len(list(read_frames(recording.parts[0]))) == recording.frame_count
    refused("is full: expected 64 MB", recorder.start, tmp_path / "next.mp4")


CHILD = """
import sys, time
from pathlib import Path
from tests.support.streaming_viewers import noise, output
from viewfinder.streaming.recording import Recorder
recorder = Recorder(lambda: "bt709")
recorder.start(Path(sys.argv[1]))
for i in range(3000):
    recorder.show(output(noise(i % 7), i, i / 30))
    print(i / 30, flush=True)
    time.sleep(1 / 30)
"""


def test_a_killed_process_loses_less_than_a_second_and_the_take_is_recovered(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path / "take.mp4")], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        while float(child.stdout.readline()) < 2.3:
            pass
        # It is being recorded: another viewfinder that starts here leaves it alone.
        assert recover_takes(tmp_path) == [] and under_way(tmp_path / "take.mp4").exists()
        child.send_signal(signal.SIGKILL)
        told_s = max(map(float, child.stdout.read().split()), default=2.3)
    shutil.copy(under_way(tmp_path / "take.mp4"), tmp_path / "as_it_is.mp4")
    [sentence] = recover_takes(tmp_path)
    assert sentence.startswith("a take that was cut off was recovered: take.mp4 (")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["as_it_is.mp4", "take.mp4"] and recover_takes(tmp_path) == []
    for path in (tmp_path / "as_it_is.mp4", tmp_path / "take.mp4"):
        assert list(read_frames(path))[-1].time_s > told_s - 1.0
    with av.open(str(tmp_path / "take.mp4")) as container:
        stream = container.streams.video[0]
        container.seek(round(1.8 / stream.time_base), stream=stream)
        # A keyframe at least at every thirtieth picture.
        assert 0.8 - 1e-3 <= next(container.decode(stream)).time <= 1.8


def played(path: Path) -> int:
    """How many pictures a player shows of a file."""
    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


def test_a_file_cut_anywhere_plays_up_to_there_or_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At every box and within it, before and after the end was written; a take of the same name is not overwritten."""
    kept: dict[str, bytes] = {}

    def settle(working: Path, path: Path) -> bool:
        kept["ended"] = working.read_bytes()
        return plain(working, path)

    plain = take_file.settle
    monkeypatch.setattr(take_file, "settle", settle)
    recorder = recorder_of([])
    recorder.start(tmp_path / "take.mp4")
    for i in range(60):
        recorder.show(output(noise(i), i, i / 30))
    wait_until(lambda: recorder._frames.empty())
    time.sleep(0.2)
    fragments = under_way(tmp_path / "take.mp4").read_bytes()
    recorder.stop()
    monkeypatch.undo()
    for whole, lengths in ((fragments, range(0, len(fragments), len(fragments) // 11)), (kept["ended"], (len(kept["ended"]),))):
        counts = []
        for length in lengths:
            under_way(tmp_path / "take.mp4").write_bytes(whole[:length])
            told = recover_takes(tmp_path)
            left = tmp_path / "take-2.mp4"
            counts.append(played(left) if told else 0)
            assert left.exists() == bool(told) and not under_way(tmp_path / "take.mp4").exists()
            left.unlink(missing_ok=True)
        assert counts == sorted(counts) and counts[-1] >= 30
    # The end was being written when the process was killed: the second index is cut off, and the fragments are there.
    with (tmp_path / "half.mp4").open("w+b") as half:
        half.write(fragments)
        size = half.tell()
        half.write(b"\0\0\1\0moov" + bytes(248))
        assert playable_bytes(half) <= size
