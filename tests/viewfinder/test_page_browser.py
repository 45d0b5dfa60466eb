"""The page and the streams in a real headless Chromium: fingers, what the screen shows, video with its age, all sizes of screens."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from itertools import combinations
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from datasets_scripts.gallery.pictures import CHROMIUM, Page, chromium_page
from mrbokeh.compositing.overlay import Overlay
from mrbokeh.video.color import code_from_linear
from tests.support.made_viewfinder import LENS_RGB, VIEW_RGB, Made, made_viewfinder
from tests.support.shared_chromium import shared_page
from tests.support.streaming_viewers import BARS, Feed, bars, output, serving_routes, streaming
from tests.support.waiting import comes_true
from tests.viewfinder.test_server_gallery import TAKE, saved
from viewfinder.frames import Remark
from viewfinder.server.access import LOOPBACK_NAMES, Access
from viewfinder.server.gallery import Gallery
from viewfinder.server.sessions import Role, Sessions
from viewfinder.sources.browser_camera import BrowserCameraSource
from viewfinder.streaming.other_programs import AlphaStream, obs_routes
from viewfinder.streaming.whep import Whep

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the page is tested by clients in Python only"),
]
SHOWN = "window.viewfinder && viewfinder.counts.shown > 3"
MESSAGE = "document.getElementById('message')?.textContent"
# The page asks for the state every 2 s; here ten times as often.
OFTEN = "{ const plain = setInterval; window.setInterval = (work, ms) => plain(work, ms === 2000 ? 200 : ms); }"
# The page takes a video for ended that shows nothing for 5 s; here after a second.
HURRIED = """(() => { const plain = performance.now;
  performance.now = () => plain.call(performance) + 4000;
  setTimeout(() => (performance.now = plain), 1700); })()"""


@pytest.fixture(autouse=True)
def new_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """aioice resolves Chromium's .local candidates behind a lock of the first event loop; servers have one, these tests several."""
    monkeypatch.delattr("aioice.ice._mdns.lock", raising=False)


@asynccontextmanager
async def opened(made: Made) -> AsyncIterator[Page]:
    """The page, once it shows pictures and nothing is wrong."""
    async with shared_page(made.url, script=OFTEN) as page:
        await page.comes_true(SHOWN)
        assert await page.value(MESSAGE) == ""
        yield page


async def text_of(page: Page, name: str) -> str:
    return await page.value(f"document.getElementById('{name}').textContent")


async def click(page: Page, *names: str) -> None:
    for name in names:
        await page.value(f"document.getElementById('{name}').click()")


async def new_pictures(page: Page, count: int = 4) -> None:
    """Wait until so many more are on the screen."""
    before = await page.value("viewfinder.counts.shown")
    await page.comes_true(f"viewfinder.counts.shown > {before + count}", 20.0)


async def laid_out(page: Page) -> None:
    await page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


