"""plan.json: a focus plan as a file, and plan.csv, the same for people who turn the ring by hand.

    {"format": "mrbokeh-focus-plan", "version": 1, "lens": {...}, "image_width_px": 6000, "near_m": 0.5, "far_m": null,
     "wanted_residual_px": 1.0, "residual_px": 0.98, "largest_coc_px": 105.2,
     "slices": [{"dioptre": 2.0, "focus_distance_m": 0.5, "film_plane_m": 0.538, "breathing": 1.0}, ...]}

Reading takes the lens, the width, the range and the dioptres; everything else follows from these. null is infinity.
"""

import csv
import math
from pathlib import Path
from typing import Any

from capture.tether.focus_plan import FocusPlan, FocusRange
from mrbokeh.optics.lens import film_plane_m
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-focus-plan"
VERSION = 1


def plan_to_json(plan: FocusPlan) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "lens": lens_to_json(plan.lenses[0]),
        "image_width_px": plan.image_width_px,
        "near_m": plan.range.near_m,
        "far_m": _finite(plan.range.far_m),
        "wanted_residual_px": plan.wanted_residual_px,
        "residual_px": plan.residual_px,
        "largest_coc_px": plan.largest_coc_px,
        "slices": [_slice_row(plan, index) for index in range(len(plan))],
    }


def plan_from_json(document: Any, where: str = "focus plan") -> FocusPlan:
    """The plan of a document, as in the head of this module. Raises InputError for other documents."""
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        raise InputError(f"{where}: expected a focus plan of version {VERSION}; write one with `mrbokeh capture plan --out plan.json`")
    try:
        far_m = math.inf if document["far_m"] is None else float(document["far_m"])
        return FocusPlan(
            lens_from_json(document["lens"], where),
            int(document["image_width_px"]),
            FocusRange(float(document["near_m"]), far_m),
            tuple(float(each["dioptre"]) for each in document["slices"]),
            float(document["wanted_residual_px"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError(f"{where}: this focus plan is damaged ({error!r})") from None


def read_plan(path: Path) -> FocusPlan:
    return plan_from_json(read_json(path, "a focus plan (plan.json)"), str(path))


def write_plan(path: Path, plan: FocusPlan) -> None:
    write_json(path, plan_to_json(plan))


def write_plan_table(path: Path, plan: FocusPlan) -> None:
    """One row for each slice, as a spreadsheet opens it; distances in metres, inf is infinity."""
    rows = [{"slice": index} | _table_row(plan, index) for index in range(len(plan))]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _table_row(plan: FocusPlan, index: int) -> dict[str, str]:
    lens = plan.lenses[index]
    return {
        "from_lens_m": f"{lens.focus_distance_m:.4f}",
        "from_film_plane_m": f"{film_plane_m(lens):.4f}",
        "dioptre": f"{plan.dioptres[index]:.4f}",
        "breathing": f"{plan.breathing[index]:.5f}",
    }


def _slice_row(plan: FocusPlan, index: int) -> dict[str, float | None]:
    lens = plan.lenses[index]
    return {
        "dioptre": plan.dioptres[index],
        "focus_distance_m": _finite(lens.focus_distance_m),
        "film_plane_m": _finite(film_plane_m(lens)),
        "breathing": plan.breathing[index],
    }


def _finite(value: float) -> float | None:
    return None if math.isinf(value) else value
