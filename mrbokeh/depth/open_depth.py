"""The depth of a photograph from any source, at the photograph's size."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, with_holes_filled
from mrbokeh.depth.depth_settings import DepthSettings
from mrbokeh.depth.edge_snapping import refined_dioptres
from mrbokeh.depth.number_maps import read_number_map, read_stereo
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.image_io import read_depth
from mrbokeh.optics.camera import have_same_shape
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]

_ARRAYS = (".npz", ".npy")
_SAME_ASPECT = 0.02


def open_depth(source: Path, photo_rgb: Rgb, settings: DepthSettings | None = None) -> DepthMap:
    """source: EXR with Z, PNG or TIFF (settings say what the numbers mean), disparity of stereo (.npz, .npy), a phone's JPEG with GDepth
    inside, or a depth network (.onnx). photo_rgb: (H, W, 3) linear; a map of another size is brought to it along its edges.

    Raises InputError where the source cannot be read, does not say what it means, or is of another shape than the photograph.
    """
    settings = settings or DepthSettings()
    if not source.is_file():
        raise InputError(f"expected depth at {source}, but there is no such file")
    depth, is_soft = _read(source, photo_rgb, settings)
    _require_same_aspect(source, depth, photo_rgb)
    filled = with_holes_filled(depth)
    refine = is_soft if settings.refined is None else settings.refined
    return _at_size_of(filled, photo_rgb, refine)


def _read(source: Path, photo_rgb: Rgb, settings: DepthSettings) -> tuple[DepthMap, bool]:
    """The map at its own size, and whether such maps have soft edges."""
    suffix = source.suffix.lower()
    if suffix == ".onnx":
        from mrbokeh.depth.depth_network import network_depth

        return network_depth(source, photo_rgb, settings), True
    if suffix == ".exr":
        depth_m = read_depth(source)
        return DepthMap(depth_m, np.ones(depth_m.shape, bool), source.name), False
    if suffix in _ARRAYS:
        return read_stereo(source, settings), False
    phone = read_phone_photo(source, settings.near_far_m)
    return (read_number_map(source, settings), settings.metres_per_unit is None) if phone is None else (phone.depth, True)


def _require_same_aspect(source: Path, depth: DepthMap, photo_rgb: Rgb) -> None:
    (rows, columns), (height, width) = depth.depth_m.shape, photo_rgb.shape[:2]
    if not have_same_shape((columns, rows), (width, height), _SAME_ASPECT):
        raise InputError(
            f"{source} is {columns}x{rows} px, the photograph {width}x{height} px: expected one view, cut the same way (is one turned?)"
        )


def _at_size_of(depth: DepthMap, photo_rgb: Rgb, refine: bool) -> DepthMap:
    import cv2

    height, width = photo_rgb.shape[:2]
    size = (width, height)
    valid = cv2.resize(depth.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if refine:
        return DepthMap.of_dioptres(np.maximum(refined_dioptres(depth.dioptres, photo_rgb), 0.0), valid, f"{depth.note}, edges refined")
    if depth.depth_m.shape == (height, width):
        return depth
    return DepthMap(cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_NEAREST), valid, f"{depth.note}, resized")
