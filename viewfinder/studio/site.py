"""StudioSite: the page of the studio and its routes, behind the same rules of access as the viewfinder's."""

import asyncio
import json
import re
import struct
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aiohttp import web

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart
from viewfinder.server.access import Access, error, json_value, message_body
from viewfinder.server.site import page_routes
from viewfinder.studio.command_line import command_line, options_of
from viewfinder.studio.desk import LARGEST, Desk, placed_state
from viewfinder.studio.saving import CLIP, FORMATS
from viewfinder.studio.state import StudioState, shadow_of, stroke_of

if TYPE_CHECKING:
    from viewfinder.studio.loupe import Region
    from viewfinder.studio.photograph import OpenedPhotograph
    from viewfinder.studio.preview import Previewer

PAGE = {
    "/": ("studio.html", "text/html"),
    "/studio.js": ("studio.js", "text/javascript"),
    "/studio.css": ("studio.css", "text/css"),
}
_LARGEST_MESSAGE = 65536
_NEWS_WAIT_S = 20.0
_LARGEST_SCREEN_PX = 1e6
_FEW_PX = 1e4
_LARGEST_REGION_PX = 1600
_PAGE_NAME = re.compile(r"\w{1,40}", re.ASCII)
_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".tif": "image/tiff", ".exr": "image/x-exr", ".mp4": "video/mp4"}

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass
class StudioSite:
    """Site of one studio. Every refusal is {"error": sentence}."""

    desk: Desk
    access: Access = field(default_factory=Access)
    _previewers: "dict[bool, Previewer]" = field(default_factory=dict)

    def application(self) -> web.Application:
        """Return all routes behind the rules of access."""
        app = web.Application(middlewares=[self.access.middleware])
        app.add_routes(page_routes(PAGE))
        get = {
            "/state": self._state,
            "/photo": self._photo,
            "/matte": self._matte,
            "/lens/{number}": self._lens,
            "/saved/{number}": self._saved,
        }
        post = {"/state": self._change, "/add": self._add, "/history": self._history, "/preview": self._preview, "/upload": self._upload}
        post |= {"/save": self._save, "/cancel": self._cancel, "/paint": self._paint, "/sun": self._sun}
        app.add_routes([web.post("/enter", self.access.enter)])
        app.add_routes([web.get(path, _refusing(handler)) for path, handler in get.items()])
        app.add_routes([web.post(path, _refusing(handler)) for path, handler in post.items()])
        app.on_startup.append(self._open)
        app.on_shutdown.append(self._close)
        return app

    async def _open(self, _app: web.Application) -> None:
        self.desk.start()

    async def _close(self, _app: web.Application) -> None:
        self.desk.tell_all()
        await self.desk.close()
        for each in self._previewers.values():
            each.close()

    async def _state(self, request: web.Request) -> web.Response:
        """Handle GET /state: all that the page shows; with ?after=NUMBER only once there is newer news, or after 20 s."""
        after = request.query.get("after", "")
        if after.isdecimal():
            await self.desk.news_after(int(after[:12]), _NEWS_WAIT_S)
        return web.json_response(self._told())

    def _told(self) -> dict[str, Any]:
        desk, project = self.desk, self.desk.project
        shown: dict[str, Any] = {
            "number": desk.number,
            "state": desk.state.document(),
            "busy": desk.busy,
            "problem": desk.problem,
            "can_undo": project.place > 0,
            "can_redo": project.place + 1 < len(project.history),
            "objects": [{"path": str(each), "name": each.stem} for each in project.objects],
            "lenses": [{"path": str(each), "name": each.stem} for each in project.lenses],
            "saves": desk.saves.told(),
            "formats": [*FORMATS, *([CLIP] if desk.state.clip is not None else [])],
            "clip": desk.clip_told(),
            "format": desk.saves.format,
            "project": str(project.path.absolute()),
            "largest": LARGEST,
            "camera": desk.camera_told(),
            "command": self._command(desk.state),
            "photo": None,
        }
        if (opened := desk.photograph) is not None:
            shown["photo"] = _photo_told(opened, desk.state)
        return shown

    def _command(self, state: StudioState) -> str | None:
        """Return the command line of a state, None while something is missing."""
        opened = self.desk.photograph
        if not state.is_complete or opened is None:
            return None
        assert state.photo is not None
        return command_line(
            options_of(placed_state(state, opened)), self.desk.saves.free_name(state.photo, FORMATS.get(self.desk.saves.format, ".png"))
        )

    async def _photo(self, _request: web.Request) -> web.Response:
        """Handle GET /photo: the photograph as it is, as large as the largest preview."""
        from viewfinder.studio.preview import jpeg_of

        opened = self._opened()
        jpeg = await asyncio.to_thread(jpeg_of, opened.plate.rgb)
        return web.Response(body=jpeg, content_type="image/jpeg")

    async def _lens(self, request: web.Request) -> web.Response:
        """Handle GET /lens/NUMBER: the outline of a lens's opening as SVG, which is the shape of its bokeh."""
        number, lenses = request.match_info["number"], self.desk.project.lenses
        if not number.isdecimal() or not int(number[:6]) < len(lenses):
            raise InputError(f"there is no lens number {number[:20]}: give lenses with --lens")
        return web.Response(text=bokeh_svg(lenses[int(number)]), content_type="image/svg+xml")

    async def _change(self, request: web.Request) -> web.Response:
        """Handle POST /state: {"changes": {name: value}, "metres_typed"}."""
        message = await _message(request)
        await self.desk.change(message.get("changes"), metres_typed=message.get("metres_typed") is True)
        return web.json_response(self._told())

    async def _add(self, request: web.Request) -> web.Response:
        """Handle POST /add: {"object": one that is offered}."""
        await self.desk.add_object((await _message(request)).get("object"))
        return web.json_response(self._told())

    async def _matte(self, _request: web.Request) -> web.Response:
        """Handle GET /matte: what the brush has told of the photograph, as a tint as large as the largest preview."""
        from viewfinder.studio.brush import tinted

        if (matte := self.desk.state.matte) is None:
            raise InputError("the brush has told nothing yet: paint over what is in front")
        png = await asyncio.to_thread(tinted, matte, self._opened().plate.rgb.shape[1::-1])
        return web.Response(body=png, content_type="image/png")

    async def _paint(self, request: web.Request) -> web.Response:
        """Handle POST /paint: {"points": [[x, y], ...], "radius", "front"} in pixels of the photograph."""
        await self.desk.paint(stroke_of(await _message(request)))
        return web.json_response(self._told())

    async def _sun(self, request: web.Request) -> web.Response:
        """Handle POST /sun: {"points": pixels of a top, a foot and a shadow's tip}; the answer also has what is "said" of that."""
        said = await self.desk.sun_by(shadow_of(await _message(request)))
        return web.json_response(self._told() | {"said": said})

    async def _history(self, request: web.Request) -> web.Response:
        """Handle POST /history: {"step": -1 or 1}."""
        await self.desk.step((await _message(request)).get("step"))
        return web.json_response(self._told())

    async def _preview(self, request: web.Request) -> web.Response:
        """Handle POST /preview: {"changes", "draft", "pixels", "page", "region", "before"}; the answer is a length, JSON of that length,
        and a JPEG.

        before: the photograph as it is, in a region; so it is where no object stands yet. 204 says that the page has asked for a newer
        picture since.
        """
        from viewfinder.studio.preview import Previewer, Wish

        message = await _message(request)
        page, draft, pixels = message.get("page"), message.get("draft") is True, message.get("pixels")
        if not isinstance(page, str) or not _PAGE_NAME.fullmatch(page):
            raise InputError("expected the page that asks, by a name of letters and digits: load the page again")
        if isinstance(pixels, bool) or not isinstance(pixels, int | float) or not 1e3 <= pixels <= 1e9:
            raise InputError(f"expected how many pixels the screen shows, got {str(pixels)[:20]!r}: load the page again")
        state, opened = self.desk.changed_state(message.get("changes") or {}), self._opened()
        region = _region_of(message.get("region"))
        as_it_is = region is not None and (message.get("before") is True or not state.is_complete)
        options = None if as_it_is else options_of(placed_state(state, opened))
        if draft not in self._previewers:
            self._previewers[draft] = Previewer("studio drafts" if draft else "studio previews")
        wish = Wish(photograph=opened, options=options, most_px=min(float(pixels), _LARGEST_SCREEN_PX), draft=draft, region=region)
        made = await asyncio.wrap_future(self._previewers[draft].ask(f"{page} loupe" if region else page, wish))
        if made is None:
            return web.Response(status=204)
        told, jpeg = made
        header = json.dumps(told | {"command": self._command(state)}).encode()
        return web.Response(body=struct.pack(">I", len(header)) + header + jpeg, content_type="application/octet-stream")

    async def _upload(self, request: web.Request) -> web.Response:
        """Handle POST /upload?kind=photo|object&name=NAME, whose body is the file."""
        kind, name = request.query.get("kind", ""), request.query.get("name", "")
        if (request.content_length or 0) > LARGEST.get(kind, 0) > 0:
            raise InputError(f"{name[:80]} is larger than the {LARGEST[kind] >> 20} MB that the studio takes: give it on the command line")
        await self.desk.upload(kind, name, request.content.iter_any())
        return web.json_response(self._told())

    async def _save(self, request: web.Request) -> web.Response:
        """Handle POST /save: {"format": one of FORMATS, or CLIP}."""
        kind = (await _message(request)).get("format")
        if kind == CLIP:
            await self.desk.save_clip()
            self.desk.tell_all()
            return web.json_response(self._told())
        self.desk.saves.start(options_of(placed_state(self.desk.state, self._opened())), kind)
        self.desk.tell_all()
        return web.json_response(self._told())

    async def _cancel(self, request: web.Request) -> web.Response:
        """Handle POST /cancel: {"number": of a save}."""
        self.desk.saves.cancel((await _message(request)).get("number"))
        return web.json_response(self._told())

    async def _saved(self, request: web.Request) -> web.FileResponse:
        """Handle GET /saved/NUMBER: the file of a finished save."""
        number = request.match_info["number"]
        path = self.desk.saves.finished(int(number[:9]) if number.isdecimal() else None)
        kind = _TYPES.get(path.suffix, "application/octet-stream")
        return web.FileResponse(path, headers={"Content-Type": kind, "Content-Disposition": f'attachment; filename="{_plain(path)}"'})

    def _opened(self) -> "OpenedPhotograph":
        """Return the opened photograph. Raises InputError while there is none."""
        if (opened := self.desk.photograph) is None:
            raise InputError(self.desk.problem or "the photograph is not opened yet: wait a moment, or drop one on the page")
        return opened


