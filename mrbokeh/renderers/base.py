"""The renderer protocol: layers and a lens in, one blurred layer out.

Every renderer conserves these (tests/renderers/test_renderers.py):
- energy: the light of a layer of one depth, far from the border, is as much after as before, colour and coverage alike;
- identity: what is in focus (a circle of confusion below one pixel) stays as it was;
- support: a point spreads no farther than its circle of confusion;
- symmetry: mirroring the picture mirrors the result of a symmetric aperture; a point in front of the focus shows the
  aperture mirrored;
- linearity: doubled light gives doubled results; alpha is blurred with the same weights as premultiplied colour;
- occlusion: an opaque layer in front hides what is behind it, and a transparent one changes nothing.
Learned renderers hold them within their stated accuracy.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens


@runtime_checkable
class Renderer(Protocol):
    """Blurs layers, front first, as a lens focused at `lens.focus_distance_m` sees them.

    What is costly and fixed goes to the constructor of an implementation; what changes per frame (the focus) to render.
    """

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        """Return one layer with premultiplied alpha; its depth is that of the sharp layers, front first."""
        ...
