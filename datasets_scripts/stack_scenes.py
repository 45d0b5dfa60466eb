"""The scenes that RAW stacks are made of: what stands in them, where cameras stand, which lens photographs them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from datasets_scripts.desk_scene import FAR_FOCUS_M, NEAR_FOCUS_M, VIEWPOINTS, desk_camera, desk_scene
from datasets_scripts.lab_scene import LAB_FAR_M, LAB_NEAR_M, LAB_VIEWPOINTS, lab_camera, lab_facts, lab_scene
from datasets_scripts.traced_scene import Scene
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens


@dataclass(frozen=True)
class StackScene:
    """A scene with its viewpoints, lens and range of focus (metres from the lens); facts go into truth.json."""

    build: Callable[[int], Scene]
    camera: Callable[[int, int, int, Lens], Camera]
    viewpoints: int
    lens: Lens
    near_m: float
    far_m: float
    facts: dict[str, Any] = field(default_factory=dict)


def _desk(seed: int) -> Scene:
    return desk_scene(seed)


# A ring on purpose: it is point-symmetric, so that front and back blur look alike to a network fed with |CoC|.
_DESK_LENS = Lens(35.0, 2.0, NEAR_FOCUS_M, 23.5, Aperture.disc().obstructed(0.5))

STACK_SCENES = {
    "desk": StackScene(_desk, desk_camera, len(VIEWPOINTS), _DESK_LENS, NEAR_FOCUS_M, FAR_FOCUS_M),
    "lab": StackScene(
        lab_scene, lab_camera, len(LAB_VIEWPOINTS), Lens(28.0, 2.8, LAB_NEAR_M, 23.5), LAB_NEAR_M, LAB_FAR_M, facts=lab_facts()
    ),
}
