"""Site: everything that one viewfinder shows to browsers: its page, its routes, and parts that may be missing."""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Protocol, runtime_checkable

import numpy as np
from aiohttp import web
from jaxtyping import UInt8

from viewfinder.server.access import LARGEST_BODY, Access, error, message_body
from viewfinder.server.controls import Controls, Dispatcher
from viewfinder.server.jpeg_stream import Broadcaster, JpegSocket
from viewfinder.server.sessions import Role

PAGE = {
    "/": ("index.html", "text/html"),
    "/camera": ("camera.html", "text/html"),
    "/viewfinder.js": ("viewfinder.js", "text/javascript"),
    "/camera.js": ("camera.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}


def page_routes(page: Mapping[str, tuple[str, str]] = PAGE) -> list[web.RouteDef]:
    """Return the routes of a page's files, by their paths: (name, content type)."""
    return [web.get(path, _handler(name, content_type)) for path, (name, content_type) in page.items()]


def _handler(name: str, content_type: str) -> Callable[[web.Request], Awaitable[web.Response]]:
    text = files("viewfinder").joinpath("page", name).read_text(encoding="utf-8")

    async def page(_request: web.Request) -> web.Response:
        return web.Response(text=text, content_type=content_type)

    return page


Matte = UInt8[np.ndarray, "height width"]


@runtime_checkable
class Part(Protocol):
    """Part of a site with routes of its own (WHEP, WHIP). `access.needed_role` says by their path who may use them: whip needs control."""

    def routes(self) -> Sequence[web.AbstractRouteDef]: ...

    async def close(self) -> None: ...


def _no_matte() -> None:
    """Give no matte."""


@dataclass
class Site:
    """Site of one viewfinder.

    dispatcher: of the controls; the data channel of a WebRTC part calls the same one.

    broadcaster: of the JPEG stream, None without it. parts: by name; "whep" tells the page to try it first, "whip" offers the camera page,
    "gallery" what was saved.
    matte: the newest coverage of the virtual layer, small and 8-bit, for the peaking of real and virtual things apart.
    """

    controls: Controls
    dispatcher: Dispatcher = field(init=False)
    access: Access = field(default_factory=Access)
    broadcaster: Broadcaster | None = None
    parts: dict[str, Part] = field(default_factory=dict)
    matte: Callable[[], Matte | None] = _no_matte

    def __post_init__(self) -> None:
        self.dispatcher = Dispatcher(self.controls)

    def application(self) -> web.Application:
        """Return all routes behind the rules of access."""
        app = web.Application(middlewares=[self.access.middleware], client_max_size=LARGEST_BODY)
        app.add_routes(page_routes())
        app.add_routes([web.post("/enter", self.access.enter), web.get("/state", self._state), web.post("/control", self._control)])
        app.add_routes([web.get("/matte", self._matte)])
        if self.broadcaster is not None:
            app.add_routes([web.get("/stream", JpegSocket(self.broadcaster, self.dispatcher, self.access).handle)])
        for part in self.parts.values():
            app.add_routes(part.routes())
        app.on_startup.append(self._open)
        app.on_shutdown.append(self._close)
        return app

    def _role(self, request: web.Request) -> Role:
        return self.access.role(request) or Role.VIEW

    async def _state(self, request: web.Request) -> web.Response:
        """Handle GET /state: the State, the role of the one who asks, and the ways to watch, best first."""
        ways = [name for name, present in (("whep", "whep" in self.parts), ("jpeg", self.broadcaster is not None)) if present]
        own = {"role": self._role(request).word, "transports": ways, "matte": self.matte() is not None, "can_send": "whip" in self.parts}
        own["gallery"] = "gallery" in self.parts and own["role"] == Role.CONTROL.word
        return web.json_response(self.controls.state() | own)

    async def _control(self, request: web.Request) -> web.Response:
        """Handle POST /control, a control message."""
        body = await message_body(request)
        answer = await self.dispatcher.answer(body, self._role(request), request.remote or "")
        return web.json_response(answer, status=400 if "error" in answer else 200)

    async def _matte(self, _request: web.Request) -> web.Response:
        """Handle GET /matte: coverage as a grey PNG."""
        import cv2

        matte = self.matte()
        if matte is None:
            return error("there is no matte now", 404)
        return web.Response(body=cv2.imencode(".png", matte)[1].tobytes(), content_type="image/png")

    async def _open(self, _app: web.Application) -> None:
        if self.broadcaster is not None:
            self.broadcaster.open()

    async def _close(self, _app: web.Application) -> None:
        if self.broadcaster is not None:
            await self.broadcaster.close()
        for part in self.parts.values():
            await part.close()
        self.dispatcher.close()
