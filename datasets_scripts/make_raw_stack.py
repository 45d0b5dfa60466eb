"""Make RAW focal stacks with known truth: a traced still life, photographed by a simulated camera into DNG files.

    python -m datasets_scripts.make_raw_stack --out DIR [--viewpoints 3 --slices 7 --width 576 --height 384 --seed 1 --samples 512]
    python -m datasets_scripts.make_raw_stack --out DIR --scene lab --viewpoints 7 --stacks 1 --slices 12 --width 960 --height 640 \
        --jitter-px 1.2 --jitter-deg 0.03 --full-well 10000 --samples 96

DIR/view_V/slice_SS.dng are the photographs; DIR/truth.json (all that is known exactly), DIR/truth/view_V/all_in_focus.exr and depth.exr
the truth. Finished files are kept, so an interrupted run goes on where it stopped.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import timedelta
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from jaxtyping import Float

from datasets_scripts.made_sets.set_files import Job, claim_folder, make_missing, mistakes_told
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from datasets_scripts.scenes.stack_scenes import STACK_SCENES, StackScene
from datasets_scripts.tracers.thin_lens import trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import Scene
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.optics.lens import Lens, film_plane_m
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
_BETWEEN_SLICES = timedelta(seconds=2)
_BETWEEN_VIEWS = timedelta(minutes=5)


@dataclass(frozen=True)
class StackPlan:
    """Settings that decide the pixels of a made stack.

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
        """Number of viewpoints with slices."""
        return self.viewpoints if self.stacks is None else min(self.stacks, self.viewpoints)

    def lens_at(self, slice_index: int) -> Lens:
        return self.stage.lens.focused_at(float(self.focus_distances_m[slice_index]))

    @property
    def focus_distances_m(self) -> Float[np.ndarray, " slices"]:
        """Focus distances from the lens, near to far, evenly in dioptres: the blur between neighbours is the same everywhere."""
        return 1.0 / np.linspace(1.0 / self.stage.near_m, 1.0 / self.stage.far_m, self.slices)

    def reference_camera(self, view: int) -> Camera:
        """Return the camera that the truth is seen from: the geometry of slice 0, the nearest focus, which sees the narrowest field."""
        return self.stage.camera(view, self.width_px, self.height_px, self.lens_at(0))

    def camera_at(self, view: int, slice_index: int) -> Camera:
        """Return the camera of one slice: breathed, shifted and rolled."""
        camera = self.stage.camera(view, self.width_px, self.height_px, self.lens_at(slice_index))
        shift_px, roll_rad = self.jitter_of(view, slice_index)
        turn = _turn(roll_rad, 4)
        x_px, y_px = (float(middle + shift) for middle, shift in zip(camera.principal_px, shift_px, strict=True))
        return replace(camera, principal_px=(x_px, y_px), camera_from_world=turn @ camera.camera_from_world)

    def jitter_of(self, view: int, slice_index: int) -> tuple[Float[np.ndarray, "2"], float]:
        """Return (shift in pixels, roll in radians) of a slice; none for the reference. The shift is at most jitter_px long."""
        if slice_index == 0:
            return np.zeros(2), 0.0
        rng = np.random.default_rng([self.seed, view, slice_index, 7])
        length_px, angle = self.jitter_px * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        roll_rad = np.deg2rad(self.jitter_deg) * rng.uniform(-1.0, 1.0)
        return length_px * np.array([np.cos(angle), np.sin(angle)]), float(roll_rad)

    def reference_from_slice(self, view: int, slice_index: int) -> Float[np.ndarray, "2 3"]:
        """Return the similarity that takes pixel positions of a slice to those of the reference, exactly."""
        slice_px, reference_px = (_pixels_from_plane(camera) for camera in (self.camera_at(view, slice_index), self.reference_camera(view)))
        _, roll_rad = self.jitter_of(view, slice_index)
        return (reference_px @ np.linalg.inv(slice_px @ _turn(roll_rad, 3)))[:2]


