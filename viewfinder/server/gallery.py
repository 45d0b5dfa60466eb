"""Gallery: the takes and captures of the captures folder for the page: a list, small pictures, the files themselves, and their end."""

import asyncio
import io
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypedDict

from aiohttp import web

from mrbokeh.stacks.capture_bundle import is_bundle
from mrbokeh.system.errors import InputError
from viewfinder.server.access import error
from viewfinder.streaming.take_file import SUFFIXES, free_bytes, is_under_way, length_s

_MOST_LISTED = 200
_SMALL_PX = 320
_PREVIEW = "preview.jpg"
# As the viewfinder names them: other files in the folder are nobody's on the page.
_OURS = re.compile(r"(viewfinder-)?\d{8}-\d{6}[\w.-]*", re.ASCII)


class Listed(TypedDict):
    """Take or capture as the page lists it. kind: "take" or "capture"; made_s: since 1970; length_s: None of captures."""

    name: str
    kind: str
    size_bytes: int
    made_s: float
    length_s: float | None


@dataclass(frozen=True)
class Gallery:
    """Part of a site. folder: which need not be there yet. Who may ask is for the rules of access to say: controls only."""

    folder: Path

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/gallery", self._list),
            web.get("/gallery/{name}/small", self._small),
            web.get("/gallery/{name}/shown", self._shown),
            web.get("/gallery/{name}/file", self._file),
            web.delete("/gallery/{name}", self._delete),
        ]

    async def close(self) -> None:
        """Close nothing: nothing runs."""

    async def _list(self, _request: web.Request) -> web.Response:
        """Answer {"saved": [Listed], "free_bytes": of the disk}."""
        return web.json_response({"saved": await asyncio.to_thread(self.listed), "free_bytes": free_bytes(self.folder)})

    def listed(self) -> list[Listed]:
        """Return what is there, the newest first; a take that is being written is not."""
        found = sorted(((path.stat().st_mtime, path) for path in self._paths()), reverse=True)[:_MOST_LISTED]
        return [_described(path, made_s) for made_s, path in found]

    def _paths(self) -> list[Path]:
        present = [path for path in self.folder.iterdir() if _OURS.fullmatch(path.name)] if self.folder.is_dir() else []
        takes = [path for path in present if path.suffix in SUFFIXES and path.is_file() and not is_under_way(path)]
        return takes + [path for path in present if path.is_dir() and is_bundle(path)]

    def _path(self, request: web.Request) -> Path:
        """Return what is asked for, by its name: only what is listed can be."""
        name = request.match_info["name"]
        for path in self._paths():
            if path.name == name:
                return path
        raise web.HTTPNotFound

    async def _small(self, request: web.Request) -> web.Response:
        """Answer with a small JPEG."""
        path = self._path(request)
        try:
            jpeg = await asyncio.to_thread(_small_jpeg, path, path.stat().st_mtime)
        except InputError as problem:
            return error(str(problem), 404)
        return web.Response(body=jpeg, content_type="image/jpeg")

    async def _shown(self, request: web.Request) -> web.StreamResponse:
        """Answer with what a browser plays or shows: the take, in the parts that it asks for, or the picture of a capture."""
        path = self._path(request)
        return web.FileResponse(path if path.is_file() else path / _PREVIEW)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        """Answer with a file to keep: the take, or all files of a capture in one archive."""
        path = self._path(request)
        name = path.name if path.is_file() else f"{path.name}.zip"
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        if path.is_file():
            return web.FileResponse(path, headers=headers)
        return web.Response(body=await asyncio.to_thread(_archive, path), content_type="application/zip", headers=headers)

    async def _delete(self, request: web.Request) -> web.Response:
        path = self._path(request)
        remove: Callable[[Path], Any] = Path.unlink if path.is_file() else shutil.rmtree
        try:
            await asyncio.to_thread(remove, path)
        except OSError as problem:
            return error(f"{path.name} could not be deleted ({problem.strerror}): close what uses it", 409)
        return web.json_response({"done": "delete"})


def _described(path: Path, made_s: float) -> Listed:
    if path.is_file():
        size_bytes = path.stat().st_size
        return Listed(name=path.name, kind="take", size_bytes=size_bytes, made_s=made_s, length_s=_length_s(path, made_s))
    size_bytes = sum(each.stat().st_size for each in path.iterdir())
    return Listed(name=path.name, kind="capture", size_bytes=size_bytes, made_s=made_s, length_s=None)


@lru_cache(maxsize=_MOST_LISTED)
def _length_s(path: Path, _made_s: float) -> float | None:
    import av

    try:
        return length_s(path)
    except av.FFmpegError:
        return None


@lru_cache(maxsize=_MOST_LISTED)
def _small_jpeg(path: Path, _made_s: float) -> bytes:
    """Return the first picture of a take, or that of a capture, as a small JPEG."""
    import cv2

    from viewfinder.sources.frame_source import SizeLimit

    bgr = _first_picture(path) if path.is_file() else cv2.imread(str(path / _PREVIEW))
    if bgr is None:
        raise InputError(f"{path.name} has no picture that can be shown")
    return bytes(cv2.imencode(".jpg", SizeLimit(_SMALL_PX).applied(bgr))[1].tobytes())


def _first_picture(path: Path) -> Any:
    import av

    try:
        with av.open(str(path)) as container:
            return next(container.decode(video=0)).to_ndarray(format="bgr24")
    except (av.FFmpegError, StopIteration):
        return None


def _archive(folder: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for each in sorted(folder.iterdir()):
            archive.write(each, f"{folder.name}/{each.name}")
    return packed.getvalue()
