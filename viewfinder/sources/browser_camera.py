"""Browser (a phone's, OBS) as the camera: WebRTC in through WHIP (RFC 9725), one connection at a time.

Its data channel brings one JSON object per message, such as {"focusDistance": 0.8}:

* focusDistance: metres from the camera, "infinity", or null where it is not known (MediaTrackSettings.focusDistance).
* pose: 16 numbers, WebXR's XRRigidTransform.matrix of the viewer (column after column; y up, the camera looks along -z).
* orientation: [x, y, z, w], AbsoluteOrientationSensor.quaternion with referenceFrame "screen" (from the screen to east, north, up).

What a message does not name stays as it was. Worlds become ours: x right, y down; of an orientation alone, z is north.
"""

import asyncio
import contextlib
import itertools
import json
import logging
import math
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from threading import Event
from typing import Any

import numpy as np
from aiohttp import web

from mrbokeh.system.errors import InputError
from mrbokeh.video.color import UNSPECIFIED, color_of
from viewfinder.frames import UNKNOWN_LENS, CameraFrame, LensState, Newest, Pose
from viewfinder.sources.frame_source import UNLIMITED, SizeLimit, upright_bgr
from viewfinder.streaming.local_sockets import listen_only_at, served_address
from viewfinder.streaming.session_description import with_address

LONGEST_MESSAGE = 4096
_KNOWN = ("focusDistance", "pose", "orientation")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_OURS_FROM_EAST_NORTH_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_ROTATION_TOLERANCE = 1e-2


@dataclass(frozen=True)
class CameraKnowledge:
    """Knowledge of a browser camera. camera_from_world: (4, 4), metres, or None."""

    lens: LensState = UNKNOWN_LENS
    camera_from_world: Pose | None = None

    def told(self, text: str) -> "CameraKnowledge":
        """Return the knowledge with what a message tells. Raises InputError with one sentence for what makes no sense."""
        message = _object(text)
        known = self
        if "focusDistance" in message:
            known = replace(known, lens=replace(known.lens, focus_distance_m=_distance_m(message["focusDistance"])))
        if "orientation" in message:
            known = replace(known, camera_from_world=_from_orientation(message["orientation"]))
        if "pose" in message:
            known = replace(known, camera_from_world=_from_pose(message["pose"]))
        return known


def _object(text: str) -> dict[str, Any]:
    if len(text) > LONGEST_MESSAGE:
        raise InputError(f"expected a message of at most {LONGEST_MESSAGE} characters, got {len(text)}")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("expected a message in JSON") from None
    if not isinstance(message, dict) or not message.keys() & set(_KNOWN):
        raise InputError(f"expected a JSON object with one of {', '.join(_KNOWN)}")
    return message


def _distance_m(value: Any) -> float | None:
    if value is None:
        return None
    if value == "infinity":
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise InputError('focusDistance: expected metres above 0, "infinity" or null')
    return float(value)


def _from_pose(value: Any) -> Pose | None:
    """Convert XRRigidTransform.matrix, which is world from viewer; both have y up and z backward."""
    if value is None:
        return None
    matrix = _numbers(value, 16, "pose").reshape(4, 4).T
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise InputError("pose: expected a rotation and a translation, column after column")
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError("pose: expected 0, 0, 0, 1 as the last row of the matrix")
    return _FLIP @ np.linalg.inv(matrix) @ _FLIP


def _from_orientation(value: Any) -> Pose | None:
    """Convert an orientation: the screen has x right, y up, z towards its user; the camera looks the other way."""
    if value is None:
        return None
    x, y, z, w = quaternion = _numbers(value, 4, "orientation")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _ROTATION_TOLERANCE:
        raise InputError("orientation: expected a quaternion of length 1, [x, y, z, w]")
    x, y, z, w = quaternion / length
    earth_from_screen = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = (_OURS_FROM_EAST_NORTH_UP @ earth_from_screen @ _FLIP[:3, :3]).T
    return pose


def _numbers(value: Any, count: int, name: str) -> np.ndarray:
    fits = isinstance(value, list) and len(value) == count
    if not fits or not all(isinstance(each, int | float) and not isinstance(each, bool) and abs(each) < 1e6 for each in value):
        raise InputError(f"{name}: expected {count} numbers")
    return np.array(value, np.float64)


DATA_CHANNEL = "camera"

log = logging.getLogger(__name__)


