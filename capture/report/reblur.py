"""Re-blur: the all-in-focus picture through the circles of confusion of a slice. Where stack, depth and lens are right, it is the slice."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

_LEAST_PX = 1e-3


@dataclass(frozen=True)
class Reblur:
    """Predicts slices by a renderer of mrbokeh, occlusion and hidden background as it does them.

    name: what the user calls the renderer, which tells whether predictions that are kept would come out the same; "" for its repr.
    """

    renderer: Renderer = field(default_factory=PolygonDifferences)
    name: str = ""

    @property
    def identity(self) -> str:
        return self.name or repr(self.renderer)

    def __call__(self, all_in_focus: Rgb, coc_px: Plane, aperture: Aperture) -> Rgb:
        """coc_px: signed diameters, in pixels of the picture."""
        largest_px = float(np.abs(coc_px).max(initial=0.0))
        if largest_px < _LEAST_PX:
            return all_in_focus
        lens = lens_with_growth(2.0 * largest_px, all_in_focus.shape[1], aperture)
        return self.renderer.render([opaque(all_in_focus, depth_with(coc_px, lens))], lens).rgb


def reblur_by(name: str) -> Reblur:
    """Choose a renderer by its name, or a trained network (.onnx), which is another one when it was trained further. Raises InputError."""
    from mrbokeh.renderers.choose import make_renderer

    path = Path(name)
    renderer = make_renderer(name)
    if path.suffix.lower() != ".onnx":
        return Reblur(renderer, name)
    return Reblur(renderer, f"{path.resolve()}, {path.stat().st_mtime_ns}")


def lens_with_growth(px_per_dioptre: float, width_px: int, aperture: Aperture) -> Lens:
    """A lens focused at 1 m whose circle of confusion grows so fast: renderers take depth and lens, and maps come without either."""
    lens = Lens(50.0, 2.0, 1.0, 36.0, aperture)
    return Lens(50.0, 2.0, 1.0, 36.0 * lens.coc_px_per_dioptre(width_px) / px_per_dioptre, aperture)


def depth_with(coc_px: Plane, lens: Lens) -> Plane:
    """(H, W) metres at which the lens has these diameters, none of which is larger than its growth per dioptre."""
    dioptres = 1.0 / lens.focus_distance_m - coc_px.astype(np.float64) / lens.coc_px_per_dioptre(coc_px.shape[1])
    return (1.0 / dioptres).astype(np.float32)
