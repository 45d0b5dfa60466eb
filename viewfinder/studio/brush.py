"""Brush: strokes that say what of the photograph stands in front of the objects, with edges that snap to the picture's.

Within a band around the edge of a stroke a graph cut decides (GrabCut: Rother, Kolmogorov and Blake 2004): the middle of the stroke is
marked for certain, what lies beyond the band stays as it was. The cut is hard; a photograph without depth shows coverage as soft as its
own edges, which a guided filter tells (`mrbokeh.depth.depth_filters`) with a window as wide as the edge is blurred.
"""

from collections.abc import Sequence
from functools import cached_property
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from mrbokeh.compositing.plate import read_matte, shrunk_matte
from mrbokeh.depth.depth_filters import guided_upsampling
from mrbokeh.images.color import srgb_codes
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.photograph import read_photograph
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart
from viewfinder.studio.state import Stroke

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Codes = UInt8[np.ndarray, "height width 3"]

_SURE, _BAND, _AROUND = 0.5, 1.4, 2.4
"""Distances from the stroke's line, in radii: marked for certain, open to the cut, and where it learns the colours of the rest."""
_MOST_PX, _ROUNDS = 2.5e5, 4
_RADII_PX = (2, 4, 8, 16, 32, 64)
_EVEN, _SEEN, _CLEAR, _FEW = 1e-4, 0.65, 0.12, 20