def _photo_told(opened: "OpenedPhotograph", state: StudioState) -> dict[str, Any]:
    """Return what the page needs of the photograph: its size, and the pinhole by which it draws the ground."""
    from mrbokeh.commands._level_ground import rolled_deg
    from viewfinder.studio.photograph import anywhere, looks_down_deg

    width_px, height_px = opened.size_px
    told = opened.told
    shown: dict[str, Any] = {"name": opened.path.name, "width_px": width_px, "height_px": height_px, "has_depth": opened.has_depth}
    if (stack := opened.stack) is not None:
        shown |= {
            "slice": opened.slice,
            "slices": len(stack),
            "focus_distances_m": list(stack.focus_distances_m) if stack.metres_known else [],
        }
    sun = opened.plate.sun
    by_file = None if sun is None or sun.right_deg is None or not sun.is_up else [round(sun.right_deg), round(sun.above_deg)]
    shown |= {
        "sun_deg": by_file,
        "f_number": told.f_number,
        "focus_m": None if told.rough_focus_m else told.focus_distance_m,
        "focal_length_mm": told.focal_length_mm,
    }
    try:
        with apart():
            whole = anywhere(state, opened)
            plate, _renderer, known_height_m = opened.upright(options_of(whole), _FEW_PX)
            eyes_m = placed_state(whole, opened).camera_height_m or known_height_m
        held = plate.world_from_camera
        shown |= {"focal_px": plate.lens.focal_px(width_px), "lens_f_number": plate.lens.f_number}
        shown |= {"widest_f_number": plate.lens.widest_f_number}
        shown |= {"camera_height_m": eyes_m, "world_from_camera": None if held is None else held.tolist()}
        shown |= {"pitch_deg": None if held is None else round(looks_down_deg(plate), 2)}
        shown |= {"roll_deg": None if held is None else round(rolled_deg(held), 2)}
    except InputError as problem:
        shown |= dict.fromkeys(("focal_px", "lens_f_number", "camera_height_m", "world_from_camera", "pitch_deg", "roll_deg")) | {
            "problem": str(problem)
        }
    return shown


