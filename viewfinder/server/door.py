"""Door: the listening socket of a server, which keeps strangers few and short, and QuietLog, which keeps what they cause short as well.

A stranger is a connection of which no request was from somebody who was let in. The one that waited longest goes when there are too
many: who means well has asked long before.
"""

import asyncio
import logging
import os
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from aiohttp.http_exceptions import HttpProcessingError

MOST_STRANGERS = 32
PATIENCE_S = 10.0
_BACKLOG = 128
_WITHOUT_DESCRIPTORS_S = 0.2
_SETTLED_S = 0.5
_MOST_KINDS = 256

log = logging.getLogger(__name__)


class _Guest(asyncio.Protocol):
    """Connection between the socket and the protocol of the server, which does not tell when it has been asked for something."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner
        self.transport: asyncio.BaseTransport | None = None
        self.over, self.asked = asyncio.Event(), asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        self._inner.data_received(data)

    def eof_received(self) -> None:
        self._inner.eof_received()

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()

    def connection_lost(self, error: Exception | None) -> None:
        self.over.set()
        self.asked.set()
        self._inner.connection_lost(error)


class Door:
    """Door of one address. answer: makes the protocol of a connection.

    A TLS handshake and the headers of the first request take at most patience_s; `came` is to be called for each request.
    """

    def __init__(self, answer: Callable[[], Any], tls: ssl.SSLContext | None, patience_s: float) -> None:
        self._answer, self._tls, self._patience_s = answer, tls, patience_s
        self._strangers: dict[Any, asyncio.Task[None]] = {}
        self._known: dict[Any, asyncio.Task[None]] = {}
        self._guests: dict[Any, _Guest] = {}
        self._socket: socket.socket | None = None
        self._accepting: asyncio.Task[None] | None = None

    def open(self, host: str, port: int) -> int:
        """Listen, and return the port; OSError where that cannot be."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM)
        try:
            if os.name == "posix":
                listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((host, port))
            listening.listen(_BACKLOG)
            listening.setblocking(False)
        except BaseException:
            listening.close()
            raise
        self._socket = listening
        self._accepting = asyncio.create_task(self._accept(listening))
        return int(listening.getsockname()[1])

    def came(self, protocol: Any, is_let_in: bool) -> None:
        """Take note of a request of a connection, by the protocol that answers it."""
        guest = self._guests.get(protocol)
        if guest is not None:
            guest.asked.set()
        if is_let_in and protocol in self._strangers:
            self._known[protocol] = self._strangers.pop(protocol)

    async def close(self) -> None:
        """Listen no more; what is connected stays."""
        if self._accepting is not None:
            self._accepting.cancel()
            await asyncio.gather(self._accepting, return_exceptions=True)
        if self._socket is not None:
            self._socket.close()

    async def leave(self) -> None:
        """End the connections that still are there."""
        tasks = [*self._strangers.values(), *self._known.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, _ = await loop.sock_accept(listening)
            except OSError as error:
                # Too many open files: whoever waits is taken when there is room again.
                log.warning("a connection could not be taken (%s)", error.strerror)
                await asyncio.sleep(_WITHOUT_DESCRIPTORS_S)
                continue
            while len(self._strangers) >= MOST_STRANGERS:
                self._strangers.pop(next(iter(self._strangers))).cancel()
            protocol = self._answer()
            guest = self._guests[protocol] = _Guest(protocol)
            task = self._strangers[protocol] = asyncio.create_task(self._serve(accepted, guest))
            task.add_done_callback(partial(self._left, protocol, accepted))
            await asyncio.sleep(0)  # where many wait, taking one waits for nothing: those who were shown out leave meanwhile

    async def _serve(self, accepted: socket.socket, guest: _Guest) -> None:
        loop = asyncio.get_running_loop()
        patience_s = self._patience_s if self._tls is not None else None
        with suppress(OSError, TimeoutError):
            async with asyncio.timeout(self._patience_s):
                await loop.connect_accepted_socket(lambda: guest, accepted, ssl=self._tls, ssl_handshake_timeout=patience_s)
                await guest.asked.wait()
            await guest.over.wait()

    def _left(self, protocol: Any, accepted: socket.socket, _task: asyncio.Task[None]) -> None:
        guest = self._guests.pop(protocol)
        if isinstance(guest.transport, asyncio.WriteTransport):
            guest.transport.abort()
        # What asyncio has not taken, or has closed by then.
        asyncio.get_running_loop().call_later(_SETTLED_S, accepted.close)
        for kept in (self._strangers, self._known):
            kept.pop(protocol, None)


_STRANGE = (HttpProcessingError, ssl.SSLError, ConnectionError, TimeoutError)
_ONCE_IN_S = 60.0


class QuietLog(logging.Filter):
    """Filter that lets one line of a kind pass in a minute, and makes a line of what strangers cause."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._last_s: dict[tuple[str, str], float] = {}
        self._left_out: dict[tuple[str, str], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, _STRANGE):
            record.msg, record.args = f"a stranger's request was refused ({type(error).__name__})", ()
            record.exc_info, record.exc_text = None, None
        kind, now_s = (record.name, str(record.msg)), self._clock()
        if now_s - self._last_s.get(kind, -_ONCE_IN_S) < _ONCE_IN_S:
            self._left_out[kind] = self._left_out.get(kind, 0) + 1
            return False
        if len(self._last_s) >= _MOST_KINDS:
            self._last_s.clear()
            self._left_out.clear()
        self._last_s[kind] = now_s
        left_out = self._left_out.pop(kind, 0)
        if left_out:
            record.msg, record.args = f"{record.getMessage()} (and {left_out} times more before)", ()
        return True


@contextmanager
def quiet_log() -> Iterator[None]:
    """Keep the log short inside the block: of servers and connections, whoever writes it."""
    kept = [(each, QuietLog()) for each in (*logging.getLogger().handlers, logging.lastResort) if each is not None]
    for handler, quiet in kept:
        handler.addFilter(quiet)
    try:
        yield
    finally:
        for handler, quiet in kept:
            handler.removeFilter(quiet)
