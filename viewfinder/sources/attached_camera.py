"""Cameras at this computer: a UVC webcam through OpenCV, and the live view of a DSLR or mirrorless camera through libgphoto2.

A tethered camera tells what it knows of its lens, by libgphoto2's names.
"""

import itertools
import re
import sys
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from mrbokeh.system.errors import InputError
from mrbokeh.system.gphoto2_library import NoCameraError, chosen_of, detected, explanation, library, opened
from viewfinder.frames import UNKNOWN_LENS, Bgr, CameraFrame, LensState
from viewfinder.sources.frame_source import UNLIMITED, CameraAwayError, SizeLimit, reconnecting


class WebcamSource:
    """FrameSource of a webcam (any camera that OpenCV opens by number); one that is pulled out is waited for.

    limit: asked of the camera; what it gives in place of that is scaled down with its aspect.
    open_camera: gives an open cv2.VideoCapture. Raises InputError where there is no such camera at the start.
    """

    transfer = "srgb"

    def __init__(
        self,
        index: int,
        limit: SizeLimit = UNLIMITED,
        fps: float | None = None,
        *,
        open_camera: Callable[[int], Any] | None = None,
    ) -> None:
        self.name = f"camera {index}"
        self.status: str | None = None
        self._index, self._fps, self._limit = index, fps, limit
        self._open_camera = open_camera or _open_by_number
        self._opened: Any = self._open()
        if self._opened is None:
            raise InputError(f"camera {index} cannot be opened: it is not plugged in, in use, or not allowed for this program")

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        sequence = itertools.count()
        return reconnecting(lambda: self._session(sequence, stopping), stopping, self._tell)

    def _tell(self, sentence: str | None) -> None:
        self.status = sentence

    def _session(self, sequence: Iterator[int], stopping: Event) -> Generator[CameraFrame, None, None]:
        camera, self._opened = self._opened or self._open(), None
        if camera is None:
            raise CameraAwayError(f"{self.name} is unplugged or in use: waiting for it")
        try:
            while not stopping.is_set():
                there, bgr = camera.read()
                captured_s = time.monotonic()
                if not there:
                    raise CameraAwayError(f"{self.name} stopped giving pictures: plug it in again")
                yield CameraFrame(self._limit.applied(bgr), captured_s, next(sequence), full_picture=bgr.copy)
        finally:
            camera.release()

    def _open(self) -> Any:
        """Return an open camera, set to what is wanted; None where it is not there."""
        import cv2

        camera = self._open_camera(self._index)
        if camera is None or not camera.isOpened():
            return None
        wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: self._limit.width_px,
            cv2.CAP_PROP_FRAME_HEIGHT: self._limit.height_px,
            cv2.CAP_PROP_FPS: self._fps,
        }
        for key, value in {**wanted, cv2.CAP_PROP_BUFFERSIZE: 1}.items():
            if value is not None:
                camera.set(key, value)
        return camera


def _open_by_number(index: int) -> Any:
    import cv2

    # Asking OpenCV for what is not there prints warnings, each time anew.
    if sys.platform.startswith("linux") and not Path(f"/dev/video{index}").exists():
        return None
    return cv2.VideoCapture(index)


_F_NUMBER = ("f-number", "aperture")
# Properties of PTP itself (PIMA 15740, 13.3.8 and 13.3.9), which libgphoto2 lists by number: 1/100 mm, and mm with all ones beyond.
_FOCAL_LENGTH, _FOCUS_DISTANCE, _BEYOND = "5008", "5009", 0xFFFF


def lens_state(camera: Any) -> LensState:
    """Ask a camera for its lens.

    camera: an initialised gphoto2.Camera. Most cameras tell the f-number; few the rest.

    PTP does not say where the distance counts from; it is taken as it is.
    """
    f_number = next((number for name in _F_NUMBER if (number := _number(camera, name)) is not None), None)
    hundredths, distance_mm = _number(camera, _FOCAL_LENGTH), _number(camera, _FOCUS_DISTANCE)
    if distance_mm is not None:
        distance_mm = float("inf") if distance_mm >= _BEYOND else distance_mm / 1000
    return LensState(distance_mm, f_number, None if hundredths is None else hundredths / 100)


