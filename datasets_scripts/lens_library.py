"""Describe the lenses of the library by their prescriptions again: fills in the lens files of mrbokeh/lens_data and prints their table.

    python -m datasets_scripts.lens_library [NAME ...]
    python -m datasets_scripts.lens_library --sheet docs/pictures/lens_library.jpg

Only "prescription" of a file is written by hand; all else comes from there (`mrbokeh.psf_models.lens_description`). The error is
measured at places of the field and depths that the fit has not seen.
"""

import json
import sys
from typing import Any

import cv2
import numpy as np

from mrbokeh.images.color import srgb_codes
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json, read_lens
from mrbokeh.optics.lens_library import FOLDER, names
from mrbokeh.psf_models.lens_description import Bench, describe, held_out_error
from mrbokeh.psf_models.lens_prescription import LensPrescription
from mrbokeh.psf_models.physical_lens import read_prescription

SENSOR_MM = (36.0, 24.0)


def main() -> None:
    """Describe the lenses of the names given, or all; or draw the sheet of their blur."""
    if sys.argv[1:2] == ["--sheet"]:
        cv2.imwrite(sys.argv[2], np.ascontiguousarray(srgb_codes(sheet(), np.uint8)[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return
    print(
        "| lens | focal length, stated (mm) | f-number, stated | light in the corner | distortion | axial colour (mm) | misplaced | disc |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in sys.argv[1:] or names():
        path = FOLDER / f"{name}.json"
        prescription = json.loads(path.read_text(encoding="utf-8"))["prescription"]
        lens = read_prescription(path)
        described = describe(lens, SENSOR_MM, prescription["iris_blades"])
        prescription["measured"] = measured(lens, described)
        path.write_text(as_text(described, prescription), encoding="utf-8")
        print(row(name, described, prescription), flush=True)


def measured(prescription: LensPrescription, lens: Lens) -> dict[str, float]:
    """Return the figures of a lens that its description does not hold, and the light that the description and a plain disc misplace."""
    half_diagonal_mm = 0.5 * float(np.hypot(*SENSOR_MM))
    far, misplaced = Bench(prescription, np.inf, half_diagonal_mm), held_out_error(prescription, lens)
    ray = far.beam.chief_ray(1.0)
    slope = abs(ray[3] / ray[4])
    return {
        "corner_light": round(far.beam.open_share(0.0, 1.0) / (1.0 + slope**2) ** 2, 2),
        "distortion": round(half_diagonal_mm / (prescription.focal_length_mm * slope) - 1.0, 4),
        "axial_colour_mm": round(prescription.axial_colour_mm, 3),
        "misplaced": round(misplaced[0], 3),
        "misplaced_by_a_disc": round(misplaced[1], 3),
    }


def as_text(lens: Lens, prescription: dict[str, Any]) -> str:
    """Return the lens file: a round opening, one fact a line, one surface a line."""
    document = lens_to_json(lens)
    aperture = {"shape": "disc"} | {key: value for key, value in document.pop("aperture").items() if key not in ("outlines", "weights")}
    facts = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in (document | {"aperture": aperture}).items()]
    told = [f"{json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in prescription.items() if key != "surfaces"]
    surfaces = ",\n".join(f"      {json.dumps(each)}" for each in prescription["surfaces"])
    inner = ",\n    ".join([*told, f'"surfaces": [\n{surfaces}]'])
    return "{\n  " + ",\n  ".join([*facts, f'"prescription": {{\n    {inner}}}']) + "\n}\n"


def row(name: str, lens: Lens, prescription: dict[str, Any]) -> str:
    """Return the row of a lens in the table of docs/lens_library.md."""
    figures, stated = prescription["measured"], prescription["stated_f_number"]
    return (
        f"| {name} | {lens.focal_length_mm:g}, {prescription['stated_focal_length_mm']:g} | {lens.f_number:.3g}, {stated or 'none'} | "
        f"{figures['corner_light']:.0%} | {figures['distortion']:+.1%} | {figures['axial_colour_mm']:+.2f} | {figures['misplaced']:.0%} | "
        f"{figures['misplaced_by_a_disc']:.0%} |"
    )


_CELL_PX, _DISC_PX, _LABEL_PX, _QUALITY = 60, 44, 150, 50
_SHOWN = ((1, 0.0), (1, 0.35), (1, 0.7), (1, 1.0), (-1, 0.0), (-1, 0.5), (-1, 1.0))
"""Side of the focus, and place to the right of the middle in half diagonals."""


def sheet() -> np.ndarray:
    """Return a picture (H, W, 3) of the blur of every lens: behind the focus from the middle to a corner on the right, then in front."""
    rows = [_strip(name) for name in names()]
    half = (len(rows) + 1) // 2
    rows += [np.zeros_like(rows[0])] * (2 * half - len(rows))
    return np.concatenate([np.concatenate(rows[:half]), np.concatenate(rows[half:])], axis=1)


def _strip(name: str) -> np.ndarray:
    lens = read_lens(name)
    written = np.zeros((_CELL_PX, _LABEL_PX), np.uint8)
    cv2.putText(written, name, (8, _CELL_PX // 2 + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (200,), 1, cv2.LINE_AA)
    label = np.repeat(written[..., None].astype(np.float32) / 255.0, 3, axis=2)
    return np.concatenate([label, *(_blurred(lens, side, place) for side, place in _SHOWN)], axis=1)


def _blurred(lens: Lens, side: int, place: float) -> np.ndarray:
    cell = np.zeros((_CELL_PX, _CELL_PX, 3), np.float32)
    for channel in range(3):
        opening = lens.aperture.seen(side, (place, 0.0), channel)
        kernel = opening.rasterize(side * _DISC_PX * lens.aperture.channel_scale(side)[channel]).kernel
        over = max(0, (len(kernel) - _CELL_PX + 1) // 2)
        kernel = kernel[over : len(kernel) - over, over : len(kernel) - over]
        top = (_CELL_PX - len(kernel)) // 2
        cell[top : top + len(kernel), top : top + len(kernel), channel] = kernel * (0.25 * np.pi * _DISC_PX**2 * 0.35)
    return np.clip(cell, 0.0, 1.0)


if __name__ == "__main__":
    main()