def make_raw_stack(out: Path, plan: StackPlan, *, overwrite: bool = False) -> int:
    """Write all that is missing of the plan into `out` and return how many jobs ran.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    most = plan.stage.viewpoints
    if not 1 <= plan.viewpoints <= most or plan.slices < 1:
        raise InputError(f"expected 1 to {most} viewpoints and at least 1 slice, got {plan.viewpoints} and {plan.slices}")
    jobs = list(_jobs(out, plan, cache(partial(plan.stage.build, plan.seed))))
    claim_folder(out / "truth.json", truth_document(plan), [path for job in jobs for path in job.paths], overwrite)
    return make_missing(jobs, "tracing")


def _jobs(out: Path, plan: StackPlan, scene: Callable[[], Scene]) -> Iterator[Job]:
    """Yield the files of a stack; the scene is built when the first of them is made."""
    for view in range(plan.viewpoints):
        folder = out / "truth" / f"view_{view}"
        yield Job((folder / "all_in_focus.exr", folder / "depth.exr"), partial(_make_truth, scene, plan, view, folder))
        for index in range(plan.slices if view < plan.photographed else 0):
            path = out / f"view_{view}" / f"slice_{index:02d}.dng"
            yield Job((path,), partial(_make_slice, scene, plan, view, index, path))


def _make_truth(scene: Callable[[], Scene], plan: StackPlan, view: int, folder: Path) -> None:
    rgb, depth_m = trace_pinhole(scene(), plan.reference_camera(view), plan.samples, plan.seed, plan.sensor.footprint_px)
    comment = "metres along the optical axis at pixel centres"
    write_exr(folder / "depth.exr", ExrPart({"Z": depth_m.astype(np.float16)}, attributes={"comments": comment}))
    write_image(folder / "all_in_focus.exr", rgb, half=True)


def _make_slice(scene: Callable[[], Scene], plan: StackPlan, view: int, index: int, path: Path) -> None:
    rgb = traced_slice(scene(), plan, view, index)
    mosaic = plan.sensor.photograph(rgb, np.random.default_rng([plan.seed, view, index]))
    base = ShotMetadata(plan.lens_at(index))
    taken_at = base.taken_at + view * _BETWEEN_VIEWS + index * _BETWEEN_SLICES
    write_dng(path, mosaic, plan.sensor, ShotMetadata(base.lens, taken_at=taken_at))


def traced_slice(scene: Scene, plan: StackPlan, view: int, index: int) -> np.ndarray:
    """Trace one slice as (H, W, 3) scene-linear Rec.709: what the sensor is given, before its colour filters and noise."""
    camera, seed = plan.camera_at(view, index), plan.seed * 1000 + view * 100 + index
    return trace(scene, camera, plan.lens_at(index), plan.samples, seed, plan.sensor.footprint_px)


def _turn(roll_rad: float, size: int) -> Float[np.ndarray, "size size"]:
    turn = np.eye(size)
    turn[:2, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    return turn


def _pixels_from_plane(camera: Camera) -> Float[np.ndarray, "3 3"]:
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def truth_document(plan: StackPlan) -> dict[str, Any]:
    """Return the content of truth.json; it is known before any ray is traced, so it also tells whether a folder holds this very plan."""
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
        "film_plane_distances_m": [film_plane_m(plan.lens_at(i)) for i in range(plan.slices)],
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


def main(
    out: Annotated[Path, typer.Option(help="Folder for the stack.")],
    scene: Annotated[str, typer.Option(help=f"One of {', '.join(STACK_SCENES)}.")] = "desk",
    viewpoints: Annotated[int, typer.Option(help="How many of the scene's viewpoints.")] = 3,
    stacks: Annotated[int | None, typer.Option(help="How many of them are photographed; of the others only the truth is made.")] = None,
    slices: int = 9,
    width: int = 544,
    height: int = 360,
    seed: Annotated[int, typer.Option(help="Textures, lights, sampling and noise.")] = 1,
    samples: Annotated[int, typer.Option(help="Lens rays per pixel.")] = 512,
    bits: Annotated[int, typer.Option(help="12 to 16.")] = 14,
    full_well: Annotated[float, typer.Option(help="Electrons at raw white: 10000 is 1 % photon noise there.")] = 60000.0,
    jitter_px: Annotated[float, typer.Option(help="Slices are shifted by up to this much.")] = 0.0,
    jitter_deg: Annotated[float, typer.Option(help="Slices are rolled by up to this much.")] = 0.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", "--force", help="Replace a stack made with other settings.")] = False,
) -> None:
    """Make DNG focal stacks of a still life with their all-in-focus image, depth and camera as truth."""
    # The black level keeps its share of the range at every bit depth.
    sensor = SensorModel(bits=bits, black_level=1008 * 2**bits // 2**14, full_well_electrons=full_well)
    size: dict[str, Any] = {"viewpoints": viewpoints, "stacks": stacks, "slices": slices, "width_px": width, "height_px": height}
    plan = StackPlan(**size, seed=seed, samples=samples, sensor=sensor, scene=scene, jitter_px=jitter_px, jitter_deg=jitter_deg)
    with mistakes_told():
        ran = make_raw_stack(out, plan, overwrite=overwrite)
    typer.echo(f"{out}: {'complete' if ran else 'nothing to do, all files were there'}")


if __name__ == "__main__":
    typer.run(main)
