"""What a composited clip costs: `python -m tests.bench.bench_video [FRAMES]` (300 by default).

1920x1080, H.264 in and out, 25 frames per second. A textured disc of 480 px wanders through the picture while the focus is pulled
through it, so that every frame is blurred anew by the polygon lens (50 mm, f/1.8, circles of confusion up to 40 px). The yardstick is
the same clip decoded to linear light and encoded again with nothing put in. Workers have one thread each for the compositing;
decoder and encoder have threads of their own, so that one worker alone keeps more than a core busy. What two cores give is therefore
compared with one worker that has one core. "One process" uses its threads within each frame instead.
"""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mrbokeh.commands.video import segment_frames
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.shots.composite_recipe import CompositeRecipe
from mrbokeh.shots.executors import Executor, ProcessExecutor, SerialExecutor
from mrbokeh.shots.frame_sources import FocusPulled
from mrbokeh.shots.render_shot import VideoTarget, render_shot
from mrbokeh.shots.shot import SEGMENT_S, MakerRecipe, Shot
from mrbokeh.video.clip import probe
from mrbokeh.video.picture_source import open_source
from mrbokeh.video.writer import VideoWriter
from tests.bench.machine import machine_line
from tests.support.shot_makers import Brighter, MovingDisc

WIDTH, HEIGHT, RATE = 1920, 1080, 25
LENS = Lens(focal_length_mm=50.0, f_number=1.8, focus_distance_m=2.5, sensor_width_mm=36.0)


class Memory:
    """The largest sum of the memory of this process and its children; pages that they share count once (proportional set size)."""

    def __init__(self) -> None:
        self.largest_mb, self._done = 0.0, threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Memory":
        self._watcher.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._done.set()
        self._watcher.join()

    def _watch(self) -> None:
        while not self._done.wait(0.2):
            self.largest_mb = max(self.largest_mb, sum(map(_own_mb, [os.getpid(), *_children(os.getpid())])))


def _own_mb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1e3
    except (OSError, StopIteration):
        return 0.0


def _children(pid: int) -> list[int]:
    try:
        direct = [int(each) for task in Path(f"/proc/{pid}/task").iterdir() for each in (task / "children").read_text().split()]
    except OSError:
        return []
    return [each for child in direct for each in (child, *_children(child))]


@contextmanager
def one_core() -> Iterator[None]:
    """Children inherit it."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def write_clip(path: Path, frames: int) -> None:
    """Soft blobs that drift, with a little of a sensor's noise; a keyframe every 250 frames, as encoders have it by default."""
    import cv2

    rng = np.random.default_rng(1)
    blobs = cv2.resize(rng.random((27, 2 * 48, 3), np.float32), (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    noise = rng.normal(0.0, 0.004, (HEIGHT + 64, WIDTH + 64, 3)).astype(np.float32)
    with VideoWriter(path, WIDTH, HEIGHT, Fraction(RATE)) as writer:
        for i in range(frames):
            y, x = rng.integers(0, 64, 2)
            writer.write(np.ascontiguousarray(blobs[:, 3 * i : 3 * i + WIDTH] + noise[y : y + HEIGHT, x : x + WIDTH]), i / RATE)


def rate_of(clip: Path, recipe: MakerRecipe, executor: Executor, encoding: str = "h264") -> tuple[float, float]:
    """(frames per second, largest memory in MB) of a whole run, from the start of the processes to the joined file."""
    out = clip.with_name(f"out.{'mp4' if encoding.startswith('h26') else 'mov'}")
    source = open_source(clip)
    shot = Shot(
        source, recipe, VideoTarget(out, encoding), range(len(source.times_s)), segment_frames(len(source.times_s), round(SEGMENT_S * RATE))
    )
    with Memory() as memory:
        started_s = time.perf_counter()
        render_shot(shot, executor)
        seconds = time.perf_counter() - started_s
    assert probe(out).frame_count == len(source.times_s)
    out.unlink()
    return len(source.times_s) / seconds, memory.largest_mb


def main() -> None:
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    with TemporaryDirectory() as folder:
        clip, lens = Path(folder) / "clip.mp4", Path(folder) / "lens.json"
        write_clip(clip, frames)
        write_lens(lens, LENS)
        pull = FocusPulled(f"0:0.8,{frames // 2}:2.5,{frames - 1}:0.8")
        recipe = CompositeRecipe(lens, (MovingDisc(),), focus=pull)
        runs: dict[str, tuple[MakerRecipe, Executor, str]] = {
            "1 worker": (recipe, ProcessExecutor(1, threads=1), "h264"),
            "2 workers": (recipe, ProcessExecutor(2, threads=1), "h264"),
            "one process, 2 threads": (recipe, SerialExecutor(2), "h264"),
            "2 workers, nothing put in": (Brighter(0.0), ProcessExecutor(2, threads=1), "h264"),
            "2 workers, ProRes 4444": (recipe, ProcessExecutor(2, threads=1), "prores4444"),
        }
        with one_core():
            rates = {"1 worker, 1 core": rate_of(clip, recipe, ProcessExecutor(1, threads=1))[0]}
        print(f"1 worker, 1 core: {rates['1 worker, 1 core']:.2f} frames per second", flush=True)
        for name, (each, executor, encoding) in runs.items():
            rates[name], memory_mb = rate_of(clip, each, executor, encoding)
            print(f"{name}: {rates[name]:.2f} frames per second, {memory_mb:.0f} MB in all processes", flush=True)
    print(f"2 workers to 1 on one core: {rates['2 workers'] / rates['1 worker, 1 core']:.2f}")
    print(f"2 workers to 1 that may use both cores: {rates['2 workers'] / rates['1 worker']:.2f}")
    print(f"2 workers to one process with 2 threads: {rates['2 workers'] / rates['one process, 2 threads']:.2f}")
    print(f"compositing to decoding and encoding alone: {rates['2 workers'] / rates['2 workers, nothing put in']:.2f} of its rate")
    print(machine_line())


if __name__ == "__main__":
    main()
