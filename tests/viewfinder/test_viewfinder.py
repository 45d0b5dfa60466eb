"""The viewfinder with a finished layer: a real server and real WebSocket clients, slow ones, several, and for a long time."""

import asyncio
import gc
import json
import os
import shutil
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
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
from mrbokeh.video.clip import read_frames
from mrbokeh.video.color import code_from_linear, linear_from_code
from tests.support.layer_viewfinder import HEIGHT, LENS, WIDTH, bright_square, running, set_focus, until, viewfinder, watching
from tests.support.live_clip import write_live_clip
from tests.support.live_viewfinder import Live, live
from tests.support.refusals import refused
from tests.support.stage_scenes import ONE_CARD, backend, scene_file
from tests.support.streaming_viewers import noise, output
from tests.support.told_parts import ToldCamera, ToldTracker
from tests.support.waiting import comes_true, wait_until
from viewfinder.app.live_compositor import LiveCompositor
from viewfinder.app.live_controls import Captures
from viewfinder.app.opening import LensBook, Parts
from viewfinder.app.running import Pipeline
from viewfinder.focus.sources import ManualFocus
from viewfinder.frames import CameraFrame, FrameStatus, Newest, OutputFrame, frame_header
from viewfinder.options import ViewfinderOptions
from viewfinder.server.endpoint import serving_site
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize, SizeLimit
from viewfinder.sources.playback import PatternSource, VideoFileSource
from viewfinder.stage.overlay_source import StaticLayer
from viewfinder.stage.stage import Stage
from viewfinder.streaming.recording import Recorder
from viewfinder.streaming.take_file import playable_bytes
from viewfinder.tracking.tracker import TrackedPose