def _number(camera: Any, name: str) -> float | None:
    """Return the number above 0 in a setting such as "f/5.6"; None where the camera has no such setting or it says a word."""
    gp = library()
    try:
        text = str(camera.get_single_config(name).get_value())
    except gp.GPhoto2Error as error:
        if error.code in (gp.GP_ERROR_BAD_PARAMETERS, gp.GP_ERROR_NOT_SUPPORTED):
            return None
        raise
    found = re.search(r"\d+(?:\.\d+)?", text)
    return (float(found[0]) or None) if found else None


_LENS_EVERY_S = 1.0
_BUSY, _BUSY_WAIT_S, _MOST_BUSY = -110, 0.1, 30
_LIVE_VIEW_SWITCH = ("viewfinder", "eosviewfinder")


class Gphoto2PreviewSource:
    """FrameSource. port: such as usb:001,005, or None for the only camera. A camera that is switched off is waited for.

    limit: larger pictures are scaled down with their aspect. open_camera: gives an initialised gphoto2.Camera.
    Frames carry what the camera tells of its lens. Raises InputError where there is no camera at the start, or no live view.
    """

    transfer = "srgb"

    def __init__(
        self,
        port: str | None = None,
        limit: SizeLimit = UNLIMITED,
        *,
        open_camera: Callable[[str | None], Any] | None = None,
    ) -> None:
        self.name = "gphoto2 camera" if port is None else f"gphoto2 camera at {port}"
        self.status: str | None = None
        self._port, self._limit = port, limit
        self._open_camera = open_camera or _open_on_cable
        try:
            self._opened: Any = self._open_camera(port)
        except CameraAwayError as error:
            raise InputError(str(error)) from None

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        sequence = itertools.count()
        return reconnecting(lambda: self._session(sequence, stopping), stopping, self._tell)

    def _tell(self, sentence: str | None) -> None:
        self.status = sentence

    def _session(self, sequence: Iterator[int], stopping: Event) -> Generator[CameraFrame, None, None]:
        gp = library()
        camera, self._opened = self._opened or self._open_camera(self._port), None
        try:
            _switch_live_view(camera, 1)
            lens, read_s = UNKNOWN_LENS, -_LENS_EVERY_S
            while not stopping.is_set():
                bgr, captured_s = self._preview(camera, stopping), time.monotonic()
                if captured_s - read_s > _LENS_EVERY_S:
                    lens, read_s = lens_state(camera), captured_s
                yield CameraFrame(self._limit.applied(bgr), captured_s, next(sequence), lens, full_picture=bgr.copy)
        except gp.GPhoto2Error as error:
            if error.code == gp.GP_ERROR_NOT_SUPPORTED:
                raise InputError(f"{self.name} gives no live view over the cable: use its HDMI output with a capture card") from None
            raise CameraAwayError(f"{self.name} is away: {explanation(error)}") from None
        finally:
            # A camera that is gone already does not matter.
            with suppress(gp.GPhoto2Error):
                _switch_live_view(camera, 0)
            with suppress(gp.GPhoto2Error):
                camera.exit()

    def _preview(self, camera: Any, stopping: Event) -> Bgr:
        """Return the next picture; asked for again while the camera is busy, as it is while the mirror goes up."""
        import cv2

        gp = library()
        for attempt in itertools.count():
            try:
                data = np.frombuffer(bytes(memoryview(camera.capture_preview().get_data_and_size())), np.uint8)
            except gp.GPhoto2Error as error:
                if error.code != _BUSY or attempt >= _MOST_BUSY:
                    raise
                stopping.wait(_BUSY_WAIT_S)
                continue
            bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
            if bgr is not None:
                return bgr
            if attempt >= _MOST_BUSY or stopping.wait(_BUSY_WAIT_S):
                break
        raise CameraAwayError(f"{self.name} sends something that is no JPEG: switch it off and on")


def _switch_live_view(camera: Any, on: int) -> None:
    gp = library()
    for name in _LIVE_VIEW_SWITCH:
        with suppress(gp.GPhoto2Error):
            widget = camera.get_single_config(name)
            widget.set_value(on)
            camera.set_single_config(name, widget)
            return


def _open_on_cable(port: str | None) -> Any:
    """Open the only camera, or the one at that port. Raises CameraAwayError where there is none."""
    gp = library()
    try:
        return opened(chosen_of(detected(), port, "--source")[1])
    except NoCameraError as error:
        raise CameraAwayError(str(error)) from None
    except gp.GPhoto2Error as error:
        raise CameraAwayError(f"the camera cannot be opened: {explanation(error)}") from None
