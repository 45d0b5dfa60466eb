"""The engine of shots: whoever makes the segments, and however often it is killed, the result is the one made in one go."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from mrbokeh.images.image_io import read_image, read_layer, write_image
from mrbokeh.shots.claims import claimed
from mrbokeh.shots.executors import Executor, ProcessExecutor, SegmentTask, SerialExecutor, render_segment
from mrbokeh.shots.render_shot import PartsFolder, SequenceTarget, VideoTarget, render_shot
from mrbokeh.shots.shot import FrameMaker, MakerRecipe, Shot, Target
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import probe, read_frames
from mrbokeh.video.picture_source import frames_taken, open_source
from mrbokeh.video.writer import VideoWriter
from tests.support.refusals import refused
from tests.support.shot_makers import Brighter, wait_for

INTRA = [("prores4444", ".mov"), ("prores4444-alpha", ".mov"), ("dnxhr-hqx", ".mov"), ("dnxhr-hqx", ".mxf")]
INTRA += [("ffv1", ".mkv"), ("ffv1-alpha", ".mkv")]
INTER = [("h264", ".mp4"), ("h264-10bit", ".mkv"), ("h265-10bit", ".mp4"), ("h265-10bit", ".mov"), ("h265-10bit", ".mkv")]
COUNT, PER_SEGMENT = 23, 5


def clip_of_blobs(folder: Path, count: int = COUNT, size: tuple[int, int] = (64, 48)) -> Path:
    """Lossless, with uneven times in milliseconds, as Matroska keeps them: 40 ms and up to 14 more."""
    rng, path = np.random.default_rng(8), folder / "clip.mkv"
    slow = cv2.resize(rng.random((size[1] // 8, size[0] // 8, 3), np.float32), size, interpolation=cv2.INTER_LINEAR)
    with VideoWriter(path, *size, Fraction(25), Fraction(1, 1000)) as writer:
        for i in range(count):
            writer.write(np.roll(slow, 3 * i, axis=1) * 0.8, (40 * i + i % 3 * 7) / 1000)
    return path


def even_clip(folder: Path, size: tuple[int, int]) -> Path:
    path = folder / "even.mkv"
    with VideoWriter(path, *size, Fraction(25), Fraction(1, 1000)) as writer:
        for i in range(COUNT):
            writer.write(np.full((size[1], size[0], 3), 0.02 * i, np.float32), i / 25)
    return path


def shot_of(clip: Path, target: Target, recipe: MakerRecipe | None = None, frames: tuple[int, int] = (0, COUNT)) -> Shot:
    return Shot(open_source(clip), recipe or Brighter(), target, range(*frames), PER_SEGMENT)


def packets_and_times(path: Path) -> tuple[list[bytes], list[Fraction]]:
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    with av.open(str(path)) as container:
        return packets, [frame.pts * frame.time_base for frame in container.decode(video=0)]


def written_in_one_go(shot: Shot, path: Path, encoding: str) -> None:
    info, maker = shot.source.info, shot.recipe.build(1)
    with VideoWriter(path, info.width_px, info.height_px, info.frame_rate, info.time_base, encoding=encoding, threads=1) as writer:
        for index, frame in zip(shot.taken, frames_taken(shot.source, shot.taken), strict=True):
            writer.write(maker.make(index, frame.rgb, frame.time_s), frame.time_s)


@pytest.mark.parametrize(("encoding", "suffix"), INTRA)
def test_joined_parts_are_the_file_written_in_one_go(tmp_path: Path, encoding: str, suffix: str) -> None:
    """Where every picture stands alone the files are the same to the byte, header and all."""
    size = (256, 128) if encoding.startswith("dnxhr") else (64, 48)  # DNxHR takes none smaller
    shot = shot_of(even_clip(tmp_path, size), VideoTarget(tmp_path / f"out{suffix}", encoding))
    render_shot(shot, SerialExecutor())
    written_in_one_go(shot, tmp_path / f"whole{suffix}", encoding)
    assert packets_and_times(tmp_path / f"out{suffix}") == packets_and_times(tmp_path / f"whole{suffix}")
    assert (tmp_path / f"out{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["even.mkv", f"out{suffix}", f"whole{suffix}"]


@pytest.mark.slow
@pytest.mark.parametrize(("encoding", "suffix"), INTER)
def test_joined_groups_of_pictures_keep_pictures_and_times(tmp_path: Path, encoding: str, suffix: str) -> None:
    """Every joined picture is the one that its part shows, at its uneven time; the file can be entered at each segment."""
    shot = shot_of(clip_of_blobs(tmp_path), VideoTarget(tmp_path / f"out{suffix}", encoding))
    folder = PartsFolder.opened(shot)
    for segment in shot.segments:
        render_segment(SegmentTask(shot, segment, folder.path))
    parts = [frame.rgb for segment in shot.segments for frame in read_frames(shot.target.part(folder.path, segment))]
    assert render_shot(shot, SerialExecutor()) == "no audio"
    frames = list(read_frames(shot.target.path))
    np.testing.assert_allclose([frame.time_s for frame in frames], shot.source.times_s, atol=1e-9)
    for there, here in zip(parts, frames, strict=True):
        np.testing.assert_array_equal(here.rgb, there)
    made = np.stack([Brighter().build(1).make(index, before.rgb, 0.0) for index, before in enumerate(shot.source.frames(0, COUNT))])
    for index, after in enumerate(frames):
        errors = np.abs(made - after.rgb).mean(axis=(1, 2, 3))
        # Halved chroma and quantisation blur the blobs a little; any other frame is far off.
        assert 2.5 * errors[index] < np.delete(errors, index).min()
    source = open_source(shot.target.path)
    np.testing.assert_array_equal(next(source.frames(12, 13)).rgb, frames[12].rgb)
    with av.open(str(shot.target.path)) as container:
        stamps = [(packet.dts, packet.pts) for packet in container.demux(video=0) if packet.size and packet.dts is not None]
    assert all(a[0] < b[0] for a, b in pairwise(stamps)), "times of decoding grow"
    assert all(dts <= pts for dts, pts in stamps)


@pytest.mark.parametrize("executor", [SerialExecutor(1), SerialExecutor(2)], ids=["one core", "overlapping"])
def test_every_frame_gets_its_own_number_and_time(tmp_path: Path, executor: Executor) -> None:
    assert isinstance(executor, Executor)
    shot = shot_of(clip_of_blobs(tmp_path), VideoTarget(tmp_path / "out.mkv"), frames=(3, 20))
    assert isinstance(shot.recipe, MakerRecipe) and isinstance(shot.recipe.build(1), FrameMaker) and isinstance(shot.target, Target)
    told: list[int] = []
    render_shot(shot, executor, progress=told.append)
    assert sum(told) == 17
    times_s = shot.source.times_s
    for index, before, after in zip(range(3, 20), shot.source.frames(3, 20), read_frames(tmp_path / "out.mkv"), strict=True):
        assert after.time_s == pytest.approx(times_s[index] - times_s[3], abs=1e-9)
        # One 16-bit step of BT.709 codes at white is 2.1 / 65535 of light.
        np.testing.assert_allclose(after.rgb, 0.5 * before.rgb + 0.1 * (index % 5 + 1) / 5, atol=2.1 / 65535)


def test_sound_is_copied_where_segments_are_joined(tmp_path: Path, shared_data: Path) -> None:
    """The sound of a real clip, under small pictures of uneven times."""
    source = shared_data / "video" / "ducks_720p.mp4"
    target = VideoTarget(tmp_path / "out.mp4", audio_from=source)
    shot = Shot(open_source(clip_of_blobs(tmp_path)), Brighter(0.0), target, range(6, 14), 4)
    assert render_shot(shot, SerialExecutor()) == "audio copied (aac)"
    begin_s = float(shot.source.times_s[6])
    with av.open(str(source)) as container:
        stored = {bytes(packet): float(packet.pts * packet.time_base) for packet in container.demux(audio=0) if packet.size}
    with av.open(str(tmp_path / "out.mp4")) as container:
        heard = [(bytes(packet), float(packet.pts * packet.time_base)) for packet in container.demux(audio=0) if packet.size]
    assert [time_s for _, time_s in heard] == pytest.approx([stored[packet] - begin_s for packet, _ in heard], abs=1e-4)
    # 8 pictures last 0.3 s; AAC has 1024 samples of 44100 Hz in a packet.
    assert len(heard) == pytest.approx((float(shot.source.times_s[14]) - begin_s) * 44100 / 1024, abs=3)
    times_s = [frame.time_s for frame in read_frames(tmp_path / "out.mp4")]
    np.testing.assert_allclose(times_s, shot.source.times_s[6:14] - begin_s, atol=1e-9)


@pytest.mark.slow
def test_a_real_clip_of_uneven_times_keeps_them(tmp_path: Path, shared_data: Path) -> None:
    """The iPhone's HEVC with a variable rate, into H.265 in parts."""
    clip = shared_data / "video" / "iphone_xr_chart.mov"
    shot = Shot(open_source(clip), Brighter(0.0), VideoTarget(tmp_path / "out.mov", "h265-10bit", clip), range(5), 3)
    assert render_shot(shot, SerialExecutor()) == "audio copied (pcm_s16le)"
    np.testing.assert_allclose([frame.time_s for frame in read_frames(tmp_path / "out.mov")], shot.source.times_s[:5], atol=1e-9)
    assert probe(tmp_path / "out.mov").color.transfer == 1


