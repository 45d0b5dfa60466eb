"""Parameters of COLMAP's camera models as focal lengths, principal point and distortion (src/colmap/sensor/models.h)."""

from collections.abc import Sequence

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.distortion.models import PARAMETERS
from mrbokeh.system.errors import InputError

_MODELS: dict[str, tuple[int, str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, "none", ()),
    "PINHOLE": (2, "none", ()),
    "SIMPLE_RADIAL": (1, "opencv", ("k1",)),
    "RADIAL": (1, "opencv", ("k1", "k2")),
    "OPENCV": (2, "opencv", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, "opencv", PARAMETERS["opencv"]),
    "OPENCV_FISHEYE": (2, "fisheye", PARAMETERS["fisheye"]),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", ("k1",)),
    "RADIAL_FISHEYE": (1, "fisheye", ("k1", "k2")),
}
"""How many focal lengths a model has, then ours and the names of its values."""

Pair = tuple[float, float]


def colmap_distortion(model: str, parameters: Sequence[float]) -> tuple[Pair, Pair, LensDistortion]:
    """(focal_px, principal_px, distortion) of a model by COLMAP's name with all its parameters, in COLMAP's order.

    Pixel centres lie at halves in COLMAP as here, so nothing is shifted.
    """
    if model not in _MODELS:
        raise InputError(
            f"expected one of COLMAP's camera models {', '.join(_MODELS)}, got {model!r}: fit the camera again with one of them"
        )
    focals, ours, names = _MODELS[model]
    if len(parameters) != focals + 2 + len(names):
        raise InputError(f"COLMAP's model {model} has {focals + 2 + len(names)} parameters, got {len(parameters)}")
    focal, (cx, cy), rest = parameters[:focals], parameters[focals : focals + 2], parameters[focals + 2 :]
    distortion = LensDistortion.of(ours, **dict(zip(names, map(float, rest), strict=True)))
    return (float(focal[0]), float(focal[-1])), (float(cx), float(cy)), distortion
