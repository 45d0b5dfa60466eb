"""Results as JPEG for people to look at: pictures, frames of a video side by side, or a page in a browser without a screen."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mrbokeh.color import display_rgb8
from mrbokeh.errors import InputError
from mrbokeh.image_io import LINEAR_SUFFIXES, read_image

WIDEST_PX = 960
_QUALITY = 82
_FRAMES = 3
_VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_STARTS_S, _SETTLES_MS = 60.0, 8000


def result_jpeg(path: Path) -> bytes:
    """An EXR is tone-mapped, of a video three frames stand side by side, anything else is shown as it is."""
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _jpeg(_frames(path))
    if path.suffix.lower() in LINEAR_SUFFIXES:
        return _jpeg(display_rgb8(read_image(path)))
    return _jpeg(display_rgb8(read_image(path), 0.0) if path.suffix.lower() in (".tif", ".tiff") else _as_stored(path))


def page_jpeg(command: list[str], address: str, folder: Path) -> bytes:
    """A page that a command serves, as a browser shows it a few seconds after it was opened."""
    browser = next((found for found in map(shutil.which, _BROWSERS) if found), None)
    if browser is None:
        raise InputError(f"a picture of {address} needs a browser: install one of {', '.join(_BROWSERS)}")
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True) as server:
        try:
            _wait_for_address(server)
            return _jpeg(_screenshot(browser, address))
        finally:
            os.killpg(server.pid, signal.SIGTERM)


def _wait_for_address(server: "subprocess.Popen[str]") -> None:
    """Servers print their address once they answer."""
    end_s = time.monotonic() + _STARTS_S
    assert server.stdout is not None
    for line in server.stdout:
        if "http" in line:
            return
        if time.monotonic() > end_s:
            break
    raise InputError(f"expected `{' '.join(map(str, server.args))}` to print its address within {_STARTS_S:g} s, but it did not")  # type: ignore[arg-type]


def _screenshot(browser: str, address: str) -> UInt8[np.ndarray, "height width 3"]:
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "page.png"
        words = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--window-size=960,600", f"--timeout={_SETTLES_MS}")
        subprocess.run([browser, *words, f"--user-data-dir={folder}", f"--screenshot={picture}", address], capture_output=True, timeout=120)
        if not picture.is_file():
            raise InputError(f"expected {browser} to take a picture of {address}, but it did not")
        return _as_stored(picture)


def _frames(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    from mrbokeh.video_io import read_frames

    frames = [display_rgb8(_smaller(frame.rgb, WIDEST_PX // _FRAMES)) for frame in read_frames(path)]
    return np.concatenate([frames[round(share * (len(frames) - 1))] for share in np.linspace(0.1, 0.9, _FRAMES)], axis=1)


def _as_stored(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    import cv2

    return cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _smaller(rgb: Float32[np.ndarray, "height width 3"], width_px: int) -> Float32[np.ndarray, "new_height new_width 3"]:
    import cv2

    height, width = rgb.shape[:2]
    if width <= width_px:
        return rgb
    return cv2.resize(rgb, (width_px, round(height * width_px / width)), interpolation=cv2.INTER_AREA)


def _jpeg(rgb: UInt8[np.ndarray, "height width 3"]) -> bytes:
    import cv2

    shrink = min(1.0, WIDEST_PX / rgb.shape[1])
    small = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1.0 else rgb
    return cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
