"""Who watches a viewfinder: slow ones, several, strangers, those who talk nonsense; and for a long time, who come and go.

MRBOKEH_SOAK_S: how long, in seconds; 600 unless set.
"""

import asyncio
import gc
import json
import os
import socket
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from tests.scenes.layer_viewfinder import HEIGHT, WIDTH, running, set_focus, viewfinder, watching
from tests.scenes.live_clip import write_live_clip
from tests.scenes.live_viewfinder import Live, live
from tests.scenes.waiting import comes_true, in_time
from viewfinder.server.endpoint import serving_site
from viewfinder.sources.frame_source import SizeLimit
from viewfinder.sources.playback import PatternSource, VideoFileSource


def test_a_slow_viewer_skips_frames_and_sees_the_newest(plate: tuple[Path, np.ndarray]) -> None:
    async def work() -> None:
        async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as slow, watching(url) as quick:
            numbers, ages_ms = [], []

            async def be_quick() -> list[int]:
                return [(await quick.frame()).header["sequence"] for _ in range(60)]

            hurrying = asyncio.create_task(be_quick())
            for _ in range(6):
                shown = await slow.frame(acknowledge=False)
                numbers.append(shown.header["sequence"])
                ages_ms.append(shown.age_ms)
                await asyncio.sleep(0.25)
                # Without an acknowledgement nothing more was sent: the credit is one.
                with pytest.raises(TimeoutError):
                    await slow.stream.receive(timeout=0.02)
                await slow.acknowledge(shown)
            steps = np.diff(await hurrying)
        # 0.27 s are 13 frames at 50 per second; a queue would have delivered the next number instead.
        assert np.all(np.diff(numbers) >= 8)
        # The age is that of one frame and its way, however long the viewer took; a queue would add 250 ms each time.
        assert max(ages_ms) < 150
        # The slow viewer does not hold up the quick one.
        assert np.mean(steps) < 3

    in_time(work)


def test_several_viewers_come_and_go() -> None:
    async def work() -> None:
        async with running(PatternSource(WIDTH, HEIGHT, 60.0)) as url, watching(url) as stays:
            for _ in range(3):
                async with watching(url) as second, watching(url) as third:
                    frames = await asyncio.gather(*(viewer.frame() for viewer in (stays, second, third)))
                    assert all(shown.bgr.shape == (HEIGHT, WIDTH, 3) for shown in frames)
            before = (await stays.frame()).header["sequence"]
            assert (await stays.frame()).header["sequence"] > before

    in_time(work)


def test_messages_that_make_no_sense_change_nothing() -> None:
    async def work() -> None:
        async with running(PatternSource(WIDTH, HEIGHT)) as url, watching(url) as viewer:
            for bad in (0.01, -1, "2", True, [1]):
                status, answer = await set_focus(url, bad)
                assert status == 400
                assert answer["error"]
            assert (await viewer.frame(acknowledge=False)).header["focus_distance_m"] == 2.0
            for text in ("no json", "[]", '{"focus": 3}'):
                await viewer.stream.send_str(text)
                assert "error" in json.loads((await viewer.stream.receive(timeout=5)).data)
            await viewer.stream.send_json({"clock": 17.5})
            answer = json.loads((await viewer.stream.receive(timeout=5)).data)
            assert answer["clock"] == 17.5
            assert abs(answer["server_ms"] - 1000 * time.monotonic()) < 1000

    in_time(work)


def test_other_web_pages_are_refused() -> None:
    async def work() -> None:
        async with (
            running(PatternSource(WIDTH, HEIGHT)) as url,
            aiohttp.ClientSession(headers={"Origin": "http://elsewhere.example"}) as session,
        ):
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(url + "stream")
            async with session.post(url + "control", json={"focus": {"distance_m": 1.0}}) as answer:
                assert answer.status == 403

    in_time(work)


def test_the_port_is_free_again_and_a_taken_one_is_named(plate: tuple[Path, np.ndarray]) -> None:
    ports = []

    async def work() -> None:
        async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
            await viewer.frame()
            ports.append(int(url.rsplit(":", 1)[1].strip("/")))
            other = viewfinder(PatternSource(WIDTH, HEIGHT), plate[0].parent)
            with pytest.raises(InputError, match=f"port {ports[0]}.*--port"), other as second:
                async with serving_site(second.site, "127.0.0.1", ports[0]):
                    pass

    in_time(work)
    with socket.socket() as client, pytest.raises(ConnectionRefusedError):
        client.connect(("127.0.0.1", ports[0]))


