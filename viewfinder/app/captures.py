"""Captures: moments of the viewfinder saved as bundles that `mrbokeh composite` renders at full quality."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.stacks.capture_bundle import write_bundle
from mrbokeh.system.errors import InputError
from viewfinder.app.live_compositor import LiveCompositor, Moment
from viewfinder.flow.frames import Bgr, CameraFrame

_RECENT_S = 0.4  # less than the object takes to fade once the track is lost


class Captures:
    """folder: bundles go there, named by date and time. scene: the file whose text a bundle keeps."""

    def __init__(self, folder: Path, compositor: LiveCompositor, renderer_name: str, scene: Path | None = None) -> None:
        self._folder, self._compositor, self.renderer_name, self._scene = folder, compositor, renderer_name, scene

    def capture(self) -> str:
        """The newest picture with a pose, if it is recent; the name of its bundle. Raises InputError where there is none."""
        moment = self._compositor.last_tracked
        if self._compositor.last is None:
            raise InputError("there is nothing to capture yet: the camera has not given a picture")
        if moment is None or self._compositor.last.frame.captured_s - moment.frame.captured_s > _RECENT_S:
            raise InputError("the camera's pose is not known now, so that the object has no place: show the board, then capture")
        name, bgr = self._free_name(), full_picture(moment.frame)
        camera = moment.camera.resized(bgr.shape[1], bgr.shape[0])
        write_bundle(
            self._folder / name,
            plate_png(bgr, self._compositor.transfer),
            _encoded(".jpg", moment.output.bgr),
            self._compositor.scenery.sharp_layers(camera),
            moment.lens,
            camera,
            self.renderer_name,
            self._facts(moment),
        )
        return name

    def _free_name(self) -> str:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        names = (stamp, *(f"{stamp}-{count}" for count in range(2, 1000)))
        return next(name for name in names if not (self._folder / name).exists())

    def _facts(self, moment: Moment) -> dict[str, Any]:
        status, pose = moment.output.status, moment.pose
        assert pose is not None, "asked before"
        return {
            "captured": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "sequence": moment.frame.sequence,
            "tracking": {"quality": pose.quality, "residual_px": pose.residual_px, "points": pose.points},
            "stages_ms": dict(status.stages_ms),
            "scene": None if self._scene is None else self._scene.read_text(encoding="utf-8"),
        }


def full_picture(frame: CameraFrame) -> UInt8[np.ndarray, "full_height full_width 3"]:
    """As large as the camera gave it."""
    return frame.bgr if frame.full_picture is None else frame.full_picture()


def plate_png(bgr: Bgr, transfer: str) -> bytes:
    """The camera's picture as an sRGB file: its codes as they came where they are sRGB, else their light in 16 bits.

    A bundle then composites in the same light as the stream did, whatever the camera's curve was.
    """
    if transfer == "srgb":
        return _encoded(".png", bgr)
    table = np.rint(65535.0 * linear_to_srgb(code_tables(transfer).linear_from_code)).astype(np.uint16)
    return _encoded(".png", table[bgr])


def _encoded(suffix: str, bgr: Bgr | UInt16[np.ndarray, "height width 3"]) -> bytes:
    import cv2

    return bytes(cv2.imencode(suffix, bgr)[1].tobytes())
