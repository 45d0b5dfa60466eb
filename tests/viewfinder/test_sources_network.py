"""Streams over real sockets on loopback: MPEG-TS over UDP and HTTP, MJPEG over HTTP; killed, restarted, absent, recorded, turned."""

import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from aiortc.codecs.h264 import H264Encoder
from aiortc.rtp import RtpPacket

from mrbokeh.video.color import color_of
from tests.support.video_files import encoded
from tests.support.waiting import wait_until
from viewfinder.frames import CameraFrame
from viewfinder.sources.frame_source import SizeLimit, upright_bgr
from viewfinder.sources.playback import NetworkStreamSource

WIDTH, HEIGHT, FPS = 160, 112, 25
RED, GREEN = (40, 60, 200), (60, 190, 50)


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def encode_live(target: Any, going: Callable[[], bool], bgr: tuple[int, int, int], **color: int) -> None:
    """H264 in MPEG-TS at 25 frames per second into a URL or a file-like object, a key frame each fifth frame."""
    with av.open(target, "w", format="mpegts", options={"flush_packets": "1"}) as container:
        stream: Any = container.add_stream(
            "libx264", rate=FPS, options={"tune": "zerolatency", "preset": "ultrafast", "g": "5", "crf": "12"}
        )
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for name, value in color.items():
            setattr(stream.codec_context, name, value)
        picture = np.full((HEIGHT, WIDTH, 3), bgr, np.uint8)
        matrix = {6: 5}.get(color.get("colorspace", 6), color.get("colorspace", 6))
        encoded = av.VideoFrame.from_ndarray(picture, "bgr24").reformat(format="yuv420p", dst_colorspace=matrix, dst_color_range=1)
        encoded.colorspace, encoded.color_range = color.get("colorspace", 2), 1
        for index in range(3000):
            if not going():
                return
            encoded.pts, encoded.time_base = index, Fraction(1, FPS)
            container.mux(stream.encode(encoded))
            time.sleep(1 / FPS)


