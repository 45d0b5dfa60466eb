"""The viewfinder with a finished layer: a real server and real WebSocket clients; where Chromium is installed, a real browser."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest

from mrbokeh.errors import InputError
from mrbokeh.image_io import write_layer
from mrbokeh.layer import Layer, clear
from mrbokeh.lens import Lens
from mrbokeh.lens_file import write_lens
from mrbokeh.overlay import Overlay, code_tables
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.video_color import code_from_linear, linear_from_code
from mrbokeh.video_io import VideoWriter
from tests.chromium import CHROMIUM, chromium_page
from viewfinder.frames import CameraFrame
from viewfinder.lens_book import LensBook
from viewfinder.newest import Newest
from viewfinder.running import Parts, Viewfinder
from viewfinder.running import running as parts_running
from viewfinder.server.app import serving_site
from viewfinder.sources.choose import open_source
from viewfinder.sources.exact_size import ExactSize
from viewfinder.sources.pattern import PatternSource
from viewfinder.sources.video_file import VideoFileSource
from viewfinder.still_layer import StillLayer

WIDTH, HEIGHT = 160, 90
# Half a dioptre out of focus blurs over 13.7 px here: 160 / 6 px per mm, 20 mm aperture, 51.3 mm to the sensor.
LENS = Lens(focal_length_mm=50.0, f_number=2.5, focus_distance_m=2.0, sensor_width_mm=6.0)


def bright_square(depth_m: float = 2.0) -> Layer:
    """24x24 px of opaque light, in focus at 2 m."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[33:57, 68:92] = 1.0
    rgb = alpha[..., None] * np.array([0.9, 0.1, 0.05], np.float32)
    return Layer(rgb, alpha, np.where(alpha > 0, np.float32(depth_m), np.float32(np.inf)))


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """(a lossless clip of one smooth picture at 50 frames per second, its 8-bit codes, blue first)."""
    x, y = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    bgr = np.rint(np.stack([60 + 120 * x, 200 - 100 * y, 80 + 60 * x * y], -1)).astype(np.uint8)
    path = tmp_path / "plate.mkv"
    with VideoWriter(path, WIDTH, HEIGHT, Fraction(50)) as writer:
        for i in range(25):
            writer.write(linear_from_code(bgr[..., ::-1] / 255.0, "bt709"), i / 50)
    return path, bgr


@contextmanager
def viewfinder(source: Any, captures: Path, layer: Layer | None = None) -> Iterator[Viewfinder]:
    still = StillLayer(layer or bright_square(), LENS, ScatterReference(), "scatter")
    with parts_running(Parts(source, still, LensBook({"test": LENS}), {"scatter": ScatterReference}, captures)) as running_one:
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


def in_time(work: Callable[[], Coroutine[Any, Any, None]], limit_s: float = 30.0) -> None:
    asyncio.run(asyncio.wait_for(work(), limit_s))


def test_frames_are_pictures_of_the_right_size_and_grow_in_number(plate: tuple[Path, np.ndarray]) -> None:
    async def work() -> None:
        async with running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url, watching(url) as viewer:
            shown = [await viewer.frame() for _ in range(40)]
        assert all(each.bgr.shape == (HEIGHT, WIDTH, 3) for each in shown)
        # 40 frames of a clip of 25: it goes round, and no frame comes twice.
        assert np.all(np.diff([each.header["sequence"] for each in shown]) >= 1)
        captured_ms = np.array([each.header["captured_ms"] for each in shown])
        assert np.all(np.diff(captured_ms) > 0)
        # The clip has 50 frames per second, of which a quick viewer gets nearly all.
        assert np.median(np.diff(captured_ms)) == pytest.approx(20.0, abs=5.0)

    in_time(work)


def test_the_plate_stays_and_the_object_is_laid_over_in_linear_light(plate: tuple[Path, np.ndarray]) -> None:
    path, bgr = plate

    async def work() -> None:
        async with running(VideoFileSource(path, WIDTH, HEIGHT)) as url, watching(url) as viewer:
            picture = (await viewer.frame()).bgr
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        same_through_jpeg = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        away = np.ones((HEIGHT, WIDTH), bool)
        away[16:80, 48:112] = False  # whole JPEG blocks (16 px) around the square
        np.testing.assert_array_equal(picture[away], same_through_jpeg[away])
        inside = code_from_linear(np.array([0.05, 0.1, 0.9]), "bt709") * 255
        np.testing.assert_allclose(picture[40:50, 74:86].reshape(-1, 3).mean(axis=0), inside, atol=2.0)

    in_time(work)


