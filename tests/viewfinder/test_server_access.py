"""Who may ask the viewfinder for what: real requests to a real server on loopback; the built page is all that a browser needs."""

import asyncio
import contextlib
import hashlib
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from tests.support.made_viewfinder import Made, made_viewfinder
from viewfinder.server.access import Access, host_name, is_loopback, needed_role, objection
from viewfinder.server.sessions import RateLimit, Role, Sessions
from viewfinder.server.site import PAGE
from viewfinder.studio.site import PAGE as STUDIO_PAGE

FOCUS = {"focus": {"distance_m": 1.0}}


def guest() -> aiohttp.ClientSession:
    """A browser of its own; unsafe: cookies of an address instead of a name are kept, as browsers do."""
    return aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))


async def entered(made: Made, client: aiohttp.ClientSession, token: Any) -> tuple[int, dict[str, Any]]:
    async with client.post(made.url + "enter", json={"token": token}) as answer:
        return answer.status, await answer.json()


async def status_of(client: aiohttp.ClientSession, method: str, url: str, **options: Any) -> int:
    async with client.request(method, url, **options) as answer:
        return answer.status


@asynccontextmanager
async def visited(access: Access | None = None) -> AsyncIterator[tuple[Made, aiohttp.ClientSession]]:
    """A viewfinder and its first guest."""
    async with made_viewfinder(access) as made, guest() as client:
        yield made, client


async def test_without_sessions_loopback_needs_no_token() -> None:
    async with visited() as (made, client):
        async with client.get(made.url + "state") as answer:
            assert (await answer.json())["role"] == "control" and answer.headers["Cache-Control"] == "no-store"
        assert await status_of(client, "POST", made.url + "control", json=FOCUS) == 200
    assert made.controls.values["focus"] == 1.0


async def test_a_stranger_gets_the_page_and_nothing_else() -> None:
    async with visited(Access(sessions=Sessions())) as (made, client):
        async with client.get(made.url) as page:
            policy = page.headers["Content-Security-Policy"]
            assert page.status == 200 and "vf-picture" in await page.text()
            assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
        for method, paths in {"GET": ("state", "matte", "stream"), "POST": ("control", "whip", "nothing")}.items():
            for path in paths:
                assert await status_of(client, method, made.url + path, json=FOCUS) == 401
        with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
            await client.ws_connect(made.url + "stream")
        assert made.controls.asked == []


async def test_a_token_is_exchanged_once_for_a_cookie_that_scripts_cannot_read() -> None:
    renewed: list[Role] = []
    sessions = Sessions(renewed.append)
    async with made_viewfinder(Access(sessions=sessions)) as made, guest() as first, guest() as second:
        token = sessions.invitation(Role.CONTROL)
        async with first.post(made.url + "enter", json={"token": token}) as answer:
            assert await answer.json() == {"role": "control"}
            cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and token not in cookie
        assert await status_of(first, "POST", made.url + "control", json=FOCUS) == 200
        status, body = await entered(made, second, token)
        assert status == 403 and "used before" in body["error"]
        assert await status_of(second, "GET", made.url + "state") == 401
        # The next guest gets an invitation of his own, which the command line is told to print.
        assert renewed == [Role.CONTROL] and sessions.invitation(Role.CONTROL) != token
        assert (await entered(made, second, sessions.invitation(Role.CONTROL)))[0] == 200


async def test_wrong_tokens_let_nobody_in() -> None:
    async with visited(Access(sessions=Sessions())) as (made, client):
        for token in ("", "wrong", None, 3, ["x"], "\ud800", "é" * 100):
            assert (await entered(made, client, token))[0] == 403, token
        assert await status_of(client, "GET", made.url + "state", headers={"Cookie": "mrbokeh=x; mrbokeh_1=y"}) == 401