@contextmanager
def at_work(work: Callable[[], Any], stop: Callable[[], Any]) -> Iterator[None]:
    """A thread works meanwhile."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        stop()
        thread.join(10)
    assert not thread.is_alive()


@contextmanager
def udp_sender(port: int, bgr: tuple[int, int, int], **color: int) -> Iterator[None]:
    stop, url = Event(), f"udp://127.0.0.1:{port}?pkt_size=1316"
    with at_work(lambda: encode_live(url, lambda: not stop.is_set(), bgr, **color), stop.set):
        yield


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address, daemon_threads = True, True


@contextmanager
def served(port: int, handler: type[socketserver.BaseRequestHandler]) -> Iterator[str]:
    """The address of a server; its handlers have `stop`, which is set at the end."""
    kind = type("Handler", (handler,), {"stop": Event()})
    with Server(("127.0.0.1", port), kind) as server, at_work(lambda: server.serve_forever(0.05), server.shutdown):
        try:
            yield f"127.0.0.1:{server.server_address[1]}"
        finally:
            kind.stop.set()


@contextmanager
def http_server(port: int, respond: Callable[[Any], None]) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                respond(self)
            except OSError:
                self.close_connection = True

        def log_message(self, *what: object) -> None: ...

    with served(port, Handler) as address:
        yield f"http://{address}/live"


def begin(handler: Any, status: int = 200, **headers: object) -> None:
    handler.send_response(status)
    for name, value in headers.items():
        handler.send_header(name.replace("_", "-"), str(value))
    handler.end_headers()


def mpegts(bgr: tuple[int, int, int]) -> Callable[[Any], None]:
    def respond(handler: Any) -> None:
        begin(handler, Content_Type="video/mp2t")
        # PyAV writes to what says how much it took.
        body = SimpleNamespace(write=lambda data: handler.wfile.write(data) or len(data))
        encode_live(body, lambda: not handler.stop.is_set(), bgr)

    return respond


def file_of(path: Path) -> Callable[[Any], None]:
    """From where it is asked for."""
    data = path.read_bytes()

    def respond(handler: Any) -> None:
        start = int((handler.headers.get("Range") or "bytes=0-").split("=")[1].split("-")[0])
        part = f"bytes {start}-{len(data) - 1}/{len(data)}"
        begin(handler, 206, Content_Length=len(data) - start, Content_Range=part, Accept_Ranges="bytes")
        handler.wfile.write(data[start:])

    return respond


def green_mjpeg(handler: Any) -> None:
    """As phone apps and network cameras do: multipart/x-mixed-replace."""
    begin(handler, Content_Type="multipart/x-mixed-replace; boundary=frame")
    jpeg = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), GREEN, np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    while not handler.stop.is_set():
        handler.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg) + jpeg + b"\r\n")
        time.sleep(1 / FPS)


def first_like(frames: Iterator[CameraFrame], bgr: tuple[int, int, int], limit_s: float = 25.0) -> CameraFrame:
    """The first frame of that colour; codecs and chroma leave it within 6 codes."""
    start_s = time.monotonic()
    for frame in frames:
        if np.abs(frame.bgr.reshape(-1, 3).mean(axis=0) - bgr).max() < 6:
            return frame
        assert time.monotonic() - start_s < limit_s, frame.bgr[5, 5]
    raise AssertionError("the stream ended")


@contextmanager
def opened(source: NetworkStreamSource) -> Iterator[tuple[Iterator[CameraFrame], Event]]:
    stopping = Event()
    frames = source.frames(stopping)
    # Where nothing comes the test fails in place of standing still.
    guard = threading.Timer(30.0, stopping.set)
    guard.start()
    try:
        yield frames, stopping
    finally:
        guard.cancel()
        stopping.set()
        frames.close()  # type: ignore[attr-defined]
    assert not [each for each in threading.enumerate() if each.name.startswith("decode ")]


@pytest.mark.slow
def test_udp_comes_goes_and_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tagged BT.709: its matrix is used although so small a picture would be BT.601 untagged (up to 12 codes apart)."""
    monkeypatch.setattr("viewfinder.sources.playback.READ_TIMEOUT_S", 1.0)
    port, tags = free_port(socket.SOCK_DGRAM), dict.fromkeys(("colorspace", "color_trc", "color_primaries", "color_range"), 1)
    source = NetworkStreamSource(f"udp://127.0.0.1:{port}")
    assert source.status is not None
    with opened(source) as (frames, _):
        with udp_sender(port, RED, **tags):
            before = first_like(frames, RED)
            assert before.bgr.shape == (HEIGHT, WIDTH, 3) and source.status is None and source.transfer == "bt709"
            assert next(frames).sequence > before.sequence
        wait_until(lambda: source.status is not None and "does not answer" in source.status)
        with udp_sender(port, GREEN, **tags):
            after = first_like(frames, GREEN)
            assert after.sequence > before.sequence and after.captured_s > before.captured_s and source.status is None


@pytest.mark.parametrize("kind", ["http", "rtsp"])
def test_a_network_camera_that_is_switched_off_and_on_goes_on(kind: str) -> None:
    port = free_port(socket.SOCK_STREAM)
    source = NetworkStreamSource(f"{kind}://127.0.0.1:{port}/live", SizeLimit(80))

    def switched_on(bgr: tuple[int, int, int]) -> AbstractContextManager[str]:
        return http_server(port, mpegts(bgr)) if kind == "http" else served(port, type("Camera", (RtspHandler,), {"bgr": bgr}))

    with opened(source) as (frames, _):
        with switched_on(RED):
            before = first_like(frames, RED)
            assert before.bgr.shape == (56, 80, 3)
        wait_until(lambda: source.status is not None)
        assert "trying again" in str(source.status) or "waiting" in str(source.status)
        with switched_on(GREEN):
            after = first_like(frames, GREEN)
            assert after.sequence > before.sequence and after.captured_s > before.captured_s and source.status is None


