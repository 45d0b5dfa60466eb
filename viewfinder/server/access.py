"""Access: the middleware that every request passes. Who may ask for what, for which names and from which pages, and how much at once.

The names in a request are checked against pages of other sites, and against names that turn into our address (DNS rebinding). A token
is exchanged for a cookie. Bodies are read up to a limit, as JSON without the numbers that JSON does not have.
"""

import asyncio
import json
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from viewfinder.server.sessions import RateLimit, Role, Sessions

# A name or an address and a port, without the rest that URLs allow there.
_HOST = re.compile(r"[\w.-]+(:\d{1,5})?|\[[0-9A-Fa-f:.]+\](:\d{1,5})?", re.ASCII)
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def host_name(host_header: str | None) -> str | None:
    """Return the name in a Host header, without port, in lower case; None if there is none or it is malformed."""
    if host_header is None or not _HOST.fullmatch(host_header):
        return None
    try:
        return urlsplit(f"//{host_header}").hostname
    except ValueError:
        return None


def objection(headers: Mapping[str, str], names: frozenset[str], *, opens_page: bool) -> str | None:
    """Return why a request is refused, as a sentence; None if it is for us (`names`) and from our own page, or from no page at all.

    opens_page: the request only loads the page, which a link of another site may do.
    """
    host = headers.get("Host")
    if host_name(host) not in names:
        return f"this viewfinder does not answer to the name {host!r}: open the address that it printed"
    origin = headers.get("Origin")
    if origin is not None and _netloc(origin) != str(host).lower():
        return "this viewfinder answers only to its own page"
    if not opens_page and headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
        return "this viewfinder answers only to its own page"
    return None


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


# Messages of the page are a few numbers and names; anything larger is not from the page.
LARGEST_MESSAGE = 1024
# Offers of WebRTC list codecs and addresses: Chromium's are 6 to 10 kB.
LARGEST_BODY = 65536
_BODY_S = 10.0


async def message_body(request: web.Request, most: int = LARGEST_MESSAGE) -> bytes:
    """Read the body of a request; one beyond so many bytes is refused (413) before it is read whole, and one that does not come (408)."""
    if (request.content_length or 0) > most:
        raise web.HTTPRequestEntityTooLarge(max_size=most, actual_size=request.content_length or 0)
    body = bytearray()
    try:
        async with asyncio.timeout(_BODY_S):
            async for chunk in request.content.iter_any():
                body += chunk
                if len(body) > most:
                    raise web.HTTPRequestEntityTooLarge(max_size=most, actual_size=len(body))
    except TimeoutError:
        raise web.HTTPRequestTimeout from None
    return bytes(body)


def json_value(text: str | bytes) -> Any:
    """Parse a JSON text of a page, None if it is none (or null). NaN and Infinity are no JSON; deep nesting is no message of ours."""
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None


def _refuse(word: str) -> None:
    raise ValueError(word)


_PAGE_PATHS = frozenset({"/", "/viewfinder.js", "/style.css", "/camera", "/camera.js", "/obs", "/studio.js", "/studio.css"})
# The page for OBS is one file, with its script in it.
_INLINE_PATHS = frozenset({"/obs"})
_VIEW_PATHS = frozenset({"state", "stream", "whep", "matte", "obs"})
_SAFETY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
}
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def _ignore(_protocol: Any, _is_let_in: bool) -> None:
    """Ignore the news."""


