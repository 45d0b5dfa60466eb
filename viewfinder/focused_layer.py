"""FocusedLayer: the virtual layer as the lens blurs it at the focus asked for, blurred again beside the running stream."""

import logging
import math
from dataclasses import dataclass
from threading import Event, Thread

import numpy as np

from mrbokeh.layer import Layer
from mrbokeh.lens import Lens
from mrbokeh.overlay import Overlay
from mrbokeh.renderers.base import Renderer
from viewfinder.newest import Newest

# A third of the light that the darkest step of 8-bit sRGB needs: weaker traces of a blur cannot be seen in the stream.
_INVISIBLE = 1e-4
_POLL_S = 0.1

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FocusedOverlay:
    overlay: Overlay
    focus_distance_m: float


class FocusedLayer:
    """A sharp layer, a lens and a renderer; `shown` is the newest finished blur, `focus` asks for another one.

    Focus distances that come while a blur is under way replace one another, so that the last one wins.
    """

    def __init__(self, sharp: Layer, lens: Lens, renderer: Renderer) -> None:
        self.sharp = sharp
        self._lens, self._renderer = lens, renderer
        self._wanted: Newest[Lens] = Newest()
        self._stopping, self._busy = Event(), Event()
        self.shown = self._blurred(lens)
        self._worker = Thread(target=self._work, name="focus", daemon=True)
        self._worker.start()

    @property
    def pending(self) -> bool:
        """Whether a focus distance was asked for that is not shown yet."""
        return self._busy.is_set() or self._wanted.waiting

    @property
    def dioptre_range(self) -> tuple[float, float]:
        """What a slider should reach: from infinity (0) to half the distance of the nearest virtual thing, if the lens can."""
        nearest_m = float(self.sharp.depth_m.min())
        closest_m = max(nearest_m / 2, 1.5 * self._lens.focal_length_mm / 1000) if math.isfinite(nearest_m) else 0.5
        return 0.0, 1.0 / closest_m

    def focus(self, focus_distance_m: float) -> None:
        """Ask for a focus distance (inf is allowed); InputError where the lens cannot focus there."""
        self._wanted.put(self._lens.focused_at(focus_distance_m))

    def close(self) -> None:
        self._stopping.set()
        self._worker.join()

    def _work(self) -> None:
        while not self._stopping.is_set():
            lens = self._wanted.take(_POLL_S)
            if lens is None:
                continue
            self._busy.set()
            try:
                self.shown = self._blurred(lens)
            except Exception:
                # The stream goes on with the old blur; a renderer may refuse a focus that another one accepts.
                log.exception("the layer could not be blurred at %s m", lens.focus_distance_m)
            finally:
                self._busy.clear()

    def _blurred(self, lens: Lens) -> FocusedOverlay:
        blurred = self._renderer.render([self.sharp], lens)
        return FocusedOverlay(Overlay.of(blurred, np.float32(_INVISIBLE).item()), lens.focus_distance_m)
