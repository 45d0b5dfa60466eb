"""A camera on a cable through libgphoto2."""

import time
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any, TypeVar

import cv2
import numpy as np

from capture.photos.raw import RAW_SUFFIXES
from capture.tether.camera_driver import Ability, CameraDescription, CameraError, CameraSettings, Preview, Shot
from capture.tether.focus_steps import Stop
from capture.tether.gphoto2_config import CameraConfig
from capture.tether.gphoto2_errors import explained
from capture.tether.gphoto2_focus import BUSY, FocusDrive, focus_drive
from capture.tether.gphoto2_settings import FILE_FORMATS, configure, is_raw_only
from mrbokeh.system.gphoto2_library import library

_LIVE_VIEW_SWITCH = ("viewfinder", "eosviewfinder")
_LIVE_VIEW_SIGNS = (*_LIVE_VIEW_SWITCH, "liveviewsize", "liveviewimagequality", "evfmode")
_MOST_ATTEMPTS = 20
_EVENT_WAIT_MS = 200
_MOST_EVENTS = 50
Answer = TypeVar("Answer")


class Gphoto2Camera:
    """A CameraDriver. camera: a gphoto2.Camera, already initialised; focus_level and reverse_focus: see gphoto2_focus."""

    def __init__(
        self, camera: Any, port: str, *, focus_level: int = 1, reverse_focus: bool = False, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._gp, self._camera, self._port, self._sleep = library(), camera, port, sleep
        self._config = CameraConfig(camera)
        self._drive: FocusDrive | None = focus_drive(self._config, level=focus_level, reverse=reverse_focus, sleep=sleep)
        self._steps: int | None = None
        self._live = False

    def describe(self) -> CameraDescription:
        with explained("asking the camera what it can do"):
            table = self._camera.get_abilities()
        can = {
            Ability.shutter: bool(table.operations & self._gp.GP_OPERATION_CAPTURE_IMAGE),
            Ability.focus_drive: self._drive is not None,
            Ability.live_view: bool(table.operations & self._gp.GP_OPERATION_CAPTURE_PREVIEW)
            and self._config.first(_LIVE_VIEW_SIGNS) is not None,
            Ability.raw: any(is_raw_only(each) for name in FILE_FORMATS for each in self._config.choices(name)),
        }
        return CameraDescription(str(table.model), self._port, frozenset(each for each, has in can.items() if has))

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        return configure(self._config, settings)

    def preview(self) -> Preview:
        self._switch_live_view(True)
        file = self._patiently("the live view", self._camera.capture_preview)
        pixels = cv2.imdecode(np.frombuffer(_bytes_of(file), np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise CameraError("the live view sent something that is no JPEG")
        return np.ascontiguousarray(pixels[..., ::-1])

    def focus_step(self, steps: int) -> None:
        self._require_drive().step(steps)
        self._steps = None if self._steps is None else self._steps + steps

    def home(self, stop: Stop) -> None:
        self._steps = None
        self._require_drive().home(stop)
        self._steps = 0

    def capture(self) -> Shot:
        """The RAW, where one shot makes several files. They stay on the card, if they go there at all."""
        self._switch_live_view(False)
        path = self._patiently("taking a photograph", lambda: self._camera.capture(self._gp.GP_CAPTURE_IMAGE))
        found = [(path.folder, path.name), *self._files_added()]
        folder, name = next((each for each in found if PurePosixPath(each[1]).suffix.lower() in RAW_SUFFIXES), found[0])
        return Shot(self.download(folder, name), name, self._steps)

    def download(self, folder: str, name: str) -> bytes:
        """A whole file of the camera."""
        file = self._patiently(f"copying {name}", lambda: self._camera.file_get(folder, name, self._gp.GP_FILE_TYPE_NORMAL))
        return _bytes_of(file)

    def close(self) -> None:
        """Live view off, mirror down; a camera that is gone already does not matter."""
        try:
            self._switch_live_view(False)
            self._camera.exit()
        except (CameraError, self._gp.GPhoto2Error):
            pass

    def _require_drive(self) -> FocusDrive:
        if self._drive is None:
            raise CameraError("this camera's focus cannot be driven over the cable: turn the ring by hand (--by-hand)")
        self._switch_live_view(True)
        return self._drive

    def _switch_live_view(self, on: bool) -> None:
        """Motors and frames need it; long transfers do not go well with it."""
        name = self._config.first(_LIVE_VIEW_SWITCH)
        if name is not None and on != self._live:
            self._config.set(name, 1 if on else 0)
        self._live = on

    def _files_added(self) -> list[tuple[str, str]]:
        found = []
        for _ in range(_MOST_EVENTS):
            with explained("waiting for the camera"):
                kind, data = self._camera.wait_for_event(_EVENT_WAIT_MS)
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                found.append((data.folder, data.name))
            elif kind in (self._gp.GP_EVENT_TIMEOUT, self._gp.GP_EVENT_CAPTURE_COMPLETE):
                break
        return found

    def _patiently(self, doing: str, ask: Callable[[], Answer]) -> Answer:
        """Again while the camera is busy, as it is right after a move or a shot."""
        for attempt in range(_MOST_ATTEMPTS):
            with explained(doing):
                try:
                    return ask()
                except self._gp.GPhoto2Error as error:
                    if error.code != BUSY or attempt == _MOST_ATTEMPTS - 1:
                        raise
            self._sleep(0.25)
        raise AssertionError("unreachable")


def _bytes_of(file: Any) -> bytes:
    return bytes(memoryview(file.get_data_and_size()))
