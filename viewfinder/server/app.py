"""The viewfinder's web server: a page, a WebSocket that streams JPEG with one credit, and the focus.

The stream: each binary message is a 4-byte big-endian length, a JSON header of that length, and a JPEG. The client sends
{"ack": sequence} when it has shown a frame, and only then gets another one: the newest there is. {"clock": t} comes back as
{"clock": t, "server_ms": now}, so that the client can tell how old a frame is in its own time.
"""

import asyncio
import json
import math
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

from aiohttp import WSMsgType, web

from mrbokeh.errors import InputError
from viewfinder.pipeline import Pipeline, StreamFrame

# Messages of the page are a few numbers; anything larger is not from the page.
_LARGEST_MESSAGE = 1024
_SHUTDOWN_S = 1.0
_PAGE = {"/": ("index.html", "text/html"), "/viewfinder.js": ("viewfinder.js", "text/javascript"), "/style.css": ("style.css", "text/css")}


class Broadcast:
    """Gives each finished frame to all who wait for one; lives in the event loop, fed from the pipeline's thread."""

    def __init__(self, pipeline: Pipeline, loop: asyncio.AbstractEventLoop) -> None:
        self._pipeline, self._loop = pipeline, loop
        self._waiting: set[asyncio.Future[StreamFrame]] = set()
        self.sockets: set[web.WebSocketResponse] = set()
        self._farewells: set[asyncio.Task[None]] = set()
        pipeline.on_frame = lambda frame: self._in_loop(self._publish, frame)
        pipeline.on_failure = lambda sentence: self._in_loop(self._fail, sentence)

    async def next_frame(self) -> StreamFrame:
        """The next frame that is finished after this call."""
        future = self._loop.create_future()
        self._waiting.add(future)
        self._pipeline.want()
        try:
            return await future
        finally:
            self._waiting.discard(future)

    def _in_loop(self, function: Any, argument: Any) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, argument)

    def _publish(self, frame: StreamFrame) -> None:
        for future in self._waiting:
            if not future.done():
                future.set_result(frame)

    def _fail(self, sentence: str) -> None:
        for socket in self.sockets:
            farewell = asyncio.ensure_future(_send_failure(socket, sentence))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)


PIPELINE: web.AppKey[Pipeline] = web.AppKey("pipeline", Pipeline)
BROADCAST: web.AppKey[Broadcast] = web.AppKey("broadcast", Broadcast)


@asynccontextmanager
async def serving(pipeline: Pipeline, host: str, port: int) -> AsyncIterator[str]:
    """Serve a running pipeline inside the block; gives the address of the page. Port 0 takes a free one."""
    app = web.Application(middlewares=[_same_origin], client_max_size=_LARGEST_MESSAGE)
    app[PIPELINE], app[BROADCAST] = pipeline, Broadcast(pipeline, asyncio.get_running_loop())
    for path, (name, content_type) in _PAGE.items():
        app.router.add_get(path, _page_handler(name, content_type))
    app.add_routes([web.get("/state", _state), web.post("/focus", _focus), web.get("/stream", _stream)])
    app.on_shutdown.append(_close_sockets)
    runner = web.AppRunner(app, shutdown_timeout=_SHUTDOWN_S, access_log=None)
    await runner.setup()
    try:
        await _bind(runner, host, port)
        bound = runner.addresses[0]
        yield f"http://{f'[{host}]' if ':' in host else host}:{bound[1]}/"
    finally:
        await runner.cleanup()


async def _bind(runner: web.AppRunner, host: str, port: int) -> None:
    try:
        await web.TCPSite(runner, host, port).start()
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot listen on {host} port {port} ({error}): choose another one with --port, or stop what uses it") from None


@web.middleware
async def _same_origin(request: web.Request, handler: Any) -> web.StreamResponse:
    """Other web pages that are open in the same browser may neither watch nor set the focus."""
    origin = request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != request.host:
        raise web.HTTPForbidden(text="this viewfinder answers only to its own page")
    return await handler(request)


def _page_handler(name: str, content_type: str) -> Any:
    text = files("viewfinder").joinpath("page", name).read_text(encoding="utf-8")

    async def page(_request: web.Request) -> web.Response:
        return web.Response(text=text, content_type=content_type, headers={"Cache-Control": "no-cache"})

    return page


