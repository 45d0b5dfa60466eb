"""The plan of a set of bokeh stacks: scenes, viewpoints, focus distances, the lens, and which stacks are tested on.

Openings are the four of Neural Bokeh's synthetic sets (Mandl et al. 2024, Figure 5): heart, circle, bladed, round.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from datasets_scripts.made_sets.set_files import distant_camera, even_in_dioptres
from datasets_scripts.scenes.bokeh_scenes import KINDS
from datasets_scripts.tracers.pupil import FieldStop
from datasets_scripts.tracers.truth import Opening
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack_dataset import Part
from mrbokeh.system.errors import InputError

_RING = FieldStop()
_ROUND_WITH_RIM = replace(Aperture.disc(), cat_eye=0.35)
NEAREST_FOCUS_M, FARTHEST_FOCUS_M = 0.9, 6.5
_LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=NEAREST_FOCUS_M, sensor_width_mm=36.0)
TEST_SHARE = 0.2
_MOST_ASIDE_M = (0.16, 0.08, 0.04)
_SMALLEST_PX = 16


@dataclass(frozen=True, eq=False)
class BokehShape:
    """An opening. aperture, stop: what rays go through. stated: the aperture as a lens file can say it; of a stop, that of the middle."""

    aperture: Aperture
    stated: Aperture
    stop: FieldStop | None = None

    def seen(self, side: int, field_xy: tuple[float, float]) -> Aperture:
        """Return the plain aperture at a place of the frame (half diagonals), whether the lens file can state it or not."""
        return self.aperture.seen(side, field_xy) if self.stop is None else self.stop.seen(self.aperture, field_xy)

    def document(self) -> dict[str, Any]:
        """Return what the lens file leaves out, for the manifest."""
        if self.stop is None:
            return {"lens_file": "states the opening exactly"}
        return {
            "lens_file": "states the opening of the middle of the frame and the rim; the stop also changes with x, as follows",
            "rim": "a circle of radius 1 about -cat_eye * field_xy clips the unit pupil",
            "stop": "a disc: radius + (radius_left - radius) * clip(-x / edge, 0, 1), moved right by shift_right * clip(x / edge, 0, 1)",
            "cat_eye": self.aperture.cat_eye,
            **vars(self.stop),
        }


def _same(aperture: Aperture) -> BokehShape:
    return BokehShape(aperture, aperture)


SHAPES: dict[str, Callable[[], BokehShape]] = {
    "heart": lambda: _same(Aperture.heart()),
    "ring": lambda: BokehShape(_ROUND_WITH_RIM, _ROUND_WITH_RIM.obstructed(_RING.radius), _RING),
    "bladed": lambda: _same(Aperture.blades(7, -0.5 * np.pi)),
    "round": lambda: _same(Aperture.disc()),
}


@lru_cache(maxsize=len(SHAPES))
def bokeh_shape(name: str) -> BokehShape:
    if name not in SHAPES:
        raise InputError(f"expected a shape out of {', '.join(SHAPES)}, got {name!r}")
    return SHAPES[name]()


@dataclass(frozen=True)
class StackSize:
    """Extent of a set. samples: camera rays per pixel, in two halves, best powers of two; each lamp sends out lamp_rays.

    fewer_in_training: so many times fewer rays for the slices of training stacks. Their noise has no mean, so that a network that fits
    many of them learns the same (Lehtinen et al. 2018, Noise2Noise); sharp pictures and slices to test on keep all rays.
    """

    scenes: tuple[str, ...]
    views: int
    focuses: int
    width_px: int
    height_px: int
    f_number: float
    samples: int
    lamp_rays: int
    fewer_in_training: int = 1

    def __post_init__(self) -> None:
        least = min(self.views, self.focuses, self.samples // self.fewer_in_training // 2, self.lamp_rays // self.fewer_in_training // 2)
        if least < 1 or min(self.width_px, self.height_px) < _SMALLEST_PX or not self.scenes:
            raise InputError(
                f"a set needs scenes, at least one view and one focus, pictures of at least {_SMALLEST_PX}x{_SMALLEST_PX} px and 2 "
                f"samples, got {len(self.scenes)} scenes, {self.views} views, {self.focuses} focuses, {self.width_px}x{self.height_px} px "
                f"and {self.samples} samples"
            )


# full: as many as Mandl et al. 2024 rendered (section 4.1), with their "large" blur of about 81 px (Table 2).
SIZES = {
    "small": StackSize(
        scenes=("garlands_1", "fence_1", "checkers_1", "leaves_1", "garlands_2"),
        views=2,
        focuses=5,
        width_px=192,
        height_px=112,
        f_number=1.1,
        samples=128,
        lamp_rays=1 << 16,
    ),
    "medium": StackSize(
        scenes=tuple(f"{kind}_{number}" for number in (1, 2, 3) for kind in KINDS),
        views=15,
        focuses=10,
        width_px=192,
        height_px=112,
        f_number=1.1,
        samples=128,
        lamp_rays=1 << 16,
        fewer_in_training=4,
    ),
    "full": StackSize(
        scenes=tuple(f"{kind}_{number}" for number in (1, 2, 3) for kind in KINDS),
        views=15,
        focuses=10,
        width_px=1920,
        height_px=1080,
        f_number=2.0,
        samples=256,
        lamp_rays=1 << 21,
    ),
}


@dataclass(frozen=True)
class StacksPlan:
    """Settings of a set; equal plans give equal pictures, but for the rounding of lamps' light, which threads add in any order."""

    shape: str
    size: StackSize = field(default_factory=lambda: SIZES["small"])
    seed: int = 1

    @property
    def opening(self) -> BokehShape:
        return bokeh_shape(self.shape)

    def rays(self, name: str) -> tuple[int, int]:
        """Return (rays per pixel, rays of each lamp) of a stack's slices: twice as many per pixel where a stop takes two thirds of them."""
        fewer = self.size.fewer_in_training if self.parts().get(name) == "train" else 1
        return self.size.samples * (1 if self.opening.stop is None else 2) // fewer, self.size.lamp_rays // fewer

    @property
    def names(self) -> list[str]:
        """SCENE/VIEW of every stack."""
        return [f"{scene}/{self.view_name(view)}" for scene in self.size.scenes for view in range(self.size.views)]

    @staticmethod
    def view_name(view: int) -> str:
        return f"view_{view:02d}"

    @property
    def focus_distances_m(self) -> tuple[float, ...]:
        return even_in_dioptres(NEAREST_FOCUS_M, FARTHEST_FOCUS_M, self.size.focuses)

    def parts(self) -> dict[str, Part]:
        """Tell which fifth of the stacks is for testing: a tenth of the scenes (at least one of several) as a whole, and of the others the
        last views until the fifth is full, one of each scene before a second one.
        """
        scenes, views = self.size.scenes, self.size.views
        whole = min(max(1, round(0.5 * TEST_SHARE * len(scenes))), len(scenes) - 1)
        apart = {f"{scene}/{self.view_name(view)}" for scene in scenes[len(scenes) - whole :] for view in range(views)}
        rest = [f"{scene}/{self.view_name(view)}" for view in reversed(range(1, views)) for scene in scenes[: len(scenes) - whole]]
        apart.update(rest[: max(0, round(TEST_SHARE * len(self.names)) - len(apart))])
        return {name: "test" if name in apart else "train" for name in self.names}

    def camera(self, scene: str, view: int) -> Camera:
        """Return the first view straight ahead from the middle, others from random places beside it; all look along the axis, since lamps
        are discs that face it. The field of view is that of the lens focused at infinity.
        """
        rng = np.random.default_rng([self.seed, view, *scene.encode()])
        camera_from_world = np.eye(4)
        camera_from_world[:3, 3] = rng.uniform(-1.0, 1.0, 3) * _MOST_ASIDE_M * min(view, 1)
        return replace(self._ahead, camera_from_world=camera_from_world)

    @property
    def _ahead(self) -> Camera:
        return distant_camera(self.lens(NEAREST_FOCUS_M), self.size.width_px, self.size.height_px)

    def lens(self, focus_distance_m: float) -> Lens:
        """Return the lens that the lens file states."""
        return replace(_LENS, f_number=self.size.f_number, focus_distance_m=focus_distance_m, aperture=self.opening.stated)

    def traced_opening(self, focus_distance_m: float) -> Opening:
        """Return the pupil that gives the fixed camera the blur of `Lens.coc_px`: it grows as the lens moves out to focus nearer."""
        per_dioptre_px = self.lens(focus_distance_m).coc_px_per_dioptre(self.size.width_px)
        return Opening(self.opening.aperture, per_dioptre_px / self._ahead.focal_px[0], focus_distance_m, self.opening.stop)
