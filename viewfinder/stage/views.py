"""The views of the page: plate, virtual, matte, depth, coc and final, as pictures of the size of the plate."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mrbokeh.compositing.overlay import CodeTables, Overlay
from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import Bgr
from viewfinder.stage.seen import Seen

Plane = Float32[np.ndarray, "height width"]
_LEAST = 1e-3
_SAME_DIOPTRES = 1e-3


def view_picture(view: str, plate_bgr: Bgr, seen: Seen | None, tables: CodeTables) -> Bgr:
    """One of VIEWS. seen: None before the first drawing, when only the plate shows anything. InputError for an unknown name.

    matte: white is all virtual, a shadow counts by how dark it is. depth: red is near, blue far, by 1 / depth over what is seen.
    coc: white is in focus, red behind, blue in front; full colour is the largest circle of confusion that is seen, 1 px at least.
    """
    if view not in _PAINTERS:
        raise InputError(f"expected a view ({', '.join(VIEWS)}), got {view!r}")
    if seen is None:
        return plate_bgr if view in ("plate", "final") else np.zeros_like(plate_bgr)
    return _PAINTERS[view](plate_bgr, seen, tables)


def _plate(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:  # noqa: ARG001
    return plate_bgr


def _final(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:
    return seen.overlay.over_codes(plate_bgr, tables)


def _virtual(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:
    return seen.overlay.over_codes(np.zeros_like(plate_bgr), tables)


def _matte(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:  # noqa: ARG001
    alpha = np.rint(255.0 * np.clip(1.0 - seen.overlay.shines_through, 0.0, 1.0)).astype(np.uint8)
    return _placed(np.repeat(alpha[..., None], 3, axis=2), seen.overlay, plate_bgr)


def _depth(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:  # noqa: ARG001
    if seen.drawing.depth_m is None:
        return np.zeros_like(plate_bgr)
    overlay, dioptres, there = _moved((1.0 / seen.drawing.depth_m).astype(np.float32), seen)
    known = dioptres[there]
    far, near = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    nearness = np.clip((dioptres - far) / max(near - far, _SAME_DIOPTRES), 0.0, 1.0)
    colours = cv2.applyColorMap(np.rint(255.0 * nearness).astype(np.uint8), cv2.COLORMAP_JET)
    return _placed(np.where(there[..., None], colours, 0).astype(np.uint8), overlay, plate_bgr)


def _coc(plate_bgr: Bgr, seen: Seen, tables: CodeTables) -> Bgr:  # noqa: ARG001
    drawing = seen.drawing
    if drawing.sharp is None or drawing.depth_m is None or drawing.lens is None:
        return np.zeros_like(plate_bgr)
    coc_px = drawing.lens.coc_px(drawing.depth_m, drawing.depth_m.shape[1]) / drawing.request.resolution
    overlay, coc_px, there = _moved(np.where(np.isfinite(drawing.depth_m), coc_px, 0.0).astype(np.float32), seen)
    share = np.clip(coc_px / max(float(np.abs(coc_px[there]).max(initial=0.0)), 1.0), -1.0, 1.0)
    blue, red = 1.0 - np.maximum(share, 0.0), 1.0 + np.minimum(share, 0.0)
    colours = np.rint(255.0 * np.stack([blue, np.minimum(blue, red), red], axis=2))
    return _placed(np.where(there[..., None], colours, 0).astype(np.uint8), overlay, plate_bgr)


def _moved(values: Plane, seen: Seen) -> tuple[Overlay, Float32[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """Values of the sharp picture in the newest one: (where, the values, whether there is anything)."""
    sharp = seen.drawing.sharp
    assert sharp is not None, "a drawing with depth has a sharp layer"
    alpha = sharp.rgba[..., 3]
    weighted = np.stack([values * alpha, np.zeros_like(alpha), np.zeros_like(alpha), alpha], axis=2)
    overlay = replace(sharp, rgba=np.ascontiguousarray(weighted)).moved_to(seen.camera)
    weight = 1.0 - overlay.shines_through
    there = weight > _LEAST
    mean = np.zeros_like(weight)
    np.divide(overlay.rgb[..., 0], weight, out=mean, where=there)
    return overlay, mean, there


def _placed(colours: UInt8[np.ndarray, "rows columns 3"], overlay: Overlay, plate_bgr: Bgr) -> Bgr:
    """A picture as large as the plate, black outside the overlay's box."""
    result = np.zeros_like(plate_bgr)
    height, width = overlay.shines_through.shape
    result[overlay.top_px : overlay.top_px + height, overlay.left_px : overlay.left_px + width] = colours
    return result


_PAINTERS: dict[str, Callable[[Bgr, Seen, CodeTables], Bgr]] = {
    "final": _final,
    "plate": _plate,
    "virtual": _virtual,
    "matte": _matte,
    "depth": _depth,
    "coc": _coc,
}
VIEWS = tuple(_PAINTERS)