class RtspHandler(socketserver.StreamRequestHandler):
    """As little of RTSP (RFC 2326) as a network camera needs to send H264 inside the TCP connection (10.12)."""

    bgr = RED
    stop: Event

    def handle(self) -> None:
        try:
            while not self.stop.is_set() and (request := self._request()) is not None:
                self._answer(*request)
                if request[0] == "PLAY":
                    self._play()
        except OSError:
            pass

    def _request(self) -> tuple[str, str] | None:
        """(method, number)"""
        line, headers = self.rfile.readline().decode(), {}
        while (header := self.rfile.readline().decode().strip()) != "":
            name, _, value = header.partition(":")
            headers[name.lower()] = value.strip()
        return (line.split()[0], headers["cseq"]) if line else None

    def _answer(self, method: str, number: str) -> None:
        sdp = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=cam\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n"
        sdp += "a=fmtp:96 packetization-mode=1\r\na=control:track1\r\n"
        extra = {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n",
            "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Length: {len(sdp)}\r\n",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n",
        }.get(method, "Session: 1\r\n")
        self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\n{extra}\r\n{sdp if method == 'DESCRIBE' else ''}".encode())

    def _play(self) -> None:
        codec: Any = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt, codec.time_base = WIDTH, HEIGHT, "yuv420p", Fraction(1, FPS)
        codec.options = {"tune": "zerolatency", "preset": "ultrafast", "g": "5", "crf": "12"}
        picture = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), self.bgr, np.uint8), "bgr24")
        number = 0
        for index in range(3000):
            if self.stop.wait(1 / FPS):
                return
            frame = picture.reformat(format="yuv420p")
            frame.pts = index
            data = b"".join(bytes(each) for each in codec.encode(frame))
            payloads = H264Encoder._packetize(H264Encoder._split_bitstream(data))
            for part, payload in enumerate(payloads):
                made = RtpPacket(96, int(part == len(payloads) - 1), number % 65536, index * 90000 // FPS, 7, payload).serialize()
                self.wfile.write(b"$\0" + len(made).to_bytes(2, "big") + made)
                number += 1


def test_mjpeg_of_a_network_camera_of_which_a_slow_viewer_gets_the_newest() -> None:
    """0.5 s asleep are about 12 frames at 25 per second: they are dropped, none is queued."""
    with http_server(0, green_mjpeg) as url, opened(NetworkStreamSource(url)) as (frames, _):
        before = first_like(frames, GREEN)
        assert before.bgr.shape == (HEIGHT, WIDTH, 3)
        time.sleep(0.5)
        asleep_until_s = time.monotonic()
        next(frames)
        after = next(frames)
        assert after.sequence - before.sequence > 5 and after.captured_s > asleep_until_s - 0.3


def test_a_recording_behind_a_url_plays_in_its_own_time(tmp_path: Path) -> None:
    """10 frames of 25 per second last 0.4 s, over and over: never faster, as a live stream would be read."""
    picture = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), GREEN, np.uint8), "bgr24")
    clip = encoded(tmp_path / "clip.mkv", "libx264", "yuv420p", *[picture] * 10)
    with http_server(0, file_of(clip)) as url, opened(NetworkStreamSource(url)) as (frames, _):
        got = [next(frames) for _ in range(14)]
    assert got[9].captured_s - got[0].captured_s > 0.3 and got[-1].sequence - got[0].sequence >= 13


def test_turned_and_untagged_pictures_are_upright() -> None:
    """What a stream says by its display matrix, which PyAV cannot write, within a limit that counts for the upright picture."""
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:32, :48] = 255

    class Turned:
        def __init__(self, rotation: int) -> None:
            self._frame, self.rotation = av.VideoFrame.from_ndarray(picture, "bgr24").reformat(format="yuv420p"), rotation

        def __getattr__(self, name: str) -> Any:
            return getattr(self._frame, name)

    for turns in range(4):
        frame, expected = Turned(90 * turns - 360 * (turns == 3)), np.rot90(picture, turns)
        upright = upright_bgr(frame, color_of(frame, "here"), SizeLimit())
        assert upright.shape == expected.shape and np.abs(upright.astype(int) - expected)[4:28, 4:28].max() < 4
        assert upright_bgr(frame, color_of(frame, "here"), SizeLimit(width_px=32)).shape[1] == 32


def test_nobody_there_is_a_sentence_without_the_password() -> None:
    port = free_port(socket.SOCK_STREAM)
    source = NetworkStreamSource(f"rtsp://me:secret@127.0.0.1:{port}/cam")
    stopping, got = Event(), list[CameraFrame]()
    with at_work(lambda: got.extend(source.frames(stopping)), stopping.set):
        wait_until(lambda: "does not answer" in str(source.status))
    assert got == [] and "secret" not in source.name + str(source.status)
    assert source.name == f"rtsp://127.0.0.1:{port}/cam"
