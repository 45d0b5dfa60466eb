"""Results as JPEG for people to look at: pictures, frames of a video side by side, or a page in a headless Chromium.

Chromium is driven through the DevTools protocol.
"""

import asyncio
import base64
import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.images.color import display_rgb8
from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.system.errors import InputError

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_LOOK_S = 0.02
_FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--no-first-run")


class NavigatedError(Exception):
    """An expression was evaluated while the browser went from one page to the next."""


class Page:
    """A page in the browser. errors: exceptions and refusals that its console showed."""

    def __init__(self, devtools: aiohttp.ClientWebSocketResponse) -> None:
        self._devtools, self._number = devtools, 0
        self.errors: list[str] = []

    async def send(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        await self._devtools.send_json({"id": self._number, "method": method, "params": parameters})
        while (message := await self._devtools.receive_json(timeout=20)).get("id") != self._number:
            self._note(message)
        if "error" in message:
            raise NavigatedError(message["error"])
        return message["result"]

    def _note(self, event: dict[str, Any]) -> None:
        details = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(details["exceptionDetails"]))
        elif event.get("method") == "Log.entryAdded" and details["entry"]["level"] == "error":
            self.errors.append(f"{details['entry']['text']} {details['entry'].get('url', '')}")

    async def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, awaited if it is a promise."""
        answer = await self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    async def comes_true(self, expression: str, limit_s: float = 15.0) -> None:
        for _ in range(int(limit_s / _LOOK_S)):
            with contextlib.suppress(NavigatedError):
                if await self.value(expression):
                    return
            await asyncio.sleep(_LOOK_S)
        raise AssertionError(f"never true: {expression}; message: {await self.value('document.body.innerText')!r}; {self.errors}")

    async def size(self, width_px: int, height_px: int) -> None:
        metrics = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": True}
        await self.send("Emulation.setDeviceMetricsOverride", **metrics)

    async def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return (left, top, width, height) of an element in the window, px."""
        rect = await self.value(f"(r => [r.left, r.top, r.width, r.height])(document.querySelector('{selector}').getBoundingClientRect())")
        return rect[0], rect[1], rect[2], rect[3]

    async def touch(self, *points: list[tuple[float, float]]) -> None:
        """Put fingers down at the first list of points, move them along the others, then up."""
        for kind, at in [("touchStart", points[0]), *(("touchMove", each) for each in points[1:])]:
            await self.send("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(at)])
        await self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    async def tap(self, selector: str, x: float = 0.5, y: float = 0.5) -> None:
        """Tap at a fraction of an element's width and height."""
        await self.value(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
        left, top, width, height = await self.box(selector)
        await self.touch([(left + x * width, top + y * height)])

    async def choose(self, selector: str, option: str) -> None:
        """Choose an option of a <select>, whose list is the system's own."""
        await self.value(f"(s => {{ s.value = '{option}'; s.dispatchEvent(new Event('change')); }})(document.querySelector('{selector}'))")

    async def screenshot(self) -> np.ndarray:
        """Return (H, W, 3) of the window, red first."""
        png = base64.b64decode((await self.send("Page.captureScreenshot", format="png"))["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]


class Chromium:
    """A running headless Chromium that shows pages, each with cookies and storage of its own."""

    def __init__(self, profile: Path, *flags: str) -> None:
        command = [str(CHROMIUM), *_FLAGS, f"--user-data-dir={profile}", *flags, "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._told = profile / "DevToolsActivePort"

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=10)

    @asynccontextmanager
    async def page(self, url: str, size_px: tuple[int, int] = (390, 844), script: str = "") -> AsyncIterator[Page]:
        """Yield a page; it has touch and the size of a phone. script: runs before the page's own."""
        while not (self._told.exists() and len(told := self._told.read_text().split()) == 2):
            assert self._process.poll() is None, f"Chromium ended with {self._process.returncode}"
            await asyncio.sleep(_LOOK_S)
        address = f"ws://127.0.0.1:{told[0]}"
        async with aiohttp.ClientSession() as session, session.ws_connect(address + told[1], max_msg_size=0) as browser:
            devtools = Page(browser)
            own = (await devtools.send("Target.createBrowserContext"))["browserContextId"]
            target = (await devtools.send("Target.createTarget", url="about:blank", browserContextId=own))["targetId"]
            async with session.ws_connect(f"{address}/devtools/page/{target}", max_msg_size=0) as shown:
                page = Page(shown)
                for domain in ("Runtime", "Log", "Page"):
                    await page.send(f"{domain}.enable")
                await page.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
                await page.size(*size_px)
                await page.send("Page.addScriptToEvaluateOnNewDocument", source=script)
                await page.send("Page.navigate", url=url)
                yield page
            await devtools.send("Target.disposeBrowserContext", browserContextId=own)


@asynccontextmanager
async def chromium_page(
    url: str, profile: Path, *flags: str, size_px: tuple[int, int] = (390, 844), script: str = ""
) -> AsyncIterator[Page]:
    """Yield a page of a browser that is started for it."""
    browser = Chromium(profile, *flags)
    try:
        async with browser.page(url, size_px, script) as page:
            yield page
    finally:
        browser.close()


WIDEST_PX = 960
_QUALITY = 82
_TALLEST = 0.9
"""Share of the width: sheets go on below."""
_FRAMES = 3
_VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv")
_WINDOW_PX = (960, 640)
_STARTS_S, _SETTLES_S = 60.0, 8.0
_STEADY = r"(text => !text.includes('tracking') || /tracking (8\d|9\d|100) %/.test(text))(document.body.innerText)"
"""A clip that is played in a loop is tracked anew where it begins, and things fade in."""


def result_jpeg(*paths: Path) -> bytes:
    """Return pictures side by side. An EXR is tone-mapped, of a video three frames are shown, of a long sheet its upper part."""
    pictures = [_shown(path) for path in paths]
    height_px = min(picture.shape[0] for picture in pictures)
    return _jpeg(np.concatenate([_resized(picture, height_px) for picture in pictures], axis=1))


def _shown(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _frames(path)
    if path.suffix.lower() in LINEAR_SUFFIXES:
        return display_rgb8(read_image(path))
    stored = display_rgb8(read_image(path), 0.0) if path.suffix.lower() in (".tif", ".tiff") else _as_stored(path)
    return stored[: round(_TALLEST * stored.shape[1])]


def _resized(rgb: UInt8[np.ndarray, "height width 3"], height_px: int) -> UInt8[np.ndarray, "height_px new_width 3"]:
    import cv2

    share = height_px / rgb.shape[0]
    return rgb if share == 1.0 else cv2.resize(rgb, (round(rgb.shape[1] * share), height_px), interpolation=cv2.INTER_AREA)


def page_jpeg(command: list[str], address: str, folder: Path) -> bytes:
    """Return a page that a command serves, as a browser shows it a few seconds after it was opened."""
    if CHROMIUM is None:
        raise InputError(f"a picture of {address} needs a browser: install Chromium (`apt-get install chromium`)")
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True) as server:
        try:
            _wait_for_address(server)
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
                return _jpeg(asyncio.run(_screenshot(address, Path(profile))))
        finally:
            os.killpg(server.pid, signal.SIGTERM)


def _wait_for_address(server: "subprocess.Popen[str]") -> None:
    """Wait until the server prints its address, which it does once it answers."""
    end_s = time.monotonic() + _STARTS_S
    assert server.stdout is not None
    for line in server.stdout:
        if "http" in line:
            return
        if time.monotonic() > end_s:
            break
    raise InputError(f"expected `{' '.join(map(str, server.args))}` to print its address within {_STARTS_S:g} s, but it did not")  # type: ignore[arg-type]


async def _screenshot(address: str, profile: Path) -> UInt8[np.ndarray, "height width 3"]:
    async with chromium_page(address, profile, size_px=_WINDOW_PX) as page:
        await asyncio.sleep(_SETTLES_S)
        await page.comes_true(_STEADY)
        return await page.screenshot()


def _frames(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    from mrbokeh.video.clip import read_frames

    frames = [display_rgb8(_smaller(frame.rgb, WIDEST_PX // _FRAMES)) for frame in read_frames(path)]
    return np.concatenate([frames[round(share * (len(frames) - 1))] for share in np.linspace(0.1, 0.9, _FRAMES)], axis=1)


def _as_stored(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    import cv2

    stored = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if stored is None:
        raise InputError(f"expected a picture in {path}, but there is none: see `shows` of its example in docs/examples.md")
    return cv2.cvtColor(stored, cv2.COLOR_BGR2RGB)


def _smaller(rgb: Float32[np.ndarray, "height width 3"], width_px: int) -> Float32[np.ndarray, "new_height new_width 3"]:
    import cv2

    height, width = rgb.shape[:2]
    if width <= width_px:
        return rgb
    return cv2.resize(rgb, (width_px, round(height * width_px / width)), interpolation=cv2.INTER_AREA)


def _jpeg(rgb: UInt8[np.ndarray, "height width 3"]) -> bytes:
    import cv2

    shrink = min(1.0, WIDEST_PX / rgb.shape[1])
    small = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1.0 else rgb
    return cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
