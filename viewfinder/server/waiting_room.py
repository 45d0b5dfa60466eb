"""WaitingRoom: where WebSockets wait for the next picture, and where a thread that has one hands it to all of them."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from aiohttp import web


class WaitingRoom:
    """`open` binds it to the running event loop; `publish` and `fail` may be called from any thread, also before and after that."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: set[asyncio.Future[bytes]] = set()
        self._farewells: set[asyncio.Task[None]] = set()
        self.sockets: set[web.WebSocketResponse] = set()
        self.failure: str | None = None

    def open(self) -> None:
        self._loop = asyncio.get_running_loop()

    async def close(self) -> None:
        """Tell every socket that the viewfinder was stopped."""
        for socket in list(self.sockets):
            await socket.close(code=1001, message=b"the viewfinder was stopped")

    @property
    def waited_for(self) -> bool:
        """Whether somebody waits; from any thread."""
        return bool(self._waiting)

    async def next_message(self) -> bytes:
        """The next message that is published after this call."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting.add(future)
        try:
            return await future
        finally:
            self._waiting.discard(future)

    def publish(self, message: bytes) -> None:
        # A picture again: the source came back.
        self.failure = None
        self._in_loop(self._publish, message)

    def fail(self, sentence: str) -> None:
        """The source died: whoever is here is told, and whoever comes later."""
        self.failure = sentence
        self._in_loop(self._fail, sentence)

    async def tell_failure(self, socket: web.WebSocketResponse) -> None:
        if self.failure is not None and not socket.closed:
            await socket.send_json({"failure": self.failure})

    def _in_loop(self, function: Callable[[Any], None], argument: Any) -> None:
        if self._loop is not None:
            # The loop may end at any moment while a thread still has news.
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(function, argument)

    def _publish(self, message: bytes) -> None:
        waiting, self._waiting = self._waiting, set()
        for future in waiting:
            if not future.done():
                future.set_result(message)

    def _fail(self, _sentence: str) -> None:
        for socket in self.sockets:
            farewell = asyncio.ensure_future(self.tell_failure(socket))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)
