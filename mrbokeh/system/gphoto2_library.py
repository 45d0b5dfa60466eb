"""python-gphoto2 where it is installed: the cameras that it finds, opening one, and its error codes in words that help.

The only module that imports it, and only when it is asked for. Methods of its objects raise `library().GPhoto2Error`.
"""

import sys
from typing import Any

from mrbokeh.system.errors import InputError, MissingExtraError

_HINTS = {
    -53: "another program holds the camera: close file managers, or on Linux stop gvfs (systemctl --user stop gvfs-gphoto2-volume-monitor)",
    -52: "it is not there any more: switch it on and check the cable",
    -60: "another program holds the camera: close it, or unplug the camera and plug it in again",
    -7: "the connection broke: check the cable and the battery",
    -34: "the connection broke: check the cable and the battery",
    -35: "the connection broke: check the cable and the battery",
    -10: "the camera did not answer in time: wake it up and check the cable",
    -110: "the camera is busy: wait for its light to go out",
}
NOTHING_FOUND = (
    "no camera found: connect it by USB, switch it on, wake it up and, where its menu asks, choose PTP or PC remote (not mass storage). "
    "No other program may hold it; on Linux a camera needs permission (udev): install the package libgphoto2-6 or its rules and plug "
    "the camera in again"
)


class NoCameraError(InputError):
    """The camera asked for is not connected, or not switched on."""


def library() -> Any:
    """The module gphoto2. Raises MissingExtraError, or InputError on Windows, for which there is none."""
    try:
        import gphoto2
    except ImportError:
        if sys.platform == "win32":
            raise InputError(
                "libgphoto2 does not run on Windows: let the maker's own software store into a folder, and name it as folder:DIR"
            ) from None
        raise MissingExtraError("gphoto2", "tether") from None
    return gphoto2


def explanation(error: Any) -> str:
    """Return what a GPhoto2Error says, its code, and what to do about it if that is known."""
    hint = _HINTS.get(error.code)
    return f"{error.string or error} ({error.code}){f'; {hint}' if hint else ''}"


def detected() -> list[tuple[str, str]]:
    """Return (model, port) of every connected camera; a port looks like usb:001,005."""
    found = library().Camera.autodetect()
    return [(found.get_name(index), found.get_value(index)) for index in range(found.count())]


def chosen_of(found: list[tuple[str, str]], port: str | None, option: str) -> tuple[str, str]:
    """Return (model, port) of the only camera, or of the one at `port`.

    option: by which the user chooses, such as --camera.
    """
    listed = ", ".join(f"{model} at {at}" for model, at in found)
    chosen = [each for each in found if port is None or each[1] == port]
    if not chosen:
        raise NoCameraError(NOTHING_FOUND if port is None or not found else f"no camera at {port}, only at {listed}")
    if len(chosen) > 1:
        raise InputError(f"several cameras are connected ({listed}): choose one with {option} gphoto2:PORT")
    return chosen[0]


def opened(port: str) -> Any:
    """An initialised gphoto2.Camera; whoever opens it calls its `exit`."""
    gp = library()
    camera, ports = gp.Camera(), gp.PortInfoList()
    ports.load()
    camera.set_port_info(ports.get_info(ports.lookup_path(port)))
    camera.init()
    return camera
