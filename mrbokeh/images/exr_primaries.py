"""What R, G and B of an EXR file mean: the attribute `chromaticities` of its header, and the way from there to linear Rec.709."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.images.color import XYZ_from_rec709, convert, rec709_from_XYZ
from mrbokeh.images.exr_io import ExrPart
from mrbokeh.system.errors import InputError

ATTRIBUTE = "chromaticities"
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""CIE x, y of red, green, blue and white (D65), ITU-R BT.709; what EXR takes where a file states nothing."""

BT2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
"""The same of ITU-R BT.2020, which holds nearly all colours of real things."""

AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
"""The same of ACES2065-1 (SMPTE ST 2065-1)."""

AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
"""The same of ACEScg (S-2014-004)."""

P3_D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
"""The same of SMPTE RP 431-2 with the white of displays."""

# Cone responses that the Bradford transform scales (Lam 1985; CIE 160:2004).
_CONES_FROM_XYZ = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# Programs write D65 with four to six digits.
_SAME_XY = 1e-4
# Digits with which configurations of colour spaces state their matrices.
_SAME_MATRIX = 1e-3
# Of real colour spaces it is below 10; three primaries on one line, rounded to float32, have 1e6 and more.
_LARGEST_CONDITION = 1e4


def stated_primaries(part: ExrPart, parts: Sequence[ExrPart] = ()) -> tuple[float, ...] | None:
    """x, y of red, green, blue and white of one part; parts: the others of its file, with which EXR lets it share them."""
    stated = (each.attributes.get(ATTRIBUTE) for each in (part, *parts))
    return next((each for each in stated if isinstance(each, tuple)), None)


def in_rec709(
    rgb: Float32[np.ndarray, "*batch 3"], primaries: tuple[float, ...] | None, path: Path | str
) -> Float32[np.ndarray, "*batch 3"]:
    """Linear Rec.709 with D65 white. Primaries of Rec.709, or none, leave it as it is, and so do pixels that are NaN or infinite.

    path: the file, for the error. Raises InputError where the primaries are no colour space.
    """
    if primaries is None or np.abs(np.subtract(primaries, REC709)).max() < _SAME_XY:
        return rgb
    matrix = rec709_from_chromaticities(primaries)
    if matrix is None:
        raise InputError(
            f"{path}: expected primaries that span a colour space (EXR attribute {ATTRIBUTE}: x, y of red, green, blue and white), got "
            f"{', '.join(f'{each:g}' for each in primaries)}: correct the attribute, or remove it if the picture is Rec.709"
        )
    finite = np.isfinite(rgb).all(axis=-1, keepdims=True)
    if finite.all():
        return convert(rgb, matrix)
    return np.where(finite, convert(np.where(finite, rgb, np.float32(0.0)), matrix), rgb)


def rec709_from_chromaticities(chromaticities: Sequence[float]) -> Float64[np.ndarray, "3 3"] | None:
    """Linear Rec.709 from RGB of stated primaries; rows sum to 1, for a white other than D65 is adapted to it (Bradford).

    chromaticities: CIE x, y of red, green, blue and white; they may lie outside of real colours, as those of cameras do.
    None where they are no colour space: primaries on one line, white without luminance.
    """
    XYZ_from_rgb = _xyz_matrix(np.asarray(chromaticities, np.float64).reshape(4, 2))
    if XYZ_from_rgb is None:
        return None
    ours, theirs = (_CONES_FROM_XYZ @ matrix.sum(axis=1) for matrix in (XYZ_from_rec709, XYZ_from_rgb))
    if theirs.min() <= 0:
        return None
    adapted = np.linalg.solve(_CONES_FROM_XYZ, (ours / theirs)[:, None] * _CONES_FROM_XYZ)
    return rec709_from_XYZ @ adapted @ XYZ_from_rgb


def known_primaries(rec709_from_rgb: Float64[np.ndarray, "3 3"]) -> tuple[float, ...] | None:
    """Those of the public standards whose way to linear Rec.709 this matrix is; None where it is that of none of them."""
    for primaries in (REC709, BT2020, AP0, AP1, P3_D65):
        if np.abs(_known(rec709_from_chromaticities(primaries)) - rec709_from_rgb).max() < _SAME_MATRIX:
            return primaries
    return None


def _xyz_matrix(xy: Float[np.ndarray, "4 2"]) -> Float64[np.ndarray, "3 3"] | None:
    """XYZ from RGB, whose primaries add up to a white of Y = 1 (OpenEXR, technical introduction). No primary's y divides: it may be 0."""
    if not np.isfinite(xy).all() or xy[3, 1] <= 0:
        return None
    xyz = np.column_stack([xy, 1.0 - xy.sum(axis=1)]).T
    columns, white = xyz[:, :3], xyz[:, 3] / xy[3, 1]
    if np.linalg.matrix_rank(columns) < 3:
        return None
    XYZ_from_rgb = columns * np.linalg.solve(columns, white)
    return XYZ_from_rgb if np.linalg.cond(XYZ_from_rgb) < _LARGEST_CONDITION else None


def _known(matrix: Float64[np.ndarray, "3 3"] | None) -> Float64[np.ndarray, "3 3"]:
    assert matrix is not None
    return matrix


BT2020_from_rec709 = np.linalg.inv(_known(rec709_from_chromaticities(BT2020)))
