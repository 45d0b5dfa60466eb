"""The viewfinder with a finished layer: a real server and real WebSocket clients."""

import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event

import aiohttp
import cv2
import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.images.layer import clear
from mrbokeh.optics.camera import Camera
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from mrbokeh.video.color import code_from_linear, linear_from_code
from tests.scenes.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square, running, set_focus, until, viewfinder, watching
from viewfinder.app.running import Pipeline
from viewfinder.frames import CameraFrame, FrameStatus, Newest, OutputFrame
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize, SizeLimit
from viewfinder.sources.playback import PatternSource, VideoFileSource
from viewfinder.stage.static_layer import StaticLayer


async def test_frames_are_pictures_of_the_right_size_and_grow_in_number(plate: tuple[Path, np.ndarray]) -> None:
    async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
        shown = [await viewer.frame() for _ in range(40)]
    assert all(each.bgr.shape == (HEIGHT, WIDTH, 3) for each in shown)
    # 40 frames of a clip of 25: it goes round, and no frame comes twice.
    assert np.all(np.diff([each.header["sequence"] for each in shown]) >= 1)
    captured_ms = np.array([each.header["captured_ms"] for each in shown])
    assert np.all(np.diff(captured_ms) > 0)
    # The clip has 50 frames per second, of which a quick viewer gets nearly all.
    assert np.median(np.diff(captured_ms)) == pytest.approx(20.0, abs=5.0)


async def test_the_plate_stays_and_the_object_is_laid_over_in_linear_light(plate: tuple[Path, np.ndarray]) -> None:
    path, bgr = plate
    async with running(VideoFileSource(path, SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
        picture = (await viewer.frame()).bgr
    jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    same_through_jpeg = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    away = np.ones((HEIGHT, WIDTH), bool)
    away[16:80, 48:112] = False  # whole JPEG blocks (16 px) around the square
    np.testing.assert_array_equal(picture[away], same_through_jpeg[away])
    inside = code_from_linear(np.array([0.05, 0.1, 0.9]), "bt709") * 255
    np.testing.assert_allclose(picture[40:50, 74:86].reshape(-1, 3).mean(axis=0), inside, atol=2.0)


async def test_the_focus_changes_the_object_and_nothing_else(plate: tuple[Path, np.ndarray]) -> None:
    async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
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


def test_a_blur_that_ends_while_a_frame_is_made_is_told_of_with_the_next() -> None:
    """Or a header would state a focus that its picture does not show."""
    camera = Camera(WIDTH, HEIGHT, (float(WIDTH), float(WIDTH)), (WIDTH / 2, HEIGHT / 2))
    nearer = replace(LENS, focus_distance_m=1.0)
    with closing(StaticLayer(bright_square(), LENS, ScatterReference())) as still:
        before = still.overlay(None, camera, nearer, 0.0)
        while still.shown.overlay is before:
            time.sleep(0.001)
        assert still.status.lens == LENS and still.pending
        assert still.overlay(None, camera, nearer, 0.0) is not before
        assert still.status.lens == nearer and not still.pending


async def test_a_failing_camera_says_so() -> None:
    class Unplugged:
        name, transfer, status = "camera 7", "srgb", None

        def frames(self, stopping: Event) -> Iterator[CameraFrame]:
            yield CameraFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic(), 0)
            assert not stopping.is_set()
            raise InputError("camera 7 stopped giving pictures")

    async with running(Unplugged()) as url, watching(url) as viewer:
        # The one picture may come before.
        messages = [await viewer.stream.receive(timeout=5)]
        if messages[0].type is not aiohttp.WSMsgType.TEXT:
            messages.append(await viewer.stream.receive(timeout=5))
        assert json.loads(messages[-1].data) == {"failure": "camera 7 stopped giving pictures"}


@pytest.mark.parametrize("trouble", [None, InputError("the layer is missing")])
def test_nothing_comes_after_the_news_that_the_camera_died(trouble: InputError | None) -> None:
    """A picture says that all is well again, even one that was under way when the camera died; so does another trouble."""
    heard: list[str] = []
    making = Event()

    class Dying:
        name, transfer, status = "camera 7", "srgb", None

        def frames(self, stopping: Event) -> Iterator[CameraFrame]:
            yield CameraFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic(), 0)
            assert making.wait(5.0) and not stopping.is_set()
            raise InputError("camera 7 died")

    class Sink:
        wants_frame = True

        def show(self, frame: OutputFrame) -> None:
            heard.append(f"picture {frame.sequence}")

        def fail(self, sentence: str) -> None:
            heard.append(sentence)

    def late(frame: CameraFrame, dropped: int) -> OutputFrame:
        making.set()
        while pipeline.failure is None:
            time.sleep(0.001)
        if trouble is not None:
            raise trouble
        return OutputFrame(frame.bgr, frame.captured_s, frame.sequence, FrameStatus(1.0, 2.0, dropped=dropped))

    pipeline = Pipeline(Dying(), late, [Sink()])
    with pipeline:
        for thread in pipeline._threads:
            thread.join(5.0)
            assert not thread.is_alive()
    assert heard == ["camera 7 died"]


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


def test_a_file_plays_in_its_own_time(plate: tuple[Path, np.ndarray]) -> None:
    """30 frames at 50 per second last 0.58 s; at most 10 per second leave every fifth."""
    stopping = Event()
    for fps, every in ((None, 1), (10.0, 5)):
        frames = VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT), fps).frames(stopping)
        times_s = np.array([next(frames).captured_s for _ in range(30 // every)])
        assert times_s[-1] - times_s[0] == pytest.approx((30 // every - 1) * every / 50, abs=0.1)
        frames.close()


def test_a_source_is_fitted_to_an_exact_size(plate: tuple[Path, np.ndarray]) -> None:
    with pytest.raises(InputError, match="aspect ratio"):
        next(ExactSize(open_source(str(plate[0])), 100, 100).frames(Event()))
    assert next(ExactSize(open_source(str(plate[0])), 320, 180).frames(Event())).bgr.shape == (180, 320, 3)