@dataclass
class Access:
    """Rules of access.

    names: what a Host header may say. sessions: None lets in everybody who reaches the server, with the role control.

    secure: the server speaks TLS, and the cookie never travels without it. Requests and attempts to enter are limited per address.
    came: is told the connection of each request, and whether it was let in.
    """

    names: frozenset[str] = LOOPBACK_NAMES
    sessions: Sessions | None = None
    secure: bool = False
    requests: RateLimit = field(default_factory=lambda: RateLimit(per_s=60.0, burst=240.0))
    entries: RateLimit = field(default_factory=lambda: RateLimit(per_s=0.1, burst=8.0))
    came: Callable[[Any, bool], None] = _ignore

    @web.middleware
    async def middleware(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Refuse with {"error": sentence}; nothing of a refused request has any effect."""
        path = _canonical(request)
        refusal = self._refusal(request, path)
        self.came(request.protocol, refusal is None and self.role(request) is not None)
        if refusal is not None:
            refusal.headers.update(_SAFETY_HEADERS)
            return refusal
        answer = await _answered(request, handler)
        # A WebSocket has sent its headers already.
        if not answer.prepared:
            answer.headers.update(
                self._page_headers(request, path) if path in _PAGE_PATHS else _SAFETY_HEADERS | {"Cache-Control": "no-store"}
            )
        return answer

    def _refusal(self, request: web.Request, path: str) -> web.Response | None:
        problem = objection(request.headers, self.names, opens_page=request.method == "GET" and path in _PAGE_PATHS)
        if problem is not None:
            return error(problem, 403)
        if not self.requests.allows(request.remote or ""):
            return error("too many requests from this address: wait a moment", 429)
        role, needed = self.role(request), needed_role(path)
        if needed is None or (role is not None and role >= needed):
            return None
        if role is None:
            return error("nobody was let in with this: open the address with its token that the viewfinder printed last", 401)
        return error("you may watch but not control: open the address for control that the viewfinder printed", 403)

    def role(self, request: web.Request) -> Role | None:
        """Return the role of the one who asks; None for a stranger, who gets to open routes only."""
        if self.sessions is None:
            return Role.CONTROL
        return self.sessions.role_of(request.cookies.get(cookie_name(request)), request.headers.get("Authorization"))

    async def enter(self, request: web.Request) -> web.Response:
        """Handle POST /enter {"token": text}: set the cookie and answer {"role": "view" or "control"}."""
        if self.sessions is None:
            return web.json_response({"role": Role.CONTROL.word})
        if not self.entries.allows(request.remote or ""):
            return error("too many attempts from this address: wait a minute", 429)
        body = json_value(await message_body(request))
        token = body.get("token") if isinstance(body, dict) else None
        entered = self.sessions.enter(token) if isinstance(token, str) else None
        if entered is None:
            return error("this token is wrong or was used before: open the address that the viewfinder printed last", 403)
        cookie, role = entered
        answer = web.json_response({"role": role.word})
        answer.set_cookie(cookie_name(request), cookie, httponly=True, samesite="Strict", secure=self.secure, path="/")
        return answer

    def _page_headers(self, request: web.Request, path: str) -> dict[str, str]:
        """Return the headers of the page: it may load and reach nothing but this server, and no other page may frame it."""
        # Older Safari does not count the WebSocket of the same host as 'self'.
        socket = f"{'wss' if self.secure else 'ws'}://{request.headers['Host']}"
        policy = f"default-src 'self'; connect-src 'self' {socket}; img-src 'self' blob: data:; media-src 'self' blob:"
        if path in _INLINE_PATHS:
            policy += "; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'"
        policy += "; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        return _SAFETY_HEADERS | {"Content-Security-Policy": policy, "Cache-Control": "no-cache"}


def needed_role(path: str) -> Role | None:
    """Return the role that the path of a route needs; None is open to all (the page itself, which then enters). The rest needs control."""
    if path in _PAGE_PATHS or path == "/enter":
        return None
    return Role.VIEW if path.split("/")[1:2] and path.split("/")[1] in _VIEW_PATHS else Role.CONTROL


def cookie_name(request: web.Request) -> str:
    """Return a name with the port in it: browsers give a cookie to every port of a host, and two viewfinders may run there."""
    port = request.headers.get("Host", "").rpartition(":")[2]
    return f"mrbokeh_{port}" if port.isdecimal() else "mrbokeh"


def error(sentence: str, status: int) -> web.Response:
    """Answer {"error": sentence}."""
    return web.json_response({"error": sentence}, status=status)


def _canonical(request: web.Request) -> str:
    """Return the path as its route was declared; what matches no route counts as needing control."""
    resource = request.match_info.route.resource
    return "" if resource is None else resource.canonical


async def _answered(request: web.Request, handler: _Handler) -> web.StreamResponse:
    """Answer with JSON too where aiohttp refuses (unknown path, wrong method, body too large)."""
    try:
        return await handler(request)
    except web.HTTPException as problem:
        if problem.status < 400:
            raise
        return error(f"{problem.reason.lower()}: {request.method} {request.path[:80]}", problem.status)
