"""Choice of the source that a word on the command line stands for."""

from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from mrbokeh.system.errors import InputError, MissingExtraError
from viewfinder.sources.frame_source import UNLIMITED, FrameSource, SizeLimit

_PATTERN_SIZE_PX = (640, 360)
_THROUGH_MEDIAMTX = ("srt", "rtmp", "rtmps")


def open_source(text: str, limit: SizeLimit = UNLIMITED, fps: float | None = None) -> FrameSource:
    """Open `test`, the number of a webcam, the path of a video, a URL, `folder:PATH`, `gphoto2`, `gphoto2:PORT` or `whip`.

    Frames come in the camera's own size, or scaled down with their aspect to the largest size that is given. fps: at most so
    many frames per second, where the source can do that. Raises InputError for anything else and for what is not there.
    """
    if fps is not None and fps <= 0:
        raise InputError(f"--max-rate: expected a positive number of frames per second, got {fps}")
    if text.isdigit():
        from viewfinder.sources.attached_camera import WebcamSource

        return WebcamSource(int(text), limit, fps)
    kind, colon, rest = text.partition(":")
    if text == "test" or kind in ("gphoto2", "whip", "folder"):
        return _named(kind, rest if colon else None, limit, fps)
    if "://" in text:
        return _stream(text, limit)
    if not Path(text).is_file():
        raise InputError(
            "--source: expected a video file, the number of a camera, an rtsp, http or udp URL, folder:PATH, gphoto2, whip or test, "
            f"got {text!r}, which is none of them"
        )
    from viewfinder.sources.playback import VideoFileSource

    return VideoFileSource(Path(text), limit, fps)


def _named(kind: str, rest: str | None, limit: SizeLimit, fps: float | None) -> FrameSource:
    if kind == "test":
        from viewfinder.sources.playback import DEFAULT_FPS, PatternSource

        return PatternSource(limit.width_px or _PATTERN_SIZE_PX[0], limit.height_px or _PATTERN_SIZE_PX[1], fps or DEFAULT_FPS)
    if kind == "gphoto2":
        from viewfinder.sources.attached_camera import Gphoto2PreviewSource

        return Gphoto2PreviewSource(rest or None, limit)
    if kind == "folder":
        from viewfinder.sources.playback import REPEATED_FPS, WatchedFolderSource

        if not rest:
            raise InputError("--source folder: expected the folder after the colon, as in folder:/home/me/tethered")
        return WatchedFolderSource(Path(rest), limit, fps or REPEATED_FPS)
    if rest is not None:
        raise InputError(f"--source: expected the word whip alone, got whip:{rest}; the camera's address is shown when the server runs")
    if find_spec("aiortc") is None:
        raise MissingExtraError("aiortc", "viewfinder")
    from viewfinder.sources.browser_camera import BrowserCameraSource

    return BrowserCameraSource(limit)


def _stream(url: str, limit: SizeLimit) -> FrameSource:
    from viewfinder.sources.playback import SCHEMES, NetworkStreamSource

    scheme = urlsplit(url).scheme.lower()
    if scheme in _THROUGH_MEDIAMTX:
        raise InputError(
            f"--source: {scheme} is not read directly: send it to MediaMTX (https://mediamtx.org), and give rtsp://127.0.0.1:8554/NAME here"
        )
    if scheme not in SCHEMES:
        raise InputError(f"--source: expected a URL of {', '.join(SCHEMES)}, got {url!r}")
    return NetworkStreamSource(url, limit)