async def test_who_may_only_view_cannot_control() -> None:
    sessions = Sessions()
    async with visited(Access(sessions=sessions)) as (made, client):
        assert await entered(made, client, sessions.invitation(Role.VIEW)) == (200, {"role": "view"})
        async with client.get(made.url + "state") as answer:
            assert (await answer.json())["role"] == "view"
        async with client.post(made.url + "control", json=FOCUS) as answer:
            assert answer.status == 403 and "watch but not control" in (await answer.json())["error"]
        assert await status_of(client, "POST", made.url + "whip", data="v=0") == 403
        async with client.ws_connect(made.url + "stream") as stream:
            assert (await stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY
            await stream.send_json(FOCUS)
            assert "watch but not control" in (await stream.receive_json(timeout=5))["error"]
        assert made.controls.asked == []


async def test_a_program_may_come_again_and_again_with_a_standing_token() -> None:
    sessions = Sessions()
    async with made_viewfinder(Access(sessions=sessions)) as made:
        standing, viewing = sessions.standing_token(Role.CONTROL), sessions.standing_token(Role.VIEW)
        for token, status in ((standing, 200), (viewing, 403), (sessions.invitation(Role.CONTROL), 401), ("", 401)):
            async with guest() as client:
                headers = {"Authorization": f"Bearer {token}"}
                assert await status_of(client, "POST", made.url + "control", json=FOCUS, headers=headers) == status
        for _ in range(2):
            async with guest() as client:
                assert await entered(made, client, viewing) == (200, {"role": "view"})
                assert await status_of(client, "GET", made.url + "state") == 200


async def test_names_that_turn_into_our_address_and_other_pages_are_refused() -> None:
    async with visited() as (made, client):
        port = made.url.rsplit(":", 1)[1].strip("/")
        for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "[::1", "localhost@evil.example", ""):
            assert await status_of(client, "GET", made.url, headers={"Host": host}) in (400, 403), host
        assert await status_of(client, "GET", made.url + "state", headers={"Host": f"localhost:{port}"}) == 200
        for origin in ("http://evil.example", "null", f"http://localhost:{port}", "http://127.0.0.1:1", "http://["):
            headers = {"Origin": origin}
            assert await status_of(client, "POST", made.url + "control", json=FOCUS, headers=headers) == 403, origin
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await client.ws_connect(made.url + "stream", headers=headers)
        assert await status_of(client, "GET", made.url + "state", headers={"Sec-Fetch-Site": "cross-site"}) == 403
        assert await status_of(client, "GET", made.url, headers={"Sec-Fetch-Site": "cross-site"}) == 200
        assert made.controls.asked == []
        headers = {"Origin": made.url.strip("/")}
        assert await status_of(client, "POST", made.url + "control", json=FOCUS, headers=headers) == 200


async def raw_answer(made: Made, request: str) -> bytes:
    """To a request that no client would send, for clients tidy paths and name a host."""
    reader, writer = await asyncio.open_connection("127.0.0.1", int(made.url.rsplit(":", 1)[1].strip("/")))
    writer.write(request.encode())
    answer = await reader.read()
    writer.close()
    await writer.wait_closed()
    return answer


async def test_too_many_requests_and_too_many_guesses_are_refused() -> None:
    access = Access(sessions=Sessions(), requests=RateLimit(0.0, 20.0), entries=RateLimit(0.0, 4.0))
    async with visited(access) as (made, client):
        statuses = [(await entered(made, client, "guess"))[0] for _ in range(6)]
        assert statuses == [403] * 4 + [429] * 2
        # Not even the right one now.
        assert (await entered(made, client, access.sessions.invitation(Role.CONTROL)))[0] == 429
        statuses = [await status_of(client, "GET", made.url + "style.css") for _ in range(14)]
        assert statuses == [200] * 13 + [429]


def test_a_bucket_fills_with_time_and_each_address_has_its_own() -> None:
    now_s = [0.0]
    limit = RateLimit(per_s=2.0, burst=3.0, clock=lambda: now_s[0])
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False] and limit.allows("b")
    now_s[0] = 0.5  # one event at two per second
    assert [limit.allows("a"), limit.allows("a")] == [True, False]
    now_s[0] = 100.0
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]


async def test_large_bodies_are_refused_before_they_are_read() -> None:
    async with visited() as (made, client):
        assert await status_of(client, "POST", made.url + "control", data=b"x" * 1025) == 413
        assert await status_of(client, "POST", made.url + "control", data=b" " * 900 + b'{"f_number": 4}') == 200

        async def endless() -> Any:
            while True:
                yield b"x" * 1000

        # Sent in chunks, without a length: the server stops reading by itself.
        with contextlib.suppress(aiohttp.ClientError):
            assert await status_of(client, "POST", made.url + "control", data=endless()) == 413
        async with client.ws_connect(made.url + "stream") as stream:
            await stream.send_str("x" * 5000)
            while (message := await stream.receive(timeout=5)).type is aiohttp.WSMsgType.BINARY:
                pass
            assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, aiohttp.WSCloseCode.MESSAGE_TOO_BIG)
        assert made.controls.asked == [("f_number", 4.0)]


