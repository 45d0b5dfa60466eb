"""OverlaySource: the protocol of what lies over the camera's picture, and the status that the page shows of it."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from mrbokeh.compositing.overlay import CodeTables, Overlay
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from viewfinder.frames import Bgr, Remark
from viewfinder.tracking.tracker import TrackedPose


@dataclass(frozen=True)
class StageStatus:
    """Status that the page shows beside the picture.

    layer_age_ms: since the drawing that is shown was begun, None before the first. lens: that blurred it.

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


@runtime_checkable
class OverlaySource(Protocol):
    """Source of what lies over the camera's picture. `overlay` and `picture` belong to the compositing thread. Points: px of the frame.

    views: that `picture` can show.
    """

    views: tuple[str, ...]

    @property
    def status(self) -> StageStatus: ...

    def overlay(self, pose: TrackedPose | None, intrinsics: Camera, lens: Lens, time_s: float) -> Overlay:
        """Return what lies over the frame now; must be fast, the drawing of it happens elsewhere."""
        ...

    @property
    def remark(self) -> Remark | None:
        """Why the overlay that was asked for last, with a certain pose, shows nothing; None where it does, or soon will."""
        ...

    def picture(self, view: str, plate_bgr: Bgr, tables: CodeTables) -> Bgr:
        """Return one of `views`, of the frame for which `overlay` was asked last."""
        ...

    def depth_at_m(self, x_px: float, y_px: float) -> float:
        """Return the depth seen there; InputError where nothing is known."""
        ...

    def sharp_layers(self, camera: Camera) -> list[Layer]:
        """Return everything virtual in focus as a camera (with pose) sees it now, front first; may take its time."""
        ...

    def set_renderer(self, name: str, renderer: Renderer) -> None: ...

    def close(self) -> None: ...
