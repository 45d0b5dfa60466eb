"""The page in a real headless Chromium: video through WHEP with its age, the fallback, a camera through WHIP, and all sizes of screens."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import combinations
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from datasets_scripts.gallery.pictures import Page, chromium_page
from tests.live.test_page_browser import IN_CHROMIUM, SHOWN, color_at
from tests.scenes.layer_viewfinder import HEIGHT, WIDTH, running
from tests.scenes.made_viewfinder import LENS_RGB, VIEW_RGB, Made, made_viewfinder
from tests.scenes.waiting import comes_true
from viewfinder.server.access import Access
from viewfinder.server.sessions import Role, Sessions
from viewfinder.sources.frame_source import SizeLimit
from viewfinder.sources.playback import VideoFileSource

pytest.importorskip("aiortc")
pytestmark = IN_CHROMIUM


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


async def test_video_comes_first_with_its_age_and_what_is_known_of_each_picture(tmp_path: Path) -> None:
    sessions = Sessions()
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
            await comes_true(lambda: whep.viewers == 0)


async def test_pictures_come_where_video_is_refused(tmp_path: Path) -> None:
    class Refusing:
        def routes(self) -> list[web.RouteDef]:
            return [web.post("/whep", self._refuse)]

        async def close(self) -> None:
            pass

        async def _refuse(self, _request: web.Request) -> web.Response:
            return web.json_response({"error": "all places are taken"}, status=503)

    async with made_viewfinder(whep=Refusing()) as made, chromium_page(made.url, tmp_path / "profile") as page:
        await page.comes_true(f"{SHOWN} && document.getElementById('way').textContent === 'pictures'")
        assert await page.value("document.getElementById('message').textContent") == ""
        # A page may ask for one way by its address.
        await page.send("Page.navigate", url=made.url + "?transport=whep")
        await page.comes_true("document.getElementById('message')?.textContent === 'all places are taken'")
        assert await page.value("viewfinder.counts.shown") == 0


async def test_a_stream_that_ends_is_opened_again(tmp_path: Path) -> None:
    async with with_video() as (made, whep), chromium_page(made.url, tmp_path / "profile") as page:
        await page.comes_true(f"{SHOWN} && document.getElementById('way').textContent === 'video'")
        for viewer in list(whep._viewers.values()):
            await viewer.close()
        before = await page.value("viewfinder.counts.shown")
        await page.comes_true(f"viewfinder.counts.shown > {before + 20}", limit_s=20.0)
        assert whep.viewers == 1


async def test_the_camera_page_sends_what_the_camera_sees(tmp_path: Path) -> None:
    """Chromium's own test camera: a green picture with a white pie and a clock."""
    from viewfinder.sources.browser_camera import BrowserCameraSource

    source, stopping, frames = BrowserCameraSource(), Event(), list[np.ndarray]()
    reading = asyncio.create_task(asyncio.to_thread(lambda: frames.extend(each.bgr for each in source.frames(stopping))))
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    async with made_viewfinder(whip=source) as made, chromium_page(made.url + "camera", tmp_path / "profile", *flags) as page:
        await page.comes_true("document.getElementById('send') && !document.getElementById('send').disabled")
        await page.tap("#send")
        await page.comes_true("document.getElementById('message').textContent === 'sending'")
        await comes_true(lambda: len(frames) > 10)
        assert await page.value("document.getElementById('preview').srcObject.getVideoTracks()[0].contentHint") == "detail"
        await page.tap("#send")
        await page.comes_true("document.getElementById('send').textContent === 'Send the camera'")
        assert page.errors == []
    stopping.set()
    await reading
    # A resolution that is kept, not halved for the sake of the rate.
    assert frames[-1].shape == (720, 1280, 3)
    blue, green, red = frames[-1].reshape(-1, 3).mean(axis=0)
    assert green > max(blue, red) + 40


SIZES = [(390, 844), (844, 390), (960, 600), (1280, 720)]

# Each control with the part of it that its scrolling ancestors and the window leave visible.
VISIBLE = """[...document.querySelectorAll('#stage, button, input, select, summary')].map((control) => {
  let { left, top, right, bottom } = control.getBoundingClientRect();
  for (let box = control.parentElement; box; box = box.parentElement) {
    if (getComputedStyle(box).overflowY === 'visible') continue;
    const clip = box.getBoundingClientRect();
    [left, top] = [Math.max(left, clip.left), Math.max(top, clip.top)];
    [right, bottom] = [Math.min(right, clip.right), Math.min(bottom, clip.bottom)];
  }
  [right, bottom] = [Math.min(right, innerWidth), Math.min(bottom, innerHeight)];
  return { name: control.id || control.textContent, box: [Math.max(left, 0), Math.max(top, 0), right, bottom] };
}).filter(({ box }) => box[2] - box[0] > 0.5 && box[3] - box[1] > 0.5)"""

