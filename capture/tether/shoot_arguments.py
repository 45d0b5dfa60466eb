"""Parsing of the arguments of `mrbokeh capture shoot`, and the camera that its --camera names."""

from fractions import Fraction
from pathlib import Path

from capture.tether.camera_driver import CameraDriver, FocusSteps, Stop
from capture.tether.focus_motor import Target
from capture.tether.focus_plan import FocusPlan
from capture.tether.live_view import Spot
from mrbokeh.system.errors import InputError


def steps_between(plan: FocusPlan, near_steps: int | None, far_steps: int | None, home: str) -> FocusSteps | None:
    """Return the scale given by --near-steps and --far-steps for the plan's range, None without them."""
    if near_steps is None and far_steps is None:
        return None
    if near_steps is None or far_steps is None:
        raise InputError("--near-steps and --far-steps belong together: two places give the scale")
    points = ((float(near_steps), 1.0 / plan.range.near_m), (float(far_steps), 1.0 / plan.range.far_m))
    return FocusSteps(parse_stop(home), tuple(sorted(points)))


def parse_stop(text: str) -> Stop:
    if text not in list(Stop):
        raise InputError(f"--home must be one of {', '.join(Stop)}, got {text!r}")
    return Stop(text)


def parse_seconds(text: str | None) -> float | None:
    """Parse "1/60" or "0.5"."""
    try:
        seconds = None if text is None else float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        seconds = 0.0
    if seconds is not None and not seconds > 0.0:
        raise InputError(f"--exposure-time must be seconds such as 1/60 or 0.5, got {text!r}")
    return seconds


def parse_spot(text: str | None) -> Spot | None:
    """Parse "X,Y" in fractions of width and height."""
    if text is None:
        return None
    try:
        x, y = (float(each) for each in text.split(","))
    except ValueError:
        raise InputError(f"a place in the picture must be X,Y from 0 to 1, such as 0.5,0.5, got {text!r}") from None
    return Spot(x, y)


def parse_target(text: str) -> Target:
    """Parse "X,Y=METRES"."""
    place, equals, distance = text.partition("=")
    spot = parse_spot(place)
    try:
        distance_m = float(distance)
    except ValueError:
        distance_m = 0.0
    if spot is None or not equals or not distance_m > 0.0:
        raise InputError(f"--target must be X,Y=METRES, such as 0.3,0.5=0.6, got {text!r}")
    return Target(spot, distance_m)


def open_named(name: str, plan: FocusPlan, *, timeout_s: float, focus_level: int, reverse_focus: bool) -> CameraDriver:
    """Open gphoto2, gphoto2:PORT, folder:DIR or simulated."""
    kind, _, rest = name.partition(":")
    if kind == "gphoto2":
        from capture.tether.gphoto2_camera import open_camera

        return open_camera(rest or None, focus_level=focus_level, reverse_focus=reverse_focus)
    if kind == "folder" and rest:
        from capture.tether.watched_folder import WatchedFolder

        return WatchedFolder(Path(rest), timeout_s=timeout_s)
    if name == "simulated":
        from capture.tether.simulated_camera import SimulatedCamera

        return SimulatedCamera.for_plan(plan)
    raise InputError(f"--camera must be gphoto2, gphoto2:PORT, folder:DIR or simulated, got {name!r}")