async def test_no_path_reaches_the_file_system_and_a_request_without_a_host_is_refused() -> None:
    paths = ("/../pyproject.toml", "/%2e%2e/app.py", "/page/index.html", "//etc/passwd", "/style.css/../../frames.py", "/..%5cx")
    async with made_viewfinder() as made:
        for path in paths:
            answer = await raw_answer(made, f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            assert answer.split(b" ")[1] in (b"404", b"400"), answer[:200]
        assert (await raw_answer(made, "GET /state HTTP/1.0\r\n\r\n")).split(b" ")[1] == b"403"


def test_roles_of_paths() -> None:
    expected = {
        None: ("/", "/style.css", "/enter", "/obs"), Role.VIEW: ("/state", "/stream", "/whep/{viewer}", "/obs/whep", "/matte"),
        Role.CONTROL: ("/control", "/whip", "/whip/{token}", ""),
    }  # fmt: skip
    assert {role: tuple(path for path in paths if needed_role(path) is role) for role, paths in expected.items()} == expected


def test_hosts_and_origins() -> None:
    names = frozenset({"192.168.1.7", "box.local"})
    assert host_name("BOX.local:8080") == "box.local" and host_name("[fe80::1]:80") == "fe80::1"
    for malformed in (None, "", "[", "[::1", "x@box.local", "box.local;x", "box.local:x", "box.local:1:2", "[x]", "[::1::]"):
        assert host_name(malformed) is None, malformed
    assert objection({"Host": "box.local:1", "Origin": "https://box.local:1"}, names, opens_page=False) is None
    assert objection({"Host": "box.local:1", "Origin": "https://box.local:2"}, names, opens_page=False) is not None
    assert objection({"Host": "localhost:1"}, names, opens_page=True) is not None
    assert [is_loopback(each) for each in ("127.0.0.9", "::1", "localhost", "192.168.1.7", "box.local")] == [True, True, True, False, False]


def test_the_oldest_guest_leaves_when_too_many_came() -> None:
    sessions = Sessions()
    cookies = [sessions.enter(sessions.invitation(Role.VIEW))[0] for _ in range(65)]
    assert sessions.role_of(cookies[0], None) is None and sessions.role_of(cookies[1], None) is Role.VIEW


ROOT = Path(__file__).resolve().parents[2] / "viewfinder"
SOURCES, BUILT = ROOT / "page_source", ROOT / "page"


def hash_of_sources() -> str:
    """As build.mjs makes it: name and text of each file of src and static, in order."""
    hashed = hashlib.sha256()
    for folder in ("src", "static"):
        for path in sorted((SOURCES / folder).iterdir(), key=lambda path: path.name):
            text = path.read_bytes().decode().replace("\r\n", "\n")
            hashed.update(f"{folder}/{path.name}\0{text}\0".encode())
    return hashed.hexdigest()


def test_the_built_page_belongs_to_its_sources_and_loads_nothing_from_elsewhere() -> None:
    for name in ("viewfinder.js", "camera.js", "studio.js"):
        first = (BUILT / name).read_text(encoding="utf-8").splitlines()[0]
        assert re.search(r"sources: ([0-9a-f]{64})$", first), first
        assert first.endswith(hash_of_sources()), f"{name} is older than its sources: `npm ci && npm run build` in viewfinder/page_source"
    for path in (SOURCES / "static").iterdir():
        assert (BUILT / path.name).read_text(encoding="utf-8") == path.read_text(encoding="utf-8")
    for path in BUILT.iterdir():
        assert not re.findall(r"(?:https?|wss?):(?://)[\w.-]+", path.read_text(encoding="utf-8")), path.name


def test_every_file_that_the_page_names_is_served_to_everybody() -> None:
    assert {name for page in (PAGE, STUDIO_PAGE) for name, _ in page.values()} == {path.name for path in BUILT.iterdir()} - {"README.md"}
    assert all(needed_role(path) is None for path in (*PAGE, *STUDIO_PAGE))
    for html in BUILT.glob("*.html"):
        named = re.findall(r'(?:src|href)="([^"]+)"', html.read_text(encoding="utf-8"))
        assert all(f"/{name}" in PAGE | STUDIO_PAGE for name in named if not name.startswith(("data:", "#")))
