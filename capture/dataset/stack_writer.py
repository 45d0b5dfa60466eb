"""One stack into the data set: its files, its exclusion masks, and the record of both."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from capture.dataset.coc_maps import FOLDER as COC_FOLDER
from capture.dataset.coc_maps import largest_coc_px, write_coc_maps
from capture.dataset.file_placing import place, record_of
from capture.dataset.radiance_histogram import RadianceHistogram
from capture.dense.scene_depth import is_depth_stale
from capture.report.examination import examine
from capture.report.exclusion_masks import exclusion_masks, has_fresh_exclusions, write_exclusions
from capture.report.reblur import Reblur
from capture.report.stack_view import StackView
from mrbokeh.images.camera_rgb import VALID
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import Part, StackRecord, record_from_json, record_to_json
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

RECORD_NAME = "record.json"
_ROWS_AT_ONCE = 256

Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class StackWriting:
    """How stacks are written. copy: files instead of hard links. with_coc: signed CoC maps as files. widest_px: for finding movement."""

    copy: bool = False
    with_coc: bool = False
    reblur: Reblur = field(default_factory=Reblur)
    widest_px: int = 960


def require_usable(stack: FocalStack) -> None:
    """Raises InputError naming what a stack lacks to be learned from."""
    if not (stack.merged and stack.registered):
        raise InputError(f"{stack.folder} is not registered and merged yet: run `mrbokeh capture merge` on it, or name another scene")
    if not stack.is_metric:
        raise InputError(
            f"{stack.folder} has slices without a focus distance: merge it again (`mrbokeh capture merge --overwrite`), which solves their "
            f"blur from the pictures, or add the distances to lens.toml and ingest"
        )
    stack.lens_of(0)
    if is_depth_stale(stack):
        raise InputError(f"{stack.folder}: its depth was found with other focus distances than it has now: run `mrbokeh capture depth`")


def write_stack(stack: FocalStack, out: Path, name: str, part: Part, writing: StackWriting) -> StackRecord:
    """Place the files in out/name; what an earlier run finished is kept where its sources have not changed since."""
    _ensure_exclusions(stack, writing)
    folder = out / name
    sources = source_files(stack)
    signature = _signature(sources, writing)
    kept = _finished(folder, signature, part)
    if kept is not None:
        return kept
    for relative, source in sources.items():
        place(source, folder / relative, copy=writing.copy)
    placed = read_focal_stack(folder)
    maps = write_coc_maps(placed, folder / COC_FOLDER) if writing.with_coc else []
    files = {relative: record_of(folder / relative) for relative in [*sources, *(f"{COC_FOLDER}/{path.name}" for path in maps)]}
    record = _measured(placed, name, part, files)
    write_json(folder / RECORD_NAME, {"signature": signature, "record": record_to_json(record)})
    return record


def source_files(stack: FocalStack) -> dict[str, Path]:
    """What a stack of the data set consists of, by its path in the folder: nothing that was only needed on the way."""
    paths = [STACK_FILE, *(each.path for each in stack.slices), *(each.name for each in (stack.all_in_focus_path, stack.depth_path))]
    return {relative: stack.folder / relative for relative in [*paths, stack.exclusion_path.name]}


def _ensure_exclusions(stack: FocalStack, writing: StackWriting) -> None:
    """`mrbokeh capture report` has made them, or they are made now."""
    if not has_fresh_exclusions(stack):
        findings = examine(StackView(stack, writing.widest_px), writing.reblur)
        write_exclusions(stack, exclusion_masks(stack, findings.moving))


def _signature(sources: dict[str, Path], writing: StackWriting) -> dict[str, Any]:
    """Changes when a source does."""
    stats = {relative: path.stat() for relative, path in sources.items()}
    return {"with_coc": writing.with_coc} | {relative: [each.st_size, each.st_mtime_ns] for relative, each in stats.items()}


def _finished(folder: Path, signature: dict[str, Any], part: Part) -> StackRecord | None:
    if not (folder / RECORD_NAME).is_file():
        return None
    document = read_json(folder / RECORD_NAME, "the record of a stack")
    if document.get("signature") != signature:
        return None
    record = record_from_json(document["record"])
    whole = all((folder / path).is_file() and (folder / path).stat().st_size == each.bytes for path, each in record.files.items())
    return replace(record, part=part) if whole else None


def _measured(stack: FocalStack, name: str, part: Part, files: dict[str, Any]) -> StackRecord:
    masks = stack.exclusions()
    excluded = np.logical_or.reduce(list(masks.values()))
    shares = {reason: float(mask.mean()) for reason, mask in masks.items()} | {"any": float(excluded.mean())}
    height, width = excluded.shape
    largest_px = largest_coc_px(stack, ~excluded)
    histogram = RadianceHistogram()
    for path in (stack.all_in_focus_path, *(stack.folder / each.path for each in stack.slices)):
        _add_picture(histogram, stack, path)
    return StackRecord(name, part, len(stack), width, height, largest_px, histogram.radiance_range(), shares, files)


def _add_picture(histogram: RadianceHistogram, stack: FocalStack, path: Path) -> None:
    """In bands of rows: of a picture only what the file holds, in half precision, is in memory at once."""
    channels = read_exr(path)[0].channels
    for top in range(0, channels["R"].shape[0], _ROWS_AT_ONCE):
        rows = slice(top, top + _ROWS_AT_ONCE)
        rgb = stack.to_rec709(np.stack([channels[each][rows] for each in "RGB"], axis=-1).astype(np.float32))
        valid = channels[VALID][rows] > 0.5 if VALID in channels else np.ones(rgb.shape[:2], bool)
        histogram.add(rgb, valid)
