"""python-gphoto2 where it is installed, and its error codes in words that help."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from capture.tether.camera_driver import CameraError
from mrbokeh.errors import InputError, MissingExtraError

UNKNOWN_MODEL = -105
_HINTS = {
    -53: "another program holds the camera: close file managers, or on Linux stop gvfs (systemctl --user stop gvfs-gphoto2-volume-monitor)",
    -52: "it is not there any more: switch it on and check the cable",
    -60: "another program holds the camera: close it, or unplug the camera and plug it in again",
    -7: "the connection broke: check the cable and the battery",
    -35: "the connection broke: check the cable and the battery",
    -10: "the camera did not answer in time: wake it up and check the cable",
    -110: "the camera is busy: wait for its light to go out",
}
UDEV_HINT = "on Linux a camera needs permission (udev): install the package libgphoto2-6 or its rules and plug the camera in again"


def library() -> Any:
    """The module gphoto2. Raises MissingExtraError, or InputError on Windows, for which there is none."""
    try:
        import gphoto2
    except ImportError:
        if sys.platform == "win32":
            raise InputError(
                "libgphoto2 does not run on Windows: let the maker's own software store into a folder, and use --camera folder:DIR"
            ) from None
        raise MissingExtraError("gphoto2", "tether") from None
    return gphoto2


@contextmanager
def explained(doing: str) -> Iterator[None]:
    """A block in which libgphoto2's errors become CameraError; `doing` says in words what was tried."""
    gp = library()
    try:
        yield
    except gp.GPhoto2Error as error:
        hint = _HINTS.get(error.code)
        raise CameraError(f"{doing} failed: {error.string or error} ({error.code}){f'; {hint}' if hint else ''}") from None
