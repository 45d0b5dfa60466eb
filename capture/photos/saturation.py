"""Which pixels hold light from full photosites: found before any processing, spread as far as demosaicing spreads it."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32

from capture.photos.libraw import WhiteBalance

if TYPE_CHECKING:
    import rawpy

DEMOSAICING_REACH_PX = 2
_SAME_SHAPE = 0.02
_FULL_IN_PICTURE = 0.99


def full_photosites(raw: "rawpy.RawPy") -> Bool[np.ndarray, "sensor_height sensor_width"]:
    """Where the raw number stands at the white level (of its channel, where the camera states one). Call after unpack()."""
    values, white = raw.raw_image_visible, int(raw.white_level)
    stated = [int(each) for each in (raw.camera_white_level_per_channel or []) if 0 < int(each) < white]
    full: np.ndarray = np.asarray(values >= min([white, *stated]))
    return full if full.ndim == 2 else np.any(full[..., :3], axis=-1)


def saturated_share(
    full: Bool[np.ndarray, "sensor_height sensor_width"],
    camera_rgb: Float32[np.ndarray, "height width 3"],
    ceilings: WhiteBalance | tuple[float, float, float],
) -> Float32[np.ndarray, "height width"]:
    """The share of each pixel of a picture that full photosites reach, 0 to 1: dilated by 2 px, then averaged onto its grid.

    Sensors whose grid LibRaw turns (Fuji's Super CCD) have another shape than their picture: there the picture's own
    channels tell, from 99 % of what a full one reads (ceilings).
    """
    height, width = camera_rgb.shape[:2]
    # Half-size pictures and square pixels made of others keep the shape of the frame only along one axis or both.
    if abs(full.shape[0] / height - 1.0) > _SAME_SHAPE and abs(full.shape[0] / height / 2.0 - 1.0) > _SAME_SHAPE:
        full = np.any(camera_rgb >= _FULL_IN_PICTURE * np.asarray(ceilings, np.float32), axis=-1)
    return resized_share(dilated(full).astype(np.float32), width, height)


def dilated(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """A mask grown by as many pixels as demosaicing reaches, in all directions."""
    import cv2

    side = 2 * DEMOSAICING_REACH_PX + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool) if mask.any() else mask


def resized_share(share: Float32[np.ndarray, "height width"], width: int, height: int) -> Float32[np.ndarray, "new_height new_width"]:
    """Area averages on another grid."""
    import cv2

    same = share.shape == (height, width)
    return share if same else np.clip(cv2.resize(share, (width, height), interpolation=cv2.INTER_AREA), 0.0, 1.0)
