"""The page: a few files of the package, read once; a request names one of them or nothing at all."""

from collections.abc import Awaitable, Callable
from importlib.resources import files

from aiohttp import web

PAGE = {
    "/": ("index.html", "text/html"),
    "/camera": ("camera.html", "text/html"),
    "/viewfinder.js": ("viewfinder.js", "text/javascript"),
    "/camera.js": ("camera.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}


def page_routes() -> list[web.RouteDef]:
    return [web.get(path, _handler(name, content_type)) for path, (name, content_type) in PAGE.items()]


def _handler(name: str, content_type: str) -> Callable[[web.Request], Awaitable[web.Response]]:
    text = files("viewfinder").joinpath("page", name).read_text(encoding="utf-8")

    async def page(_request: web.Request) -> web.Response:
        return web.Response(text=text, content_type=content_type)

    return page
