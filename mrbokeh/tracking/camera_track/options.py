"""What a file of cameras does not say of itself, and what it cannot hold."""

from collections.abc import Callable, Container
from dataclasses import dataclass

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.camera_track.tracked_frame import TrackedFrame
from mrbokeh.tracking.upright import UPRIGHT_FROM_WORLD

ROTATION_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


@dataclass(frozen=True)
class TrackOptions:
    """None leaves it to the format.

    up: axis of the file's world that points up. size_px: (width, height) of the pictures. rotation_order: of a .chan, first
      rotation first. sensor_width_mm: of OpenTrackIO samples that do not tell it. metric: whether its lengths are metres.
    keep_distortion: False drops a lens distortion, which would else be an error where it cannot be read.
    """

    up: str | None = None
    size_px: tuple[int, int] | None = None
    rotation_order: str = "ZXY"
    sensor_width_mm: float | None = None
    metric: bool | None = None
    keep_distortion: bool = True

    def __post_init__(self) -> None:
        for name, value, choices in (("rotation-order", self.rotation_order, ROTATION_ORDERS), ("up", self.up, tuple(UPRIGHT_FROM_WORLD))):
            if value is not None and value not in choices:
                raise InputError(f"--{name} must be one of {', '.join(choices)}, got {value!r}")

    def is_metric(self, usual: bool) -> bool:
        return usual if self.metric is None else self.metric


_FACTS: dict[str, Callable[[TrackedFrame], bool]] = {
    "focus distances": lambda each: each.focus_distance_m is not None,
    "f-numbers": lambda each: each.f_number is not None,
    "times": lambda each: each.time_s is not None,
    "lens distortion": lambda each: bool(each.coefficients),
    "principal points off the middle": lambda each: not _centred(each),
    "pixels that are not square": lambda each: abs(each.camera.focal_px[0] / each.camera.focal_px[1] - 1.0) > 1e-9,
}


def lost(track: CameraTrack, kept: Container[str] = ()) -> tuple[str, ...]:
    """What the track tells and a file that holds only `kept` does not."""
    told = [name for name, knows in _FACTS.items() if any(knows(each) for each in track.frames.values())]
    return tuple(name for name in told if name not in kept)


def _centred(each: TrackedFrame) -> bool:
    middle = each.camera.width_px / 2.0, each.camera.height_px / 2.0
    return max(abs(a - b) for a, b in zip(each.camera.principal_px, middle, strict=True)) < 1e-9
