"""What is known exactly about a made RAW stack, as the JSON file beside it."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets_scripts.desk_scene import FAR_FOCUS_M, NEAR_FOCUS_M, desk_camera
from datasets_scripts.dng_writer import film_plane_distance_m
from datasets_scripts.sensor_model import SensorModel
from mrbokeh.aperture import Aperture
from mrbokeh.camera_file import camera_to_json
from mrbokeh.lens import Lens
from mrbokeh.lens_file import lens_to_json

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
    "focal_px(reference) / focal_px(slice i)."
)


@dataclass(frozen=True)
class StackPlan:
    """Everything that decides the pixels of a made stack.

    samples: lens rays per pixel; the truth takes as many pinhole rays.
    """

    viewpoints: int = 3
    slices: int = 9
    width_px: int = 544
    height_px: int = 360
    seed: int = 1
    samples: int = 256
    sensor: SensorModel = field(default_factory=SensorModel)

    def lens_at(self, slice_index: int) -> Lens:
        """Hexagonal iris on purpose: it is point-symmetric, so that front and back blur look alike to a network fed with |CoC|."""
        return Lens(35.0, 2.0, float(self.focus_distances_m[slice_index]), 23.5, Aperture.disc().obstructed(0.5))

    @property
    def focus_distances_m(self) -> Float[np.ndarray, " slices"]:
        """From the lens, near to far, equally spaced in dioptres so that the blur between neighbours is the same everywhere."""
        return 1.0 / np.linspace(1.0 / NEAR_FOCUS_M, 1.0 / FAR_FOCUS_M, self.slices)


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
            {"reference_camera": camera_to_json(desk_camera(view, plan.width_px, plan.height_px, reference))}
            for view in range(plan.viewpoints)
        ],
        "truth_units": "scene-linear Rec.709 RGB, 1.0 = raw white of green at exposure 1; Z in metres along the optical axis at pixel "
        "centres",
        "sensor": _sensor_document(sensor),
        "relation": _RELATION,
    }


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
