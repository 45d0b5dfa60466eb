"""Which cameras libgphoto2 finds, and opening one of them."""

from dataclasses import dataclass

from capture.tether.camera_driver import CameraDescription, CameraError
from capture.tether.gphoto2_camera import Gphoto2Camera
from capture.tether.gphoto2_library import UDEV_HINT, explained, library
from mrbokeh.errors import InputError

NOTHING_FOUND = (
    "no camera found: connect it by USB, switch it on, wake it up and, where its menu asks, choose PTP or PC remote (not mass storage). "
    f"No other program may hold it; {UDEV_HINT}"
)


@dataclass(frozen=True)
class FoundCamera:
    """A camera as libgphoto2 lists it. description: None where it could not be opened, which `problem` explains."""

    model: str
    port: str
    description: CameraDescription | None = None
    problem: str = ""


def detected() -> list[tuple[str, str]]:
    """(model, port) of everything connected."""
    gp = library()
    with explained("looking for cameras"):
        found = gp.Camera.autodetect()
        return [(found.get_name(index), found.get_value(index)) for index in range(found.count())]


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
    gp, found = library(), detected()
    chosen = [each for each in found if port is None or each[1] == port]
    if not chosen:
        raise CameraError(NOTHING_FOUND if port is None or not found else f"no camera at {port}, only at {_listed(found)}")
    if len(chosen) > 1:
        raise InputError(f"several cameras are connected ({_listed(found)}): choose one with --camera gphoto2:PORT")
    with explained(f"opening {chosen[0][0]} at {chosen[0][1]}"):
        camera = gp.Camera()
        ports = gp.PortInfoList()
        ports.load()
        camera.set_port_info(ports.get_info(ports.lookup_path(chosen[0][1])))
        camera.init()
        return Gphoto2Camera(camera, chosen[0][1], focus_level=focus_level, reverse_focus=reverse_focus)


def _listed(found: list[tuple[str, str]]) -> str:
    return ", ".join(f"{model} at {port}" for model, port in found)
