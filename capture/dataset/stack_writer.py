"""Stacks of a data set, one at a time: files, exclusion masks, circles of confusion if asked for, and the record of all.

Depth and lens say all about blur, so that a data set carries no maps unless asked: 30 of 24 megapixels are 1.4 GB per stack. Half
precision keeps 11 bits: at 100 px of blur a step is 0.06 px.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from capture.dense.scene_depth import is_depth_stale
from capture.report.examination import examine
from capture.report.exclusion import exclusion_masks, has_fresh_exclusions, write_exclusions
from capture.report.stack_view import Reblur, StackView
from mrbokeh.images.camera_rgb import VALID
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FileRecord, Part, RadianceRange, StackRecord, record_from_json, record_to_json
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.errors import InputError

CHANNEL = "coc_px"
COC_FOLDER = "coc"
_COMMENT = "signed diameter of the circle of confusion in pixels of the registered slice: + behind the focus, - in front"
QUANTILES = ("0.5", "0.99", "0.999", "0.9999")
_LOWEST_STOP, _STOPS, _PER_STOP = -16, 40, 128
_CHUNK_BYTES = 1 << 20
RECORD_NAME = "record.json"
_ROWS_AT_ONCE = 256

Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class StackWriting:
    """Settings of writing. copy: files instead of hard links. with_coc: signed CoC maps as files. widest_px: for finding movement."""

    copy: bool = False
    with_coc: bool = False
    reblur: Reblur = field(default_factory=Reblur)
    widest_px: int = 960


@dataclass
class RadianceHistogram:
    """Histogram of the largest channel of pixels, in steps of 1/128 stop (0.5 %); below 2^-16 all are one.

    Takes pictures in bands and never holds them all. largest: exact.
    """

    largest: float = 0.0
    _counts: Int64[np.ndarray, " bins"] = field(default_factory=lambda: np.zeros(_STOPS * _PER_STOP, np.int64))

    def add(self, rgb: Float[np.ndarray, "height width 3"], counted: Bool[np.ndarray, "height width"]) -> None:
        peak = rgb.max(axis=2)[counted]
        if peak.size:
            self.largest = max(self.largest, float(peak.max()))
            steps = (np.log2(np.maximum(peak, 2.0**_LOWEST_STOP)) - _LOWEST_STOP) * _PER_STOP
            self._counts += np.bincount(np.minimum(steps.astype(np.int64), len(self._counts) - 1), minlength=len(self._counts))

    def quantile(self, share: float) -> float:
        """Return the upper edge of the step below which this share of the pixels lies."""
        total = int(self._counts.sum())
        if total == 0:
            return 0.0
        step = int(np.searchsorted(np.cumsum(self._counts), share * total)) + 1
        return min(2.0 ** (_LOWEST_STOP + step / _PER_STOP), self.largest)

    def radiance_range(self) -> RadianceRange:
        return RadianceRange(self.largest, {each: self.quantile(float(each)) for each in QUANTILES})


def require_usable(stack: FocalStack) -> None:
    """Raise InputError naming what a stack lacks to be learned from."""
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
    """Return the files of a stack in the data set, by their paths in its folder: nothing that was only needed on the way."""
    paths = [STACK_FILE, *(each.path for each in stack.slices), *(each.name for each in (stack.all_in_focus_path, stack.depth_path))]
    return {relative: stack.folder / relative for relative in [*paths, stack.exclusion_path.name]}


def _ensure_exclusions(stack: FocalStack, writing: StackWriting) -> None:
    """Write exclusion masks, unless `mrbokeh capture report` has made them."""
    if not has_fresh_exclusions(stack):
        findings = examine(StackView(stack, writing.widest_px), writing.reblur)
        write_exclusions(stack, exclusion_masks(stack, findings.moving))


def _signature(sources: dict[str, Path], writing: StackWriting) -> dict[str, Any]:
    """Return what changes when a source does."""
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
    return StackRecord(
        name=name,
        part=part,
        slices=len(stack),
        width_px=width,
        height_px=height,
        largest_coc_px=largest_px,
        radiance=histogram.radiance_range(),
        excluded_shares=shares,
        files=files,
    )


def _add_picture(histogram: RadianceHistogram, stack: FocalStack, path: Path) -> None:
    """Add a picture in bands of rows: only what the file holds, in half precision, is in memory at once."""
    channels = read_exr(path)[0].channels
    for top in range(0, channels["R"].shape[0], _ROWS_AT_ONCE):
        rows = slice(top, top + _ROWS_AT_ONCE)
        rgb = stack.to_rec709(np.stack([channels[each][rows] for each in "RGB"], axis=-1).astype(np.float32))
        valid = channels[VALID][rows] > 0.5 if VALID in channels else np.ones(rgb.shape[:2], bool)
        histogram.add(rgb, valid)


def coc_maps(stack: FocalStack) -> Iterator[Float32[np.ndarray, "height width"]]:
    """Return (H, W) signed circles of confusion for each slice, in order; one at a time."""
    depth_m = stack.depth_m()
    return (stack.coc_px(index, depth_m) for index in range(len(stack)))


def largest_coc_px(stack: FocalStack, counted: Bool[np.ndarray, "height width"]) -> float:
    """Return the largest diameter over all slices among counted pixels."""
    return max(float(np.abs(coc_px[counted]).max(initial=0.0)) for coc_px in coc_maps(stack))


def write_coc_maps(stack: FocalStack, folder: Path) -> list[Path]:
    """Write folder/00.exr and so on, in half precision; existing ones are kept."""
    paths = [folder / f"{index:02d}.exr" for index in range(len(stack))]
    for path, coc_px in zip(paths, coc_maps(stack), strict=True):
        if not path.exists():
            write_exr(path, ExrPart({CHANNEL: coc_px.astype(np.float16)}, attributes={"comments": _COMMENT}))
    return paths


def place(source: Path, target: Path, *, copy: bool = False) -> None:
    """Give the file a second name, or copy it. A link costs no space, and is safe: all of mrbokeh's files are replaced, never changed."""
    with atomic_path(target) as temporary:
        temporary.unlink(missing_ok=True)
        if copy:
            shutil.copyfile(source, temporary)
            return
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def record_of(path: Path) -> FileRecord:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return FileRecord(digest.hexdigest(), path.stat().st_size)
