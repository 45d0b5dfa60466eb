"""Seen: what the newest frame shows of the scene, for those who ask about it: picking and views."""

from dataclasses import dataclass

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.staged_scene import StagedScene
from viewfinder.stage.drawn_layer import Drawing
from viewfinder.stage.occlusion import Occlusion


@dataclass(frozen=True, eq=False)
class Seen:
    """camera: of the newest frame, upright. drawing: the one that was moved to it to become the overlay."""

    overlay: Overlay
    camera: Camera
    drawing: Drawing
    staged: StagedScene
    occlusion: Occlusion | None = None
