"""lens.toml of a shoot: what its photographs do not state, from the plan and the motor."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

from capture.photos.sidecar import FILE_NAME
from capture.tether.focus_plan import FocusPlan
from capture.tether.shoot_log import ShootLog
from mrbokeh.system.atomic_files import atomic_path

_HEAD = "# written by mrbokeh capture shoot: what the photographs themselves do not state\n"


def write_sidecar(log: ShootLog, plan: FocusPlan, *, planned_distances: bool = False) -> Path | None:
    """Write, renew or remove the shoot's lens.toml; one that somebody else wrote is left alone. None where there is none of ours.

    Focus distances are written where a photograph states none, where those stated do not tell the slices apart, since
    cameras round them, or always (planned_distances), which suits a motor whose scale was measured.
    """
    path = log.folder / FILE_NAME
    if path.exists() and not path.read_text(encoding="utf-8").startswith(_HEAD):
        return None
    lines = [*_lens_lines(log, plan), *([] if states_focus(log) and not planned_distances else _focus_lines(log))]
    if not lines:
        path.unlink(missing_ok=True)
        return None
    with atomic_path(path) as temporary:
        temporary.write_text(_HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def states_focus(log: ShootLog) -> bool:
    """Whether the photographs tell their focus distances well enough to tell the slices apart."""
    stated = [each["stated"]["focus_dioptre"] for _, each in sorted(log.slices.items())]
    return None not in stated and all(near > far for near, far in pairwise(stated))


def _lens_lines(log: ShootLog, plan: FocusPlan) -> list[str]:
    stated: list[dict[str, Any]] = [each["stated"] for each in log.slices.values()]
    known = {"focal_length_mm": plan.lens.focal_length_mm, "f_number": plan.lens.f_number}
    lines = [f"{name} = {value!r}" for name, value in known.items() if not all(each[name] for each in stated)]
    return lines + ([] if all(each["sensor"] for each in stated) else [f"sensor_width_mm = {plan.lens.sensor_width_mm!r}"])


def _focus_lines(log: ShootLog) -> list[str]:
    rows = [f'"{each["file"]}" = {_metres(each["dioptre"])}' for _, each in sorted(log.slices.items())]
    return ['focus_origin = "lens"', "", "[focus_distances_m]", *rows]


def _metres(dioptre: float) -> str:
    return "inf" if dioptre <= 0.0 or math.isinf(1.0 / dioptre) else repr(round(1.0 / dioptre, 6))
