"""The plan of a truth set: scenes, views, the five openings, focus distances, and the camera and lenses that see them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from datasets_scripts.scenes.truth_scenes import SCENES
from datasets_scripts.tracers.truth import Opening
from datasets_scripts.tracers.truth_scene import TruthScene
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

_MAKERS: dict[str, Callable[[], Aperture]] = {
    "disc": Aperture.disc,
    "blades7": lambda: Aperture.blades(7, 0.3, 0.35),
    "heart": Aperture.heart,
    "ring": lambda: Aperture.ring(0.55),
    "cat_eye": lambda: replace(Aperture.disc(), cat_eye=0.7),
}
SHAPE_NAMES = tuple(_MAKERS)


def lens_shape(name: str) -> Aperture:
    if name not in _MAKERS:
        raise InputError(f"expected an aperture out of {', '.join(SHAPE_NAMES)}, got {name!r}")
    return _MAKERS[name]()


FOCAL_LENGTH_MM, F_NUMBER, SENSOR_WIDTH_MM = 50.0, 1.2, 36.0
CONVENTIONS = {
    "blur": "a point at depth z is moved by u * coc / 2 for the lens point u of the unit pupil (x right, y down), with "
    "coc = coc_px_per_dioptre * (1 / focus - 1 / z), which is what Lens.coc_px of this project gives; the camera never changes",
    "cat_eye": "the pupil is clipped by a circle of radius 1 around -cat_eye * field_xy, the place of the point seen, from the "
    "middle of the frame in half diagonals",
    "pixel": "mean scene-linear radiance over the pixel's square and over the open part of the pupil, so that nothing is vignetted",
    "depth": "metres along the optical axis at the pixel's centre, or those of a lamp that gives over half of the pixel's light; "
    "inf is the sky",
    "layers": "front first, premultiplied: the thin foreground alone, then everything else as it is without it, lit and shadowed "
    "as in the whole scene; Z of a layer as above, or at the nearest place where the layer covers a part of the pixel",
}

_LAMP_RAYS_PER_SAMPLE = 1024
_STEP_ASIDE_M = 0.07
_SMALLEST_PX = 16


@dataclass(frozen=True)
class TruthPlan:
    """Settings of a set; equal plans give equal pictures, but for the rounding of lamps' light, which threads add in any order.

    samples: camera rays per pixel, best a power of two; each lamp sends out 1024 times as many rays.
    """

    width_px: int = 640
    height_px: int = 360
    samples: int = 256
    seed: int = 1
    views: int = 1
    scenes: tuple[str, ...] = tuple(SCENES)
    shapes: tuple[str, ...] = SHAPE_NAMES

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px) < _SMALLEST_PX or min(self.samples, self.views) < 1 or self.seed < 0:
            raise InputError(
                f"a truth set needs pictures of at least {_SMALLEST_PX}x{_SMALLEST_PX} px, 1 sample, 1 view and a seed from 0 up, but came "
                f"with {self.width_px}x{self.height_px} px, {self.samples} samples, {self.views} views and seed {self.seed}"
            )
        for asked, known, what in ((self.scenes, tuple(SCENES), "scenes"), (self.shapes, SHAPE_NAMES, "apertures")):
            if not asked or set(asked) - set(known):
                raise InputError(f"expected {what} out of {','.join(known)}, got {','.join(asked) or 'none'}")

    @property
    def lamp_rays(self) -> int:
        return self.samples * _LAMP_RAYS_PER_SAMPLE

    def camera(self, view: int) -> Camera:
        """Return a view: the first straight ahead, others from beside it; the field of view is that of the lens focused at infinity."""
        focal_px = FOCAL_LENGTH_MM * self.width_px / SENSOR_WIDTH_MM
        angle_rad, aside_m = 2.4 * view, _STEP_ASIDE_M * min(view, 1)
        camera_from_world = np.eye(4)
        camera_from_world[:2, 3] = -aside_m * np.array([np.cos(angle_rad), 0.5 * np.sin(angle_rad)])
        return Camera(
            width_px=self.width_px,
            height_px=self.height_px,
            focal_px=(focal_px, focal_px),
            principal_px=(0.5 * self.width_px, 0.5 * self.height_px),
            camera_from_world=camera_from_world,
        )

    def lens(self, shape: str, focus_distance_m: float) -> Lens:
        return Lens(
            focal_length_mm=FOCAL_LENGTH_MM,
            f_number=F_NUMBER,
            focus_distance_m=focus_distance_m,
            sensor_width_mm=SENSOR_WIDTH_MM,
            aperture=lens_shape(shape),
        )

    def opening(self, shape: str, focus_distance_m: float) -> Opening:
        """Return the pupil that gives the fixed camera exactly the blur of `Lens.coc_px`.

        A lens that is focused nearer stands farther from its film and blurs more by the same factor. Here the film stays where
        it is, and the pupil grows by that factor.
        """
        per_dioptre_px = self.lens(shape, focus_distance_m).coc_px_per_dioptre(self.width_px)
        return Opening(lens_shape(shape), per_dioptre_px / self.camera(0).focal_px[0], focus_distance_m)


def truth_name(shape: str, focus_index: int) -> str:
    return f"{shape}_{focus_index}.exr"


def view_document(plan: TruthPlan, name: str, scene: TruthScene, view: int) -> dict[str, object]:
    """Return meta.json of one view."""
    camera, distances_m = plan.camera(view), list(scene.focus_distances_m)
    return {
        "format": "mrbokeh-truth",
        "version": 1,
        "scene": name,
        "kind": scene.kind,
        "seed": plan.seed,
        "view": view,
        "samples": plan.samples,
        "lamp_rays": plan.lamp_rays,
        "lamps": len(scene.lamps),
        "lens": {"focal_length_mm": FOCAL_LENGTH_MM, "f_number": F_NUMBER, "sensor_width_mm": SENSOR_WIDTH_MM},
        "focus_distances_m": distances_m,
        "coc_px_per_dioptre": [plan.lens("disc", each).coc_px_per_dioptre(plan.width_px) for each in distances_m],
        "pupil_diameters_m": [plan.opening("disc", each).diameter_m for each in distances_m],
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "focal_px": list(camera.focal_px),
            "principal_px": list(camera.principal_px),
            "camera_from_world": camera.camera_from_world.tolist(),
        },
        "apertures": {shape: _aperture_document(shape) for shape in plan.shapes},
        "truth": {shape: [f"truth/{truth_name(shape, index)}" for index in range(len(distances_m))] for shape in plan.shapes},
        "layers": ["layers/00.exr", "layers/01.exr"] if scene.kind == "thin" else [],
        "conventions": CONVENTIONS,
    }


def _aperture_document(shape: str) -> dict[str, object]:
    aperture = lens_shape(shape)
    outlines = [np.round(outline, 9).tolist() for outline in aperture.outlines]
    return {"outlines": outlines, "weights": list(aperture.weights), "cat_eye": aperture.cat_eye}
