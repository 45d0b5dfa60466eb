"""How a stage is doing: what the page shows beside the picture."""

import time
from dataclasses import dataclass

from mrbokeh.optics.lens import Lens
from viewfinder.stage.drawing_thread import DrawingThread, Drawn
from viewfinder.stage.drawn_layer import DrawRequest
from viewfinder.stage.redraw import blur_changed


@dataclass(frozen=True)
class StageStatus:
    """layer_age_ms: since the drawing that is shown was begun, None before the first. lens: that blurred it.

    focus_pending: another blur was asked for and is not shown yet. draws_per_s: over the last two seconds. busy: drawing now.
    resolution: of the drawing, 1 is every pixel. opacity: 0 where the track is lost. problem: a sentence for the page, or None.
    """

    layer_age_ms: float | None
    lens: Lens | None
    focus_pending: bool
    draws_per_s: float
    busy: bool
    resolution: float
    opacity: float
    triangles: int
    renderer: str
    problem: str | None


def status_of(thread: DrawingThread, wanted: DrawRequest | None, opacity: float) -> StageStatus:
    """wanted: what was asked for last, None before the first frame."""
    drawn, setup = thread.newest, thread.setup
    return StageStatus(
        layer_age_ms=None if drawn is None else 1e3 * (time.monotonic() - drawn.started_s),
        lens=None if drawn is None else drawn.drawing.request.lens,
        focus_pending=wanted is not None and (drawn is None or _blurred_otherwise(drawn, wanted)),
        draws_per_s=thread.draws_per_s,
        busy=thread.busy,
        resolution=1.0 if drawn is None else drawn.drawing.request.resolution,
        opacity=opacity,
        triangles=sum(each.triangle_count for each in setup.staged.objects),
        renderer=setup.renderer_name,
        problem=thread.problem,
    )


def _blurred_otherwise(drawn: Drawn, wanted: DrawRequest) -> bool:
    return blur_changed(drawn.drawing.request.lens, wanted.lens, drawn.drawing)
