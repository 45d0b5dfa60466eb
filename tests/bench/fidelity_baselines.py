"""What one would try first, to measure renderers against: no blur, gathering, scattering without order, and GEGL's lens-blur."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.renderers.scatter_reference import scatter
from mrbokeh.system.errors import InputError

_GATHER_STEP_PX = 0.5
_GEGL_GROWTH_PX = 0.5  # a point through lens-blur of radius r fills a disc of radius r + 1/2


def no_blur(picture: Layer, lens: Lens) -> np.ndarray:  # noqa: ARG001 (all baselines are called alike)
    return picture.rgb


def gather(picture: Layer, lens: Lens) -> np.ndarray:
    """Every pixel is the mean of its neighbours under its own kernel, to half a pixel of diameter."""
    levels = np.round(lens.coc_px(picture.depth_m, picture.width_px) / _GATHER_STEP_PX).astype(int)
    result = picture.rgb.copy()
    for level in np.unique(levels):
        here = levels == level
        diameter_px = float(level) * _GATHER_STEP_PX
        kernel = lens.aperture.seen(1 if level > 0 else -1).rasterize(diameter_px).kernel
        # filter2D correlates; a pixel that gathers what a scatter would send needs the kernel turned round.
        result[here] = cv2.filter2D(picture.rgb, -1, kernel[::-1, ::-1].copy(), borderType=cv2.BORDER_REFLECT)[here]
    return result


def scatter_without_order(picture: Layer, lens: Lens) -> np.ndarray:
    """Every pixel spreads over its kernel, whatever stands in front; light over the summed weights, mirrored borders."""
    coc_px = lens.coc_px(picture.depth_m, picture.width_px)
    aperture = lens.aperture.seen(1)
    margin = kernel_radius_px(float(np.abs(coc_px).max()), aperture.unit_radius)
    around = ((margin, margin), (margin, margin))
    values = np.pad(np.dstack([picture.rgb, picture.alpha]).astype(np.float64), (*around, (0, 0)), mode="symmetric")
    spread = scatter(values, np.pad(coc_px, around, mode="symmetric"), aperture)[margin:-margin, margin:-margin]
    return (spread[..., :3] / np.maximum(spread[..., 3:], 1e-6)).astype(np.float32)


def has_gegl() -> bool:
    return shutil.which("gegl") is not None


def gegl_lens_blur(picture: Layer, lens: Lens) -> np.ndarray:
    """gegl:lens-blur, a disc whose radius at every pixel comes from a mask (Debian package gegl)."""
    radius_px = np.maximum(np.abs(lens.coc_px(picture.depth_m, picture.width_px)) / 2 - _GEGL_GROWTH_PX, 0.0)
    largest_px = float(radius_px.max())
    share = (radius_px / largest_px).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        source, mask, result = (Path(folder) / name for name in ("in.exr", "mask.exr", "out.exr"))
        write_image(source, picture.rgb, half=False)
        write_exr(mask, ExrPart(dict.fromkeys("RGB", share)))
        blur = ["gegl:lens-blur", f"radius={largest_px}", "linear-mask=true", "aux=[", "gegl:load", f"path={mask}", "]"]
        done = subprocess.run(["gegl", str(source), "-o", str(result), "--", *blur], capture_output=True, text=True)
        if not result.is_file():
            raise InputError(f"expected a picture from gegl, got none: {done.stderr.strip()[-300:]}")
        return read_image(result)


BASELINES = {"no blur": no_blur, "per-pixel gather": gather, "scatter without order": scatter_without_order}
