"""The WebSocket that streams JPEG with one credit, answers the clock and takes control messages.

The client sends {"ack": sequence} when it has shown a picture, and only then gets another one: the newest there is. {"clock": t} comes
back as {"clock": t, "server_ms": now}, so that the client can tell how old a picture is in its own time. Everything else is a control
message and answered as POST /control answers it.
"""

import asyncio
import time
from typing import Any

from aiohttp import WSMsgType, web

from viewfinder.server.access import Access, error
from viewfinder.server.bounded import LARGEST_MESSAGE, json_value
from viewfinder.server.dispatcher import Dispatcher
from viewfinder.server.rate_limit import RateLimit
from viewfinder.server.sessions import Role
from viewfinder.server.waiting_room import WaitingRoom

_MOST_SOCKETS = 16


class JpegSocket:
    """GET /stream. Sockets beyond 16 are refused; one that floods is closed."""

    def __init__(self, room: WaitingRoom, dispatcher: Dispatcher, access: Access) -> None:
        self._room, self._dispatcher, self._access = room, dispatcher, access
        # Twice what a screen of 120 Hz acknowledges.
        self._limit = RateLimit(per_s=240.0, burst=480.0)

    async def handle(self, request: web.Request) -> web.StreamResponse:
        if len(self._room.sockets) >= _MOST_SOCKETS:
            return error(f"{_MOST_SOCKETS} viewers watch already: close one of them", 503)
        # Pictures are compressed already; another compression would only cost time.
        socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=10.0, compress=False)
        await socket.prepare(request)
        self._room.sockets.add(socket)
        credit = asyncio.Event()
        credit.set()
        sender = asyncio.create_task(self._send(socket, credit))
        try:
            await self._room.tell_failure(socket)
            await self._receive(socket, request, credit)
        finally:
            self._room.sockets.discard(socket)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
        return socket

    async def _receive(self, socket: web.WebSocketResponse, request: web.Request, credit: asyncio.Event) -> None:
        async for message in socket:
            if not self._limit.allows(request.remote or ""):
                await socket.close(code=1008, message=b"too many messages")
            elif message.type is WSMsgType.TEXT:
                answer = await self._answer(message.data, request, credit)
                if answer is not None:
                    await socket.send_json(answer)

    async def _answer(self, text: str, request: web.Request, credit: asyncio.Event) -> dict[str, Any] | None:
        match json_value(text):
            case {"ack": int(), **rest} if not rest:
                credit.set()
                return None
            case {"clock": int() | float() as asked, **rest} if not rest:
                return {"clock": asked, "server_ms": 1000 * time.monotonic()}
        return await self._dispatcher.answer(text, self._access.role(request) or Role.VIEW, request.remote or "")

    async def _send(self, socket: web.WebSocketResponse, credit: asyncio.Event) -> None:
        """One picture per credit, always the newest."""
        while not socket.closed:
            await credit.wait()
            credit.clear()
            await socket.send_bytes(await self._room.next_message())
