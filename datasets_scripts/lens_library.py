"""Describe the lenses of the library by their prescriptions again: fills in the lens files of mrbokeh/lens_data and prints their table.

    python -m datasets_scripts.lens_library [NAME ...]

Only "prescription" of a file is written by hand; all else comes from there (`mrbokeh.psf_models.lens_description`). The error is
measured at places of the field and depths that the fit has not seen.
"""

import json
import sys
from typing import Any

import numpy as np

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json
from mrbokeh.optics.lens_library import FOLDER, names
from mrbokeh.psf_models.lens_description import FOCUS_IN_FOCAL_LENGTHS, Bench, describe, misplaced_light
from mrbokeh.psf_models.lens_prescription import LensPrescription
from mrbokeh.psf_models.physical_lens import read_prescription

SENSOR_MM = (36.0, 24.0)
HELD_OUT_FIELDS, HELD_OUT_DEPTHS = (0.2, 0.5, 0.85), (0.75, 3.0)
"""Places in half diagonals, and depths in focus distances."""


def main() -> None:
    """Describe the lenses of the names given, or all."""
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
    far, focus_m = Bench(prescription, np.inf, half_diagonal_mm), FOCUS_IN_FOCAL_LENGTHS * prescription.focal_length_mm / 1000.0
    near = Bench(prescription, focus_m, half_diagonal_mm)
    lights = [near.light(share * focus_m, each) for share in HELD_OUT_DEPTHS for each in HELD_OUT_FIELDS]
    disc = Lens(lens.focal_length_mm, lens.f_number, lens.focus_distance_m)
    ray = far.beam.chief_ray(1.0)
    slope = abs(ray[3] / ray[4])
    return {
        "corner_light": round(far.beam.open_share(0.0, 1.0) / (1.0 + slope**2) ** 2, 2),
        "distortion": round(half_diagonal_mm / (prescription.focal_length_mm * slope) - 1.0, 4),
        "axial_colour_mm": round(prescription.axial_colour_mm, 3),
        "misplaced": round(float(np.mean([misplaced_light(lens, each) for each in lights])), 3),
        "misplaced_by_a_disc": round(float(np.mean([misplaced_light(disc, each) for each in lights])), 3),
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


if __name__ == "__main__":
    main()
