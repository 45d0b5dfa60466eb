"""`mrbokeh viewfinder` as a process, and the sources that it opens by name."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

import aiohttp
import numpy as np
import pytest

from mrbokeh.images.image_io import write_layer
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.errors import InputError
from tests.scenes.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square, in_time, watching, write_plate
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize
from viewfinder.sources.playback import VideoFileSource


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return write_plate(tmp_path)


def test_a_file_plays_in_its_own_time(plate: tuple[Path, np.ndarray]) -> None:
    """30 frames at 50 per second last 0.58 s; at most 10 per second leave every fifth."""
    stopping = Event()
    for fps, every in ((None, 1), (10.0, 5)):
        frames = VideoFileSource(plate[0], WIDTH, HEIGHT, fps).frames(stopping)
        times_s = np.array([next(frames).captured_s for _ in range(30 // every)])
        assert times_s[-1] - times_s[0] == pytest.approx((30 // every - 1) * every / 50, abs=0.1)
        frames.close()


def test_sources_are_named_or_refused(plate: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    assert open_source("test", WIDTH, HEIGHT, None).name == "test pattern"
    assert open_source(str(plate[0]), 2 * WIDTH, 2 * HEIGHT, None).name == "plate.mkv"
    with pytest.raises(InputError, match="aspect ratio"):
        next(ExactSize(open_source(str(plate[0])), 100, 100).frames(Event()))
    assert next(ExactSize(open_source(str(plate[0])), 320, 180).frames(Event())).bgr.shape == (180, 320, 3)
    with pytest.raises(InputError, match="none of them"):
        open_source(str(tmp_path / "absent.mp4"), WIDTH, HEIGHT, None)
    with pytest.raises(InputError, match="--fps"):
        open_source("test", WIDTH, HEIGHT, 0.0)
    with pytest.raises(InputError, match="cannot be opened"):
        open_source("987", WIDTH, HEIGHT, None)


@contextmanager
def command(tmp_path: Path, *extra: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`mrbokeh viewfinder` as a process, and the address that it prints."""
    write_layer(tmp_path / "layer.exr", bright_square())
    write_lens(tmp_path / "lens.json", LENS)
    files = ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json")]
    arguments = [sys.executable, "-u", "-m", "mrbokeh.cli", "viewfinder", "--source", "test", *files, *extra]
    root = Path(__file__).parents[2]
    with subprocess.Popen(arguments, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            yield process, next((word for word in line.split() if word.startswith("http://")), "")
        finally:
            process.kill()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
def test_the_command_serves_until_ctrl_c(tmp_path: Path) -> None:
    with command(tmp_path, "--port", "0") as (process, url):
        assert url.startswith("http://127.0.0.1:")

        async def work() -> None:
            async with watching(url) as viewer, aiohttp.ClientSession() as session:
                assert (await viewer.frame()).bgr.shape == (HEIGHT, WIDTH, 3)
                async with session.get(url) as page:
                    assert "viewport" in await page.text()
                process.send_signal(signal.SIGINT)
                while (await viewer.stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY:
                    pass
                assert viewer.stream.close_code == aiohttp.WSCloseCode.GOING_AWAY

        in_time(work)
        output, errors = process.communicate(timeout=10)
        assert (process.returncode, output, errors) == (0, "viewfinder stopped\n", "")


def test_a_taken_port_ends_the_command_with_a_sentence(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with command(tmp_path, "--port", str(taken.getsockname()[1])) as (process, _):
            _, errors = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "choose another one with --port" in errors
    assert "Traceback" not in errors
