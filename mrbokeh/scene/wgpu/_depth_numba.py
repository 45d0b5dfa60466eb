"""Exact depth of the triangles that a picture sees. Compiled with numba."""

from math import inf

import numpy as np

from mrbokeh.scene._vectors_numba import Vector, compiled, corner, cross, dot, row, sub

_AT_CENTRE = 16


@compiled
def fill_depth(
    deciding: np.ndarray,
    corners: np.ndarray,
    eye: np.ndarray,
    axes: np.ndarray,
    intrinsics: np.ndarray,
    places: np.ndarray,
    out: np.ndarray,
) -> None:
    """Depth along the optical axis, inf where nothing is seen.

    deciding: (H, W) uint32: triangle + 1 in the lower 27 bits, above them the sample at which it is met. places: (17, 2) of samples.
    corners: (T, 3, 3) and eye in the same axes. axes: rows right, down, forward. intrinsics: fx, fy, cx, cy.

    Devices move corners to 1/256 px, so that at a border between two triangles a centre may count to the wrong one: then one of
    those that the pixels around see is taken, if it is truly met.
    """
    height, width = deciding.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = inf
            triangle = int(deciding[y, x] & 0x7FFFFFF) - 1
            if triangle < 0:
                continue
            sample = int(deciding[y, x] >> 27)
            right = (x + places[sample, 0] - intrinsics[2]) / intrinsics[0]
            down = (y + places[sample, 1] - intrinsics[3]) / intrinsics[1]
            ray = (
                right * axes[0, 0] + down * axes[1, 0] + axes[2, 0],
                right * axes[0, 1] + down * axes[1, 1] + axes[2, 1],
                right * axes[0, 2] + down * axes[1, 2] + axes[2, 2],
            )
            depth, is_met = _met(corners, triangle, row(eye, 0), ray)
            out[y, x] = depth
            if is_met or sample != _AT_CENTRE:
                continue
            for k in range(9):
                other_y, other_x = y + k // 3 - 1, x + k % 3 - 1
                if 0 <= other_y < height and 0 <= other_x < width:
                    other = int(deciding[other_y, other_x] & 0x7FFFFFF) - 1
                    if other >= 0 and other != triangle:
                        there, is_met = _met(corners, other, row(eye, 0), ray)
                        # A surface behind would not be the one that the device confused with this one.
                        if is_met and abs(there - depth) < 0.02 * depth:
                            out[y, x] = there
                            break


@compiled
def _met(corners: np.ndarray, triangle: int, eye: Vector, ray: Vector) -> tuple[float, bool]:
    """Return (depth of the triangle's plane, whether the ray meets the triangle): Moeller and Trumbore 1997."""
    a = corner(corners, triangle, 0)
    side_1, side_2, to_origin = sub(corner(corners, triangle, 1), a), sub(corner(corners, triangle, 2), a), sub(eye, a)
    p, q = cross(ray, side_2), cross(to_origin, side_1)
    determinant = dot(p, side_1)
    if determinant == 0.0:
        return inf, False
    w1, w2 = dot(p, to_origin) / determinant, dot(q, ray) / determinant
    return dot(q, side_2) / determinant, w1 >= 0.0 and w2 >= 0.0 and w1 + w2 <= 1.0
