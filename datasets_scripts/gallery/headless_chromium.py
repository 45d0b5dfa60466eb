"""A headless Chromium on a page, driven through the DevTools protocol."""

import asyncio
import base64
import contextlib
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
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
        for _ in range(int(limit_s / 0.05)):
            with contextlib.suppress(NavigatedError):
                if await self.value(expression):
                    return
            await asyncio.sleep(0.05)
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


@asynccontextmanager
async def chromium_page(url: str, profile: Path, *flags: str, size_px: tuple[int, int] = (390, 844)) -> AsyncIterator[Page]:
    """Yield a page of a browser with a profile of its own; it has touch and the size of a phone."""
    command = [str(CHROMIUM), *_FLAGS, f"--user-data-dir={profile}", *flags, "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port_file = profile / "DevToolsActivePort"
        while not (port_file.exists() and port_file.read_text().strip()):
            assert process.poll() is None, f"Chromium ended with {process.returncode}"
            await asyncio.sleep(0.05)
        port = port_file.read_text().split()[0]
        async with aiohttp.ClientSession() as session:
            async with session.get(f"http://127.0.0.1:{port}/json/list") as answer:
                target = next(each for each in await answer.json() if each["type"] == "page")
            async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as devtools:
                page = Page(devtools)
                for domain in ("Runtime", "Log", "Page"):
                    await page.send(f"{domain}.enable")
                await page.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
                await page.size(*size_px)
                await page.send("Page.navigate", url=url)
                yield page
    finally:
        process.terminate()
        process.wait(timeout=10)
