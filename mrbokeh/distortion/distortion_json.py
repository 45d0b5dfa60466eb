"""A LensDistortion as JSON: {"model": "opencv", "k1": -0.1, ...}, values that are 0 left out.

Parameters of COLMAP's camera models as focal lengths, principal point and distortion (src/colmap/sensor/models.h).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mrbokeh.distortion.distortion import HUGIN_UNIT, LensDistortion, read_st_map
from mrbokeh.distortion.models import IN_LENGTHS, PARAMETERS
from mrbokeh.system.atomic_files import read_json
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


def distortion_to_json(distortion: LensDistortion) -> dict[str, Any]:
    """InputError for an ST map that was not read from a file."""
    if distortion.st_map is not None:
        if distortion.st_map.path is None:
            raise InputError(
                "an ST map is written by its file's name, but this one was made in memory: write it as EXR and read it from there"
            )
        return {"model": "st_map", "path": distortion.st_map.path, "kind": distortion.st_map.kind}
    named = zip(PARAMETERS.get(distortion.model, ()), distortion.values, strict=True)
    unit = {"unit_half_diagonals": distortion.unit_half_diagonals} if distortion.model in IN_LENGTHS else {}
    return {"model": distortion.model, **{name: value for name, value in named if value}, **unit}


def distortion_from_json(document: dict[str, Any], where: str = "distortion", folder: Path | str = ".") -> LensDistortion:
    """The inverse of `distortion_to_json`; an ST map's path is relative to `folder`.

    Values without a model are OpenCV's, as camera tracks have them: {"k1": -0.1}.
    COLMAP's names are understood too: {"model": "RADIAL", "values": [k1, k2]}, without focal length and principal point.
    """
    try:
        values = dict(document)
        model = values.pop("model", "opencv") if values else values.pop("model")
        if model == "st_map":
            return LensDistortion.from_st_map(read_st_map(Path(folder) / values["path"], values.get("kind", "distort")))
        if model.isupper():
            return _of_colmap(model, values["values"])
        unit = float(values.pop("unit_half_diagonals", HUGIN_UNIT))
        return LensDistortion.of(model, unit, **{name: float(value) for name, value in values.items()})
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{where}: expected the name of a model and its values as numbers ({error!r})") from None


def read_distortion(path: Path | None) -> LensDistortion:
    """From a JSON file; None bends nothing."""
    if path is None:
        return LensDistortion()
    return distortion_from_json(read_json(path, "a lens distortion (JSON)"), str(path), path.parent)


def _of_colmap(model: str, values: list[float]) -> LensDistortion:
    focals = [1.0] if model.startswith(("SIMPLE", "RADIAL")) else [1.0, 1.0]
    return colmap_distortion(model, [*focals, 0.0, 0.0, *map(float, values)])[2]