def _region_of(value: Any) -> "Region | None":
    """Return the region that a loupe shows: [x, y, side, blur] in pixels of the photograph. Raises InputError."""
    from viewfinder.studio.loupe import Region

    if value is None:
        return None
    sound = isinstance(value, list) and len(value) == 4
    if not sound or not all(isinstance(each, int | float) and not isinstance(each, bool) and -1e6 < each < 1e6 for each in value):
        raise InputError(f"expected the region of a loupe as x, y, side and blur in pixels, got {str(value)[:60]!r}")
    x_px, y_px, side_px, blur_px = value
    return Region(float(x_px), float(y_px), max(16, min(_LARGEST_REGION_PX, int(side_px))), max(0.0, float(blur_px)))


async def _message(request: web.Request) -> dict[str, Any]:
    body = json_value(await message_body(request, _LARGEST_MESSAGE))
    if not isinstance(body, dict):
        raise InputError("expected a message in JSON, an object of names and values: load the page again")
    return body


def _refusing(handler: _Handler) -> _Handler:
    """Return the handler with refusals as sentences (400)."""

    async def refused(request: web.Request) -> web.StreamResponse:
        try:
            return await handler(request)
        except InputError as problem:
            return error(str(problem), 400)
        except OSError as problem:
            return error(f"{problem.strerror or 'the system refused it'}: make room, or choose another folder with --pictures", 400)

    return refused


