"""Calibration of a lens against depth: its true focus for each stated distance and the growth of its blur; used on later stacks.

lens_calibration.json: {"format": "mrbokeh-lens-calibration", "version": 1, "lens_model", "focal_length_mm", "f_number", "width_px",
"offset_m", "rows": [{"stated_dioptre", "dioptre", "px_per_dioptre", "breathing_scale", "sigma_dioptre", "stacks"}]}, rows from far
to near. stated_dioptre is null if the camera stated none; such rows hold for their own stack only.

The calibration gives stacks without camera poses their focus distances, and with them metric depth from focus.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from capture.merging.merged_pictures import depth_m_of
from capture.merging.metres.known_metres import with_known_nearest, write_changed_metres
from mrbokeh.stacks.focal_stack import GROWTH, GROWTH_WIDTH, FocalStack, Slice, find_focal_stacks, write_focal_stack
from mrbokeh.stacks.guessed_metres import STATED_DISTANCE, is_near_first, stated_distances_m
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-lens-calibration"
VERSION = 1
FILE_NAME = "lens_calibration.json"

_LENS_DIFFERS = 0.01


@dataclass(frozen=True)
class CalibratedFocus:
    """One focus of the lens.

    stated_dioptre: 1 / the focus distance that the camera or the user stated, from the lens. dioptre: 1 / the distance from the
    entrance pupil, as found. px_per_dioptre: growth of the circle of confusion in the photograph (before registration enlarges it)
    at the calibration's width_px. breathing_scale: enlargement of the photograph in registration to the reference of its stack.
    stacks: how many stacks the row averages.
    """

    stated_dioptre: float | None
    dioptre: float
    px_per_dioptre: float
    breathing_scale: float
    sigma_dioptre: float
    stacks: int = 1


@dataclass(frozen=True)
class LensCalibration:
    """A calibrated lens.

    offset_m: what the stated distances exceed those from the entrance pupil by. rows: far to near.
    """

    lens_model: str | None
    focal_length_mm: float
    f_number: float
    width_px: int
    offset_m: float
    rows: tuple[CalibratedFocus, ...]

    def dioptre_of(self, stated_dioptre: float) -> float:
        """Return the true focus for a stated one: the offset, plus the rows' differences from it, interpolated.

        Beyond the rows the difference of the last one is used.
        """
        stated, found = self._table("dioptre")
        return self._expected(stated_dioptre) + float(np.interp(stated_dioptre, stated, found - [self._expected(each) for each in stated]))

    def px_per_dioptre_at(self, stated_dioptre: float, width_px: int) -> float:
        stated, growth = self._table("px_per_dioptre")
        return float(np.interp(stated_dioptre, stated, growth)) * width_px / self.width_px

    def _expected(self, stated_dioptre: float) -> float:
        return 1.0 / max(1.0 / stated_dioptre - self.offset_m, 1e-3) if stated_dioptre > 0 else 0.0

    def _table(self, column: str) -> tuple[np.ndarray, np.ndarray]:
        pairs = [(row.stated_dioptre, getattr(row, column)) for row in self.rows if row.stated_dioptre is not None]
        if not pairs:
            raise InputError("expected a lens calibration with stated focus distances, got one without: it serves no other stack")
        stated, values = np.array(sorted(pairs)).T
        return stated, values


def apply_lens_calibration(stack: FocalStack, calibration: LensCalibration) -> FocalStack:
    """Return the stack with calibrated focus distances, and px_per_dioptre in the metadata of its slices; nothing is written.

    The stated distances stay in the metadata. Raises InputError if the lens is another or a distance is unknown.
    """
    check_lens(stack, calibration)
    unknown = [each.path for each, distance in zip(stack.slices, stated_distances_m(stack), strict=True) if distance is None]
    if unknown:
        raise InputError(f"{stack.folder}: a lens calibration translates stated focus distances, but {unknown[0]} has none")
    width_px = stack.camera.width_px if stack.camera is not None else calibration.width_px
    slices = []
    for each, distance_m in zip(stack.slices, stated_distances_m(stack), strict=True):
        stated = 1.0 / distance_m if distance_m else 0.0
        growth = calibration.px_per_dioptre_at(stated, width_px)
        slices.append(with_calibrated_focus(each, distance_m, calibration.dioptre_of(stated), growth, width_px))
    return focused_stack(stack, slices)


def with_calibrated_focus(each: Slice, stated_m: float | None, dioptre: float, px_per_dioptre: float, width_px: int) -> Slice:
    """Return the slice with its calibrated focus.

    px_per_dioptre: of the photograph at width_px; a registered picture has it times the slice's scale.
    """
    told = {GROWTH: px_per_dioptre, GROWTH_WIDTH: width_px}
    stated = "inf" if stated_m == float("inf") else stated_m
    distance_m = 1.0 / dioptre if dioptre > 0 else float("inf")
    return replace(each, focus_distance_m=distance_m, metadata=each.metadata | told | {STATED_DISTANCE: stated})


def focused_stack(stack: FocalStack, slices: Sequence[Slice]) -> FocalStack:
    """Return the stack with these slices and its lens focused as in its reference."""
    changed = replace(stack, slices=tuple(slices))
    return changed if changed.lens is None else replace(changed, lens=changed.stated_lens_of(changed.reference))


def lens_model_of(stack: FocalStack) -> str | None:
    return next((str(name) for each in stack.slices if (name := each.metadata.get("lens_model"))), None)


def check_lens(stack: FocalStack, calibration: LensCalibration) -> None:
    """Raise InputError if the stack was taken with another lens, focal length or f-number."""
    if stack.lens is None:
        raise InputError(f"{stack.folder} does not know its lens: give focal_length_mm and f_number in a lens.toml and ingest again")
    ours, theirs = lens_model_of(stack), calibration.lens_model
    same = not (ours and theirs) or ours == theirs
    for value, calibrated in ((stack.lens.focal_length_mm, calibration.focal_length_mm), (stack.lens.f_number, calibration.f_number)):
        same &= abs(value / calibrated - 1.0) <= _LENS_DIFFERS
    if not same:
        raise InputError(
            f"the calibration is of {theirs or 'a lens'} {calibration.focal_length_mm:g} mm f/{calibration.f_number:g}, but {stack.folder} "
            f"was taken with {ours or 'a lens'} {stack.lens.focal_length_mm:g} mm f/{stack.lens.f_number:g}: calibrate that lens"
        )


def write_lens_calibration(path: Path | str, calibration: LensCalibration) -> None:
    write_json(path, {"format": FORMAT, "version": VERSION} | asdict(calibration))


def read_lens_calibration(path: Path | str) -> LensCalibration:
    document = read_json(path, "a lens calibration (`mrbokeh capture scale` writes one)")
    if not isinstance(document, dict) or (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        raise InputError(
            f"{path}: expected format {FORMAT!r} version {VERSION}: run `mrbokeh capture scale` on the calibration scene again"
        )
    try:
        values = {key: value for key, value in document.items() if key not in ("format", "version", "rows")}
        return LensCalibration(**values, rows=tuple(CalibratedFocus(**row) for row in document["rows"]))
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is incomplete ({error!r}): run `mrbokeh capture scale` on the calibration scene again") from None


def calibrate_scene(scene: Path, calibration: LensCalibration) -> list[FocalStack]:
    """Apply the calibration to every stack of a scene and write them; all lenses are checked before anything is changed."""
    stacks = find_focal_stacks(scene)
    for stack in stacks:
        check_lens(stack, calibration)
    changed = [apply_lens_calibration(stack, calibration) for stack in stacks]
    for before, after in zip(stacks, changed, strict=True):
        if after.merged:
            write_calibrated(before, after)
        else:
            write_focal_stack(after)
    return changed


def write_calibrated(before: FocalStack, after: FocalStack) -> None:
    """Write a merged stack with new focus distances, and its depth in metres recomputed from the focus index."""
    depth_m, turned = depth_m_of(after, after.focus_index()), is_near_first(before) != is_near_first(after)
    assert depth_m is not None, f"{after.folder}: calibrated stacks are metric"
    write_changed_metres(with_known_nearest(after, turned), depth_m, turned)
