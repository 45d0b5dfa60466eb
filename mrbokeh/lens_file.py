"""The lens file: a Lens as JSON, so that a lens can be kept, named and passed around."""

from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.aperture import Aperture
from mrbokeh.atomic_files import read_json, write_json
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens

FORMAT = "mrbokeh-lens"
VERSION = 1


def lens_to_json(lens: Lens) -> dict[str, Any]:
    aperture = {"outlines": [np.round(outline, 9).tolist() for outline in lens.aperture.outlines], "weights": list(lens.aperture.weights)}
    focus = None if np.isinf(lens.focus_distance_m) else lens.focus_distance_m
    return {
        "format": FORMAT,
        "version": VERSION,
        "focal_length_mm": lens.focal_length_mm,
        "f_number": lens.f_number,
        "focus_distance_m": focus,
        "sensor_width_mm": lens.sensor_width_mm,
        "aperture": aperture,
    }


def lens_from_json(document: dict[str, Any], where: str = "lens") -> Lens:
    """The lens that `lens_to_json` wrote; a focus_distance_m of null is infinity."""
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{where}: expected a lens with format {FORMAT!r} and version {VERSION}; write one with `mrbokeh lens new`")
    try:
        outlines = tuple(np.asarray(outline, np.float64) for outline in document["aperture"]["outlines"])
        aperture = Aperture(outlines, tuple(float(weight) for weight in document["aperture"]["weights"]))
        focus = document["focus_distance_m"]
        return Lens(
            float(document["focal_length_mm"]),
            float(document["f_number"]),
            float("inf") if focus is None else float(focus),
            float(document["sensor_width_mm"]),
            aperture,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: the lens is incomplete or malformed ({error!r}); compare with one of `mrbokeh lens new`") from None


def read_lens(path: Path | str) -> Lens:
    return lens_from_json(read_json(path, "a lens file (LENS.json)"), str(path))


def write_lens(path: Path | str, lens: Lens) -> None:
    write_json(path, lens_to_json(lens))
