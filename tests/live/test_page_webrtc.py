"""The page in a real headless Chromium over WebRTC: video through WHEP with its age, the fallback, and a camera sent through WHIP."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from datasets_scripts.gallery.headless_chromium import CHROMIUM, chromium_page
from tests.live.test_page_browser import color_at
from tests.scenes.made_viewfinder import LENS_RGB, VIEW_RGB, Made, in_time, made_viewfinder
from viewfinder.server.access import Access
from viewfinder.server.sessions import Role, Sessions

pytest.importorskip("aiortc")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; WebRTC is tested by clients in Python only"),
]
SHOWN = "window.viewfinder && viewfinder.counts.shown > 5"


@pytest.fixture(autouse=True)
def new_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """aioice resolves Chromium's .local candidates behind a lock of the first event loop; servers have one, these tests several."""
    monkeypatch.delattr("aioice.ice._mdns.lock", raising=False)


@asynccontextmanager
async def with_video(access: Access | None = None) -> AsyncIterator[tuple[Made, Any]]:
    """A viewfinder that also encodes video."""
    from viewfinder.streaming.encoded_stream import EncodedStream
    from viewfinder.streaming.whep import Whep

    stream = EncodedStream()
    try:
        whep = Whep(stream)
        async with made_viewfinder(access, sinks=[stream], whep=whep) as made:
            yield made, whep
    finally:
        stream.close()


def test_video_comes_first_with_its_age_and_what_is_known_of_each_picture(tmp_path: Path) -> None:
    sessions = Sessions()

    async def work() -> None:
        async with with_video(Access(sessions=sessions)) as (made, whep):
            url = f"{made.url}#token={sessions.invitation(Role.CONTROL)}"
            async with chromium_page(url, tmp_path / "profile") as page:
                await page.comes_true(f"{SHOWN} && viewfinder.age !== null && viewfinder.clock.known")
                await page.comes_true("document.getElementById('way').textContent === 'video'")
                assert whep.viewers == 1 and not made.jpeg.broadcaster.sockets
                assert await page.value("!document.getElementById('video').hidden && document.getElementById('picture').hidden")
                # From the capture to the screen on one machine.
                assert 0 < await page.value("viewfinder.age") < 1000
                assert await page.value("viewfinder.focus") == 2.0
                # Video at this size keeps flat colours within a few codes.
                np.testing.assert_allclose(await color_at(page, 0.2, 0.5), VIEW_RGB["final"], atol=8)
                np.testing.assert_allclose(await color_at(page, 0.5, 0.5), LENS_RGB["fifty"], atol=12)
                await page.tap("#stage", 0.25, 0.75)
                await page.comes_true("viewfinder.focus === 1.5 && document.getElementById('metres').textContent === '1.50 m'")
                await page.choose("#view", "matte")
                await page.comes_true("viewfinder.model.state.view === 'matte'")
                before = await page.value("viewfinder.counts.shown")
                await page.comes_true(f"viewfinder.counts.shown > {before + 10}")
                np.testing.assert_allclose(await color_at(page, 0.2, 0.5), VIEW_RGB["matte"], atol=8)
                # Marks are drawn from video as from pictures.
                await page.value("document.getElementById('aid_peakReal').click()")
                await page.comes_true("document.getElementById('marks').width === 160")
                assert page.errors == []
                await page.send("Page.navigate", url="about:blank")
                for _ in range(100):
                    if whep.viewers == 0:
                        break
                    await page.value("new Promise((done) => setTimeout(done, 50))")
                assert whep.viewers == 0

    in_time(work, 60.0)


def test_pictures_come_where_video_is_refused(tmp_path: Path) -> None:
    class Refusing:
        def routes(self) -> list[web.RouteDef]:
            return [web.post("/whep", self._refuse)]

        async def close(self) -> None:
            pass

        async def _refuse(self, _request: web.Request) -> web.Response:
            return web.json_response({"error": "all places are taken"}, status=503)

    async def work() -> None:
        async with made_viewfinder(whep=Refusing()) as made, chromium_page(made.url, tmp_path / "profile") as page:
            await page.comes_true(f"{SHOWN} && document.getElementById('way').textContent === 'pictures'")
            assert await page.value("document.getElementById('message').textContent") == ""
            # A page may ask for one way by its address.
            await page.send("Page.navigate", url=made.url + "?transport=whep")
            await page.comes_true("document.getElementById('message')?.textContent === 'all places are taken'")
            assert await page.value("viewfinder.counts.shown") == 0

    in_time(work, 60.0)


def test_a_stream_that_ends_is_opened_again(tmp_path: Path) -> None:
    async def work() -> None:
        async with with_video() as (made, whep), chromium_page(made.url, tmp_path / "profile") as page:
            await page.comes_true(f"{SHOWN} && document.getElementById('way').textContent === 'video'")
            for viewer in list(whep._viewers.values()):
                await viewer.close()
            before = await page.value("viewfinder.counts.shown")
            await page.comes_true(f"viewfinder.counts.shown > {before + 20}", limit_s=20.0)
            assert whep.viewers == 1

    in_time(work, 60.0)


def test_the_camera_page_sends_what_the_camera_sees(tmp_path: Path) -> None:
    """Chromium's own test camera: a green picture with a white pie and a clock."""
    from viewfinder.sources.browser_camera import BrowserCameraSource

    source, stopping, frames = BrowserCameraSource(), Event(), []

    def read() -> None:
        for frame in source.frames(stopping):
            frames.append(frame.bgr)

    reader = Thread(target=read)
    reader.start()
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")

    async def work() -> None:
        async with made_viewfinder(whip=source) as made, chromium_page(made.url + "camera", tmp_path / "profile", *flags) as page:
            await page.comes_true("document.getElementById('send') && !document.getElementById('send').disabled")
            await page.tap("#send")
            await page.comes_true("document.getElementById('message').textContent === 'sending'")
            for _ in range(200):
                if len(frames) > 10:
                    break
                await page.value("new Promise((done) => setTimeout(done, 50))")
            assert await page.value("document.getElementById('preview').srcObject.getVideoTracks()[0].contentHint") == "detail"
            await page.tap("#send")
            await page.comes_true("document.getElementById('send').textContent === 'Send the camera'")
            assert page.errors == []

    try:
        in_time(work, 60.0)
    finally:
        stopping.set()
        reader.join()
    assert len(frames) > 10
    # A resolution that is kept, not halved for the sake of the rate.
    assert frames[-1].shape == (720, 1280, 3)
    blue, green, red = frames[-1].reshape(-1, 3).mean(axis=0)
    assert green > max(blue, red) + 40
