"""Parts that several pictures of one photograph share, so that the second is made sooner: opened files, prepared scenes, light."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.plate_light import Surroundings, surroundings_of
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.staging.staged_scene import Assets

if TYPE_CHECKING:
    from mrbokeh.scene import SceneRenderer
    from mrbokeh.scene.light import Environment, Light
    from mrbokeh.scene.staging.filming import Filming

SunDegrees = tuple[float, float]

_DRAFT_EDGES, _DRAFT_SAMPLES, _DRAFT_PX = 4, 32, 4_000


@dataclass
class KeptParts:
    """Parts that are kept from picture to picture; for one thread and one photograph.

    draft: while True, pictures are made in a hurry, as while an object is dragged: the last place's light serves every place, edges have
    fewer steps, and light on the ground is computed in few pixels. small: while True, objects that were prepared are only moved, which
    differs by rounding, as nobody sees in a picture made smaller. holds_light: while True, the last place's light serves,
    as for a part of a picture, which does not show its surroundings.
    """

    assets: Assets = field(default_factory=Assets)
    draft: bool = False
    small: bool = False
    holds_light: bool = False
    _renderers: "dict[tuple[str, int, bool], SceneRenderer]" = field(default_factory=dict)
    _around: tuple[object, Surroundings] | None = None
    _light: "tuple[object, tuple[Environment, tuple[Light, ...]]] | None" = None

    def renderer(self, filming: "Filming") -> "SceneRenderer":
        """Return the renderer of these settings, with what it prepared for earlier drafts and small pictures.

        A whole picture has a new one: an object that was prepared elsewhere and moved differs by the rounding of its corners.
        """
        if not (self.draft or self.small):
            return filming.renderer()
        key = (filming.backend, filming.samples if filming.backend == "mitsuba" else 0, filming.denoise)
        if key not in self._renderers:
            self._renderers[key] = filming.renderer()
        whole = self._renderers[key]
        return whole.with_quality(_DRAFT_EDGES) if self.draft and isinstance(whole, EmbreeRaycaster) else whole

    def filming(self, filming: "Filming") -> "Filming":
        """Return the settings of a draft while one is made."""
        if filming.backend == "mitsuba" or not self.draft:
            return filming
        return replace(filming, samples=_DRAFT_SAMPLES, change_px=_DRAFT_PX, finer_change=False)

    def light(
        self, plate: Plate, foot_px: tuple[float, float], world_from_camera: np.ndarray, sun_degrees: SunDegrees | None
    ) -> "tuple[Environment, tuple[Light, ...]]":
        """Return `picture_light`, the very same objects for the same place, because renderers keep what they prepared for them."""
        key = (plate.rgb.shape, foot_px, world_from_camera.tobytes())
        if self._around is None or (self._around[0] != key and not (self.draft or self.holds_light)):
            self._around = key, surroundings_of(plate, foot_px, world_from_camera)
        lit_by = (self._around[0], sun_degrees)
        if self._light is None or self._light[0] != lit_by:
            self._light = lit_by, self._around[1].light(sun_degrees)
        return self._light[1]
