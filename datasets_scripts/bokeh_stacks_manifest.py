"""The manifest of a set of traced stacks: hashes, split, radiance and noise, measured on the files as they were written."""

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from datasets_scripts.bokeh_stacks_plan import StacksPlan
from datasets_scripts.bokeh_stacks_view import NOISE_FLOOR
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FileRecord, FocalStackDataset, Part, RadianceRange, StackRecord

LICENCE = (
    "These pictures are computed from scenes that a program of this project makes up; no photograph, model or texture of anybody is in "
    "them. Use them as you like (CC0 1.0)."
)
_QUANTILES = ("0.5", "0.99", "0.999", "0.9999")


def dataset_of(out: Path, plan: StacksPlan) -> FocalStackDataset:
    """The data set of finished stacks. Its radiance scale is the largest radiance: nothing is cut off."""
    records = tuple(stack_record(out, name, part) for name, part in plan.parts().items())
    floors_db = {record.name: noise_floors_db(read_focal_stack(out / record.name)) for record in records}
    every_db = [each for floors in floors_db.values() for each in floors]
    metadata: dict[str, Any] = {
        "made_by": "datasets_scripts.bokeh_stacks",
        "plan": asdict(plan),
        "opening": plan.opening.document(),
        "noise_floor_db": {"lowest": min(every_db), "median": float(np.median(every_db)), "by_stack": floors_db},
        "noise_floor_is": "PSNR of a slice against one without noise, linear radiance clipped to [0, 1], from two halves of the samples",
        "split_by": "whole scenes, and the last viewpoints of the others",
    }
    return FocalStackDataset(out, LICENCE, max(each.radiance.largest for each in records), records, metadata)


def stack_record(out: Path, name: str, part: Part) -> StackRecord:
    """Reads every picture once."""
    stack = read_focal_stack(out / name)
    depth_m = stack.depth_m()
    largest_px = max(float(np.abs(stack.coc_px(index, depth_m)).max()) for index in range(len(stack)))
    paths = [STACK_FILE, *(each.path for each in stack.slices), stack.all_in_focus_path.name, stack.depth_path.name]
    files = {path: file_record(stack.folder / path) for path in paths}
    return StackRecord(name, part, len(stack), depth_m.shape[1], depth_m.shape[0], largest_px, radiance_range(stack), {"any": 0.0}, files)


def radiance_range(stack: FocalStack) -> RadianceRange:
    """The quantiles are those of the picture in which they are largest."""
    peaks = [rgb.max(axis=2) for rgb in (stack.all_in_focus(), *stack.iter_rgb())]
    quantiles = {each: max(float(np.quantile(peak, float(each))) for peak in peaks) for each in _QUANTILES}
    return RadianceRange(max(float(peak.max()) for peak in peaks), quantiles)


def noise_floors_db(stack: FocalStack) -> list[float]:
    return [round(float(read_exr(stack.folder / each.path)[0].attributes[NOISE_FLOOR]), 2) for each in stack.slices]


def file_record(path: Path) -> FileRecord:
    with path.open("rb") as file:
        return FileRecord(hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)