@pytest.mark.parametrize("suffix", [".exr", ".png", ".tif"])
def test_numbered_pictures_in_and_out(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(1)
    for number in range(1001, 1008):
        write_image(tmp_path / f"in.{number}{suffix}", rng.random((24, 32, 3), np.float32))
    shot = Shot(
        open_source(tmp_path / f"in.%04d{suffix}", "24"), Brighter(), SequenceTarget(tmp_path / f"out.%04d{suffix}", 1001), range(2, 7), 2
    )
    render_shot(shot, SerialExecutor())
    outs = sorted(file.name for file in tmp_path.glob("out.*"))
    assert outs == [f"out.{number}{suffix}" for number in range(1003, 1008)]
    for index, frame in enumerate(shot.source.frames(2, 7), 2):
        expected = 0.5 * frame.rgb + 0.1 * (index % 5 + 1) / 5
        np.testing.assert_allclose(read_image(tmp_path / f"out.{1001 + index}{suffix}"), expected, atol=2**-11)
    refused(r"out\.1003\S+ exists already", render_shot, shot, SerialExecutor())
    render_shot(shot, SerialExecutor(), overwrite=True)


def test_a_virtual_layer_alone_keeps_its_alpha(tmp_path: Path) -> None:
    """In ProRes 4444 as straight colour beside alpha, in EXR premultiplied with depth."""
    clip, recipe = clip_of_blobs(tmp_path), Brighter(as_layer=True)
    render_shot(shot_of(clip, VideoTarget(tmp_path / "out.mov", "prores4444-alpha"), recipe, (0, 6)), SerialExecutor())
    with av.open(str(tmp_path / "out.mov")) as container:
        stored = next(container.decode(video=0)).reformat(format="yuva444p16le")
    alpha = np.frombuffer(stored.planes[3], "<u2").reshape(48, -1)[:, :64] / 65535
    np.testing.assert_allclose(alpha, 0.5, atol=1 / 1023)
    first = next(open_source(clip).frames(0, 1)).rgb
    # ProRes of 10 bit: a code step is 1/876 of luma; the mean error of such blocks stays near one.
    assert np.abs(next(read_frames(tmp_path / "out.mov")).rgb - (0.5 * first + 0.02)).mean() < 0.004
    render_shot(shot_of(clip, SequenceTarget(tmp_path / "out.%04d.exr", layers=True), recipe, (0, 6)), SerialExecutor())
    layer = read_layer(tmp_path / "out.0000.exr")
    np.testing.assert_allclose(layer.rgb, 0.5 * (0.5 * first + 0.02), atol=2**-11)
    assert (layer.alpha == 0.5).all() and (layer.depth_m == 2.0).all()


def test_what_a_container_cannot_hold_is_told_before_the_work(tmp_path: Path) -> None:
    clip = clip_of_blobs(tmp_path, size=(272, 136))
    refused("even rates only", render_shot, shot_of(clip, VideoTarget(tmp_path / "out.mxf")), SerialExecutor())
    refused("too small for dnxhd", render_shot, shot_of(clip_of_blobs(tmp_path), VideoTarget(tmp_path / "out.mxf")), SerialExecutor())
    for name in ("out.%04d.gif", "out.%04d"):
        refused("expected numbered", render_shot, shot_of(clip, SequenceTarget(tmp_path / name)), SerialExecutor())
    with pytest.raises(InputError, match=r"expected numbered \.exr, not \.png"):
        render_shot(shot_of(clip, SequenceTarget(tmp_path / "out.%04d.png", layers=True)), SerialExecutor())
    assert [file.name for file in tmp_path.iterdir()] == ["clip.mkv"]


def test_what_is_finished_is_not_made_again(tmp_path: Path) -> None:
    clip, target = clip_of_blobs(tmp_path), VideoTarget(tmp_path / "out.mkv")
    whole = VideoTarget(tmp_path / "whole.mkv")
    render_shot(shot_of(clip, whole), SerialExecutor())
    shot = shot_of(clip, target)
    folder = PartsFolder.opened(shot)
    for segment in (shot.segments[1], shot.segments[3]):
        render_segment(SegmentTask(shot, segment, folder.path))
    made_at = {number: shot.target.part(folder.path, shot.segments[number]).stat().st_mtime_ns for number in (1, 3)}

    class Watching(SerialExecutor):
        def run(self, tasks: Any, progress: Any) -> None:
            assert [task.segment.number for task in tasks] == [0, 2, 4]
            super().run(tasks, progress)
            for number, stamp in made_at.items():
                assert shot.target.part(folder.path, shot.segments[number]).stat().st_mtime_ns == stamp

    told: list[int] = []
    render_shot(shot, Watching(), progress=told.append)
    assert told[0] == 10 and sum(told) == COUNT
    assert target.path.read_bytes() == whole.path.read_bytes()
    assert not folder.path.exists()


def test_parts_of_other_settings_are_refused_but_not_a_folder_without_parts(tmp_path: Path) -> None:
    clip, other = clip_of_blobs(tmp_path), tmp_path / "lens.json"
    other.write_text("one")
    begun = shot_of(clip, VideoTarget(tmp_path / "out.mkv"), Brighter(0.1, reads=(other,)))
    render_segment(SegmentTask(begun, begun.segments[0], PartsFolder.opened(begun).path))
    changes = {
        "amount": shot_of(clip, VideoTarget(tmp_path / "out.mkv"), Brighter(0.2, reads=(other,))),
        "frames": shot_of(clip, VideoTarget(tmp_path / "out.mkv"), Brighter(0.1, reads=(other,)), (0, 9)),
    }
    for name, shot in changes.items():
        refused(rf"other settings \({name}\): run with the same to go on, or --overwrite", render_shot, shot, SerialExecutor())
    other.write_text("another")
    with pytest.raises(InputError, match=r"other settings \(files\)"):
        render_shot(shot_of(clip, VideoTarget(tmp_path / "out.mkv"), Brighter(0.1, reads=(other,))), SerialExecutor())
    render_shot(changes["amount"], SerialExecutor(), overwrite=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["clip.mkv", "lens.json", "out.mkv"]
    refused("exists already", render_shot, changes["amount"], SerialExecutor())
    # A run that was stopped before its first segment leaves its manifest alone: nothing of it can be mixed with other settings.
    target = VideoTarget(tmp_path / "again.mkv")
    before = PartsFolder.opened(shot_of(clip, target, Brighter(0.1)))
    assert before.path.is_dir() and not before.holds_parts and len(before.missing) == 5
    begun = PartsFolder.opened(shot_of(clip, target, Brighter(0.2)))
    render_segment(SegmentTask(begun.shot, begun.shot.segments[0], begun.path))
    assert begun.holds_parts and len(begun.missing) == 4
    refused(r"other settings \(amount\)", render_shot, before.shot, SerialExecutor())
    render_shot(begun.shot, SerialExecutor())
    render_shot(shot_of(clip, VideoTarget(tmp_path / "whole.mkv"), Brighter(0.2)), SerialExecutor())
    assert target.path.read_bytes() == (tmp_path / "whole.mkv").read_bytes()


@contextmanager
def opened_once_all_work(recipe: Brighter, count: int = 2) -> Iterator[None]:
    """No held frame is made before so many workers have come, so that none of them finds all done."""
    assert recipe.gate is not None and recipe.pids is not None
    gate, pids = recipe.gate, recipe.pids
    pids.mkdir()

    def open_it() -> None:
        wait_for(lambda: len(list(pids.iterdir())) == count)
        gate.touch()

    opener = threading.Thread(target=open_it, daemon=True)
    opener.start()
    yield
    opener.join()


@pytest.fixture
def alone_in_their_main(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers import the main module of whoever starts them: for those of pytest that is itself, half of their time."""
    main = sys.modules["__main__"]
    for name in ("__spec__", "__file__"):
        monkeypatch.setattr(main, name, None, raising=False)


@pytest.mark.usefixtures("alone_in_their_main")
def test_worker_processes_make_the_same_file_and_a_killed_one_loses_nothing(tmp_path: Path) -> None:
    """One of two is killed (signal 9) at frame 3, in the middle of the first segment; frames from 4 on wait until another replaced it."""
    clip = clip_of_blobs(tmp_path)
    render_shot(shot_of(clip, VideoTarget(tmp_path / "one.mp4")), SerialExecutor())
    told: list[int] = []
    fatal = tmp_path / "fatal"
    fatal.touch()
    recipe = Brighter(gate=tmp_path / "gate", held_from=4, killing=fatal, pids=tmp_path / "pids")
    with opened_once_all_work(recipe, 3):
        render_shot(shot_of(clip, VideoTarget(tmp_path / "two.mp4"), recipe), ProcessExecutor(2), progress=told.append)
    assert not fatal.exists() and len(list((tmp_path / "pids").iterdir())) == 3
    assert sum(told) == COUNT
    assert (tmp_path / "two.mp4").read_bytes() == (tmp_path / "one.mp4").read_bytes()
    assert sorted(file.name for file in tmp_path.glob("*.*")) == ["clip.mkv", "one.mp4", "two.mp4"]


@pytest.mark.usefixtures("alone_in_their_main")
def test_a_mistake_in_a_worker_is_told_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="pictures with alpha need"):
        render_shot(shot_of(clip_of_blobs(tmp_path), VideoTarget(tmp_path / "out.mkv"), Brighter(as_layer=True)), ProcessExecutor(1))


STARTING = """
import signal, time
from multiprocessing import get_context
from pathlib import Path
from mrbokeh.shots.executors import _ctrl_c_later
for _ in range(2):
    worker = get_context("spawn").Process(target=time.sleep, args=(60,), daemon=True)
    with _ctrl_c_later():
        worker.start()
    blocked = Path(f"/proc/{worker.pid}/status").read_text().partition("SigBlk:")[2].split()[0]
    print(int(blocked, 16) >> signal.SIGINT - 1 & 1, int(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())))
    worker.terminate()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ctrl_c_is_held_back_from_the_first_worker_as_from_the_others() -> None:
    """The first start of a process starts Python's resource tracker too, which lets SIGINT through again (CPython 3.11). 1: held back."""
    assert subprocess.run([sys.executable, "-c", STARTING], capture_output=True, text=True).stdout == "1 0\n" * 2


def held_shot(folder: Path) -> Shot:
    """The clip in a folder; frames from the third segment on wait for its gate."""
    recipe = Brighter(gate=folder / "gate", held_from=2 * PER_SEGMENT, pids=folder / "pids")
    return shot_of(folder / "clip.mkv", VideoTarget(folder / "out.mkv"), recipe)


PROGRAM = """
import sys
from pathlib import Path
from mrbokeh.shots.render_shot import render_shot
from mrbokeh.shots.executors import ProcessExecutor
if __name__ == "__main__":
    from tests.shots.test_shots import held_shot
    render_shot(held_shot(Path(sys.argv[1])), ProcessExecutor(2))
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path) -> None:
    """The whole program dies of signal 9 after its first segments; its workers leave by themselves; the same again ends as in one go."""
    clip = clip_of_blobs(tmp_path)
    render_shot(shot_of(clip, VideoTarget(tmp_path / "whole.mkv")), SerialExecutor())
    (tmp_path / "pids").mkdir()
    root = Path(__file__).parents[2]
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path)]
    process = subprocess.Popen(command, cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    shot = held_shot(tmp_path)
    parts = [shot.target.part(shot.parts_path, segment) for segment in shot.segments]
    wait_for(lambda: all(part.exists() for part in parts[:2]) or process.poll() is not None)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    workers = [int(file.name) for file in (tmp_path / "pids").iterdir()]
    wait_for(lambda: not any(alive(pid) for pid in workers))
    assert workers and [part.exists() for part in parts] == [True, True, False, False, False]
    assert not (tmp_path / "out.mkv").exists()
    (tmp_path / "gate").touch()
    told: list[int] = []
    render_shot(shot, SerialExecutor(), progress=told.append)
    assert told[0] == 2 * PER_SEGMENT and sum(told) == COUNT, "what was finished is not made again"
    assert (tmp_path / "out.mkv").read_bytes() == (tmp_path / "whole.mkv").read_bytes()
    assert not shot.parts_path.exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
@pytest.mark.slow
def test_two_runs_of_one_command_share_the_segments(tmp_path: Path) -> None:
    """As two machines on one disk: each makes what the other has not claimed, one joins, and the file is that of one run, though one of the
    first run's workers dies of signal 9 in the middle of a segment, which whoever is free takes over.
    """
    clip = clip_of_blobs(tmp_path)
    render_shot(shot_of(clip, VideoTarget(tmp_path / "whole.mkv")), SerialExecutor())
    (tmp_path / "pids").mkdir()
    (tmp_path / "program.py").write_text(PROGRAM)
    shot, root = held_shot(tmp_path), Path(__file__).parents[2]
    command, environment = [sys.executable, str(tmp_path / "program.py"), str(tmp_path)], {**os.environ, "PYTHONPATH": str(root)}
    runs = [subprocess.Popen(command, cwd=root, env=environment) for _ in range(2)]
    # Four workers: two make the first two segments, then three hold one each, before the gate.
    parts = [shot.target.part(shot.parts_path, segment) for segment in shot.segments]
    wait_for(lambda: len(list(shot.parts_path.glob("0*.claim"))) == 3 and all(part.exists() for part in parts[:2]))
    claims = {int(each.read_text().split()[1]): each.name for each in shot.parts_path.glob("*.claim")}
    assert sorted(claims.values()) == ["00002.claim", "00003.claim", "00004.claim"], "nobody works on what another has"
    os.kill(next(iter(claims)), signal.SIGKILL)
    (tmp_path / "gate").touch()
    assert [run.wait(timeout=60) for run in runs] == [0, 0]
    assert (tmp_path / "out.mkv").read_bytes() == (tmp_path / "whole.mkv").read_bytes()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["clip.mkv", "gate", "out.mkv", "pids", "program.py", "whole.mkv"]


def test_claims_are_taken_over_only_from_the_dead(tmp_path: Path) -> None:
    """A living owner keeps its claim as long as it is touched; one of a dead process is free at once, one untouched for a minute then."""
    claim = tmp_path / "00000.claim"
    with claimed(claim) as mine:
        with claimed(claim) as other:
            assert (mine, other) == (True, False)
        machine = claim.read_text().split()[0]
    assert not claim.exists()
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for owner, age_s, is_free in (
        (f"{machine} {dead.pid} a", 0, True), (f"{machine} {os.getpid()} a", 0, False), (f"{machine} {os.getpid()} a", 90, True),
        (f"elsewhere {dead.pid} a", 30, False), (f"elsewhere {os.getpid()} a", 90, True), ("", 30, False), ("", 90, True),
    ):  # fmt: skip
        claim.write_text(owner)
        touched_s = time.time() - age_s
        os.utime(claim, (touched_s, touched_s))
        with claimed(claim) as taken:
            assert taken == is_free
        assert claim.exists() != is_free
    assert {each.name for each in tmp_path.iterdir()} <= {"00000.claim"}, "no signs are left"
    with claimed(tmp_path / "gone" / "00000.claim") as taken:
        assert not taken


def test_ranges_of_a_sequence_are_written_side_by_side(tmp_path: Path) -> None:
    """As a farm does it: the parts of each task have a folder of their own."""
    clip, target = clip_of_blobs(tmp_path), SequenceTarget(tmp_path / "out.%04d.exr", 1001)
    shots = [shot_of(clip, target, frames=frames) for frames in ((0, 10), (10, 23))]
    assert [each.parts_path.name for each in shots] == ["out.%04d.exr.1001-1010.parts", "out.%04d.exr.1011-1023.parts"]
    PartsFolder.opened(shots[0])
    render_shot(shots[1], SerialExecutor())
    render_shot(shots[0], SerialExecutor())
    assert len(list(tmp_path.glob("out.*"))) == 23


def alive(pid: int) -> bool:
    """Whether a process works; one that nobody waits for is dead all the same."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"
    except OSError:
        return False
