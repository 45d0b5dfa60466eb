"""The camera that a word on the command line stands for."""

from pathlib import Path

from capture.tether.camera_driver import CameraDriver
from capture.tether.focus_plan import FocusPlan
from mrbokeh.system.errors import InputError


def open_named(name: str, plan: FocusPlan, *, timeout_s: float, focus_level: int, reverse_focus: bool) -> CameraDriver:
    """gphoto2, gphoto2:PORT, folder:DIR or simulated."""
    kind, _, rest = name.partition(":")
    if kind == "gphoto2":
        from capture.tether.gphoto2_cameras import open_camera

        return open_camera(rest or None, focus_level=focus_level, reverse_focus=reverse_focus)
    if kind == "folder" and rest:
        from capture.tether.watched_folder import WatchedFolder

        return WatchedFolder(Path(rest), timeout_s=timeout_s)
    if name == "simulated":
        from capture.tether.simulated import SimulatedCamera

        return SimulatedCamera.for_plan(plan)
    raise InputError(f"--camera must be gphoto2, gphoto2:PORT, folder:DIR or simulated, got {name!r}")
