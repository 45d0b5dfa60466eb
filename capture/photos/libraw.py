"""LibRaw (through rawpy) with the settings that keep RAW linear, unclipped and on one scale; its colour matrices; full photosites.

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

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.images.color import XYZ_from_rec709
from mrbokeh.system.errors import InputError, MissingExtraError

if TYPE_CHECKING:
    import rawpy

if TYPE_CHECKING:
    import rawpy

MAX_16_BIT = 65535.0
_FEWEST_PIXELS = 1000
DEMOSAICING_REACH_PX = 2
_SAME_SHAPE = 0.02
_FULL_IN_PICTURE = 0.99
NEARLY_FULL = 0.95
_ROWS_AT_ONCE = 256

WhiteBalance = tuple[float, float, float]


@contextmanager
def opened_raw(path: Path) -> Iterator["rawpy.RawPy"]:
    """Open a RAW file and read its header; failures of LibRaw become InputError."""
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


def processed(raw: "rawpy.RawPy", multipliers: tuple[float, float, float], space: "rawpy.ColorSpace", half_size: bool) -> np.ndarray:
    """Return (H, W, channels) uint16 by the recipe above, scaled so that the largest multiplier is 1."""
    import rawpy

    red, green, blue = multipliers
    demosaiced_here = raw.raw_type == rawpy.RawType.Flat and not half_size
    return raw.postprocess(
        user_wb=[red, green, blue, green], output_color=space, gamma=(1, 1), output_bps=16, no_auto_bright=True, bright=1.0,
        median_filter_passes=1 if demosaiced_here else 0,
        adjust_maximum_thr=0.0, highlight_mode=rawpy.HighlightMode.Ignore, user_flip=0,
        demosaic_algorithm=rawpy.DemosaicAlgorithm.AAHD, half_size=half_size,
    )  # fmt: skip


def full_photosites(raw: "rawpy.RawPy") -> Bool[np.ndarray, "sensor_height sensor_width"]:
    """Return where the raw number stands at the white level (of its channel, where the camera states one). Call after unpack()."""
    values, white = raw.raw_image_visible, int(raw.white_level)
    stated = [int(each) for each in (raw.camera_white_level_per_channel or []) if 0 < int(each) < white]
    full: np.ndarray = np.asarray(values >= min([white, *stated]))
    return full if full.ndim == 2 else np.any(full[..., :3], axis=-1)


def saturated_share(
    full: Bool[np.ndarray, "sensor_height sensor_width"],
    camera_rgb: Float32[np.ndarray, "height width 3"],
    ceilings: WhiteBalance | tuple[float, float, float],
) -> Float32[np.ndarray, "height width"]:
    """Return the share of each pixel of a picture that full photosites reach, 0 to 1: dilated by 2 px, then averaged onto its grid.

    Sensors whose grid LibRaw turns (Fuji's Super CCD) have another shape than their picture: there the picture's own
    channels tell, from 99 % of what a full one reads (ceilings).
    """
    height, width = camera_rgb.shape[:2]
    # Half-size pictures and square pixels made of others keep the shape of the frame only along one axis or both.
    if abs(full.shape[0] / height - 1.0) > _SAME_SHAPE and abs(full.shape[0] / height / 2.0 - 1.0) > _SAME_SHAPE:
        full = np.any(camera_rgb >= _FULL_IN_PICTURE * np.asarray(ceilings, np.float32), axis=-1)
    return resized_share(dilated(full).astype(np.float32), width, height)


def dilated(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Grow a mask by as many pixels as demosaicing reaches, in all directions."""
    side = 2 * DEMOSAICING_REACH_PX + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool) if mask.any() else mask


def resized_share(share: Float32[np.ndarray, "height width"], width: int, height: int) -> Float32[np.ndarray, "new_height new_width"]:
    """Average over areas on another grid."""
    same = share.shape == (height, width)
    return share if same else np.clip(cv2.resize(share, (width, height), interpolation=cv2.INTER_AREA), 0.0, 1.0)


def neutral_where_full(
    camera_rgb: Float32[np.ndarray, "height width 3"], ceilings: tuple[float, float, float]
) -> Float32[np.ndarray, "height width 3"]:
    """Return white-balanced camera RGB with full channels raised to the brightest channel of their pixel.

    A full channel reads its white balance multiplier, whatever light there was: a white lamp turns magenta, because green has
    the smallest multiplier. The light was at least as bright as the brightest channel says, and most lights are near white.
    ceilings: what a full red, green and blue read (the white balance multipliers). From 95 % of its ceiling on a channel
    moves over smoothly, so that demosaicing leaves no seam. Coloured lights, whose other channels are not full, keep their hue.
    """
    result = np.empty_like(camera_rgb)
    # Strips, because the steps between take several times the memory of what they are made from.
    for first in range(0, len(camera_rgb), _ROWS_AT_ONCE):
        rows = camera_rgb[first : first + _ROWS_AT_ONCE]
        fullness = np.clip((rows / np.asarray(ceilings, np.float32) - NEARLY_FULL) / (1.0 - NEARLY_FULL), 0.0, 1.0)
        result[first : first + _ROWS_AT_ONCE] = rows + fullness * (rows.max(axis=2, keepdims=True) - rows)
    return result


def rec709_from_balanced_camera(
    color_matrix: Float[np.ndarray, "3 4"], camera_from_XYZ: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "3 3"] | None:
    """Return the matrix to linear Rec.709 from white-balanced camera RGB; each row sums to 1, so that balanced grey stays grey.

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
    """Return the sRGB-from-camera matrix that LibRaw applies to some old cameras (Kodak DC120) without telling it.

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


def _reason(path: Path, error: Exception) -> str:
    if path.suffix.lower() == ".gpr":
        return "GoPro's GPR needs GoPro's own decoder, which LibRaw comes without: convert it with Adobe DNG Converter"
    return error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