SOAK_S = float(os.environ.get("MRBOKEH_SOAK_S", "600"))
WARM_UP = 0.3
"""This share of the rounds, and at least four, may grow: kernels are loaded and allocators take what they will keep."""
GROWTH_MB = 24.0
"""A decoded picture of the clip has 0.4 MB: a leak of one in fifty would show in ten minutes."""
VIEWERS_S = (1.0, 3.0, 5.0)


@dataclass(frozen=True)
class Rest:
    """What the process holds while nobody watches."""

    rss_mb: float
    threads: tuple[str, ...]
    open_files: int


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory and open files are read from /proc, which only Linux has")
def test_memory_threads_and_open_files_stay_while_viewers_come_and_go(tmp_path: Path) -> None:
    rests = asyncio.run(asyncio.wait_for(_soak(tmp_path), 2 * SOAK_S + 120))
    settled = rests[max(4, round(WARM_UP * len(rests))) :]
    assert len(settled) >= 3, f"only {len(rests)} rounds: give MRBOKEH_SOAK_S more than {SOAK_S:g}"
    rss_mb = np.array([each.rss_mb for each in settled])
    third = -(-len(rss_mb) // 3)
    growth_mb = float(np.median(rss_mb[-third:]) - np.median(rss_mb[:third]))
    print(f"{len(rests)} rounds in {SOAK_S:g} s, {rss_mb[0]:.0f} to {rss_mb[-1]:.0f} MB, growth of the medians {growth_mb:.1f} MB")
    assert growth_mb < GROWTH_MB
    assert {each.threads for each in settled} == {settled[0].threads}
    assert {each.open_files for each in settled} == {settled[0].open_files}


async def _soak(folder: Path) -> list[Rest]:
    clip, rests = write_live_clip(folder, 480, 270, 12), list[Rest]()
    end_s = time.monotonic() + SOAK_S
    async with live(clip, folder / "captures") as one:
        while time.monotonic() < end_s:
            watching = asyncio.gather(*(_viewer(one.url, seconds) for seconds in VIEWERS_S))
            await _play(one, len(rests))
            rates = await watching
            # Nobody is forgotten: this is no measurement, the cores are shared with the viewers.
            assert min(rates) > 1.0
            await comes_true(lambda: not one.is_watched, 30)
            rests.append(await _rest())
    return rests


async def _viewer(url: str, time_s: float) -> float:
    """Pictures per second that a viewer saw."""
    command = [sys.executable, "-m", "tests.scenes.live_viewers", url, "1", str(time_s)]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    said, _ = await process.communicate()
    assert process.returncode == 0
    return float(json.loads(said.splitlines()[-1])["rates"][0])


async def _play(one: Live, round_number: int) -> None:
    """What a photographer does meanwhile."""
    away_m = 0.02 * (-1) ** round_number
    await comes_true(lambda: one.viewfinder.compositor.last is not None, 60)
    for message in (
        {"object": {"name": "card", "move_m": [away_m, 0.0]}},
        {"focus": {"distance_m": 0.5 + 0.1 * (round_number % 3)}},
        {"lens": ("clip", "wide")[round_number % 2]},
        {"renderer": ("polygon", "scatter")[round_number % 2]},
        {"record": True},
        {"view": "depth"},
    ):
        await one.done(message)
        await asyncio.sleep(0.3)
    await one.done({"view": "final"})
    await comes_true(lambda: one.moment.pose is not None, 60)
    await one.done({"capture": {}})
    await one.done({"record": False})


async def _rest() -> Rest:
    """Two seconds later: sockets of viewers who left close a moment after them."""
    await asyncio.sleep(2.0)
    gc.collect()
    rss_mb = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    threads = sorted(thread.name for thread in threading.enumerate() if not thread.name.startswith("asyncio"))
    return Rest(rss_mb, tuple(threads), await _open_files())


async def _open_files() -> int:
    """The most of several looks: between two passes the clip is closed for a moment."""
    looks = []
    for _ in range(10):
        looks.append(len(os.listdir("/proc/self/fd")))
        await asyncio.sleep(0.05)
    return max(looks)
