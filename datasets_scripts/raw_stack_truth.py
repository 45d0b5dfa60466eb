"""What is known exactly about a made RAW stack, as the JSON file beside it."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets_scripts.dng_writer import film_plane_distance_m
from datasets_scripts.sensor_model import SensorModel
from datasets_scripts.stack_scenes import STACK_SCENES, StackScene
from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-raw-stack-truth"
VERSION = 1

_RELATION = (
    "raw share = (raw - black_level) / (white_level - black_level) at each photosite = camera_from_rec709 @ rgb of the colour "
    "under it, times exposure, plus noise, clipped at 1. A reader that divides by as_shot_neutral (white balance, raw white of "
    "green = 1.0) and applies rec709_from_balanced_camera gets exposure * rgb of the traced slice; exposure is "
    "2^-BaselineExposure."
)
_REFERENCE = (
    "all_in_focus.exr and depth.exr are seen by a pinhole in the middle of the lens with reference_camera: the focal length in "
    "pixels of slice 0, the nearest focus, which sees the narrowest field. Slice i maps onto it by scaling about principal_px by "
    "focal_px(reference) / focal_px(slice i), or where slices were jittered by views[V].reference_from_slice[i]."
)


@dataclass(frozen=True)
class StackPlan:
    """Everything that decides the pixels of a made stack.

    samples: lens rays per pixel; the truth takes as many pinhole rays.
    stacks: how many of the viewpoints are photographed; of the others there is truth only.
    jitter_px, jitter_deg: by how much slices (but the reference) are shifted and rolled about the middle, as by a loose tripod.
    scene: a name of STACK_SCENES.
    """

    viewpoints: int = 3
    slices: int = 9
    width_px: int = 544
    height_px: int = 360
    seed: int = 1
    samples: int = 256
    sensor: SensorModel = field(default_factory=SensorModel)
    scene: str = "desk"
    stacks: int | None = None
    jitter_px: float = 0.0
    jitter_deg: float = 0.0

    @property
    def stage(self) -> StackScene:
        if self.scene not in STACK_SCENES:
            raise InputError(f"expected one of the scenes {', '.join(STACK_SCENES)}, got {self.scene!r}")
        return STACK_SCENES[self.scene]

    @property
    def photographed(self) -> int:
        """Viewpoints with slices."""
        return self.viewpoints if self.stacks is None else min(self.stacks, self.viewpoints)

    def lens_at(self, slice_index: int) -> Lens:
        return self.stage.lens.focused_at(float(self.focus_distances_m[slice_index]))

    @property
    def focus_distances_m(self) -> Float[np.ndarray, " slices"]:
        """From the lens, near to far, equally spaced in dioptres so that the blur between neighbours is the same everywhere."""
        return 1.0 / np.linspace(1.0 / self.stage.near_m, 1.0 / self.stage.far_m, self.slices)

    def reference_camera(self, view: int) -> Camera:
        """Where the truth is seen from: the geometry of slice 0, the nearest focus, which sees the narrowest field."""
        return self.stage.camera(view, self.width_px, self.height_px, self.lens_at(0))

    def camera_at(self, view: int, slice_index: int) -> Camera:
        """The camera of one slice: breathed, shifted and rolled."""
        camera = self.stage.camera(view, self.width_px, self.height_px, self.lens_at(slice_index))
        shift_px, roll_rad = self.jitter_of(view, slice_index)
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
        x_px, y_px = (float(middle + shift) for middle, shift in zip(camera.principal_px, shift_px, strict=True))
        return replace(camera, principal_px=(x_px, y_px), camera_from_world=turn @ camera.camera_from_world)

    def jitter_of(self, view: int, slice_index: int) -> tuple[Float[np.ndarray, "2"], float]:
        """(shift in pixels, roll in radians) of a slice; none for the reference. The shift is at most jitter_px long."""
        if slice_index == 0:
            return np.zeros(2), 0.0
        rng = np.random.default_rng([self.seed, view, slice_index, 7])
        length_px, angle = self.jitter_px * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        roll_rad = np.deg2rad(self.jitter_deg) * rng.uniform(-1.0, 1.0)
        return length_px * np.array([np.cos(angle), np.sin(angle)]), float(roll_rad)

    def reference_from_slice(self, view: int, slice_index: int) -> Float[np.ndarray, "2 3"]:
        """The similarity that takes pixel positions of a slice to those of the reference, exactly."""
        slice_px, reference_px = (_pixels_from_plane(camera) for camera in (self.camera_at(view, slice_index), self.reference_camera(view)))
        _, roll_rad = self.jitter_of(view, slice_index)
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
        return (reference_px @ np.linalg.inv(slice_px @ turn))[:2]


def _pixels_from_plane(camera: Camera) -> Float[np.ndarray, "3 3"]:
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def truth_document(plan: StackPlan) -> dict[str, Any]:
    """The content of truth.json; it is known before any ray is traced, so it also tells whether a folder holds this very plan."""
    sensor = plan.sensor
    reference = plan.lens_at(0)
    step_dioptre = float(np.diff(1.0 / plan.focus_distances_m).mean()) if plan.slices > 1 else 0.0
    return {
        "format": FORMAT,
        "version": VERSION,
        "plan": {key: value for key, value in asdict(plan).items() if key != "sensor"},
        "files": {"slice": "view_{view}/slice_{slice:02d}.dng", "truth": "truth/view_{view}/all_in_focus.exr, truth/view_{view}/depth.exr"},
        "lens": lens_to_json(reference),
        "focus_distances_m": plan.focus_distances_m.tolist(),
        "film_plane_distances_m": [film_plane_distance_m(plan.lens_at(i)) for i in range(plan.slices)],
        "focal_px": [plan.lens_at(i).focal_px(plan.width_px) for i in range(plan.slices)],
        "distances": "focus_distances_m count from the lens, film_plane_distances_m = d_f + d_s from the sensor (thin lens), "
        "as in EXIF SubjectDistance",
        "step_dioptre": abs(step_dioptre),
        "largest_residual_coc_px": abs(step_dioptre) / 2.0 * reference.coc_px_per_dioptre(plan.width_px),
        "reference_slice": 0,
        "reference": _REFERENCE,
        "views": [
            {"reference_camera": camera_to_json(plan.reference_camera(view))} | _jitter_document(plan, view)
            for view in range(plan.viewpoints)
        ],
        "truth_units": "scene-linear Rec.709 RGB, 1.0 = raw white of green at exposure 1; Z in metres along the optical axis at pixel "
        "centres",
        "sensor": _sensor_document(sensor),
        "relation": _RELATION,
    } | plan.stage.facts


def _jitter_document(plan: StackPlan, view: int) -> dict[str, Any]:
    if view >= plan.photographed or not (plan.jitter_px or plan.jitter_deg):
        return {}
    return {"reference_from_slice": [plan.reference_from_slice(view, index).tolist() for index in range(plan.slices)]}


def _sensor_document(sensor: SensorModel) -> dict[str, Any]:
    balanced_from_rec709 = np.diag(1.0 / sensor.as_shot_neutral) @ sensor.camera_from_rec709
    return asdict(sensor) | {
        "camera_from_xyz": [list(row) for row in sensor.camera_from_xyz],
        "white_level": sensor.white_level,
        "as_shot_neutral": sensor.as_shot_neutral.tolist(),
        "camera_from_rec709": sensor.camera_from_rec709.tolist(),
        "rec709_from_balanced_camera": np.linalg.inv(balanced_from_rec709).tolist(),
        "noise": "Poisson photons at full_well_electrons = raw white, Gaussian read noise; None or 0 electrons: no noise",
    }