async def color_at(page: Page, x: float, y: float) -> np.ndarray:
    """Mean red, green, blue of 5x5 screen pixels at a fraction of the picture."""
    left, top, width, height = await page.box("#stage")
    column, row = int(left + x * width), int(top + y * height)
    return (await page.screenshot())[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(axis=0)


async def assert_shown(page: Page, beside: tuple[int, int, int], middle: tuple[int, int, int] | None = None, atol: float = 5.0) -> None:
    """Flat colours lose up to 3 codes in JPEG's YCbCr; video at this size keeps them within a few."""
    np.testing.assert_allclose(await color_at(page, 0.2, 0.5), beside, atol=atol)
    if middle is not None:
        np.testing.assert_allclose(await color_at(page, 0.5, 0.5), middle, atol=1.5 * atol)


async def test_taps_pickers_and_buttons_control_the_viewfinder() -> None:
    async with made_viewfinder() as made, opened(made) as page:
        await assert_shown(page, VIEW_RGB["final"], LENS_RGB["fifty"])
        await read_out(page)
        await level_against_the_phone(page)
        await tell_where_the_focus_came_from(page, made)
        assert page.errors == []
        await say_why_nothing_is_seen(page, made)
        await focus_by_touch(page, made)
        await choose_lens_and_view(page, made)
        await capture_and_record(page, made)
        # What was refused on purpose is the only thing that the console complains of.
        assert all("400" in each and "control" in each for each in page.errors), page.errors


async def read_out(page: Page) -> None:
    # Captured, encoded, sent, decoded and drawn on one machine: the age is positive and far below a second.
    # Offsets of clocks are measured by round trips, and may be some milliseconds off for a moment while the machine is busy.
    await page.comes_true("document.getElementById('age')?.textContent > 0 && 0 < viewfinder.age && viewfinder.age < 1000")
    assert float(await text_of(page, "fps")) > 5
    assert (await text_of(page, "way"), await text_of(page, "tracking")) == ("pictures", "tracking 90 %")
    await click(page, "aid_times")
    await page.comes_true("document.getElementById('times').textContent.startsWith('composite 1.3 · jpeg ')")
    # The source makes a picture every 20 ms; a page that stops for half a second misses about 25 of them.
    dropped = await page.value("viewfinder.counts.dropped")
    await page.value("{ const end = performance.now() + 500; while (performance.now() < end); }")
    await page.comes_true(f"viewfinder.counts.dropped >= {dropped + 10}")


async def level_against_the_phone(page: Page) -> None:
    """deviceorientation (W3C): beta 90 is upright; rolled 10 degrees clockwise up leans 10 degrees to the left."""
    await click(page, "aid_level")
    # up = (-cos b sin g, sin b, cos b cos g): b = 80, g = 90 lies on (-0.174, 0.985, 0), 10 degrees to the left.
    # Tipped back by 30 degrees the camera looks down by 30, a third of a right angle: the horizon lies higher.
    for beta, gamma, roll_deg, down in ((90, 0, 0, 0), (80, 90, -10, 0), (60, 0, 0, -30 / 90)):
        told = f"{{alpha: 0, beta: {beta}, gamma: {gamma}}}"
        await page.value(f"dispatchEvent(new DeviceOrientationEvent('deviceorientation', {told})), 0")
        line = await page.value("(m => [m.a, m.b, m.f])(new DOMMatrix(getComputedStyle(document.getElementById('level')).transform))")
        shown = np.degrees(np.arctan2(line[1], line[0])), line[2] / (await page.box("#stage"))[3]
        np.testing.assert_allclose(shown, [roll_deg, down], atol=1e-3)


async def tell_where_the_focus_came_from(page: Page, made: Made) -> None:
    """And when the tilt is unsure."""
    badge = "document.getElementById('tracking')"
    assert await text_of(page, "focus_from") == "from the file of the lens"
    for name, told in (("by hand", "by hand"), ("blur of the board", "from blur of the board"), ("the camera", "from the camera")):
        made.controls.values["focus_from"] = name
        await page.comes_true(f"document.getElementById('focus_from').textContent === '{told}'")
    # Seen without scrolling, on the smallest phone.
    left, top, width, height = await page.box("#focus_from")
    assert left >= 0 and left + width <= 390 and top + height < (await page.box("vf-shutter"))[1]
    made.controls.values |= {"tracking": 0.07, "tracking_unsure": True}
    await page.comes_true(f"{badge}.textContent === 'tilt unsure: go nearer' && {badge}.dataset.quality === 'unsure'")
    made.controls.values |= {"tracking": 0.9, "tracking_unsure": False}
    await page.comes_true(f"{badge}.textContent === 'tracking 90 %'")


async def say_why_nothing_is_seen(page: Page, made: Made) -> None:
    """With each picture, and an arrow to where the object went, which points there and lies at the edge on that side."""
    remark = "document.getElementById('remark')"
    place = "(([x, y, w, h], a) => [(a.x + a.width / 2 - x) / w, (a.y + a.height / 2 - y) / h])"
    for arrow, at in (((1.0, 0.0), (0.92, 0.5)), ((-0.6, 0.8), (0.5 - 0.42 * 0.75, 0.92)), ((0.0, -1.0), (0.5, 0.08))):
        made.controls.values["remark"] = Remark(f"the object is at {arrow}", arrow)
        await page.comes_true(f"{remark}.textContent === 'the object is at {arrow}' && !{remark}.hidden")
        box = list(await page.box("vf-picture"))
        shown = await page.value(f"{place}({box}, document.getElementById('arrow').getBoundingClientRect())")
        np.testing.assert_allclose(shown, at, atol=0.01)
    made.controls.values["remark"] = Remark("the camera is not tracked")
    await page.comes_true(
        f"{remark}.textContent === 'the camera is not tracked' && document.getElementById('arrow').hasAttribute('hidden')"
    )
    # Where no pictures come the state says it.
    made.pictures.rest()
    made.controls.values["remark"] = Remark("made is late")
    await page.comes_true(f"{remark}.textContent === 'made is late'")
    made.pictures.go_on()
    made.controls.values["remark"] = None
    await page.comes_true(f"{remark}.hidden")


async def focus_by_touch(page: Page, made: Made) -> None:
    await page.tap("#stage", 0.25, 0.75)
    await page.comes_true("document.getElementById('spot').textContent === '1.50 m'")
    assert next(each for each in made.controls.asked if each[0] == "at")[1:] == pytest.approx((0.25, 0.75), abs=0.01)
    await page.comes_true("document.getElementById('metres').textContent === '1.50 m'")
    # The slider follows: 1 / 1.5 m.
    assert float(await page.value("document.getElementById('focus').value")) == pytest.approx(1 / 1.5)
    await asyncio.sleep(0.35)  # a second tap at once would be a double tap
    await page.tap("#stage", 0.75, 0.75)
    await page.comes_true(f"{MESSAGE} === 'there is no depth there: tap another place'")
    assert made.controls.values["focus"] == 1.5
    # The right end of the slider is 2 dioptres.
    await page.tap("#focus", 0.999)
    await page.comes_true("viewfinder.focus !== 1.5")
    assert made.controls.values["focus"] == pytest.approx(0.5, abs=0.03)


async def choose_lens_and_view(page: Page, made: Made) -> None:
    for name, chosen, told in (("lens", "eighty", "'eighty'"), ("view", "plate", "'plate'"), ("f_number", "1.4", "1.4")):
        await page.choose(f"#{name}", chosen)
        await page.comes_true(f"viewfinder.model.state.{name} === {told}")
    assert made.controls.asked[-3:] == [("lens", "eighty"), ("view", "plate"), ("f_number", 1.4)]
    await page.value("scrollTo(0, 0)")
    await new_pictures(page)
    await assert_shown(page, VIEW_RGB["plate"], LENS_RGB["eighty"])
    await page.tap("#ab")
    await page.comes_true("viewfinder.model.state.view === 'final'")


async def capture_and_record(page: Page, made: Made) -> None:
    await page.tap("#capture")
    await page.comes_true(f"{MESSAGE} === 'saved bundle_0001'")
    assert made.controls.asked[-1] == ("capture",)
    await page.tap("#record")
    await page.comes_true("document.getElementById('record').getAttribute('aria-pressed') === 'true'")
    assert made.controls.asked[-1] == ("recording", True)
    await tell_of_the_take(page, made)
    # What others set is followed.
    made.controls.set_lens("fifty")
    made.controls.focus_at_distance(4.0)
    await page.comes_true("document.getElementById('lens').value === 'fifty' && document.getElementById('metres').textContent === '4.00 m'")


async def tell_of_the_take(page: Page, made: Made) -> None:
    """A red frame, how long it is, how long the disk will do, and what became of it."""
    frame = "getComputedStyle(document.getElementById('stage'), '::after').borderTopColor"
    assert await page.value(frame) == "rgb(221, 51, 51)"
    made.controls.values |= {"recorded_s": 75.0, "room_s": 7200.0}
    await page.comes_true("/^1:1[5-9]$/.test(document.getElementById('timer').textContent)")
    made.controls.values["room_s"] = 130.5
    await page.comes_true("/^1:1\\d · disk full in 2:10$/.test(document.getElementById('timer').textContent)")
    made.controls.values |= {"recording": False, "notices": [{"number": 1, "sentence": "saved a.mp4"}, {"number": 2, "sentence": "room"}]}
    await page.comes_true(f"{MESSAGE} === 'saved a.mp4 · room' && document.getElementById('timer').hidden")
    # Each is shown once.
    await page.value("viewfinder.model.say('')")
    made.controls.values["notices"] = [{"number": 2, "sentence": "room"}, {"number": 3, "sentence": "saved b.mp4"}]
    await page.comes_true(f"{MESSAGE} === 'saved b.mp4'")
    assert await page.value(frame) != "rgb(221, 51, 51)"


async def test_marks_are_drawn_where_the_picture_has_edges_on_the_real_and_the_virtual_apart() -> None:
    """The rim of 4 white pixels around the virtual square has an edge to the real picture outside and one to the square inside."""

    async def assert_share(rgb: tuple[int, int, int], least: float, most: float) -> None:
        """As soon as it is so."""
        left, top, width, height = (round(each) for each in await page.box("#stage"))
        for again in range(100):
            stage = (await page.screenshot())[top : top + height, left : left + width].astype(int)
            found = float((np.abs(stage - rgb).max(axis=2) < 40).mean())
            if least <= found <= most:
                return
            await asyncio.sleep(0.02 + 0.001 * again)
        raise AssertionError(f"{rgb}: {found}")

    async def changed(**values: float) -> None:
        made.controls.values |= values
        await new_pictures(page)

    green, magenta = (51, 255, 51), (255, 26, 230)
    async with made_viewfinder() as made, opened(made) as page:
        await assert_share(green, 0, 0)
        await assert_share(magenta, 0, 0)
        await click(page, "aid_peakReal")
        # Edges of about 3 px around 40 and 32 px squares, of 160 x 96 px: 2 to 7 %.
        await assert_share(green, 0.015, 0.08)
        await assert_share(magenta, 0, 0)
        # Contrast does not count: a rim that is 36 codes brighter than its background (luma 87 of 255) is as sharp as the white one.
        await changed(rim=123)
        await assert_share(green, 0.01, 0.08)
        await changed(rim=255, blur_px=1.0)
        await assert_share(green, 0.01, 0.08)
        # Out of focus nothing is marked: in 2 px far less than 0.6 of what happens in 6.
        await changed(blur_px=4.0)
        await assert_share(green, 0, 0)
        await changed(blur_px=0.0)
        await click(page, "aid_peakReal", "aid_peakVirtual")
        await assert_share(magenta, 0.003, 0.04)
        await assert_share(green, 0, 0)
        await click(page, "aid_peakVirtual", "aid_zebra", "aid_grid")
        # Half of the rim's white (40^2 - 32^2 of 15360 px = 3.8 %) is striped dark.
        await assert_share((51, 51, 51), 0.008, 0.05)
        await assert_shown(page, VIEW_RGB["final"])
        await click(page, "aid_histogram")
        # Three colours: some bins are high, most are empty.
        context = "document.getElementById('histogram').getContext('2d')"
        heights = f"(c => [...Array(128).keys()].map(x => c.getImageData(x, 47, 1, 1).data[3]))({context})"
        await page.comes_true(f"(n => 4 <= n && n <= 40)({heights}.filter((each) => each).length)")
        assert page.errors == []


async def test_fingers_zoom_the_display_drag_the_object_and_never_send_too_much() -> None:
    async with made_viewfinder() as made, opened(made) as page:
        left, top, width, height = await page.box("#stage")
        middle = (left + width / 2, top + height / 2)
        await page.touch(*([(middle[0] - d, middle[1]), (middle[0] + d, middle[1])] for d in (30, 40, 50, 60)))
        # The fingers' distance doubles.
        assert (await page.box("#stage"))[2] == pytest.approx(2 * width, rel=0.02)
        # Enlarged about the middle, the tap at a quarter of the window means 3/8 of the picture.
        await asyncio.sleep(0.3)
        await page.touch([(left + width / 4, middle[1])])
        await page.comes_true("document.getElementById('spot').textContent === '1.50 m'")
        assert next(each for each in made.controls.asked if each[0] == "at")[1:] == pytest.approx((0.375, 0.5), abs=0.02)
        await asyncio.sleep(0.35)
        for _ in range(2):
            await page.touch([middle])
        assert (await page.box("#stage"))[2] == pytest.approx(width, rel=0.01)
        made.controls.asked.clear()
        await page.choose("#object", "lantern")
        await page.touch(*([(middle[0] + d, middle[1] + d / 2)] for d in (0, 12, 24, 39)))
        # 2 m across the width and 1.2 m over the height, whatever the number of messages.
        way_m = pytest.approx([2 * 39 / width, 1.2 * 19.5 / height], abs=0.02)
        await comes_true(lambda: np.sum([each[2:] for each in made.controls.asked if each[0] == "move"] or [[0, 0]], axis=0) == way_m)
        await click(page, "visible")
        await page.comes_true("viewfinder.model.state.objects[0].visible === false")
        # Neither drag nor pinch focused.
        assert [each for each in made.controls.asked if each[0] in ("at", "focus")] == []
        page.errors.clear()
        # 100 positions of the slider in 0.8 s or more, of which the page sends about 20 per second; the server refuses from 40 on.
        took_s = await page.value("""(async () => {
          const slider = document.getElementById('focus'), began = performance.now();
          for (let i = 1; i <= 100; i++) {
            slider.value = i / 100;
            slider.dispatchEvent(new Event('input'));
            await new Promise((done) => setTimeout(done, 8));
          }
          return (performance.now() - began) / 1000;
        })()""")
        await page.comes_true("viewfinder.focus === 1")
        sent = [each for each in made.controls.asked if each[0] == "focus"]
        assert 5 < len(sent) < 33 * took_s and sent[-1] == ("focus", 1.0) and page.errors == []


async def test_the_token_is_used_up_and_a_guest_may_only_watch() -> None:
    sessions = Sessions()
    async with made_viewfinder(Access(sessions=sessions)) as made:
        url = f"{made.url}#token={sessions.invitation(Role.VIEW)}"
        async with shared_page(url) as page:
            await page.comes_true(f"{SHOWN} && {MESSAGE} === ''")
            assert (await page.value("location.href"), await page.value("document.cookie")) == (made.url, "")
            await page.comes_true("document.getElementById('capture').disabled && document.getElementById('focus').disabled")
            await page.tap("#stage", 0.25, 0.75)
            await page.send("Page.reload")
            await page.comes_true(f"{SHOWN} && {MESSAGE} === ''")
            # For a browser that knows nobody it is spent.
            await page.send("Network.clearBrowserCookies")
            for address in ("about:blank", url):
                await page.send("Page.navigate", url=address)
            await page.comes_true(f"{MESSAGE}?.includes('used before')")
    assert made.controls.asked == []


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


async def test_portrait_landscape_and_the_left_hand_and_no_control_covers_another() -> None:
    """Where the capture buttons floated, they lay over "smooth tracking" at 960x600. With all aids open, for both hands."""
    async with made_viewfinder() as made, opened(made) as page:
        picture, capture = await page.box("#stage"), await page.box("#capture")
        assert picture[2] == 390 and picture[3] == pytest.approx(390 * 96 / 160, abs=1)
        # The button is in the right thumb's corner, a finger wide.
        assert capture[0] > 195 and capture[1] > 600 and min(capture[2:]) >= 44
        await click(page, "aid_leftHand")
        assert (await page.box("#capture"))[0] < 195
        await page.size(844, 390)
        await laid_out(page)
        panel, picture = await page.box("#panel"), await page.box("#stage")
        assert panel[0] == 0 and picture[0] >= panel[2] and picture[3] <= 390
        await click(page, "aid_leftHand")
        assert (await page.box("#panel"))[0] > (await page.box("#stage"))[0]
        await page.value("document.querySelector('vf-aids details').open = true")
        for width_px, height_px in SIZES:
            await page.size(width_px, height_px)
            for hand in ("right", "left"):
                await laid_out(page)
                await assert_nothing_covered(page, f"{width_px}x{height_px}, {hand} hand")
                stage = await page.box("#stage")
                assert stage[2] * stage[3] > 0.25 * width_px * height_px, "the picture is what the page is for"
                await click(page, "aid_leftHand")
        assert page.errors == []


async def test_what_stopped_is_told_and_forgotten_when_it_comes_back() -> None:
    async with AsyncExitStack() as browser:
        async with made_viewfinder() as made:
            port = int(made.url.rsplit(":", 1)[1].strip("/"))
            page = await browser.enter_async_context(opened(made))
            made.pictures.rest()
            made.jpeg.fail("the camera was unplugged")
            await page.comes_true(f"{MESSAGE} === 'the camera was unplugged'")
            made.pictures.go_on()
            await page.comes_true(f"{MESSAGE} === ''")
        await page.comes_true(f"{MESSAGE} === 'connection lost, trying again'")
        async with made_viewfinder(Access(sessions=Sessions()), port=port):
            # A viewfinder that was started anew knows nobody.
            await page.comes_true(f"{MESSAGE}.includes('printed last')")
        before = await page.value("viewfinder.counts.shown")
        async with made_viewfinder(port=port):
            await page.comes_true(f"viewfinder.counts.shown > {before} && {MESSAGE} === ''")


async def test_video_comes_first_with_its_age_and_what_is_known_of_each_picture_and_is_opened_again() -> None:
    sessions = Sessions()
    with streaming() as stream:
        whep = Whep(stream)
        async with made_viewfinder(Access(sessions=sessions), sinks=[stream], whep=whep) as made:
            url = f"{made.url}#token={sessions.invitation(Role.CONTROL)}"
            async with shared_page(url) as page:
                await page.comes_true(f"{SHOWN} && viewfinder.age !== null && viewfinder.clock.known")
                await page.comes_true("document.getElementById('way').textContent === 'video'")
                assert whep.viewers == 1 and not made.jpeg.broadcaster.sockets
                assert await page.value("!document.getElementById('video').hidden && document.getElementById('picture').hidden")
                # From the capture to the screen on one machine.
                assert 0 < await page.value("viewfinder.age") < 1000 and await page.value("viewfinder.focus") == 2.0
                await assert_shown(page, VIEW_RGB["final"], LENS_RGB["fifty"], atol=8)
                await page.tap("#stage", 0.25, 0.75)
                await page.comes_true("viewfinder.focus === 1.5 && document.getElementById('metres').textContent === '1.50 m'")
                await page.choose("#view", "matte")
                await page.comes_true("viewfinder.model.state.view === 'matte'")
                await new_pictures(page, 10)
                await assert_shown(page, VIEW_RGB["matte"], atol=8)
                # Marks are drawn from video as from pictures.
                await click(page, "aid_peakReal")
                await page.comes_true("document.getElementById('marks').width === 160")
                assert page.errors == []
                # A stream that ends is opened again.
                for viewer in list(whep._viewers.values()):
                    await viewer.close()
                await page.value(HURRIED)
                await new_pictures(page, 20)
                assert whep.viewers == 1
                await page.send("Page.navigate", url="about:blank")
                await comes_true(lambda: whep.viewers == 0)


async def test_pictures_come_where_video_is_refused() -> None:
    class Refusing:
        def routes(self) -> list[web.RouteDef]:
            return [web.post("/whep", self._refuse)]

        async def close(self) -> None: ...

        async def _refuse(self, _request: web.Request) -> web.Response:
            return web.json_response({"error": "all places are taken"}, status=503)

    async with made_viewfinder(whep=Refusing()) as made, opened(made) as page:
        await page.comes_true("document.getElementById('way').textContent === 'pictures'")
        # A page may ask for one way by its address.
        await page.send("Page.navigate", url=made.url + "?transport=whep")
        await page.comes_true(f"{MESSAGE} === 'all places are taken'")
        assert await page.value("viewfinder.counts.shown") == 0


async def test_what_was_saved_is_played_and_deleted_at_the_second_press(tmp_path: Path) -> None:
    folder = saved(tmp_path / "captures")
    async with made_viewfinder(gallery=Gallery(folder)) as made, opened(made) as page:
        await page.comes_true("!document.getElementById('open_gallery').hidden")
        await click(page, "open_gallery")
        entry = "[...document.querySelectorAll('#saved li')].find((each) => each.textContent.includes('.mp4'))"
        await page.comes_true(f"document.getElementById('gallery').open && {entry}?.textContent.includes('0:02')")
        await page.comes_true(f"{entry}.querySelector('img').naturalWidth === 320")
        assert await page.value("/^[\\d.]+ GB free$/.test(document.getElementById('room').textContent)")
        assert await page.value(f"{entry}.querySelector('a').getAttribute('href')") == f"/gallery/{TAKE}/file"
        await page.value(f"{entry}.querySelector('button').click()")
        if await page.value("document.createElement('video').canPlayType('video/mp4; codecs=avc1.640028') !== ''"):
            await page.comes_true("document.querySelector('#playing video').currentTime > 0.3")
        remove = f"{entry}.querySelector('button:last-child')"
        await page.value(f"{remove}.click()")
        await page.comes_true(f"{remove}.textContent === 'Really?'")
        assert (folder / TAKE).exists()
        await page.value(f"{remove}.click()")
        await page.comes_true("document.querySelectorAll('#saved li').length === 1")
        assert not (folder / TAKE).exists() and page.errors == []


async def test_without_a_network_the_page_shows_pictures_at_once(tmp_path: Path) -> None:
    """Then browsers have no address to offer; before, the connection was waited for until 6 s had passed without a picture."""
    flag = "--webrtc-ip-handling-policy=disable_non_proxied_udp"
    with streaming() as stream:
        async with made_viewfinder(sinks=[stream], whep=Whep(stream)) as made, chromium_page(made.url, tmp_path / "profile", flag) as page:
            await page.comes_true(f"{SHOWN} && document.getElementById('way').textContent === 'pictures' && {MESSAGE} === ''")
            asked = await page.value("performance.getEntriesByType('resource').map((each) => new URL(each.name).pathname)")
            assert "/state" in asked and "/whep" not in asked


async def test_the_camera_page_needs_a_secure_page_and_sends_what_the_camera_sees(tmp_path: Path) -> None:
    """A name that resolves to this machine but is not called localhost is as insecure for the browser as a LAN address. Then Chromium's own
    test camera: a green picture with a white pie and a clock."""
    source, stopping, frames = BrowserCameraSource(), Event(), list[np.ndarray]()
    reading = asyncio.create_task(asyncio.to_thread(lambda: frames.extend(each.bgr for each in source.frames(stopping))))
    flags = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream", "--host-resolver-rules=MAP viewfinder.test 127.0.0.1")
    async with AsyncExitStack() as ending, made_viewfinder(Access(names=LOOPBACK_NAMES | {"viewfinder.test"}), whip=source) as made:
        ending.callback(stopping.set)
        insecure = made.url.replace("127.0.0.1", "viewfinder.test")
        async with chromium_page(insecure + "camera", tmp_path / "profile", *flags) as page:
            await page.comes_true(f"{MESSAGE}?.includes('--tls')")
            assert await page.value("document.getElementById('send').disabled")
            # The viewfinder itself works there, without tilt.
            await page.send("Page.navigate", url=insecure)
            await page.comes_true(f"{SHOWN} && {MESSAGE} === ''")
            assert await page.value("window.isSecureContext || document.getElementById('aid_level') !== null") is False
            # What the console says of insecure pages is not ours.
            page.errors.clear()
            await page.send("Page.navigate", url=made.url + "camera")
            await page.comes_true("document.getElementById('send') && !document.getElementById('send').disabled")
            await page.tap("#send")
            await page.comes_true(f"{MESSAGE} === 'sending'")
            await comes_true(lambda: len(frames) > 10)
            assert await page.value("document.getElementById('preview').srcObject.getVideoTracks()[0].contentHint") == "detail"
            await page.tap("#send")
            await page.comes_true("document.getElementById('send').textContent === 'Send the camera'")
            assert page.errors == []
    await reading
    # A resolution that is kept, not halved for the sake of the rate.
    assert frames[-1].shape == (720, 1280, 3)
    blue, green, red = frames[-1].reshape(-1, 3).mean(axis=0)
    assert green > max(blue, red) + 40


PLAIN_PAGE = """<video autoplay muted playsinline></video><script>
const video = document.querySelector("video");
window.shown = []; window.messages = [];
const next = (_, picture) => { shown.push(picture.rtpTimestamp); video.requestVideoFrameCallback(next); };
video.requestVideoFrameCallback(next);
async function play() {
  window.peer = new RTCPeerConnection();
  const known = RTCRtpReceiver.getCapabilities("video").codecs.filter((codec) => ["video/CODEC", "video/rtx"].includes(codec.mimeType));
  peer.addTransceiver("video", { direction: "recvonly" }).setCodecPreferences(known);
  peer.createDataChannel("status", { ordered: false, maxRetransmits: 0 }).onmessage = (event) => messages.push(JSON.parse(event.data));
  peer.ontrack = (event) => { video.srcObject = new MediaStream([event.track]); };
  await peer.setLocalDescription();
  const answer = await fetch("whep", { method: "POST", headers: { "Content-Type": "application/sdp" }, body: peer.localDescription.sdp });
  await peer.setRemoteDescription({ type: "answer", sdp: await answer.text() });
}
play();
</script>"""
# The middles of eight columns of what an element shows, as [red, green, blue, alpha].
MIDDLES = """(() => { const shown = document.querySelector("ELEMENT"), copy = document.createElement("canvas");
  copy.width = WIDTH; copy.height = HEIGHT; const context = copy.getContext("2d"); context.drawImage(shown, 0, 0);
  return [...Array(8).keys()].map((i) => [...context.getImageData(Math.floor((i + 0.5) * WIDTH / 8), HEIGHT / 2, 1, 1).data]); })()"""


@asynccontextmanager
async def page_of(routes: list[web.RouteDef], whep: Whep, path: str) -> AsyncIterator[Page]:
    """A browser on a path of a server with these routes."""
    async with serving_routes(routes) as url:
        try:
            async with shared_page(url + path, size_px=(800, 600)) as page:
                yield page
        finally:
            await whep.close()


async def test_colours_are_right_on_the_screen_and_pictures_have_their_names() -> None:
    async def index(request: web.Request) -> web.Response:
        return web.Response(text=PLAIN_PAGE.replace("CODEC", request.query["codec"]), content_type="text/html")

    # As large as HD, where browsers would take what is untagged for BT.709.
    with streaming() as stream, Feed(stream, lambda _: bars(1280, 720), 20.0):
        whep = Whep(stream)
        async with page_of([web.get("/", index), *whep.routes()], whep, "/?codec=H264") as page:
            for codec in ("H264", "VP8"):
                await page.comes_true(f"location.search === '?codec={codec}' && window.shown && shown.length > 20 && messages.length > 20")
                seen = np.array(await page.value(MIDDLES.replace("ELEMENT", "video").replace("WIDTH", "1280").replace("HEIGHT", "720")))
                # Limited range and whole codes of luma and chroma cost up to 2 (BT.709 shown as 601 would cost 39).
                np.testing.assert_allclose(seen[:, 2::-1], BARS.astype(int), atol=3)
                named = await page.value("shown.filter((each) => messages.some((message) => message.rtp_timestamp === each)).length")
                assert named >= await page.value("shown.length") - 3 and stream.encoded[codec] > 20
                await page.value("location.search = '?codec=VP8', 0")


async def test_obs_gets_colour_and_alpha() -> None:
    """Columns of the picture: nothing, an opaque surface of half the light, the same half covered, a glow without coverage."""
    width, height = 320, 180
    light = np.zeros((height, width, 3), np.float32)
    shines = np.ones((height, width), np.float32)
    light[:, 80:160], shines[:, 80:160] = [0.5, 0.25, 0.1], 0.0
    light[:, 160:240], shines[:, 160:240] = [0.25, 0.125, 0.05], 0.5
    light[:, 240:] = [0.2, 0.2, 0.2]
    surface = 255 * code_from_linear(np.array([0.5, 0.25, 0.1], np.float32), "srgb")
    glow = 255 * code_from_linear(np.float32([0.2] * 3), "srgb")
    # What OBS adds to the codes of the camera times (1 - alpha), and alpha.
    expected = np.array([[0, 0, 0, 0], [*surface, 255], [*(surface / 2), 127.5], [*glow, 0]])

    async def feed(alpha: AlphaStream) -> None:
        sequence = 0
        while True:
            if alpha.wants_frame:
                alpha.show(Overlay(0, 0, light, shines), output(np.zeros((height, width, 3), np.uint8), sequence))
                sequence += 1
            await asyncio.sleep(0.05)

    with streaming() as stream:
        alpha, whep = AlphaStream(stream, "srgb"), Whep(stream)
        feeding = asyncio.ensure_future(feed(alpha))
        async with page_of(obs_routes(whep), whep, "/obs") as page:
            await page.comes_true("document.querySelector('canvas')?.height === 180")
            # Straight from the drawing buffer, which is premultiplied; the row in the middle, first column of each quarter's middle.
            expression = """(() => { const gl = document.querySelector("canvas").getContext("webgl"), all = [];
              for (const x of [40, 120, 200, 280]) { const one = new Uint8Array(4);
                gl.readPixels(x, 90, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one); all.push([...one]); } return all; })()"""
            await page.comes_true(f"{expression}[1][3] > 200")
            seen = np.array(await page.value(expression))
        feeding.cancel()
        alpha.close()
    np.testing.assert_allclose(seen, expected, atol=5)
    assert seen[0].tolist() == [0, 0, 0, 0] and seen[1, 3] == 255
