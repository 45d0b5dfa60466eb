"""WHEP (draft-ietf-wish-whep-03): a browser posts an SDP offer and gets the answer; the resource in Location ends with DELETE."""

import asyncio
import re
import secrets
from typing import TYPE_CHECKING

from aiohttp import web

from mrbokeh.system.errors import InputError
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.session_description import with_address

if TYPE_CHECKING:
    from viewfinder.streaming.viewer_connection import ViewerConnection

# Offers of WebRTC list codecs and addresses: those of browsers have 2 to 10 kB.
_LARGEST_SDP = 65536
_CANDIDATE = re.compile(r"^a=candidate:(.+)$", re.MULTILINE)
_MID = re.compile(r"^a=mid:(.+)$", re.MULTILINE)
_MOST_CANDIDATES = 32


class Whep:
    """WHEP of a stream. Who may come is decided before these routes; here only how many (viewers_limit) and how large.

    connect_within_s: a viewer whose connection does not stand by then is removed.
    """

    def __init__(self, stream: EncodedStream, *, viewers_limit: int = 8, connect_within_s: float = 15.0) -> None:
        self._stream, self._viewers_limit, self._connect_within_s = stream, viewers_limit, connect_within_s
        self._viewers: dict[str, ViewerConnection] = {}
        self._closed = False

    def routes(self, path: str = "/whep") -> list[web.RouteDef]:
        return [
            web.post(path, self._offer),
            web.options(path, self._options),
            web.patch(path + "/{viewer}", self._trickle),
            web.delete(path + "/{viewer}", self._leave),
            web.options(path + "/{viewer}", self._options),
        ]

    @property
    def viewers(self) -> int:
        return len(self._viewers)

    async def close(self) -> None:
        """Close all connections; later offers are refused."""
        self._closed = True
        await asyncio.gather(*(viewer.close() for viewer in list(self._viewers.values())))

    async def _offer(self, request: web.Request) -> web.Response:
        if request.content_type != "application/sdp":
            return _refusal(415, f"expected Content-Type application/sdp, got {request.content_type}")
        if self._closed or len(self._viewers) >= self._viewers_limit:
            return _refusal(503, f"expected at most {self._viewers_limit} viewers, and all places are taken: close another page")
        # The place is taken before the first wait, so that many offers at once do not slip through.
        name = secrets.token_urlsafe(16)
        viewer = self._viewers[name] = self._new_viewer(name)
        try:
            async with asyncio.timeout(self._connect_within_s):
                offer = with_address(await _text(request), request.remote)
                answer = await viewer.answer(offer, self._connect_within_s)
        except (InputError, TimeoutError) as error:
            await viewer.close()
            return _refusal(400, str(error) or f"expected an SDP offer within {self._connect_within_s:g} s")
        except BaseException:
            await viewer.close()
            raise
        headers = {"Location": f"{request.path.rstrip('/')}/{name}", "Access-Control-Expose-Headers": "Location"}
        return web.Response(status=201, text=answer, content_type="application/sdp", headers=headers)

    def _new_viewer(self, name: str) -> "ViewerConnection":
        from viewfinder.streaming.viewer_connection import ViewerConnection, keyframe_requests_arrive

        if not keyframe_requests_arrive() and self._stream.keyframe_every_s is None:
            self._stream.keyframe_every_s = 2.0
        return ViewerConnection(self._stream, lambda _viewer: self._forget(name))

    def _forget(self, name: str) -> None:
        self._viewers.pop(name, None)

    async def _trickle(self, request: web.Request) -> web.Response:
        """Take further addresses of the viewer (RFC 8840); a restart of ICE is not offered."""
        viewer = self._viewers.get(request.match_info["viewer"])
        if viewer is None:
            return _refusal(404, "there is no such viewer (any more): post a new offer")
        if request.content_type != "application/trickle-ice-sdpfrag":
            return _refusal(415, f"expected Content-Type application/trickle-ice-sdpfrag, got {request.content_type}")
        try:
            await _add_candidates(viewer, with_address(await _text(request), request.remote))
        except InputError as error:
            return _refusal(400, str(error))
        return web.Response(status=204)

    async def _leave(self, request: web.Request) -> web.Response:
        viewer = self._viewers.get(request.match_info["viewer"])
        if viewer is None:
            return _refusal(404, "there is no such viewer (any more)")
        await viewer.close()
        return web.Response()

    async def _options(self, _request: web.Request) -> web.Response:
        return web.Response(status=204, headers={"Accept-Post": "application/sdp", "Allow": "POST, PATCH, DELETE, OPTIONS"})


def _refusal(status: int, sentence: str) -> web.Response:
    return web.json_response({"error": sentence}, status=status)


async def _text(request: web.Request) -> str:
    """Read the body; InputError as soon as it is larger than a description can be. The limit of the application does not apply."""
    body = bytearray()
    async for chunk in request.content.iter_any():
        body += chunk
        if len(body) > _LARGEST_SDP:
            raise InputError(f"expected an SDP of at most {_LARGEST_SDP} bytes, got a larger one")
    try:
        return body.decode()
    except UnicodeDecodeError:
        raise InputError("expected an SDP, which is text, got bytes that are not UTF-8") from None


async def _add_candidates(viewer: "ViewerConnection", fragment: str) -> None:
    from aiortc.sdp import candidate_from_sdp

    mid = _MID.search(fragment)
    lines = _CANDIDATE.findall(fragment)
    if len(lines) > _MOST_CANDIDATES:
        raise InputError(f"expected at most {_MOST_CANDIDATES} candidates at once, got {len(lines)}")
    for line in lines:
        try:
            candidate = candidate_from_sdp(line.strip())
            candidate.sdpMid = mid.group(1).strip() if mid else "0"
            await viewer.peer.addIceCandidate(candidate)
        except Exception as error:
            raise InputError(f"expected ICE candidates, got {line[:80]!r} ({error})") from None
