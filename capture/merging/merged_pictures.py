"""What a photographer takes along from a merged stack: the all-in-focus picture as TIFF, PNG and, of RAW, DNG, and its depth in colours.

PNG, TIFF and depth stand upright as the cameras' orientation says; DNG says so in its header, and the EXR stay as the sensor saw them.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from capture.merging.tiff_writer import BYTE, LONG, RATIONAL, SHORT, UNDEFINED, TiffTag, fractions_tag, text_tag, write_tiff
from mrbokeh.figures.stack_pictures import depth_codes, orientation_of, write_upright_png
from mrbokeh.images.camera_rgb import Matrix3x3
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.images.exif import upright
from mrbokeh.images.picture_codec import codes_of, even_codes, write_stored
from mrbokeh.stacks.focal_stack import FocalStack

PNG_NAME, TIFF_NAME, DNG_NAME, DEPTH_NAME = "all_in_focus.png", "all_in_focus.tif", "all_in_focus.dng", "depth.png"

_SOFTWARE = "mrbokeh"
_RGB, _LINEAR_RAW, _D65 = 2, 34892, 21
_TOP = 65535
_BRIGHTEST = 4.0
_MATRIX_DENOMINATOR, _FINE_DENOMINATOR = 10000, 1000000

Rgb = Float32[np.ndarray, "height width 3"]
Rgb8 = UInt8[np.ndarray, "height width 3"]


def write_readable_pictures(stack: FocalStack, camera_rgb: Rgb | None = None, depth_rgb8: Rgb8 | None = None) -> None:
    """Write the pictures of a merged stack, beside its EXR.

    camera_rgb: its all-in-focus picture as it is stored. depth_rgb8: its `depth_codes`. What is None is read.

    all_in_focus.png: 8 bits, sRGB, nothing tone-mapped: pixels that one slice gave come out as they were in its 8-bit photograph, unless
    its exposure was evened out. all_in_focus.tif: 16 bits with a profile. all_in_focus.dng: of RAW, linear camera RGB.
    """
    if camera_rgb is None:
        camera_rgb = stack.all_in_focus_camera_rgb()
    rgb, orientation, folder = stack.to_rec709(camera_rgb), orientation_of(stack), stack.folder
    write_upright_png(folder / PNG_NAME, rgb, stack)
    _write_srgb_tiff(folder / TIFF_NAME, upright(codes_of(rgb, np.uint16, "srgb"), orientation))
    write_depth_picture(stack, depth_rgb8)
    if stack.rec709_from_camera is not None and stack.metadata.get("white_balance") is not None:
        model = next((model for each in stack.slices if (model := each.metadata.get("camera_model"))), "unknown camera")
        write_linear_dng(folder / DNG_NAME, camera_rgb, stack.rec709_from_camera, stack.metadata["white_balance"], model, orientation)


def write_depth_picture(stack: FocalStack, depth_rgb8: Rgb8 | None = None) -> None:
    """Write depth.png, the depth in colours. depth_rgb8: its `depth_codes`, read if None."""
    codes = depth_codes(stack) if depth_rgb8 is None else depth_rgb8
    write_stored(stack.folder / DEPTH_NAME, upright(codes, orientation_of(stack)))


def readable_names(stack: FocalStack) -> list[str]:
    """Return the names of the files that a merge of this stack writes for people."""
    is_raw = stack.rec709_from_camera is not None and stack.metadata.get("white_balance") is not None
    return [PNG_NAME, TIFF_NAME, *([DNG_NAME] if is_raw else []), DEPTH_NAME]


def write_linear_dng(
    path: Path, camera_rgb: Rgb, rec709_from_camera: Matrix3x3, white_balance: Sequence[float], model: str, orientation: int
) -> None:
    """Write white-balanced camera RGB as DNG 1.4 of a sensor without a mosaic (LinearRaw): balanced back, to be balanced as shot.

    Light above the white of green (up to four times) is kept by a scale that BaselineExposure takes back. The matrix is that of daylight
    with the camera's balance in it, which is all that a stack knows and gives our own colours at the balance that was shot.
    """
    neutral = 1.0 / np.asarray(white_balance, np.float64)
    native = camera_rgb * neutral.astype(np.float32)
    scale = float(np.clip(native.max(), 1.0, _BRIGHTEST))
    camera_from_XYZ = neutral[:, None] * (np.linalg.inv(np.asarray(rec709_from_camera)) @ rec709_from_XYZ)
    tags = {
        254: TiffTag(LONG, (0,)),
        262: TiffTag(SHORT, (_LINEAR_RAW,)),
        271: text_tag(_SOFTWARE),
        272: text_tag(model),
        274: TiffTag(SHORT, (orientation,)),
        305: text_tag(_SOFTWARE),
        50706: TiffTag(BYTE, (1, 4, 0, 0)),  # DNGVersion
        50707: TiffTag(BYTE, (1, 1, 0, 0)),  # DNGBackwardVersion
        50708: text_tag(model),  # UniqueCameraModel
        50714: TiffTag(SHORT, (0, 0, 0)),  # BlackLevel
        50717: TiffTag(SHORT, (_TOP, _TOP, _TOP)),  # WhiteLevel
        50721: fractions_tag(camera_from_XYZ.reshape(-1).tolist(), _MATRIX_DENOMINATOR),  # ColorMatrix1
        50728: fractions_tag(neutral.tolist(), _FINE_DENOMINATOR, RATIONAL),  # AsShotNeutral
        50730: fractions_tag([math.log2(scale)], _FINE_DENOMINATOR),  # BaselineExposure
        50778: TiffTag(SHORT, (_D65,)),  # CalibrationIlluminant1
    }
    write_tiff(path, even_codes(native / np.float32(scale), np.uint16), tags)


def _write_srgb_tiff(path: Path, codes: UInt16[np.ndarray, "height width 3"]) -> None:
    tags = {
        262: TiffTag(SHORT, (_RGB,)),
        274: TiffTag(SHORT, (1,)),
        305: text_tag(_SOFTWARE),
        34675: TiffTag(UNDEFINED, tuple(_srgb_profile())),
    }
    write_tiff(path, codes, tags)


def _srgb_profile() -> bytes:
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