async def test_frames_grow_in_number_and_the_object_is_laid_over_the_plate_in_linear_light(plate: tuple[Path, np.ndarray]) -> None:
    path, bgr = plate
    async with running(VideoFileSource(path, SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
        shown = [await viewer.frame() for _ in range(30)]
        # The clock is that of the captures.
        await viewer.stream.send_json({"clock": 17.5})
        while (message := await viewer.stream.receive(timeout=5)).type is not aiohttp.WSMsgType.TEXT:
            pass
        answer = json.loads(message.data)
        assert answer["clock"] == 17.5 and abs(answer["server_ms"] - 1000 * time.monotonic()) < 1000
    assert all(each.bgr.shape == (HEIGHT, WIDTH, 3) for each in shown)
    # 30 frames of a clip of 25: it goes round, and no frame comes twice.
    assert np.all(np.diff([each.header["sequence"] for each in shown]) >= 1)
    captured_ms = np.array([each.header["captured_ms"] for each in shown])
    # The clip has 50 frames per second, of which a quick viewer gets nearly all.
    assert np.all(np.diff(captured_ms) > 0) and np.median(np.diff(captured_ms)) == pytest.approx(20.0, abs=5.0)
    jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    away = np.ones((HEIGHT, WIDTH), bool)
    away[16:80, 48:112] = False  # whole JPEG blocks (16 px) around the square
    picture = shown[0].bgr
    np.testing.assert_array_equal(picture[away], cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[away])
    inside = code_from_linear(np.array([0.05, 0.1, 0.9]), "bt709") * 255
    np.testing.assert_allclose(picture[40:50, 74:86].reshape(-1, 3).mean(axis=0), inside, atol=2.0)


async def test_the_focus_changes_the_object_and_nothing_else(plate: tuple[Path, np.ndarray]) -> None:
    async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
        sharp = await viewer.frame()
        assert sharp.header["focus_distance_m"] == 2.0 and (await set_focus(url, 1.0))[0] == 200
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
        assert still.status.lens == LENS and still.pending and still.overlay(None, camera, nearer, 0.0) is not before
        assert still.status.lens == nearer and not still.pending


def dying(may_die: Event | None = None, sentence: str = "camera 7 stopped giving pictures") -> ToldCamera:
    """A camera that dies after its first frame, then or when it may."""

    def frames(stopping: Event) -> Iterator[CameraFrame]:
        yield CameraFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic(), 0)
        assert (may_die is None or may_die.wait(5.0)) and not stopping.is_set()
        raise InputError(sentence)

    return ToldCamera(frames)


async def test_a_failing_camera_says_so() -> None:
    """Without the folders of this machine, in the stream and in the state."""
    trouble = "/home/me/clips/of today/camera 7.mp4 is broken: see C:\\made\\notes.txt, and /whip"
    shown = "of today/camera 7.mp4 is broken: see notes.txt, and /whip"
    async with running(dying(sentence=trouble)) as url, watching(url) as viewer:
        # The one picture may come before.
        while (message := await viewer.stream.receive(timeout=5)).type is not aiohttp.WSMsgType.TEXT:
            pass
        assert json.loads(message.data) == {"failure": shown}
        async with aiohttp.ClientSession() as session, session.get(url + "state") as answer:
            assert (await answer.json())["failure"] == shown


@pytest.mark.parametrize("trouble", [None, InputError("the layer is missing")])
def test_nothing_comes_after_the_news_that_the_camera_died(trouble: InputError | None) -> None:
    """A picture says that all is well again, even one that was under way when the camera died; so does another trouble."""
    heard: list[str] = []
    making = Event()

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

    pipeline = Pipeline(dying(making), late, [Sink()])
    with pipeline:
        for thread in pipeline._threads:
            thread.join(5.0)
            assert not thread.is_alive()
    assert heard == ["camera 7 stopped giving pictures"]


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
        refused("has not given a picture", controls.focus_at_point, 0.5, 0.5)
        refused("focuses from", controls.focus_at_distance, 0.02)
        refused("--scene", controls.move_object, "lantern", (0.1, 0.0))
        assert controls.state()["dioptre_range"] == (0.0, pytest.approx(1 / 0.3)), "6 focal lengths of 50 mm"


def test_a_file_plays_in_its_own_time(plate: tuple[Path, np.ndarray]) -> None:
    """20 frames at 50 per second last 0.38 s; at most 10 per second leave every fifth."""
    for fps, every in ((None, 1), (10.0, 5)):
        with closing(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT), fps).frames(Event())) as frames:
            times_s = np.array([next(frames).captured_s for _ in range(20 // every)])
        assert times_s[-1] - times_s[0] == pytest.approx((20 // every - 1) * every / 50, abs=0.1)
    refused("aspect ratio", next, ExactSize(open_source(str(plate[0])), 100, 100).frames(Event()))
    assert next(ExactSize(open_source(str(plate[0])), 320, 180).frames(Event())).bgr.shape == (180, 320, 3)


def test_a_take_that_was_cut_off_is_recovered_and_told_of_at_the_next_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, recorder = tmp_path / "viewfinder-1.recording.mp4", Recorder(lambda: "bt709", lambda _: None, waiting=100)
    recorder.start(tmp_path / "viewfinder-2.mp4")
    for i in range(60):
        recorder.show(output(noise(i), i, i / 30))

    def is_copied() -> bool:
        for working in tmp_path.glob("*2.recording.mp4"):
            shutil.copy(working, left)
        with left.open("ab+") as file:
            return playable_bytes(file) > 0

    wait_until(is_copied)
    recorder.stop()
    with viewfinder(PatternSource(WIDTH, HEIGHT), tmp_path) as running_one:
        [notice] = running_one.site.controls.state()["notices"]
    assert "viewfinder-1.mp4" in notice["sentence"] and notice["sentence"] in capsys.readouterr().out
    assert len(list(read_frames(tmp_path / "viewfinder-1.mp4"))) >= 15, "half a second"


async def test_a_slow_viewer_skips_frames_and_sees_the_newest(plate: tuple[Path, np.ndarray]) -> None:
    async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as slow, watching(url) as quick:
        numbers, ages_ms = [], []

        async def be_quick() -> list[int]:
            return [(await quick.frame()).header["sequence"] for _ in range(40)]

        hurrying = asyncio.create_task(be_quick())
        for _ in range(4):
            shown = await slow.frame(acknowledge=False)
            numbers.append(shown.header["sequence"])
            ages_ms.append(shown.age_ms)
            # Without an acknowledgement nothing more is sent: the credit is one.
            with pytest.raises(TimeoutError):
                await slow.stream.receive(timeout=0.25)
            await slow.acknowledge(shown)
        steps = np.diff(await hurrying)
    # 0.25 s are 12 frames at 50 per second; a queue would have delivered the next number instead.
    assert np.all(np.diff(numbers) >= 8)
    # The age is that of one frame and its way, however long the viewer took; a queue would add 250 ms each time.
    assert max(ages_ms) < 150
    # The slow viewer does not hold up the quick one.
    assert np.mean(steps) < 3


async def test_the_port_is_free_again_and_a_taken_one_is_named(plate: tuple[Path, np.ndarray]) -> None:
    ports = []
    async with running(VideoFileSource(plate[0], SizeLimit(WIDTH, HEIGHT))) as url, watching(url) as viewer:
        await viewer.frame()
        ports.append(int(url.rsplit(":", 1)[1].strip("/")))
        other = viewfinder(PatternSource(WIDTH, HEIGHT), plate[0].parent)
        with pytest.raises(InputError, match=f"port {ports[0]}.*--port"), other as second:
            async with serving_site(second.site, "127.0.0.1", ports[0]):
                pass
    with socket.socket() as client, pytest.raises(ConnectionRefusedError):
        client.connect(("127.0.0.1", ports[0]))


def test_of_a_pose_that_is_not_certain_the_page_is_told_and_nothing_is_captured(tmp_path: Path) -> None:
    tracker = ToldTracker(lambda frame: TrackedPose(np.eye(4), 0.2, frame.captured_s, is_certain=frame.sequence == 0))
    lenses = LensBook({"test": LENS})
    still = StaticLayer(bright_square(), LENS, ScatterReference(), "scatter")
    parts = Parts(ViewfinderOptions("test"), PatternSource(WIDTH, HEIGHT), still, lenses, {"scatter": ScatterReference})
    compositor = LiveCompositor(parts, ManualFocus(), tracker)
    captures = Captures(tmp_path, compositor, "scatter")
    plate = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    try:
        certain = compositor(CameraFrame(plate, 1.0, 0), 0)
        unsure = compositor(CameraFrame(plate, 2.0, 1), 0)
        refused("pose is not known now", captures.capture)
    finally:
        compositor.close()
    headers = [frame_header(each) for each in (certain, unsure)]
    assert [(each["tracking"], each["tracking_unsure"]) for each in headers] == [(0.2, False), (0.2, True)]
    assert compositor.last_tracked is not None and compositor.last_tracked.frame.sequence == 0


def test_every_picture_says_why_nothing_virtual_is_in_it(tmp_path: Path) -> None:
    poses = {0: None, 1: (False, 0.0), 2: (True, 0.0), 3: (True, 0.0)}

    def pose_of(frame: CameraFrame) -> TrackedPose | None:
        known = poses[frame.sequence]
        return None if known is None else TrackedPose(np.eye(4), 0.2, frame.captured_s, is_certain=known[0])

    scene = scene_file(tmp_path, ONE_CARD)
    for tracker, sentences in (
        (ToldTracker(pose_of), ["told does not tell where it is", "tilt of the board is unsure", "behind the camera", "is late"]),
        (None, ["behind the camera: turn round, along the arrow. Nothing tells where the camera is: start with --board"] * 3 + ["is late"]),
    ):
        stage = Stage(scene, backend())
        stage.set_renderer("scatter", ScatterReference())
        parts = Parts(
            ViewfinderOptions("test"), PatternSource(WIDTH, HEIGHT), stage, LensBook({"test": LENS}), {"scatter": ScatterReference}
        )
        with closing(LiveCompositor(parts, ManualFocus(), tracker)) as compositor:
            for number, sentence in enumerate(sentences):

                def says(number: int = number, sentence: str = sentence, late_s: float = 0.0 if number < 3 else 2.5) -> bool:
                    frame = CameraFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic() - late_s, number)
                    remark = compositor(frame, 0).status.remark
                    return remark is not None and sentence in remark.sentence

                wait_until(says)


SOAK_S = float(os.environ.get("MRBOKEH_SOAK_S", "600"))
WARM_UP = 0.3
"""This share of the rounds, and at least four, may grow: kernels are loaded and allocators take what they will keep."""
GROWTH_MB = 24.0
"""A decoded picture of the clip has 0.4 MB: a leak of one in fifty would show in ten minutes."""
VIEWERS_S = (1.0, 3.0, 5.0)


@dataclass(frozen=True)
class Rest:
    """What the process holds while nobody watches."""

    rss_mb: float
    threads: tuple[str, ...]
    open_files: int


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory and open files are read from /proc, which only Linux has")
def test_memory_threads_and_open_files_stay_while_viewers_come_and_go(tmp_path: Path) -> None:
    rests = asyncio.run(asyncio.wait_for(_soak(tmp_path), 2 * SOAK_S + 120))
    settled = rests[max(4, round(WARM_UP * len(rests))) :]
    assert len(settled) >= 3, f"only {len(rests)} rounds: give MRBOKEH_SOAK_S more than {SOAK_S:g}"
    rss_mb = np.array([each.rss_mb for each in settled])
    third = -(-len(rss_mb) // 3)
    growth_mb = float(np.median(rss_mb[-third:]) - np.median(rss_mb[:third]))
    print(f"{len(rests)} rounds in {SOAK_S:g} s, {rss_mb[0]:.0f} to {rss_mb[-1]:.0f} MB, growth of the medians {growth_mb:.1f} MB")
    assert growth_mb < GROWTH_MB and {each.threads for each in settled} == {settled[0].threads}
    assert {each.open_files for each in settled} == {settled[0].open_files}


async def _soak(folder: Path) -> list[Rest]:
    clip, rests = write_live_clip(folder, 480, 270, 12), list[Rest]()
    end_s = time.monotonic() + SOAK_S
    async with live(clip, folder / "captures") as one:
        while time.monotonic() < end_s:
            watching = asyncio.gather(*(_viewer(one.url, seconds) for seconds in VIEWERS_S))
            await _play(one, len(rests))
            rates = await watching
            # Nobody is forgotten: this is no measurement, the cores are shared with the viewers.
            assert min(rates) > 1.0
            await comes_true(lambda: not one.is_watched, 30)
            rests.append(await _rest())
    return rests


async def _viewer(url: str, time_s: float) -> float:
    """Pictures per second that a viewer saw."""
    command = [sys.executable, "-m", "tests.support.live_viewers", url, "1", str(time_s)]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    said, _ = await process.communicate()
    assert process.returncode == 0
    return float(json.loads(said.splitlines()[-1])["rates"][0])


async def _play(one: Live, round_number: int) -> None:
    """What a photographer does meanwhile."""
    away_m = 0.02 * (-1) ** round_number
    await comes_true(lambda: one.viewfinder.compositor.last is not None, 60)
    for message in (
        {"object": {"name": "card", "move_m": [away_m, 0.0]}},
        {"focus": {"distance_m": 0.5 + 0.1 * (round_number % 3)}},
        {"lens": ("clip", "wide")[round_number % 2]},
        {"renderer": ("polygon", "scatter")[round_number % 2]},
        {"record": True},
        {"view": "depth"},
    ):
        await one.done(message)
        await asyncio.sleep(0.3)
    await one.done({"view": "final"})
    await comes_true(lambda: one.moment.pose is not None, 60)
    await one.done({"capture": {}})
    await one.done({"record": False})


async def _rest() -> Rest:
    """Two seconds later: sockets of viewers who left close a moment after them."""
    await asyncio.sleep(2.0)
    gc.collect()
    rss_mb = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    threads = sorted(thread.name for thread in threading.enumerate() if not thread.name.startswith("asyncio"))
    return Rest(rss_mb, tuple(threads), await _open_files())


async def _open_files() -> int:
    """The most of several looks: between two passes the clip is closed for a moment."""
    looks = []
    for _ in range(10):
        looks.append(len(os.listdir("/proc/self/fd")))
        await asyncio.sleep(0.05)
    return max(looks)
