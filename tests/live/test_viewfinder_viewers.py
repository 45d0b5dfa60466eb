"""Who watches a viewfinder: slow ones, several, strangers, and those who talk nonsense."""

import asyncio
import json
import socket
import time
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from tests.scenes.layer_viewfinder import (
    HEIGHT,
    WIDTH,
    in_time,
    running,
    set_focus,
    viewfinder,
    watching,
    write_plate,
)
from viewfinder.server.endpoint import serving_site
from viewfinder.sources.playback import PatternSource, VideoFileSource


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return write_plate(tmp_path)


def test_a_slow_viewer_skips_frames_and_sees_the_newest(plate: tuple[Path, np.ndarray]) -> None:
    async def work() -> None:
        async with running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url, watching(url) as slow, watching(url) as quick:
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
        async with running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url, watching(url) as viewer:
            await viewer.frame()
            ports.append(int(url.rsplit(":", 1)[1].strip("/")))
            other = viewfinder(PatternSource(WIDTH, HEIGHT), plate[0].parent)
            with pytest.raises(InputError, match=f"port {ports[0]}.*--port"), other as second:
                async with serving_site(second.site, "127.0.0.1", ports[0]):
                    pass

    in_time(work)
    with socket.socket() as client, pytest.raises(ConnectionRefusedError):
        client.connect(("127.0.0.1", ports[0]))
