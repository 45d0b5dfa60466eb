"""VirtualWebcam: the finished pictures as a camera that OBS, Zoom and browsers can choose, through pyvirtualcam.

On Linux the device is one of v4l2loopback (`sudo modprobe v4l2loopback`), on Windows and macOS the one that OBS installs.
"""

import logging
from importlib import import_module
from threading import Event, Thread
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from mrbokeh.system.errors import InputError
from viewfinder.frames import Bgr, Newest, OutputFrame

ANY_DEVICE = "auto"
_FPS = 30.0
_PROBED_PX = (640, 360)
_POLL_S = 0.1
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
