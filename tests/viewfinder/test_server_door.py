"""The door of the server over real sockets: strangers are few and short, who is in stays, and the log is short."""

import asyncio
import errno
import logging
import re
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import aiohttp
import pytest

from tests.support.made_viewfinder import Made, made_viewfinder
from tests.support.streaming_viewers import SDP, WIDTH, Feed, Viewer, streaming, watching
from tests.support.waiting import comes_true
from tests.viewfinder.conftest import Make
from viewfinder.server.access import LOOPBACK_NAMES, Access
from viewfinder.server.door import MOST_STRANGERS, QuietLog
from viewfinder.server.endpoint import load_tls
from viewfinder.server.sessions import Role, Sessions
from viewfinder.streaming.whep import Whep

Socket = tuple[asyncio.StreamReader, asyncio.StreamWriter]
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "


def port_of(made: Made) -> int:
    return int(made.url.rsplit(":", 1)[1].strip("/"))


async def opened(made: Made, count: int, said: bytes = b"") -> list[Socket]:
    """So many connections that say something and then nothing more."""
    sockets = [await asyncio.open_connection("127.0.0.1", port_of(made)) for _ in range(count)]
    for _, writer in sockets:
        writer.write(said)
    return sockets


def is_open(socket: Socket) -> bool:
    """Whether the server has not closed it, with or without a reset."""
    return not socket[0].at_eof() and socket[0].exception() is None


async def all_closed(sockets: list[Socket]) -> None:
    for reader, writer in sockets:
        with suppress(ConnectionError):
            await asyncio.wait_for(reader.read(), 20)
        writer.close()


@pytest.mark.parametrize("said", [b"", HALF, b"POST /enter HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{"])
async def test_who_asks_for_nothing_is_shown_out(said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Headers, and bodies, that do not come; whoever asks meanwhile is served."""
    monkeypatch.setattr("viewfinder.server.endpoint.PATIENCE_S", 0.5)
    monkeypatch.setattr("viewfinder.server.access._BODY_S", 0.5)
    access = Access(LOOPBACK_NAMES, Sessions())
    async with made_viewfinder(access) as made, aiohttp.ClientSession() as session:
        sockets = await opened(made, 20, said.replace(b"127.0.0.1", b"127.0.0.1:%d" % port_of(made)))
        async with session.get(made.url) as answer:
            assert answer.status == 200
        await all_closed(sockets)


async def test_many_strangers_lock_nobody_out_and_who_was_let_in_stays() -> None:
    access = Access(LOOPBACK_NAMES, sessions := Sessions())
    async with made_viewfinder(access) as made, aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
        async with session.post(made.url + "enter", json={"token": sessions.invitation(Role.CONTROL)}) as answer:
            assert answer.status == 200
        async with session.ws_connect(made.url + "stream") as stream:
            sockets = await opened(made, 5 * MOST_STRANGERS, HALF)
            await comes_true(lambda: sum(map(is_open, sockets)) <= MOST_STRANGERS)
            async with aiohttp.ClientSession() as newcomer, newcomer.get(made.url) as answer:
                assert answer.status == 200
            # The oldest went, the newest are still waited for, and the stream goes on.
            assert not is_open(sockets[0]) and is_open(sockets[-1])
            await stream.send_json({"clock": 1})
            while (message := await stream.receive(timeout=10)).type is not aiohttp.WSMsgType.TEXT:
                assert message.type is aiohttp.WSMsgType.BINARY
        for _, writer in sockets:
            writer.close()


async def test_handshakes_that_do_not_come_are_not_waited_for(make_certificate: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viewfinder.server.endpoint.PATIENCE_S", 0.5)
    certificate, key = make_certificate()
    async with made_viewfinder(tls=load_tls(certificate, key)) as made:
        silent = await opened(made, 10)
        hello = await opened(made, 10, b"\x16\x03\x01\x02\x00\x01\x00")
        context = ssl.create_default_context(cafile=str(certificate))
        async with aiohttp.ClientSession() as session, session.get(made.url, ssl=context) as answer:
            assert answer.status == 200
        await all_closed(silent + hello)


MALFORMED = (
    b"GARBAGE\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\nHost: a\r\nBad Header\x00: 1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01",
    b"POST /control HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n", b"GET / HTTP/1.1\r\nX: " + b"x" * 20000 + b"\r\n\r\n",
)  # fmt: skip


async def test_malformed_requests_make_a_line_a_minute_of_each_kind_without_a_traceback(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with made_viewfinder() as made:
        for malformed in MALFORMED * 5:
            [(reader, writer)] = await opened(made, 1, malformed)
            writer.write_eof()
            with suppress(ConnectionError):
                await asyncio.wait_for(reader.read(), 20)
            writer.close()
        async with aiohttp.ClientSession() as session, session.get(made.url) as answer:
            assert answer.status == 200
    lines = [each.getMessage() for each in caplog.records if each.name.startswith("aiohttp")]
    assert lines and len(lines) == len(set(lines)) and all(each.startswith("a stranger's request was refused (") for each in lines)
    assert not any(each.exc_info or each.exc_text for each in caplog.records)


def test_what_was_left_out_of_the_log_is_counted() -> None:
    now_s = [0.0]
    quiet, passed = QuietLog(lambda: now_s[0]), list[str]()
    for at_s in (0, 1, 30, 59, 61, 62, 200):
        now_s[0] = float(at_s)
        record = logging.LogRecord("x", logging.WARNING, "file", 1, "no room for %s", (at_s,), None)
        passed += [record.getMessage()] if quiet.filter(record) else []
    assert passed == ["no room for 0", "no room for 61 (and 3 times more before)", "no room for 200 (and 1 times more before)"]


async def test_without_room_for_another_connection_the_server_goes_on_when_there_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loop = asyncio.get_running_loop()
    accept: Callable[..., Any] = loop.sock_accept
    refusals = [OSError(errno.EMFILE, "Too many open files")] * 3

    async def crowded(listening: Any) -> Any:
        if refusals:
            raise refusals.pop()
        return await accept(listening)

    monkeypatch.setattr(loop, "sock_accept", crowded)
    async with made_viewfinder() as made, aiohttp.ClientSession() as session, session.get(made.url) as answer:
        assert answer.status == 200 and not refusals
    assert [each.getMessage() for each in caplog.records] == ["a connection could not be taken (Too many open files)"]


async def test_sockets_of_webrtc_stand_at_the_address_served_only() -> None:
    with streaming() as stream:
        async with made_viewfinder(whep=Whep(stream)) as made, aiohttp.ClientSession() as session:
            viewer = Viewer()
            await viewer.peer.setLocalDescription()
            async with session.post(made.url + "whep", data=viewer.peer.localDescription.sdp, headers=SDP) as answer:
                found = re.findall(r"a=candidate:(?:\S+ ){4}(\S+)", await answer.text())
            assert len(found) >= 1 and set(found) == {"127.0.0.1"}
            await viewer.peer.close()


async def test_an_aiortc_without_the_known_parts_goes_on_and_says_so(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viewfinder.streaming.local_sockets._TRANSPORTS", "_not_there")
    with streaming() as stream, Feed(stream):
        async with made_viewfinder(whep=Whep(stream)) as made, watching(made.url.rstrip("/")) as viewer:
            assert (await viewer.next()).width == WIDTH
    assert "listens on every address" in caplog.text
