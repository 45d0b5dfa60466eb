"""DepthSettings: what the user states of a depth map that does not say it itself, and its parsing from the command line."""

from dataclasses import dataclass

from mrbokeh.system.errors import InputError

GIVES = ("inverse", "metric")
"""What a depth network can give: numbers that grow with 1 / depth up to scale and offset, or metres."""


@dataclass(frozen=True)
class KnownDistance:
    """Somebody measured it: what is seen at a pixel of the photograph is that far away."""

    x_px: float
    y_px: float
    depth_m: float


@dataclass(frozen=True)
class StereoCalibration:
    """depth = focal_px * baseline_m / (disparity + offset_px); the offset is the difference of the principal points (doffs)."""

    focal_px: float
    baseline_m: float
    offset_px: float = 0.0


@dataclass(frozen=True)
class DepthSettings:
    """near_far_m: what the largest and the smallest number of a map linear in dioptres mean; inf is allowed for the far one.

    metres_per_unit: an integer file holds depth, 0 is unknown. stereo: of a disparity file. model_gives, known: of a network.
    refined: soft edges are sharpened along the photograph; None: where the source is known to be soft.
    """

    near_far_m: tuple[float, float] | None = None
    metres_per_unit: float | None = None
    stereo: StereoCalibration | None = None
    model_gives: str = "inverse"
    known: tuple[KnownDistance, ...] = ()
    refined: bool | None = None

    def __post_init__(self) -> None:
        if self.near_far_m is not None and not 0 < self.near_far_m[0] < self.near_far_m[1]:
            raise InputError(f"expected the nearest and the farthest distance in metres, 0 < NEAR < FAR, got {self.near_far_m}")
        if self.metres_per_unit is not None and not self.metres_per_unit > 0:
            raise InputError(f"expected how many metres one step of the depth file means, above 0, got {self.metres_per_unit}")
        if self.model_gives not in GIVES:
            raise InputError(f"expected a depth network to give 'inverse' or 'metric' depth, got {self.model_gives!r}")


def parse_near_far(text: str) -> tuple[float, float]:
    """NEAR:FAR in metres, such as 0.5:inf."""
    near, far = _numbers(text, ":", 2, "NEAR:FAR in metres, such as 0.5:8 or 0.5:inf")
    return near, far


def parse_stereo(text: str) -> StereoCalibration:
    """FOCAL_PX,BASELINE_M or FOCAL_PX,BASELINE_M,OFFSET_PX."""
    count = 3 if text.count(",") == 2 else 2
    return StereoCalibration(*_numbers(text, ",", count, "FOCAL_PX,BASELINE_M or FOCAL_PX,BASELINE_M,OFFSET_PX"))


def parse_known(text: str) -> KnownDistance:
    """X,Y,METRES."""
    known = KnownDistance(*_numbers(text, ",", 3, "X,Y,METRES of a pixel whose distance is known"))
    if not known.depth_m > 0:
        raise InputError(f"expected a known distance above 0 m, got {text!r}")
    return known


def _numbers(text: str, separator: str, count: int, expected: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(each) for each in text.split(separator))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise InputError(f"expected {expected}, got {text!r}")
    return numbers