# What a finger meets that aims at the middle of a control, once the page was scrolled to it.
UNREACHABLE = """[...document.querySelectorAll('button, input, select, summary')]
  .filter((control) => control.checkVisibility() && control.getBoundingClientRect().width > 0)
  .filter((control) => {
    control.scrollIntoView({ block: 'nearest' });
    const box = control.getBoundingClientRect();
    const met = document.elementFromPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2);
    return !(met && (control.contains(met) || met.contains(control) && met.tagName === 'LABEL'));
  }).map((control) => control.id || control.textContent)"""


def overlapping(controls: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Pairs whose boxes share more than half a pixel."""
    found = []
    for one, other in combinations(controls, 2):
        (left, top, right, bottom), (x, y, x_end, y_end) = one["box"], other["box"]
        if min(right, x_end) - max(left, x) > 0.5 and min(bottom, y_end) - max(top, y) > 0.5:
            found.append((one["name"], other["name"]))
    return found


async def assert_nothing_covered(page: Page, what: str) -> None:
    for scrolled in (0, 10_000):
        await page.value(f"document.getElementById('panel').scrollTo(0, {scrolled})")
        controls = await page.value(VISIBLE)
        assert {"stage", "capture", "record"} <= {each["name"] for each in controls}, what
        assert overlapping(controls) == [], what
    assert await page.value(UNREACHABLE) == [], what
    assert await page.value("document.documentElement.scrollWidth <= innerWidth"), what


async def test_no_control_covers_another_at_any_size(tmp_path: Path) -> None:
    """Where the capture buttons floated, they lay over "smooth tracking" at 960x600. With all aids open, for both hands."""
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await page.comes_true(SHOWN)
        await page.value("document.querySelector('vf-aids details').open = true")
        for width_px, height_px in SIZES:
            await page.size(width_px, height_px)
            for hand in ("right", "left"):
                await asyncio.sleep(0.3)
                await assert_nothing_covered(page, f"{width_px}x{height_px}, {hand} hand")
                stage = await page.box("#stage")
                assert stage[2] * stage[3] > 0.25 * width_px * height_px, "the picture is what the page is for"
                await page.value("document.getElementById('aid_leftHand').click()")
        assert page.errors == []


async def test_the_page_says_where_the_focus_came_from_and_when_the_tilt_is_unsure(tmp_path: Path) -> None:
    focus, badge = "document.getElementById('focus_from').textContent", "document.getElementById('tracking')"
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await page.comes_true(SHOWN)
        assert await page.value(focus) == "from the file of the lens"
        for name, told in (("by hand", "by hand"), ("blur of the board", "from blur of the board"), ("the camera", "from the camera")):
            made.controls.values["focus_from"] = name
            await page.comes_true(f"{focus} === '{told}'")
        # Seen without scrolling, on the smallest phone.
        left, top, width, height = await page.box("#focus_from")
        assert left >= 0 and left + width <= 390 and top + height < (await page.box("vf-shutter"))[1]
        made.controls.values |= {"tracking": 0.07, "tracking_unsure": True}
        await page.comes_true(f"{badge}.textContent === 'tilt unsure: go nearer' && {badge}.dataset.quality === 'unsure'")
        made.controls.values |= {"tracking": 0.9, "tracking_unsure": False}
        await page.comes_true(f"{badge}.textContent === 'tracking 90 %'")
        assert page.errors == []


@pytest.mark.parametrize("transport", ["whep", "jpeg"])
async def test_the_page_shows_the_stream_in_a_browser(tmp_path: Path, plate: tuple[Path, np.ndarray], transport: str) -> None:
    """The plate on the screen, red in the square, and beside the square more red when a finger has moved the focus."""
    async with (
        running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url,
        chromium_page(f"{url}?transport={transport}", tmp_path / "profile") as page,
    ):

        async def color_at(x_px: float, y_px: float) -> np.ndarray:
            left, top, width, height = await page.box("#stage")
            column, row = int(left + (x_px + 0.5) / WIDTH * width), int(top + (y_px + 0.5) / HEIGHT * height)
            return (await page.screenshot())[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)

        await page.comes_true("window.viewfinder && viewfinder.counts.shown > 20 && viewfinder.age > 0")
        assert 0 < float(await page.value("viewfinder.age")) < 1000
        np.testing.assert_allclose(await color_at(20, 20), plate[1][20, 20, ::-1], atol=10)
        beside = (await color_at(64, 45))[0]
        await page.value("(s => { s.value = 1; s.dispatchEvent(new Event('input')); })(document.getElementById('focus'))")
        await page.comes_true("viewfinder.focus === 1")
        assert (await color_at(64, 45))[0] > beside + 25
        assert await page.value("document.getElementById('message').textContent") == ""
        assert page.errors == []
