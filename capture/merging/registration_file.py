"""registration.json: how the slices of a stack lie, to be read by people and used again instead of computing it."""

from pathlib import Path
from typing import Any

import numpy as np

from capture.merging.breathing import Breathing
from capture.merging.plane_transforms import Transform
from capture.merging.registration import Registration
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FILE_NAME = "registration.json"
FORMAT = "mrbokeh-registration"
VERSION = 1

_CONVENTION = (
    "reference_from_slice takes (x, y, 1) of a slice to pixels of the reference slice; the first pixel's centre is (0.5, 0.5); "
    "a third row, where the camera has turned, is what both are divided by"
)


def write_registration(path: Path | str, registration: Registration) -> None:
    breathing = registration.breathing
    document = {
        "format": FORMAT,
        "version": VERSION,
        "convention": _CONVENTION,
        "size_px": registration.size_px,
        "reference": registration.reference,
        "reference_from_slice": [transform.tolist() for transform in registration.reference_from_slice],
        "correlations": registration.correlations,
        "residuals_px": registration.residuals_px,
        "camera_moved": registration.camera_moved,
        "breathing": None if breathing is None else vars(breathing),
    }
    write_json(path, document)


def read_registration(path: Path | str, slices: int | None = None, size_px: tuple[int, int] | None = None) -> Registration:
    """Raises InputError where the file is not a registration, or not one of so many slices of that (width, height)."""
    document = read_json(path, "a registration")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{path}: expected format {FORMAT!r} version {VERSION}: delete the file, and merging registers the slices anew")
    try:
        registration = _registration(document)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} is incomplete ({error!r}): delete it, and merging registers the slices anew") from None
    _require_fit(registration, path, slices, size_px)
    return registration


def _registration(document: dict[str, Any]) -> Registration:
    transforms = tuple(_transform(each) for each in document["reference_from_slice"])
    if not 0 <= document["reference"] < len(transforms):
        raise ValueError(f"reference {document['reference']} of {len(transforms)} slices")
    breathing, size_px = document["breathing"], document["size_px"]
    return Registration(
        reference=int(document["reference"]),
        reference_from_slice=transforms,
        correlations=tuple(float(each) for each in document["correlations"]),
        residuals_px=tuple(None if each is None else float(each) for each in document["residuals_px"]),
        size_px=None if size_px is None else (int(size_px[0]), int(size_px[1])),
        breathing=None if breathing is None else Breathing(**breathing | {"scales": tuple(breathing["scales"])}),
        camera_moved=bool(document["camera_moved"]),
    )


def _transform(rows: Any) -> Transform:
    matrix = np.array(rows, np.float64)
    if matrix.shape not in ((2, 3), (3, 3)) or not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix[:2, :2])) > 0:
        raise ValueError(f"{rows} is no transform of 2 or 3 rows and 3 columns")
    return matrix


def _require_fit(registration: Registration, path: Path | str, slices: int | None, size_px: tuple[int, int] | None) -> None:
    count = len(registration.reference_from_slice)
    if slices is not None and slices != count:
        raise InputError(f"{path} registers {count} slices, but the stack has {slices}: give the registration of a stack like this one")
    if size_px is not None and registration.size_px is not None and size_px != registration.size_px:
        expected, given = (" x ".join(map(str, each)) for each in (size_px, registration.size_px))
        raise InputError(
            f"{path} registers slices of {given} px, but the stack has {expected} px: give the registration of a stack like it"
        )
