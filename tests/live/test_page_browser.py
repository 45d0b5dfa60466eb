"""The page in a real headless Chromium over the JPEG stream: what its fingers do and what its screen shows."""

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np
import pytest

from datasets_scripts.gallery.pictures import CHROMIUM, Page, chromium_page
from tests.scenes.made_viewfinder import LENS_RGB, VIEW_RGB, Made, made_viewfinder
from viewfinder.server.access import Access
from viewfinder.server.sessions import Role, Sessions

IN_CHROMIUM = pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the page is tested by clients in Python only"),
]
SHOWN = "window.viewfinder && viewfinder.counts.shown > 3"


async def color_at(page: Page, x: float, y: float) -> np.ndarray:
    """Mean red, green, blue of 5x5 screen pixels at a fraction of the picture."""
    left, top, width, height = await page.box("#stage")
    column, row = int(left + x * width), int(top + y * height)
    return (await page.screenshot())[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(axis=0)


def assert_color(color: np.ndarray, expected: tuple[int, int, int]) -> None:
    # Flat colours lose up to 3 codes in JPEG's YCbCr.
    np.testing.assert_allclose(color, expected, atol=5)


async def opened(page: Page) -> None:
    await page.comes_true(SHOWN)
    assert await page.value("document.getElementById('message').textContent") == ""


async def test_taps_pickers_and_buttons_control_the_viewfinder(tmp_path: Path) -> None:
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        assert_color(await color_at(page, 0.2, 0.5), VIEW_RGB["final"])
        assert_color(await color_at(page, 0.5, 0.5), LENS_RGB["fifty"])
        await focus_by_touch(page, made)
        await choose_lens_and_view(page, made)
        await capture_and_record(page, made)
        await follow_what_others_set(page, made)
        # What was refused on purpose is the only thing that the console complains of.
        assert all("400" in each and "control" in each for each in page.errors), page.errors


async def focus_by_touch(page: Page, made: Made) -> None:
    await page.tap("#stage", 0.25, 0.75)
    await page.comes_true("document.getElementById('spot').textContent === '1.50 m'")
    _, x, y = next(each for each in made.controls.asked if each[0] == "at")
    assert (x, y) == pytest.approx((0.25, 0.75), abs=0.01)
    await page.comes_true("document.getElementById('metres').textContent === '1.50 m'")
    # The slider follows: 1 / 1.5 m.
    assert float(await page.value("document.getElementById('focus').value")) == pytest.approx(1 / 1.5)
    await asyncio.sleep(0.35)  # a second tap at once would be a double tap
    await page.tap("#stage", 0.75, 0.75)
    await page.comes_true("document.getElementById('message').textContent === 'there is no depth there: tap another place'")
    assert made.controls.values["focus"] == 1.5
    # The right end of the slider is 2 dioptres.
    await page.tap("#focus", 0.999)
    await page.comes_true("viewfinder.focus !== 1.5")
    assert made.controls.values["focus"] == pytest.approx(0.5, abs=0.03)


async def choose_lens_and_view(page: Page, made: Made) -> None:
    await page.choose("#lens", "eighty")
    await page.comes_true("viewfinder.model.state.lens === 'eighty'")
    await page.choose("#view", "plate")
    await page.comes_true("viewfinder.model.state.view === 'plate'")
    await page.choose("#f_number", "1.4")
    await page.comes_true("viewfinder.model.state.f_number === 1.4")
    assert made.controls.asked[-3:] == [("lens", "eighty"), ("view", "plate"), ("f_number", 1.4)]
    await page.value("scrollTo(0, 0)")
    before = await page.value("viewfinder.counts.shown")
    await page.comes_true(f"viewfinder.counts.shown > {before + 2}")
    assert_color(await color_at(page, 0.5, 0.5), LENS_RGB["eighty"])
    assert_color(await color_at(page, 0.2, 0.5), VIEW_RGB["plate"])
    await page.tap("#ab")
    await page.comes_true("viewfinder.model.state.view === 'final'")


async def capture_and_record(page: Page, made: Made) -> None:
    await page.tap("#capture")
    await page.comes_true("document.getElementById('message').textContent === 'saved bundle_0001'")
    assert made.controls.asked[-1] == ("capture",)
    await page.tap("#record")
    await page.comes_true("document.getElementById('record').getAttribute('aria-pressed') === 'true'")
    assert made.controls.asked[-1] == ("recording", True)


async def follow_what_others_set(page: Page, made: Made) -> None:
    made.controls.set_lens("fifty")
    made.controls.focus_at_distance(4.0)
    await page.comes_true("document.getElementById('lens').value === 'fifty' && document.getElementById('metres').textContent === '4.00 m'")


async def test_the_readout_tells_age_rate_way_and_stages(tmp_path: Path) -> None:
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await page.comes_true("document.getElementById('age')?.textContent > 0")
        # Captured, encoded, sent, decoded and drawn on one machine: the age is positive and far below a second.
        # Offsets of clocks are measured by round trips, and may be some milliseconds off for a moment while the machine is busy.
        await page.comes_true("0 < viewfinder.age && viewfinder.age < 1000")
        assert float(await page.value("document.getElementById('fps').textContent")) > 5
        assert await page.value("document.getElementById('way').textContent") == "pictures"
        assert await page.value("document.getElementById('tracking').textContent") == "tracking 90 %"
        await page.value("document.getElementById('aid_times').click()")
        await page.comes_true("document.getElementById('times').textContent.startsWith('composite 1.3 · jpeg ')")
        # The source makes a picture every 20 ms; a page that stops for half a second misses about 25 of them.
        dropped = await page.value("viewfinder.counts.dropped")
        await page.value("{ const end = performance.now() + 500; while (performance.now() < end); }")
        await page.comes_true(f"viewfinder.counts.dropped >= {dropped + 10}")
        assert page.errors == []


async def test_marks_are_drawn_where_the_picture_has_edges_on_the_real_and_the_virtual_apart(tmp_path: Path) -> None:
    """The rim of 4 white pixels around the virtual square has an edge to the real picture outside and one to the square inside."""

    async def share(page: Page, rgb: tuple[int, int, int]) -> float:
        left, top, width, height = (round(each) for each in await page.box("#stage"))
        stage = (await page.screenshot())[top : top + height, left : left + width].astype(int)
        return float((np.abs(stage - rgb).max(axis=2) < 40).mean())

    async def switch(page: Page, *names: str) -> None:
        for name in names:
            await page.value(f"document.getElementById('aid_{name}').click()")
        await asyncio.sleep(0.8)

    green, magenta = (51, 255, 51), (255, 26, 230)
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        assert await share(page, green) == await share(page, magenta) == 0
        await switch(page, "peakReal")
        # Edges of about 3 px around 40 and 32 px squares, of 160 x 96 px: 2 to 7 %.
        assert 0.015 < await share(page, green) < 0.08
        assert await share(page, magenta) == 0
        # Contrast does not count: a rim that is 36 codes brighter than its background (luma 87 of 255) is as sharp as the white one.
        made.controls.values["rim"] = 123
        await asyncio.sleep(0.5)
        assert 0.01 < await share(page, green) < 0.08
        made.controls.values["rim"] = 255
        made.controls.values["blur_px"] = 1.0
        await asyncio.sleep(0.5)
        assert 0.01 < await share(page, green) < 0.08
        # Out of focus nothing is marked: in 2 px far less than 0.6 of what happens in 6.
        made.controls.values["blur_px"] = 4.0
        await asyncio.sleep(0.5)
        assert await share(page, green) == 0
        made.controls.values["blur_px"] = 0.0
        await asyncio.sleep(0.5)
        await switch(page, "peakReal", "peakVirtual")
        assert await share(page, green) == 0
        assert 0.003 < await share(page, magenta) < 0.04
        await switch(page, "peakVirtual", "zebra", "grid")
        # Half of the rim's white (40^2 - 32^2 of 15360 px = 3.8 %) is striped dark.
        assert 0.008 < await share(page, (51, 51, 51)) < 0.05
        assert_color(await color_at(page, 0.2, 0.5), VIEW_RGB["final"])
        await switch(page, "histogram")
        # Three colours: some bins are high, most are empty.
        context = "document.getElementById('histogram').getContext('2d')"
        heights = f"(c => [...Array(128).keys()].map(x => c.getImageData(x, 47, 1, 1).data[3]))({context})"
        filled = np.count_nonzero(await page.value(heights))
        assert 4 <= filled <= 40
        assert page.errors == []


async def test_fingers_zoom_the_display_and_drag_the_object(tmp_path: Path) -> None:
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        left, top, width, height = await page.box("#stage")
        middle = (left + width / 2, top + height / 2)
        around = [[(middle[0] - d, middle[1]), (middle[0] + d, middle[1])] for d in (30, 40, 50, 60)]
        await page.touch(*around)
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
        await asyncio.sleep(0.5)
        moves = np.array([each[2:] for each in made.controls.asked if each[0] == "move"])
        # 2 m across the width and 1.2 m over the height, whatever the number of messages.
        assert moves.sum(axis=0) == pytest.approx([2 * 39 / width, 1.2 * 19.5 / height], abs=0.02)
        await page.value("document.getElementById('visible').click()")
        await page.comes_true("viewfinder.model.state.objects[0].visible === false")
        # Neither drag nor pinch focused.
        assert [each for each in made.controls.asked if each[0] in ("at", "focus")] == []


async def test_the_token_is_used_up_and_a_guest_may_only_watch(tmp_path: Path) -> None:
    sessions = Sessions()
    async with made_viewfinder(Access(sessions=sessions)) as made:
        spent = sessions.invitation(Role.VIEW)
        async with chromium_page(f"{made.url}#token={spent}", tmp_path / "one") as page:
            await opened(page)
            assert await page.value("location.href") == made.url
            assert await page.value("document.cookie") == ""
            await page.comes_true("document.getElementById('capture').disabled && document.getElementById('focus').disabled")
            await page.tap("#stage", 0.25, 0.75)
            await page.send("Page.reload")
            await opened(page)
        async with chromium_page(f"{made.url}#token={spent}", tmp_path / "two") as page:
            await page.comes_true("document.getElementById('message')?.textContent.includes('used before')")
    assert made.controls.asked == []


async def test_portrait_landscape_and_the_left_hand(tmp_path: Path) -> None:
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        picture, capture = await page.box("#stage"), await page.box("#capture")
        assert picture[2] == 390 and picture[3] == pytest.approx(390 * 96 / 160, abs=1)
        # The button is in the right thumb's corner, a finger wide.
        assert capture[0] > 195 and capture[1] > 600 and min(capture[2:]) >= 44
        await page.value("document.getElementById('aid_leftHand').click()")
        assert (await page.box("#capture"))[0] < 195
        await page.size(844, 390)
        await asyncio.sleep(0.3)
        panel, picture = await page.box("#panel"), await page.box("#stage")
        assert panel[0] == 0 and picture[0] >= panel[2] and picture[3] <= 390
        await page.value("document.getElementById('aid_leftHand').click()")
        assert (await page.box("#panel"))[0] > (await page.box("#stage"))[0]
        assert await page.value("document.documentElement.scrollWidth <= innerWidth")


async def test_the_level_turns_against_the_phone(tmp_path: Path) -> None:
    """deviceorientation (W3C): beta 90 is upright; rolled 10 degrees clockwise up leans 10 degrees to the left."""
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        await page.value("document.getElementById('aid_level').click()")

        async def shown(beta: float, gamma: float) -> np.ndarray:
            """(roll in degrees, clockwise; shift in heights, down) of the line."""
            await page.value(
                f"dispatchEvent(new DeviceOrientationEvent('deviceorientation', {{alpha: 0, beta: {beta}, gamma: {gamma}}})), 0"
            )
            matrix = await page.value("(m => [m.a, m.b, m.f])(new DOMMatrix(getComputedStyle(document.getElementById('level')).transform))")
            return np.array([np.degrees(np.arctan2(matrix[1], matrix[0])), matrix[2] / (await page.box("#stage"))[3]])

        np.testing.assert_allclose(await shown(90, 0), [0, 0], atol=1e-3)
        # up = (-cos b sin g, sin b, cos b cos g): b = 80, g = 90 lies on (-0.174, 0.985, 0), 10 degrees to the left.
        np.testing.assert_allclose(await shown(80, 90), [-10, 0], atol=1e-3)
        # Tipped back by 30 degrees the camera looks down by 30, a third of a right angle: the horizon lies higher.
        np.testing.assert_allclose(await shown(60, 0), [0, -30 / 90], atol=1e-3)


async def test_the_camera_page_needs_a_secure_page_and_says_so(tmp_path: Path) -> None:
    # A name that resolves to this machine but is not called localhost: as insecure for the browser as a LAN address.
    async with made_viewfinder(Access(names=frozenset({"viewfinder.test"}))) as made:
        url = made.url.replace("127.0.0.1", "viewfinder.test") + "camera"
        async with chromium_page(url, tmp_path / "profile", "--host-resolver-rules=MAP viewfinder.test 127.0.0.1") as page:
            await page.comes_true("document.getElementById('message')?.textContent.includes('--tls')")
            assert await page.value("document.getElementById('send').disabled")
            # The viewfinder itself works there, without tilt.
            await page.send("Page.navigate", url=made.url.replace("127.0.0.1", "viewfinder.test"))
            await opened(page)
            assert await page.value("window.isSecureContext || document.getElementById('aid_level') !== null") is False


async def test_a_finger_that_does_not_rest_never_sends_too_much(tmp_path: Path) -> None:
    """300 positions of the slider in 2.4 s, of which the page sends about 20 per second; the server refuses from 40 on."""
    async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
        await opened(page)
        await page.value("""(async () => {
          const slider = document.getElementById('focus');
          for (let i = 1; i <= 300; i++) {
            slider.value = i / 300;
            slider.dispatchEvent(new Event('input'));
            await new Promise((done) => setTimeout(done, 8));
          }
        })()""")
        await page.comes_true("viewfinder.focus === 1")
        sent = [each for each in made.controls.asked if each[0] == "focus"]
        assert 5 < len(sent) < 80
        assert sent[-1] == ("focus", 1.0)
        assert page.errors == []


async def test_what_stopped_is_told_and_forgotten_when_it_comes_back(tmp_path: Path) -> None:
    message = "document.getElementById('message').textContent"
    async with AsyncExitStack() as browser:
        async with made_viewfinder() as made:
            port = int(made.url.rsplit(":", 1)[1].strip("/"))
            page = await browser.enter_async_context(chromium_page(made.url, tmp_path / "profile"))
            await opened(page)
            made.pictures.rest()
            made.jpeg.fail("the camera was unplugged")
            await page.comes_true(f"{message} === 'the camera was unplugged'")
            made.pictures.go_on()
            await page.comes_true(f"{message} === ''")
        await page.comes_true(f"{message} === 'connection lost, trying again'")
        async with made_viewfinder(Access(sessions=Sessions()), port=port):
            # A viewfinder that was started anew knows nobody.
            await page.comes_true(f"{message}.includes('printed last')")
        before = await page.value("viewfinder.counts.shown")
        async with made_viewfinder(port=port):
            await page.comes_true(f"viewfinder.counts.shown > {before} && {message} === ''")
