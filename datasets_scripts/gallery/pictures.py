"""Results as JPEG for people to look at: pictures, frames of a video side by side, or a page in a browser without a screen."""

import asyncio
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from datasets_scripts.gallery.headless_chromium import CHROMIUM, chromium_page
from mrbokeh.images.color import display_rgb8
from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_image
from mrbokeh.system.errors import InputError

WIDEST_PX = 960
_QUALITY = 82
_TALLEST = 0.9
"""Share of the width: sheets go on below."""
_FRAMES = 3
_VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv")
_WINDOW_PX = (960, 640)
_STARTS_S, _SETTLES_S = 60.0, 8.0
_STEADY = r"(text => !text.includes('tracking') || /tracking (8\d|9\d|100) %/.test(text))(document.body.innerText)"
"""A clip that is played in a loop is tracked anew where it begins, and things fade in."""


def result_jpeg(*paths: Path) -> bytes:
    """Return pictures side by side. An EXR is tone-mapped, of a video three frames are shown, of a long sheet its upper part."""
    pictures = [_shown(path) for path in paths]
    height_px = min(picture.shape[0] for picture in pictures)
    return _jpeg(np.concatenate([_resized(picture, height_px) for picture in pictures], axis=1))


def _shown(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        return _frames(path)
    if path.suffix.lower() in LINEAR_SUFFIXES:
        return display_rgb8(read_image(path))
    stored = display_rgb8(read_image(path), 0.0) if path.suffix.lower() in (".tif", ".tiff") else _as_stored(path)
    return stored[: round(_TALLEST * stored.shape[1])]


def _resized(rgb: UInt8[np.ndarray, "height width 3"], height_px: int) -> UInt8[np.ndarray, "height_px new_width 3"]:
    import cv2

    share = height_px / rgb.shape[0]
    return rgb if share == 1.0 else cv2.resize(rgb, (round(rgb.shape[1] * share), height_px), interpolation=cv2.INTER_AREA)


def page_jpeg(command: list[str], address: str, folder: Path) -> bytes:
    """Return a page that a command serves, as a browser shows it a few seconds after it was opened."""
    if CHROMIUM is None:
        raise InputError(f"a picture of {address} needs a browser: install Chromium (`apt-get install chromium`)")
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True) as server:
        try:
            _wait_for_address(server)
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
                return _jpeg(asyncio.run(_screenshot(address, Path(profile))))
        finally:
            os.killpg(server.pid, signal.SIGTERM)


def _wait_for_address(server: "subprocess.Popen[str]") -> None:
    """Wait until the server prints its address, which it does once it answers."""
    end_s = time.monotonic() + _STARTS_S
    assert server.stdout is not None
    for line in server.stdout:
        if "http" in line:
            return
        if time.monotonic() > end_s:
            break
    raise InputError(f"expected `{' '.join(map(str, server.args))}` to print its address within {_STARTS_S:g} s, but it did not")  # type: ignore[arg-type]


async def _screenshot(address: str, profile: Path) -> UInt8[np.ndarray, "height width 3"]:
    async with chromium_page(address, profile, size_px=_WINDOW_PX) as page:
        await asyncio.sleep(_SETTLES_S)
        await page.comes_true(_STEADY)
        return await page.screenshot()


def _frames(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    from mrbokeh.video.clip import read_frames

    frames = [display_rgb8(_smaller(frame.rgb, WIDEST_PX // _FRAMES)) for frame in read_frames(path)]
    return np.concatenate([frames[round(share * (len(frames) - 1))] for share in np.linspace(0.1, 0.9, _FRAMES)], axis=1)


def _as_stored(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    import cv2

    stored = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if stored is None:
        raise InputError(f"expected a picture in {path}, but there is none: see `shows` of its example in docs/examples.md")
    return cv2.cvtColor(stored, cv2.COLOR_BGR2RGB)


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