def test_the_focus_changes_the_object_and_nothing_else(plate: tuple[Path, np.ndarray]) -> None:
    async def work() -> None:
        async with running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url, watching(url) as viewer:
            sharp = await viewer.frame()
            assert sharp.header["focus_distance_m"] == 2.0
            assert (await set_focus(url, 1.0))[0] == 200
            soft = await until(viewer, lambda shown: shown.header["focus_distance_m"] == 1.0)
            assert (await set_focus(url, None))[0] == 200
            await until(viewer, lambda shown: shown.header["focus_distance_m"] is None)
            assert (await set_focus(url, 2.0))[0] == 200
            again = await until(viewer, lambda shown: shown.header["focus_distance_m"] == 2.0)
        np.testing.assert_array_equal(again.bgr, sharp.bgr)
        change = np.abs(soft.bgr.astype(float) - sharp.bgr).max(axis=2)
        # Light leaves the square's rim: 3 px outside the edge it gets redder, by far more than JPEG does.
        assert soft.bgr[40:50, 64, 2].mean() > sharp.bgr[40:50, 64, 2].mean() + 40
        # The blur of 13.7 px reaches 7 px beyond rows 33 to 56; JPEG carries it to the end of its blocks at 16 and 79, chroma 1 px farther.
        assert change[:15].max() == change[81:].max() == 0

    in_time(work)


async def until(viewer: Viewer, true_of: Callable[[Shown], bool]) -> Shown:
    """The first frame of which something is true, among the next 400."""
    for _ in range(400):
        shown = await viewer.frame()
        if true_of(shown):
            return shown
    raise AssertionError("it never came")


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


def test_a_failing_camera_says_so() -> None:
    class Unplugged:
        name, transfer, status = "camera 7", "srgb", None

        def frames(self, stopping: Event) -> Iterator[CameraFrame]:
            yield CameraFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic(), 0)
            assert not stopping.is_set()
            raise InputError("camera 7 stopped giving pictures")

    async def work() -> None:
        async with running(Unplugged()) as url, watching(url) as viewer:
            messages = [await viewer.stream.receive(timeout=5) for _ in range(2)]
            texts = [json.loads(each.data) for each in messages if each.type is aiohttp.WSMsgType.TEXT]
            assert texts == [{"failure": "camera 7 stopped giving pictures"}]

    in_time(work)


def test_codes_through_the_tables_equal_the_composite_in_linear_light() -> None:
    """Against compositing in float: at most half a code of rounding and 0.2 of the table apart."""
    rng = np.random.default_rng(5)
    bgr = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    blurred = ScatterReference().render([bright_square(1.0)], LENS)
    for transfer in ("bt709", "srgb"):
        tables = code_tables(transfer)
        np.testing.assert_array_equal(tables.code_from_linear[np.rint(tables.linear_from_code * 16383).astype(int)], np.arange(256))
        overlay = Overlay.of(blurred)
        exact = code_from_linear(overlay.over(linear_from_code(bgr[..., ::-1] / 255.0, transfer)), transfer)[..., ::-1] * 255
        np.testing.assert_allclose(overlay.over_codes(bgr, tables), np.clip(exact, 0, 255), atol=0.72)
    nothing = Overlay.of(clear(HEIGHT, WIDTH))
    np.testing.assert_array_equal(nothing.over_codes(bgr, code_tables("srgb")), bgr)


def test_the_slot_keeps_the_newest() -> None:
    slot: Newest[int] = Newest()
    for number in range(5):
        slot.put(number)
    assert (slot.take(0.0), slot.take(0.0)) == (4, None)


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


def test_what_a_finished_layer_cannot_do_is_said(tmp_path: Path) -> None:
    with viewfinder(PatternSource(WIDTH, HEIGHT), tmp_path) as running_one:
        controls = running_one.site.controls
        with pytest.raises(InputError, match="has not given a picture"):
            controls.focus_at_point(0.5, 0.5)
        with pytest.raises(InputError, match="focuses from"):
            controls.focus_at_distance(0.02)
        with pytest.raises(InputError, match="--scene"):
            controls.move_object("lantern", (0.1, 0.0))
        assert controls.state()["dioptre_range"] == (0.0, pytest.approx(1 / 0.3)), "6 focal lengths of 50 mm"


@contextmanager
def command(tmp_path: Path, *extra: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`mrbokeh viewfinder` as a process, and the address that it prints."""
    write_layer(tmp_path / "layer.exr", bright_square())
    write_lens(tmp_path / "lens.json", LENS)
    files = ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json")]
    arguments = [sys.executable, "-u", "-m", "mrbokeh.cli", "viewfinder", "--source", "test", *files, *extra]
    root = Path(__file__).parent.parent
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


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the page is tested by clients in Python only")
@pytest.mark.parametrize("transport", ["whep", "jpeg"])
def test_the_page_shows_the_stream_in_a_browser(tmp_path: Path, plate: tuple[Path, np.ndarray], transport: str) -> None:
    """The plate on the screen, red in the square, and beside the square more red when a finger has moved the focus."""

    async def work() -> None:
        async with (
            running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url,
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

    in_time(work, 60.0)
