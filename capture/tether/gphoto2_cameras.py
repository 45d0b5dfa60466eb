"""Which cameras libgphoto2 finds, and opening one of them."""

from dataclasses import dataclass

from capture.tether.camera_driver import CameraDescription, CameraError
from capture.tether.gphoto2_camera import Gphoto2Camera
from capture.tether.gphoto2_errors import explained
from mrbokeh.system import gphoto2_library
from mrbokeh.system.gphoto2_library import NoCameraError, chosen_of, opened


@dataclass(frozen=True)
class FoundCamera:
    """A camera as libgphoto2 lists it. description: None where it could not be opened, which `problem` explains."""

    model: str
    port: str
    description: CameraDescription | None = None
    problem: str = ""


def detected() -> list[tuple[str, str]]:
    """(model, port) of everything connected."""
    with explained("looking for cameras"):
        return gphoto2_library.detected()


def list_cameras() -> list[FoundCamera]:
    """Every camera with what it can do; each is opened and let go again."""
    cameras = []
    for model, port in detected():
        try:
            camera = open_camera(port)
        except CameraError as error:
            cameras.append(FoundCamera(model, port, problem=str(error)))
            continue
        try:
            cameras.append(FoundCamera(model, port, camera.describe()))
        finally:
            camera.close()
    return cameras


def open_camera(port: str | None = None, *, focus_level: int = 1, reverse_focus: bool = False) -> Gphoto2Camera:
    """The only camera, or the one at a port such as usb:001,005. Raises CameraError where there is none, InputError where many."""
    try:
        model, at = chosen_of(detected(), port, "--camera")
    except NoCameraError as error:
        raise CameraError(str(error)) from None
    with explained(f"opening {model} at {at}"):
        return Gphoto2Camera(opened(at), at, focus_level=focus_level, reverse_focus=reverse_focus)
