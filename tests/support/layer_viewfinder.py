"""A viewfinder with a finished layer over a known plate, and WebSocket clients as the page is one."""

import json
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import aiohttp
import cv2
import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.video.color import linear_from_code
from tests.support.video_files import filmed
from viewfinder.app.opening import LensBook, Parts
from viewfinder.app.running import Viewfinder
from viewfinder.app.running import running as parts_running
from viewfinder.options import ViewfinderOptions
from viewfinder.server.endpoint import serving_site
from viewfinder.stage.overlay_source import StaticLayer

WIDTH, HEIGHT = 160, 90
# Half a dioptre out of focus blurs over 13.7 px here: 160 / 6 px per mm, 20 mm aperture, 51.3 mm to the sensor.
LENS = Lens(focal_length_mm=50.0, f_number=2.5, focus_distance_m=2.0, sensor_width_mm=6.0)


def bright_square(depth_m: float = 2.0) -> Layer:
    """24x24 px of opaque light, in focus at 2 m."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[33:57, 68:92] = 1.0
    rgb = alpha[..., None] * np.array([0.9, 0.1, 0.05], np.float32)
    return Layer(rgb, alpha, np.where(alpha > 0, np.float32(depth_m), np.float32(np.inf)))


def write_plate(folder: Path) -> tuple[Path, np.ndarray]:
    """(a lossless clip of one smooth picture at 50 frames per second, its 8-bit codes, blue first)."""
    x, y = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    bgr = np.rint(np.stack([60 + 120 * x, 200 - 100 * y, 80 + 60 * x * y], -1)).astype(np.uint8)
    return filmed(folder / "plate.mkv", [linear_from_code(bgr[..., ::-1] / 255.0, "bt709")] * 25, 50), bgr


@contextmanager
def viewfinder(source: Any, captures: Path, layer: Layer | None = None) -> Iterator[Viewfinder]:
    still = StaticLayer(layer or bright_square(), LENS, ScatterReference(), "scatter")
    options = ViewfinderOptions("test", captures=captures)
    with parts_running(Parts(options, source, still, LensBook({"test": LENS}), {"scatter": ScatterReference})) as running_one:
        yield running_one


@asynccontextmanager
async def running(source: Any, layer: Layer | None = None) -> AsyncIterator[str]:
    with TemporaryDirectory() as captures, viewfinder(source, Path(captures), layer) as running_one:
        async with serving_site(running_one.site, "127.0.0.1", 0) as url:
            yield url


@dataclass
class Shown:
    header: dict[str, Any]
    bgr: np.ndarray
    age_ms: float


class Viewer:
    """A client as the page is one: shows a frame, then acknowledges it."""

    def __init__(self, stream: aiohttp.ClientWebSocketResponse) -> None:
        self.stream = stream

    async def frame(self, *, acknowledge: bool = True) -> Shown:
        message = await self.stream.receive(timeout=10)
        assert message.type is aiohttp.WSMsgType.BINARY, message
        length = int.from_bytes(message.data[:4], "big")
        header = json.loads(message.data[4 : 4 + length])
        jpeg = message.data[4 + length :]
        assert (jpeg[:2], jpeg[-2:]) == (b"\xff\xd8", b"\xff\xd9")
        shown = Shown(
            header, cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), 1000 * time.monotonic() - header["captured_ms"]
        )
        if acknowledge:
            await self.acknowledge(shown)
        return shown

    async def acknowledge(self, shown: Shown) -> None:
        await self.stream.send_json({"ack": shown.header["sequence"]})


@asynccontextmanager
async def watching(url: str) -> AsyncIterator[Viewer]:
    async with aiohttp.ClientSession() as session, session.ws_connect(url + "stream") as stream:
        yield Viewer(stream)


async def control(url: str, message: Any) -> tuple[int, dict[str, Any]]:
    async with aiohttp.ClientSession() as session, session.post(url + "control", json=message) as answer:
        return answer.status, await answer.json()


async def set_focus(url: str, distance_m: Any) -> tuple[int, dict[str, Any]]:
    return await control(url, {"focus": {"distance_m": distance_m}})


async def until(viewer: Viewer, true_of: Callable[[Shown], bool]) -> Shown:
    """The first frame of which something is true, among the next 400."""
    for _ in range(400):
        shown = await viewer.frame()
        if true_of(shown):
            return shown
    raise AssertionError("it never came")
