"""Drawing of a lens's bokeh: the outline of its opening, which a small light far out of focus shows."""

from pathlib import Path

from mrbokeh.renderers.choose import read_lens
from mrbokeh.system.errors import InputError

_SIDE_PX, _RADIUS_PX = 64, 26.0


def bokeh_svg(path: Path) -> str:
    """Return a small SVG of a lens's opening; a network, whose blur has no outline, is drawn as a dashed disc."""
    try:
        if path.suffix.lower() == ".onnx":
            return _svg(f'<circle r="{_RADIUS_PX}" fill="none" stroke="#f0b429" stroke-width="2" stroke-dasharray="4 3"/>')
        aperture = read_lens(path).aperture
    except InputError:
        return _svg('<text text-anchor="middle" fill="#e8e6e1" font-size="12">?</text>')
    scale = _RADIUS_PX / max(aperture.unit_radius, 1e-6)
    rings = [" ".join(f"{scale * x:.2f},{scale * y:.2f}" for x, y in outline) for outline in aperture.outlines]
    path_data = " ".join(f"M {ring} Z" for ring in rings)
    return _svg(f'<path d="{path_data}" fill="#f0b429" fill-rule="evenodd"/>')


def _svg(drawn: str) -> str:
    half = _SIDE_PX / 2
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-half} {-half} {_SIDE_PX} {_SIDE_PX}">{drawn}</svg>'
