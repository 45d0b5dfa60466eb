"""LibRaw (through rawpy) with the settings that keep RAW linear, unclipped and on one scale, and its colour matrices.

The recipe: one white balance handed in from outside; adjust_maximum_thr=0, else LibRaw rescales each frame by its own
brightest pixel, and defocused slices drift by up to a third; HighlightMode.Ignore with the largest multiplier taken
back out, else a white-balanced red clips at half its range; no auto-brightening, no gamma, no rotation; AAHD
demosaicing, then one median over the colour differences, which takes the coloured fringes off small bright lights (0.4 dB
for the merged picture of a traced desk with lamps). LibRaw cuts off below the black level, so the noise of black areas is
one-sided. Files without a mosaic (linear DNG, sRAW) are not filtered.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mrbokeh.images.color import XYZ_from_rec709
from mrbokeh.system.errors import InputError, MissingExtraError

if TYPE_CHECKING:
    import rawpy

WhiteBalance = tuple[float, float, float]

MAX_16_BIT = 65535.0
_FEWEST_PIXELS = 1000


@contextmanager
def opened_raw(path: Path) -> Iterator["rawpy.RawPy"]:
    """A RAW file whose header was read; failures of LibRaw become InputError."""
    try:
        import rawpy
    except ImportError:
        raise MissingExtraError("rawpy", "capture") from None

    raw = rawpy.RawPy()
    try:
        raw.open_file(str(path))
        if raw.color_desc != b"RGBG":
            raise InputError(f"{path}: expected a sensor with red, green and blue, but its colours are {raw.color_desc.decode()!r}")
        yield raw
    except rawpy.LibRawError as error:
        raise InputError(f"{path} cannot be decoded as RAW: {_reason(path, error)}") from None
    finally:
        raw.close()


def _reason(path: Path, error: Exception) -> str:
    if path.suffix.lower() == ".gpr":
        return "GoPro's GPR needs GoPro's own decoder, which LibRaw comes without: convert it with Adobe DNG Converter"
    return error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)


def processed(raw: "rawpy.RawPy", multipliers: tuple[float, float, float], space: "rawpy.ColorSpace", half_size: bool) -> np.ndarray:
    """(H, W, channels) uint16 by the recipe above, scaled so that the largest multiplier is 1."""
    import rawpy

    red, green, blue = multipliers
    demosaiced_here = raw.raw_type == rawpy.RawType.Flat and not half_size
    return raw.postprocess(
        user_wb=[red, green, blue, green], output_color=space, gamma=(1, 1), output_bps=16, no_auto_bright=True, bright=1.0,
        median_filter_passes=1 if demosaiced_here else 0,
        adjust_maximum_thr=0.0, highlight_mode=rawpy.HighlightMode.Ignore, user_flip=0,
        demosaic_algorithm=rawpy.DemosaicAlgorithm.AAHD, half_size=half_size,
    )  # fmt: skip


def rec709_from_balanced_camera(
    color_matrix: Float[np.ndarray, "3 4"], camera_from_XYZ: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "3 3"] | None:
    """Linear Rec.709 from white-balanced camera RGB; each row sums to 1, so that balanced grey stays grey.

    LibRaw gives color_matrix (sRGB from camera) for DNG and leaves it 0 elsewhere, camera_from_XYZ the other way round.
    None where it gives neither.
    """
    if np.any(color_matrix[:, :3]):
        matrix = color_matrix[:, :3].astype(np.float64)
    elif np.any(camera_from_XYZ[:3]):
        camera_from_rec709 = camera_from_XYZ[:3].astype(np.float64) @ XYZ_from_rec709
        matrix = np.linalg.inv(camera_from_rec709 / camera_from_rec709.sum(axis=1, keepdims=True))
    else:
        return None
    return matrix / matrix.sum(axis=1, keepdims=True)


def matrix_used_by_libraw(raw: "rawpy.RawPy") -> Float[np.ndarray, "3 3"]:
    """The sRGB-from-camera matrix that LibRaw applies to some old cameras (Kodak DC120) without telling it.

    Found by least squares between two conversions of the picture; its half size suffices. Identity where it has none.
    """
    import rawpy

    camera, srgb = (
        processed(raw, (1.0, 1.0, 1.0), space, True).reshape(-1, 3).astype(np.float64)
        for space in (rawpy.ColorSpace.raw, rawpy.ColorSpace.sRGB)
    )
    unclipped = np.all((srgb > 0.001 * MAX_16_BIT) & (srgb < 0.999 * MAX_16_BIT), axis=1)
    if np.count_nonzero(unclipped) < _FEWEST_PIXELS:
        return np.eye(3)
    matrix = np.linalg.lstsq(camera[unclipped], srgb[unclipped], rcond=None)[0].T
    return matrix / matrix.sum(axis=1, keepdims=True)
