"""Make RAW focal stacks with known truth: a traced still life, photographed by a simulated camera into DNG files.

    python -m datasets_scripts.make_raw_stack --out DIR [--viewpoints 3 --slices 7 --width 576 --height 384 --seed 1 --samples 512]
    python -m datasets_scripts.make_raw_stack --out DIR --scene lab --viewpoints 7 --stacks 1 --slices 12 --width 960 --height 640 \
        --jitter-px 1.2 --jitter-deg 0.03 --full-well 10000 --samples 96

DIR/view_V/slice_SS.dng are the photographs; DIR/truth.json, DIR/truth/view_V/all_in_focus.exr and depth.exr the truth.
Finished files are kept, so an interrupted run goes on where it stopped.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from datasets_scripts.dng_writer import ShotMetadata, write_dng
from datasets_scripts.raw_stack_truth import StackPlan, truth_document
from datasets_scripts.sensor_model import SensorModel
from datasets_scripts.stack_scenes import STACK_SCENES
from datasets_scripts.thin_lens_tracer import trace, trace_pinhole
from datasets_scripts.traced_scene import Scene
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

_BETWEEN_SLICES = timedelta(seconds=2)
_BETWEEN_VIEWS = timedelta(minutes=5)


@dataclass(frozen=True)
class _Job:
    """One file (or pair of files) to make, and how."""

    paths: tuple[Path, ...]
    make: Callable[[Scene], None]

    @property
    def done(self) -> bool:
        return all(path.is_file() for path in self.paths)


def make_raw_stack(out: Path, plan: StackPlan, *, force: bool = False, progress: Callable[[int, int], None] | None = None) -> int:
    """Write all that is missing of the plan into `out`; returns how many jobs ran. `progress` hears (files done, files in all).

    Raises InputError where `out` holds something else, unless `force` says to replace it.
    """
    most = plan.stage.viewpoints
    if not 1 <= plan.viewpoints <= most or plan.slices < 1:
        raise InputError(f"expected 1 to {most} viewpoints and at least 1 slice, got {plan.viewpoints} and {plan.slices}")
    jobs = list(_jobs(out, plan))
    _claim_folder(out, plan, [path for job in jobs for path in job.paths], force)
    waiting = [job for job in jobs if not job.done]
    scene = plan.stage.build(plan.seed) if waiting else Scene()
    for index, job in enumerate(waiting):
        if progress:
            progress(len(jobs) - len(waiting) + index, len(jobs))
        job.make(scene)
    if progress:
        progress(len(jobs), len(jobs))
    return len(waiting)


def _claim_folder(out: Path, plan: StackPlan, paths: list[Path], force: bool) -> None:
    """Go on only in a folder that is empty or holds the same plan; truth.json is the sign of it and is written first."""
    truth_path, document = out / "truth.json", truth_document(plan)
    if force:
        for path in (*paths, truth_path):
            path.unlink(missing_ok=True)
    if truth_path.exists():
        if read_json(truth_path, "the truth of a RAW stack") != document:
            raise InputError(f"{out} holds a RAW stack made with other settings: choose another folder, or --force to replace its files")
    elif any(path.exists() for path in paths):
        raise InputError(f"{out} holds slices or truth without a truth.json: choose another folder, or --force to replace them")
    else:
        write_json(truth_path, document)


def _jobs(out: Path, plan: StackPlan) -> Iterator[_Job]:
    for view in range(plan.viewpoints):
        folder = out / "truth" / f"view_{view}"
        aif_path, depth_path = folder / "all_in_focus.exr", folder / "depth.exr"
        yield _Job((aif_path, depth_path), partial(_make_truth, plan=plan, view=view, aif_path=aif_path, depth_path=depth_path))
        for index in range(plan.slices if view < plan.photographed else 0):
            path = out / f"view_{view}" / f"slice_{index:02d}.dng"
            yield _Job((path,), partial(_make_slice, plan=plan, view=view, index=index, path=path))


def _make_truth(scene: Scene, plan: StackPlan, view: int, aif_path: Path, depth_path: Path) -> None:
    rgb, depth_m = trace_pinhole(scene, plan.reference_camera(view), plan.samples, plan.seed, plan.sensor.footprint_px)
    comment = "metres along the optical axis at pixel centres"
    write_exr(depth_path, ExrPart({"Z": depth_m.astype(np.float16)}, attributes={"comments": comment}))
    write_image(aif_path, rgb, half=True)


def _make_slice(scene: Scene, plan: StackPlan, view: int, index: int, path: Path) -> None:
    rgb = traced_slice(scene, plan, view, index)
    mosaic = plan.sensor.photograph(rgb, np.random.default_rng([plan.seed, view, index]))
    base = ShotMetadata(plan.lens_at(index))
    taken_at = base.taken_at + view * _BETWEEN_VIEWS + index * _BETWEEN_SLICES
    write_dng(path, mosaic, plan.sensor, ShotMetadata(base.lens, taken_at=taken_at))


def traced_slice(scene: Scene, plan: StackPlan, view: int, index: int) -> np.ndarray:
    """(H, W, 3) scene-linear Rec.709: what the sensor is given for one slice, before its colour filters and noise."""
    return trace(
        scene,
        plan.camera_at(view, index),
        plan.lens_at(index),
        plan.samples,
        plan.seed * 1000 + view * 100 + index,
        plan.sensor.footprint_px,
    )


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
    force: Annotated[bool, typer.Option("--force", help="Replace a stack made with other settings.")] = False,
) -> None:
    """Make DNG focal stacks of a still life with their all-in-focus image, depth and camera as truth."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    # The black level keeps its share of the range at every bit depth.
    sensor = SensorModel(bits=bits, black_level=1008 * 2**bits // 2**14, full_well_electrons=full_well)
    plan = StackPlan(viewpoints, slices, width, height, seed, samples, sensor, scene, stacks, jitter_px, jitter_deg)
    try:
        with Progress("tracing", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()) as bar:
            task = bar.add_task("tracing", total=None)
            ran = make_raw_stack(out, plan, force=force, progress=lambda done, total: bar.update(task, completed=done, total=total))
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {'complete' if ran else 'nothing to do, all files were there'}")


if __name__ == "__main__":
    typer.run(main)