def snapped(codes: Codes, marked: Mask, points_px: Sequence[tuple[float, float]], radius_px: float) -> Mask:
    """Return what a stroke marks of a photograph (display codes): the stroke, its edge moved to that of the picture.

    marked: what was marked before the stroke, of the same size. points_px: x, y of the stroke's line, in pixels.
    """
    height, width = marked.shape
    line, reach = np.array(points_px, float), _AROUND * radius_px + 2.0
    left, top = np.clip(np.floor(line.min(0) - reach), 0, [width - 1, height - 1]).astype(int)
    right, bottom = np.clip(np.ceil(line.max(0) + reach), [left + 1, top + 1], [width, height]).astype(int)
    part = np.s_[top:bottom, left:right]
    scale = min(1.0, float(np.sqrt(_MOST_PX / ((bottom - top) * (right - left)))))
    size = (max(8, round(scale * (right - left))), max(8, round(scale * (bottom - top))))
    small = cv2.resize(codes[part], size, interpolation=cv2.INTER_AREA)
    before = cv2.resize(marked[part].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    cut = _cut(small, before, (line - (left, top)) * (size[0] / (right - left), size[1] / (bottom - top)), radius_px * scale)
    whole = cv2.resize(cut.astype(np.float32), (right - left, bottom - top), interpolation=cv2.INTER_LINEAR) > 0.5
    result = np.zeros_like(marked)
    result[part] = whole
    return result


def _cut(codes: Codes, before: Mask, line_px: np.ndarray, radius_px: float) -> Mask:
    """Return the pixels that the graph cut gives to the stroke."""
    away_px = _away_px(before.shape, line_px)
    sure, near, around = (away_px <= max(1.0, share * radius_px) for share in (_SURE, _BAND, _AROUND))
    labels = np.full(before.shape, cv2.GC_BGD, np.uint8)
    labels[near] = np.where(away_px <= radius_px, cv2.GC_PR_FGD, cv2.GC_PR_BGD)[near]
    labels[before | sure] = cv2.GC_FGD
    rest = around & ~near & ~before
    if rest.sum() < 50:
        return np.asarray((away_px <= radius_px) | sure)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    seen = np.where(around[..., None] | before[..., None], codes, np.uint8(0))
    cv2.grabCut(np.ascontiguousarray(seen[..., ::-1]), labels, None, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    taken = (((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)) & near) | sure
    _count, pieces = cv2.connectedComponents(taken.astype(np.uint8), connectivity=4)
    return np.asarray(np.isin(pieces, pieces[sure]) & taken)


def _away_px(shape: tuple[int, int], line_px: np.ndarray) -> Plane:
    """Return every pixel's distance from a line through points."""
    drawn = np.ones(shape, np.uint8)
    line = np.clip(np.floor(line_px), 0, [shape[1] - 1, shape[0] - 1]).astype(np.int32)
    cv2.polylines(drawn, [line], isClosed=False, color=0)
    cv2.circle(drawn, line[0].tolist(), 0, 0)  # a single point is no line
    return np.asarray(cv2.distanceTransform(drawn, cv2.DIST_L2, 5), np.float32)


def as_shown(codes: Codes, marked: Mask) -> Plane:
    """Return the coverage in [0, 1] of what is marked, as soft at its edge as the photograph is there."""
    hard = marked.astype(np.float32)
    rows, columns = np.nonzero(marked)
    if not len(rows) or marked.all():
        return hard
    most = 3 * _RADII_PX[-1]
    part = np.s_[max(0, rows.min() - most) : rows.max() + most + 1, max(0, columns.min() - most) : columns.max() + most + 1]
    guide, height, width = codes[part].astype(np.float32) / 255.0, *hard[part].shape
    scale = min(1.0, float(np.sqrt(_MOST_PX / (height * width))))
    size = (max(8, round(scale * width)), max(8, round(scale * height)))
    small = cv2.resize(hard[part], size, interpolation=cv2.INTER_AREA)
    radius_px = _edge_px(cv2.resize(guide, size, interpolation=cv2.INTER_AREA), small > 0.5)
    soft = np.clip((guided_upsampling(small, guide, radius_px, _EVEN) - 0.1) / 0.8, 0.0, 1.0)
    hard[part] = np.where(_from_edge_px(marked[part]) <= 3 * radius_px / scale, soft, hard[part])
    return hard


def _edge_px(picture: Float32[np.ndarray, "height width 3"], marked: Mask) -> int:
    """Return how far beside the edge both sides show nearly the contrast that they show twice as far away: how wide it is blurred."""
    from_edge_px = _from_edge_px(marked)
    edge = from_edge_px < 1.5
    for radius_px in _RADII_PX:
        near, far = (_contrast(picture, marked, from_edge_px, each)[edge] for each in (radius_px, 2 * radius_px))
        clear = far > _CLEAR
        if clear.sum() < _FEW or np.median(near[clear] / far[clear]) >= _SEEN:
            break
    return radius_px


def _contrast(picture: Float32[np.ndarray, "height width 3"], marked: Mask, from_edge_px: Plane, far_px: int) -> Plane:
    """Return, around every pixel, how much the colours so far within the edge differ from those so far beyond it."""
    ring = np.abs(from_edge_px - far_px) < max(1.0, 0.25 * far_px)
    size, means = (2 * far_px + 3, 2 * far_px + 3), []
    for side in (marked, ~marked):
        weight = (ring & side).astype(np.float32)
        total = np.maximum(cv2.blur(weight, size), 1e-6)
        means.append(cv2.blur(picture * weight[..., None], size) / total[..., None])
    return np.asarray(np.abs(means[0] - means[1]).sum(axis=2), np.float32)


def _from_edge_px(marked: Mask) -> Plane:
    """Return every pixel's distance from the edge of what is marked."""
    codes = marked.astype(np.uint8)
    inside, outside = (cv2.distanceTransform(each, cv2.DIST_L2, 5) for each in (codes, 1 - codes))
    return np.asarray(np.maximum(inside, outside), np.float32)


class Brush:
    """Brush for one photograph, or for a focal stack, whose all-in-focus picture shows its edges.

    has_depth: depth tells what no stroke reached, and mattes are hard.
    """

    def __init__(self, path: Path, stack: FocalStack | None = None, *, has_depth: bool) -> None:
        self._path, self._stack, self._has_depth = path, stack, has_depth
        self._painted: dict[Path | None, tuple[Mask, Mask]] = {}

    @cached_property
    def _codes(self) -> Codes:
        with apart():
            return srgb_codes(self._stack.all_in_focus() if self._stack else read_photograph(self._path).rgb, np.uint8)

    def paint(self, before: Path | None, stroke: Stroke, out: Path) -> None:
        """Write a matte (PNG) for `mrbokeh composite --matte`: an earlier one with a stroke. Raises InputError for another size."""
        codes = self._codes
        front, told = self._marked(before)
        if front.shape != codes.shape[:2]:
            raise InputError(f"{before} is {front.shape[1]}x{front.shape[0]} px, but the photograph {codes.shape[1]}x{codes.shape[0]}")
        same = front if stroke.is_front else told & ~front
        cut = snapped(codes, same, stroke.points_px, stroke.radius_px)
        front, told = (front | cut if stroke.is_front else front & ~cut), told | cut
        # A soft edge read back and cut at its half would move with every stroke.
        self._painted = {**dict(list(self._painted.items())[-1:]), out: (front, told)}
        planes = [front, told] if self._has_depth else [as_shown(codes, front)]
        pictures = [Image.fromarray(np.rint(255.0 * each).astype(np.uint8)) for each in planes]
        with atomic_path(out) as written:
            (Image.merge("LA", pictures) if self._has_depth else pictures[0]).save(written, "PNG", compress_level=3)

    def _marked(self, before: Path | None) -> tuple[Mask, Mask]:
        """Return what an earlier matte says is in front, and of what it tells anything."""
        if before in self._painted:
            return self._painted[before]
        held = np.full(self._codes.shape[:2], np.nan, np.float32) if before is None else read_matte(before)
        return held > 0.5, ~np.isnan(held) if self._has_depth else np.ones(held.shape, bool)


def tinted(path: Path, size_px: tuple[int, int]) -> bytes:
    """Return a matte as a PNG of some size that lies over the picture: what is in front in orange, what is told to be behind in blue."""
    whole = read_matte(path)
    held, has_gaps = shrunk_matte(whole, size_px), bool(np.isnan(whole).any())
    front = np.nan_to_num(held, nan=0.0)
    shown = np.empty((*held.shape, 4), np.uint8)
    shown[..., :3] = _FRONT
    shown[..., :3][(front < 0.5) & has_gaps] = _BEHIND
    shown[..., 3] = 255.0 * _TINT * (~np.isnan(held) if has_gaps else front)
    kept = BytesIO()
    Image.fromarray(shown).save(kept, "PNG", compress_level=1)
    return kept.getvalue()


_FRONT, _BEHIND, _TINT = (255, 140, 0), (40, 120, 255), 0.5
