"""AlphaStream: the virtual layer alone, for OBS: one picture twice as high, colour above alpha, because H.264 has no alpha.

The page `obs.html` puts the halves together. OBS lays the page over the camera in display codes and not in light: soft edges come
out a little different from our own composite, which is laid over in linear light.
"""

from dataclasses import dataclass
from importlib.resources import files
from threading import Event, Thread

import numpy as np
from aiohttp import web
from jaxtyping import Float32, UInt8

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.video.color import code_from_linear
from viewfinder.frames import Newest, OutputFrame
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.whep import Whep

_POLL_S = 0.1


@dataclass(frozen=True)
class _Shown:
    overlay: Overlay
    frame: OutputFrame


class AlphaStream:
    """Feeder of an EncodedStream of its own, in a thread of its own. transfer: of the camera's codes, which OBS gets from elsewhere."""

    def __init__(self, stream: EncodedStream, transfer: str) -> None:
        self._stream, self._transfer = stream, transfer
        self._newest: Newest[_Shown] = Newest()
        self._stopping = Event()
        self._thread = Thread(target=self._work, name="alpha", daemon=True)
        self._thread.start()

    @property
    def wants_frame(self) -> bool:
        return self._stream.wants_frame

    def show(self, overlay: Overlay, frame: OutputFrame) -> None:
        """Take the overlay that lies in that frame; returns at once."""
        self._newest.put(_Shown(overlay, frame))

    def fail(self, sentence: str) -> None:
        self._stream.fail(sentence)

    def close(self) -> None:
        """End the thread; the EncodedStream belongs to who made it."""
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stopping.is_set():
            shown = self._newest.take(_POLL_S)
            if shown is not None:
                frame = shown.frame
                bgr = color_over_alpha(shown.overlay, frame.bgr.shape[1], frame.bgr.shape[0], self._transfer)
                self._stream.show(OutputFrame(bgr, frame.captured_s, frame.sequence, frame.status))


def color_over_alpha(overlay: Overlay, width_px: int, height_px: int, transfer: str) -> UInt8[np.ndarray, "double width 3"]:
    """Return (2 H, W, 3) 8-bit codes, blue first: above premultiplied colour, below alpha as grey. A last odd row is left out."""
    height_px &= ~1
    picture = np.zeros((2 * height_px, width_px, 3), np.uint8)
    rows, columns = overlay.shines_through.shape
    rows = min(rows, height_px - overlay.top_px)
    alpha = np.clip(1 - overlay.shines_through[:rows], 0, 1)[..., None]
    top, left = overlay.top_px, overlay.left_px
    color = _premultiplied_codes(overlay.rgb[:rows, :, ::-1], alpha, transfer)
    picture[top : top + rows, left : left + columns] = np.rint(255 * color)
    picture[height_px + top : height_px + top + rows, left : left + columns] = np.rint(255 * alpha)
    return picture


def _premultiplied_codes(
    light: Float32[np.ndarray, "rows columns 3"], alpha: Float32[np.ndarray, "rows columns 1"], transfer: str
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return what is to be added to codes of the camera times one minus alpha: alpha times the code of the surface.

    Light beyond what the coverage can reflect (a glow) is added as its own code, so that it does not vanish where alpha is 0.
    """
    surface = np.minimum(light / np.maximum(alpha, np.float32(1e-6)), np.float32(1.0))
    glow = np.maximum(light - alpha, np.float32(0.0))
    codes = alpha * code_from_linear(surface, transfer) + code_from_linear(glow, transfer)
    return np.clip(codes, 0.0, 1.0).astype(np.float32)


class ObsPart:
    """Page for OBS and its stream as one part of a site. whep: of AlphaStream's EncodedStream."""

    def __init__(self, whep: Whep) -> None:
        self._whep = whep

    def routes(self) -> list[web.RouteDef]:
        return obs_routes(self._whep)

    async def close(self) -> None:
        await self._whep.close()


def obs_routes(whep: Whep) -> list[web.RouteDef]:
    """Return the routes /obs, the page for OBS's browser source, and /obs/whep, where it gets its stream."""
    text = files("viewfinder.streaming").joinpath("obs.html").read_text(encoding="utf-8")

    async def page(_request: web.Request) -> web.Response:
        return web.Response(text=text, content_type="text/html", headers={"Cache-Control": "no-cache"})

    return [web.get("/obs", page), *whep.routes("/obs/whep")]
