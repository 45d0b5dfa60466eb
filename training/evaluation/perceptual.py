"""LPIPS (Zhang et al. 2018) with weights that the user has.

None are shipped: its networks were trained on ImageNet photographs and its weights come under terms of their own; and it was made
for small 8-bit pictures, so that blurred lights above white are invisible to it. With the package `lpips` installed elsewhere, a file is
made by torch.onnx.export(lpips.LPIPS(net="alex"), (a, b), "lpips.onnx") with free height and width.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.renderers.network.onnx_sessions import open_session
from mrbokeh.system.errors import InputError

Image = Float32[np.ndarray, "height width 3"]
NOT_MEASURED = "LPIPS is not measured: no weights are shipped (see --lpips)."


class OnnxPerceptualDistance:
    """Distance of two linear pictures by a network (.onnx) that takes two (1, 3, H, W) sRGB pictures in [-1, 1] and gives one number."""

    def __init__(self, path: Path) -> None:
        if not path.is_file() or path.suffix.lower() != ".onnx":
            raise InputError(f"expected the weights of LPIPS as an .onnx file, got {path}: export them from the package lpips")
        self._session = open_session(path, providers=["cpu"])
        self._inputs = [each.name for each in self._session.get_inputs()]
        if len(self._inputs) != 2:
            raise InputError(f"expected {path} to take two pictures, but it takes {self._inputs}: export LPIPS with its two inputs")

    def __call__(self, result: Image, truth: Image) -> float:
        pictures = (encoded(result), encoded(truth))
        return float(np.squeeze(self._session.run(None, dict(zip(self._inputs, pictures, strict=True)))[0]))


def encoded(rgb: Image) -> Float32[np.ndarray, "1 3 height width"]:
    """sRGB of what a display shows, radiance clipped to [0, 1], mapped to [-1, 1]."""
    display = 2.0 * linear_to_srgb(np.clip(rgb, 0.0, 1.0)) - 1.0
    return np.ascontiguousarray(display.transpose(2, 0, 1)[None]).astype(np.float32)
