"""Streams for other programs: the virtual layer alone for OBS, and the finished pictures as a webcam.

H.264 has no alpha, so that AlphaStream sends one picture twice as high, colour above alpha; the page `obs.html` puts the halves together.
OBS lays the page over the camera in display codes and not in light: soft edges come out a little different from our own composite,
which is laid over in linear light.

VirtualWebcam is a camera that OBS, Zoom and browsers can choose, through pyvirtualcam. On Linux the device is one of v4l2loopback (`sudo
modprobe v4l2loopback`), on Windows and macOS the one that OBS installs.
"""

import logging
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from threading import Event, Thread
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from aiohttp import web
from jaxtyping import Float32, UInt8

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.system.errors import InputError
from mrbokeh.video.color import code_from_linear
from viewfinder.frames import Bgr, Newest, OutputFrame
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


ANY_DEVICE = "auto"
_FPS = 30.0
_PROBED_PX = (640, 360)
_LEAVE_S = 3.0

log = logging.getLogger(__name__)


@runtime_checkable
class Device(Protocol):
    """Device as pyvirtualcam.Camera has it. device: its name."""

    device: str
    width: int
    height: int

    def send(self, frame: UInt8[np.ndarray, "height width 3"]) -> None: ...

    def close(self) -> None: ...


class VirtualWebcam:
    """FrameSink. device: a name such as /dev/video9 or "OBS Virtual Camera"; "auto" takes the first that is free.

    The device has the size of the first picture; later ones of another size are fitted into it, for programs that look at it cannot
    follow. InputError where there is no such device. failure: a sentence once it does not take pictures any more.
    """

    def __init__(self, device: str = ANY_DEVICE) -> None:
        self._wanted = None if device == ANY_DEVICE else device
        # Whether there is a device is told at once, though its size is not known yet.
        probed = open_device(self._wanted, *_PROBED_PX)
        self.name = probed.device
        probed.close()
        self.failure: str | None = None
        self._frames: Newest[OutputFrame] = Newest()
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="virtual webcam", daemon=True)
        self._thread.start()

    @property
    def wants_frame(self) -> bool:
        """True until it fails: whether somebody looks at the device is not told."""
        return self.failure is None

    def show(self, frame: OutputFrame) -> None:
        self._frames.put(frame)

    def fail(self, _sentence: str) -> None:
        """Keep the last picture: the camera may come back."""

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(_LEAVE_S)

    def _run(self) -> None:
        opened: Device | None = None
        try:
            while not self._stopping.is_set():
                frame = self._frames.take(_POLL_S)
                if frame is None:
                    continue
                opened = opened or open_device(self.name, *frame.bgr.shape[1::-1])
                opened.send(fitted(frame.bgr, opened.width, opened.height))
        except InputError as error:
            self.failure = str(error)
        except Exception as error:
            log.exception("the virtual webcam failed")
            self.failure = f"the virtual webcam {self.name} takes no more pictures: {error}"
        finally:
            if opened is not None:
                opened.close()


def open_device(name: str | None, width_px: int, height_px: int) -> Device:
    """Open a device; InputError without pyvirtualcam, and where no device is there or it is in use."""
    try:
        pyvirtualcam: Any = import_module("pyvirtualcam")
    except ImportError:
        raise InputError(
            "a virtual webcam needs the package pyvirtualcam, which mrbokeh does not install, for its licence is the GPL: "
            "`pip install pyvirtualcam`"
        ) from None
    try:
        opened: Device = pyvirtualcam.Camera(width_px, height_px, _FPS, fmt=pyvirtualcam.PixelFormat.BGR, device=name)
    except (RuntimeError, ValueError) as error:
        wanted = "a virtual webcam" if name is None else f"the virtual webcam {name}"
        raise InputError(
            f"{wanted} could not be opened ({error}): on Linux load one with `sudo modprobe v4l2loopback exclusive_caps=1`, elsewhere "
            f"install OBS, which brings one"
        ) from None
    return opened


def fitted(bgr: Bgr, width_px: int, height_px: int) -> UInt8[np.ndarray, "fitted_height fitted_width 3"]:
    """Scale a picture to as large as fits in, black around."""
    height, width = bgr.shape[:2]
    if (width, height) == (width_px, height_px):
        return np.ascontiguousarray(bgr)
    scale = min(width_px / width, height_px / height)
    inner = max(1, round(scale * width)), max(1, round(scale * height))
    left, top = (width_px - inner[0]) // 2, (height_px - inner[1]) // 2
    whole = np.zeros((height_px, width_px, 3), np.uint8)
    whole[top : top + inner[1], left : left + inner[0]] = cv2.resize(bgr, inner, interpolation=cv2.INTER_AREA)
    return whole