class WhipSession:
    """Connection of one browser camera, in one asyncio loop: a WebRTC peer that only receives.

    on_connected: called when the connection stands. on_frame: gets every decoded PyAV frame as it comes. on_message: every message of
    the data channel "camera"; what it returns is the answer, None for none. on_end: called once the connection is over.
    """

    def __init__(
        self,
        on_connected: Callable[[], None],
        on_frame: Callable[[Any], None],
        on_message: Callable[[str], str | None],
        on_end: Callable[[], None],
    ) -> None:
        from aiortc import RTCConfiguration, RTCPeerConnection

        # Without servers of its own aiortc would ask one on the internet and wait for it.
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._on_connected, self._on_frame, self._on_message, self._on_end = on_connected, on_frame, on_message, on_end
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        self.is_vp8 = False
        self._peer.on("track", self._drain_track)
        self._peer.on("datachannel", self._listen)
        self._peer.on("connectionstatechange", self._follow)
        self.token = secrets.token_urlsafe(16)

    async def answer(self, offer: str, host: str | None = None) -> str:
        """Return the SDP that answers an offer, with all candidates in it. Raises InputError for an offer that cannot be answered.

        host: the one address at which sockets are opened, None opens them on all.
        """
        from aiortc import RTCSessionDescription
        from aiortc.exceptions import InvalidAccessError, InvalidStateError

        try:
            await self._peer.setRemoteDescription(RTCSessionDescription(offer, "offer"))
            listen_only_at(self._peer, host)
            receivers = [each.receiver for each in self._peer.getTransceivers() if each.kind == "video"]
            for receiver in receivers:
                _release_on_marker(receiver)
            if not receivers:
                raise InputError("expected an offer with a video track to send, got none")
            await self._peer.setLocalDescription(await self._peer.createAnswer())
        except InputError:
            raise
        except (
            ValueError,
            KeyError,
            IndexError,
            AssertionError,
            AttributeError,
            TypeError,
            InvalidAccessError,
            InvalidStateError,
        ) as error:
            # aiortc's parser checks little and fails in many ways.
            log.debug("an offer was refused", exc_info=True)
            raise InputError(f"expected an SDP offer that WebRTC understands ({type(error).__name__})") from None
        sdp = str(self._peer.localDescription.sdp)
        self.is_vp8 = _first_video_codec(sdp) == "VP8"
        return sdp

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        await self._peer.close()
        for task in self._tasks - {asyncio.current_task()}:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self._on_end()

    def _start(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _drain_track(self, track: Any) -> None:
        self._start(self._drain(track))

    async def _drain(self, track: Any) -> None:
        """Take all frames, sound too: aiortc queues without bound what nobody takes."""
        from aiortc.mediastreams import MediaStreamError

        with contextlib.suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                if track.kind == "video":
                    self._on_frame(frame)

    def _listen(self, channel: Any) -> None:
        if channel.label == DATA_CHANNEL:

            @channel.on("message")
            def heard(message: str | bytes) -> None:
                answer = self._on_message(message) if isinstance(message, str) else None
                if answer is not None:
                    channel.send(answer)

    def _follow(self) -> None:
        if self._peer.connectionState == "connected" and not self._closed:
            self._on_connected()
        if self._peer.connectionState in ("failed", "closed") and not self._closed:
            self._start(self.close())


def _release_on_marker(receiver: Any) -> None:
    """Let frames out with their last packet, where this aiortc has the private classes for that."""
    try:
        from viewfinder.sources.marker_buffer import release_on_marker
    except ImportError:
        log.info("aiortc's jitter buffer is not the one that is known: each frame waits for the next one")
        return
    release_on_marker(receiver)


def _first_video_codec(sdp: str) -> str | None:
    """Return the codec that a sender takes: the first of the answer's video."""
    from aiortc.sdp import SessionDescription

    media = next((each for each in SessionDescription.parse(sdp).media if each.kind == "video"), None)
    return media.rtp.codecs[0].name.upper() if media is not None and media.rtp.codecs else None


LONGEST_OFFER_BYTES = 65536
_SDP = "application/sdp"
_POLL_S, _SILENT_S = 0.1, 2.0
_WAITING = "waiting for a browser camera"
_BT601 = 6


class BrowserCameraSource:
    """FrameSource that a web server feeds: add `routes` to its application, and `close` to what runs when it ends.

    One camera at a time; a new one takes the place of the old one once its connection stands, for a page that was loaded anew says no
    good-bye. An offer whose connection does not stand within connect_within_s is forgotten. Frames have the size that came, which browsers
    change as they like, or are scaled down with their aspect to the largest size given here.
    Who may send is for the server's middleware to say (RFC 9725, 4.8: a bearer token).
    """

    name = "browser camera"

    def __init__(self, limit: SizeLimit = UNLIMITED, connect_within_s: float = 15.0) -> None:
        self.transfer = "bt709"
        self.status: str | None = _WAITING
        self._limit = limit
        self._newest: Newest[tuple[int, Any, float, CameraKnowledge, bool]] = Newest()
        self._sequence = itertools.count()
        self._knowledge = CameraKnowledge()
        self._connect_within_s = connect_within_s
        self._session: WhipSession | None = None
        self._offering: WhipSession | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._changing = asyncio.Lock()

    def routes(self, path: str = "/whip") -> list[web.RouteDef]:
        """Return the routes: POST an offer to the path; DELETE the address that came back to end."""
        return [web.post(path, self._offered), web.delete(path + "/{token}", self._deleted)]

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        last_s = time.monotonic()
        while not stopping.is_set():
            newest = self._newest.take(_POLL_S)
            if newest is not None:
                yield self._frame(*newest)
                last_s = time.monotonic()
            elif time.monotonic() - last_s > _SILENT_S:
                self.status = _WAITING if self._session is None else "the browser camera is connected but sends no picture: waiting for it"

    async def close(self) -> None:
        """End the connection; to be called in the loop of the server."""
        sessions = self._session, self._offering
        self._session = self._offering = None
        self.status = _WAITING if sessions[0] is not None else self.status
        for session in filter(None, sessions):
            await session.close()

    def _frame(self, sequence: int, frame: Any, captured_s: float, known: CameraKnowledge, is_vp8: bool) -> CameraFrame:
        color = color_of(frame, self.name)
        if is_vp8 and frame.colorspace == UNSPECIFIED:
            # RFC 6386, 9.2: VP8 knows BT.601 only, at every size.
            color = replace(color, matrix=_BT601)
        self.transfer, self.status = color.transfer_name, None
        full = partial(upright_bgr, frame, color, UNLIMITED)
        return CameraFrame(
            bgr=upright_bgr(frame, color, self._limit),
            captured_s=captured_s,
            sequence=sequence,
            lens=known.lens,
            camera_from_world=known.camera_from_world,
            full_picture=full,
        )

    async def _offered(self, request: web.Request) -> web.Response:
        if request.content_type != _SDP:
            return web.Response(status=415, text=f"expected {_SDP}, got {request.content_type}")
        offer = await request.content.read(LONGEST_OFFER_BYTES + 1)
        while len(offer) <= LONGEST_OFFER_BYTES and (more := await request.content.read(LONGEST_OFFER_BYTES + 1 - len(offer))):
            offer += more
        if len(offer) > LONGEST_OFFER_BYTES:
            return web.Response(status=413, text=f"expected an offer of at most {LONGEST_OFFER_BYTES} bytes")
        async with self._changing:
            return await self._answered(request, with_address(offer.decode("utf-8", "replace"), request.remote))

    async def _answered(self, request: web.Request, offer: str) -> web.Response:
        session = WhipSession(
            lambda: self._connected(session),
            lambda frame: self._came(session, frame),
            lambda message: self._heard(session, message),
            lambda: self._ended(session),
        )
        try:
            answer = await session.answer(offer, served_address(request))
        except InputError as error:
            await session.close()
            return web.Response(status=400, text=str(error))
        before, self._offering = self._offering, session
        if before is not None:
            await before.close()
        asyncio.get_running_loop().call_later(self._connect_within_s, self._give_up, session)
        headers = {"Location": f"{request.path}/{session.token}"}
        return web.Response(status=201, text=answer, content_type=_SDP, headers=headers)

    def _connected(self, session: WhipSession) -> None:
        """Let a camera take the place of the one before."""
        if session is self._offering:
            before, self._session, self._offering = self._session, session, None
            self._knowledge = CameraKnowledge()
            if before is not None:
                self._close_soon(before)

    def _give_up(self, session: WhipSession) -> None:
        if session is self._offering:
            self._offering = None
            self._close_soon(session)

    def _close_soon(self, session: WhipSession) -> None:
        task = asyncio.ensure_future(session.close())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _deleted(self, request: web.Request) -> web.Response:
        """End the camera; one that another has replaced, or whose connection was closed first, has gone already."""
        token = request.match_info["token"]
        for session in filter(None, (self._session, self._offering)):
            if secrets.compare_digest(token.encode(), session.token.encode()):
                await session.close()
        return web.Response()

    def _came(self, session: WhipSession, frame: Any) -> None:
        if session is self._session:
            self._newest.put((next(self._sequence), frame, time.monotonic(), self._knowledge, session.is_vp8))

    def _heard(self, session: WhipSession, message: str) -> str | None:
        if session is not self._session:
            return None
        try:
            self._knowledge = self._knowledge.told(message)
        except InputError as error:
            return json.dumps({"error": str(error)})
        return None

    def _ended(self, session: WhipSession) -> None:
        if session is self._offering:
            self._offering = None
        if session is self._session:
            self._session = None
            self.status = "the browser camera is gone: waiting for it"
