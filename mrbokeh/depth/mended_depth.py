"""Depth as people have it, mended by the photograph before it is used.

Depth of phones, networks, stereo and scanners has soft or misplaced edges, pixels between two surfaces, and holes. A lens makes ghosts of
all that. What is wrong must show in the depth itself, or in many places of the photograph: depth of a render passes as it is.

Holes take the surface that is reached with the least change of colour. Soft edges are made hard (soft_edges) in the unit in which they
are ramps, dioptres or metres. Hard edges are moved by a pixel or two where colours say the same everywhere (edge_votes).
"""

from dataclasses import dataclass

import numpy as np

from mrbokeh.depth.edge_votes import Guide, Mask, Picture, Plane, moved_by_colour
from mrbokeh.depth.soft_edges import LEAST_SOFT_PX, sharpened, softness
from mrbokeh.system.messages import say

LEAST_JUMP = 0.04
"""Least jump between two surfaces, as a share of the map's range."""
_RANGE = (0.5, 99.5)
_NEARER, _NEARER_LAMP = 1.2, 1.7
"""How many times nearer than the map's nearest hundredths a surface, or a lamp in the air, may have been before it was blurred. In metres a
thin thing before what is far loses more: there surfaces may be as near as lamps."""
_ROUND = 1e-6


@dataclass(frozen=True)
class Mended:
    """Depth in metres (inf: background), and what was done to it, for people; empty where it is as it came."""

    depth_m: Plane
    told: str


def mended_aloud(depth_m: Plane, photo_rgb: Picture) -> Plane:
    """Return depth as `mended` does, and say what was done."""
    result = mended(depth_m, photo_rgb)
    if result.told:
        say(f"depth is mended by the picture: {result.told} (--exact-depth leaves it as it is)", err=True)
    return result.depth_m


def mended(depth_m: Plane, photo_rgb: Picture) -> Mended:
    """Mend the depth of a photograph, all in focus if that is known. Depth that is NaN or not above 0 is a hole, inf the background."""
    known = depth_m > 0
    if not known.any():
        return Mended(np.full(depth_m.shape, np.inf, np.float32), "it holds nothing")
    guide, done = Guide.of(photo_rgb), []
    if not known.all():
        depth_m = filled(depth_m, known, guide)
        done.append(f"holes filled ({100.0 * (1.0 - known.mean()):.2g} %)")
    values, unit = _ramps(depth_m)
    jump = _jump(values)
    soft = softness(values, jump)
    if soft.sigma_px >= LEAST_SOFT_PX:
        nearest = float(np.percentile(values[::2, ::2], _RANGE[1]))
        most = (nearest * _NEARER, nearest * _NEARER_LAMP) if unit == "dioptres" else (nearest / _NEARER_LAMP,) * 2
        values = sharpened(values, guide, jump, soft.sigma_px, most)
        done.append(f"edges made hard (soft by {soft.sigma_px:.1f} px)")
    else:
        values, told = moved_by_colour(values, guide, jump)
        done += [f"edges moved (near things were {told})"] if told else []
    changed = len(done) > (not known.all())
    return Mended(_metres(values, unit) if changed else depth_m, ", ".join(done))


def _jump(values: Plane) -> float:
    low, high = np.percentile(values[::4, ::4], _RANGE)
    return max(LEAST_JUMP * float(high - low), 1e-9)


def _ramps(depth_m: Plane) -> tuple[Plane, str]:
    """Return values that grow with nearness in the unit in which edges are even ramps: dioptres, or metres below 0.

    A surface that has no edges in one of them, slanted evenly, is taken in that, so that it stays.
    """
    dioptres = np.where(np.isfinite(depth_m), 1.0 / depth_m, 0.0).astype(np.float32)
    if not np.isfinite(depth_m).all():
        return dioptres, "dioptres"
    metres = -depth_m
    skewed = [softness(each, _jump(each)).skewed for each in (dioptres, metres)]
    return (metres, "metres") if skewed[1] < skewed[0] else (dioptres, "dioptres")


def _metres(values: Plane, unit: str) -> Plane:
    """Return metres of values, infinity where there is none."""
    if unit == "metres":
        return -values
    depth_m = np.full(values.shape, np.inf, np.float32)
    np.divide(np.float32(1.0), values, out=depth_m, where=values > _ROUND)
    return depth_m


def filled(depth_m: Plane, known: Mask, guide: Guide) -> Plane:
    """Return depth in which each hole has that of the known pixel that is reached with the least change of colour."""
    from mrbokeh.depth._mended_depth_numba import flow

    result = np.where(known, depth_m, np.float32(np.inf)).astype(np.float32)
    flow(result, known, guide.root)
    return result