async def _state(request: web.Request) -> web.Response:
    """What the page needs to know once."""
    pipeline = request.app[PIPELINE]
    sharp, nearest_farthest = pipeline.layer.sharp, pipeline.layer.dioptre_range
    state = {"source": pipeline.source.name, "width_px": sharp.width_px, "height_px": sharp.height_px, "dioptre_range": nearest_farthest}
    return web.json_response(state | {"focus_distance_m": _finite(pipeline.layer.shown.focus_distance_m)})


async def _focus(request: web.Request) -> web.Response:
    """{"focus_distance_m": metres, or null for infinity}; answers before the new blur is ready."""
    try:
        message = await request.json()
        if not isinstance(message, dict) or set(message) != {"focus_distance_m"}:
            raise InputError('expected {"focus_distance_m": metres, or null for infinity}')
        request.app[PIPELINE].layer.focus(_metres(message["focus_distance_m"]))
    except InputError as error:
        return web.json_response({"error": str(error)}, status=400)
    except ValueError:
        return web.json_response({"error": "expected JSON"}, status=400)
    return web.json_response(message, status=202)


def _metres(value: Any) -> float:
    if value is None:
        return math.inf
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"expected focus_distance_m as a number of metres, or null for infinity, got {value!r}")
    return float(value)


async def _stream(request: web.Request) -> web.WebSocketResponse:
    broadcast = request.app[BROADCAST]
    # Pictures are compressed already; another compression would only cost time.
    socket = web.WebSocketResponse(max_msg_size=_LARGEST_MESSAGE, heartbeat=10.0, compress=False)
    await socket.prepare(request)
    broadcast.sockets.add(socket)
    if failure := request.app[PIPELINE].failure:
        await _send_failure(socket, failure)
    credit = asyncio.Event()
    credit.set()
    sender = asyncio.create_task(_send_frames(socket, broadcast, credit))
    try:
        async for message in socket:
            if message.type is WSMsgType.TEXT:
                await _answer(socket, message.data, credit)
    finally:
        broadcast.sockets.discard(socket)
        sender.cancel()
        await asyncio.gather(sender, return_exceptions=True)
    return socket


async def _answer(socket: web.WebSocketResponse, text: str, credit: asyncio.Event) -> None:
    """A message of the page; one that is not understood changes nothing and is answered with an error."""
    try:
        message = json.loads(text)
    except ValueError:
        message = None
    if isinstance(message, dict) and set(message) == {"ack"}:
        credit.set()
    elif isinstance(message, dict) and set(message) == {"clock"}:
        await socket.send_json({"clock": message["clock"], "server_ms": 1000 * time.monotonic()})
    else:
        await socket.send_json({"error": 'expected {"ack": sequence} or {"clock": milliseconds}'})


async def _send_frames(socket: web.WebSocketResponse, broadcast: Broadcast, credit: asyncio.Event) -> None:
    """One frame per credit, always the newest."""
    while not socket.closed:
        await credit.wait()
        credit.clear()
        frame = await broadcast.next_frame()
        await socket.send_bytes(packed(frame))


def packed(frame: StreamFrame) -> bytes:
    """A stream message: length of the header, header, JPEG."""
    header = {
        "sequence": frame.sequence,
        "captured_ms": 1000 * frame.captured_s,
        "focus_distance_m": _finite(frame.focus_distance_m),
        "focus_pending": frame.focus_pending,
        "composite_ms": round(frame.composite_ms, 2),
        "encode_ms": round(frame.encode_ms, 2),
    }
    encoded = json.dumps(header).encode()
    return struct.pack(">I", len(encoded)) + encoded + frame.jpeg


def _finite(metres: float) -> float | None:
    """Infinity is null, for JSON has no word for it."""
    return metres if math.isfinite(metres) else None


async def _send_failure(socket: web.WebSocketResponse, sentence: str) -> None:
    if not socket.closed:
        await socket.send_json({"failure": sentence})


async def _close_sockets(app: web.Application) -> None:
    for socket in list(app[BROADCAST].sockets):
        await socket.close(code=1001, message=b"the viewfinder was stopped")