def _plain(path: Path) -> str:
    return re.sub(r"[^\w.-]", "_", path.name, flags=re.ASCII)


_SIDE_PX, _RADIUS_PX = 64, 26.0


def bokeh_svg(path: Path) -> str:
    """Return a small SVG of a lens's opening; a network, whose blur has no outline, is drawn as a dashed disc."""
    from mrbokeh.renderers.choose import read_lens

    try:
        if path.suffix.lower() == ".onnx":
            return _svg(f'<circle r="{_RADIUS_PX}" fill="none" stroke="#f0b429" stroke-width="2" stroke-dasharray="4 3"/>')
        aperture = read_lens(path).aperture
    except InputError:
        return _svg('<text text-anchor="middle" fill="#e8e6e1" font-size="12">?</text>')
    scale = _RADIUS_PX / max(aperture.unit_radius, 1e-6)
    rings = [" ".join(f"{scale * x:.2f},{scale * y:.2f}" for x, y in outline) for outline in aperture.outlines]
    path_data = " ".join(f"M {ring} Z" for ring in rings)
    return _svg(f'<path d="{path_data}" fill="#f0b429" fill-rule="evenodd"/>')


def _svg(drawn: str) -> str:
    half = _SIDE_PX / 2
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-half} {-half} {_SIDE_PX} {_SIDE_PX}">{drawn}</svg>'
