"""Ray-traced focal stacks with a known lens, to train on: heart, ring, bladed and round bokeh (Mandl et al. 2024, section 4.1).

    python -m datasets_scripts.bokeh_stacks OUT --shape heart [--size small|medium|full --pull 48]
    mrbokeh train fit OUT --out RUN

OUT is a data set with a manifest (`mrbokeh.stacks.focal_stack_dataset`): OUT/SCENE/view_NN/ are focal stacks with all-in-focus picture and
depth, OUT/lens.json is the lens. Finished files are kept, so an interrupted run goes on where it stopped; `--scenes` gives machines a
share of the work each. With --pull OUT.pull/ becomes one test view at many focus distances, to see whether blur changes smoothly.
It needs Mitsuba 3 (`pip install -e '.[datasets]'`) and LLVM's library (Debian: libllvm19).
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import cached_property, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from datasets_scripts.made_sets.bokeh_plan import SHAPES, SIZES, StacksPlan
from datasets_scripts.made_sets.set_files import (
    LICENCE,
    Job,
    Overwrite,
    claim_set,
    focus_index,
    make_missing,
    mistakes_told,
    slice_name,
    stack_record,
    write_dataset,
)
from datasets_scripts.scenes.bokeh_scenes import bokeh_scene
from datasets_scripts.tracers.truth import Opening, Picture, TruthTracer
from datasets_scripts.tracers.truth_layer import make_tracer, sharp_layer
from datasets_scripts.tracers.truth_scene import pack
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

NOISE_FLOOR = "noiseFloorDb"
# Two halves differ by twice the variance of one, their mean has half of it: a quarter, 6.02 dB.
_MEAN_OVER_DIFFERENCE_DB = 20.0 * np.log10(2.0)


class StackView:
    """One viewpoint in OUT/SCENE/VIEW. focus_distances_m: those of the plan, or others for a focus pull."""

    def __init__(
        self,
        folder: Path,
        plan: StacksPlan,
        scene: str,
        view: int,
        focus_distances_m: tuple[float, ...] | None = None,
    ) -> None:
        self.folder, self._plan, self._scene, self._view = folder, plan, scene, view
        self.focus_distances_m = focus_distances_m or plan.focus_distances_m

    def jobs(self) -> Iterator[Job]:
        """Yield the files of the view; stack.json comes last, when the pictures are there."""
        yield Job((self.folder / "all_in_focus.exr", self.folder / "depth.exr"), self._make_sharp)
        for index in range(len(self.focus_distances_m)):
            yield Job((self.folder / slice_name(index),), partial(self._make_slice, index))
        yield Job((self.folder / FILE_NAME,), self._make_stack)

    @cached_property
    def _tracers(self) -> tuple[TruthTracer, TruthTracer]:
        """Two tracers, equal but for their random numbers, so that their difference shows the noise."""
        camera = self._plan.camera(self._scene, self._view)
        packed = pack(bokeh_scene(self._scene), camera)
        first, second = (make_tracer(packed, camera, "all", 2 * self._plan.seed + half) for half in (0, 1))
        return first, second

    def defocused(self, opening: Opening) -> tuple[Picture, float]:
        """Return (picture, its noise floor in dB: the PSNR that a perfect method would reach)."""
        samples, lamp_rays = self._plan.rays(f"{self._scene}/{self._plan.view_name(self._view)}")
        first, second = (tracer.traced(opening, samples // 2).rgb + tracer.lamp_light(opening, lamp_rays // 2) for tracer in self._tracers)
        return 0.5 * (first + second), float(psnr(first, second) + _MEAN_OVER_DIFFERENCE_DB)

    def make(self) -> None:
        """Make what is missing of the view."""
        for job in self.jobs():
            if not job.done:
                job.make()

    def _make_slice(self, index: int) -> None:
        rgb, noise_floor_db = self.defocused(self._plan.traced_opening(self.focus_distances_m[index]))
        write_camera_rgb(self.folder / slice_name(index), rgb, None, attributes={NOISE_FLOOR: noise_floor_db})

    def _make_sharp(self) -> None:
        size = self._plan.size
        first, second = (sharp_layer(tracer, self._plan.size.samples // 2, size.lamp_rays // 2) for tracer in self._tracers)
        depth_m = first.depth_m
        if not np.isfinite(depth_m).all():
            raise InputError(f"{self._scene} is open somewhere: expected a scene in which every pixel has a depth")
        confidence = np.ones_like(depth_m)
        write_merged(self.folder, 0.5 * (first.rgb + second.rgb), focus_index(depth_m, self.focus_distances_m), confidence, depth_m)

    def _make_stack(self) -> None:
        stack = FocalStack(
            self.folder,
            tuple(Slice(slice_name(index), distance_m) for index, distance_m in enumerate(self.focus_distances_m)),
            lens=self._plan.lens(self.focus_distances_m[0]),
            camera=self._plan.camera(self._scene, self._view),
            registered=True,
            merged=True,
            metadata={"traced": True, "scene": self._scene, "shape": self._plan.shape, "opening": self._plan.opening.document()},
        )
        write_focal_stack(stack)
        self.__dict__.pop("_tracers", None)  # tens of megabytes, of a view that is done


def make_bokeh_stacks(
    out: Path, plan: StacksPlan, only: tuple[str, ...] = (), *, workers: int = 1, overwrite: bool = False
) -> FocalStackDataset | None:
    """Write what is missing of a set, the manifest last. Return the set, or None where only some scenes were asked for.

    workers: processes that share cores and views; their rays are the same from any number of them, only the order of sums is not.
    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    _require_scenes(plan, only)
    load()
    views = [StackView(out / name, plan, *_place(name)) for name in plan.names]
    _claim(out, plan, views, overwrite)
    write_lens(out / "lens.json", plan.lens(plan.focus_distances_m[0]))
    chosen = [view for view, name in zip(views, plan.names, strict=True) if not only or _place(name)[0] in only]
    _trace(chosen, workers)
    if not all(job.done for view in views for job in view.jobs()):
        return None
    return _dataset(out, plan)


def make_pull(out: Path, plan: StacksPlan, frames: int, *, overwrite: bool = False) -> Path:
    """Trace a test view in so many focus steps, evenly in dioptres, from the second to the last but one distance; return its folder."""
    if frames < 2:
        raise InputError(f"a focus pull needs at least 2 frames, got {frames}")
    name = next(name for name, part in plan.parts().items() if part == "test")
    inner = plan.focus_distances_m[1:-1] or plan.focus_distances_m
    distances_m = tuple(float(each) for each in 1.0 / np.linspace(1.0 / inner[0], 1.0 / inner[-1], frames))
    view = StackView(out / name, plan, *_place(name), distances_m)
    _claim(out, plan, [view], overwrite, {"pull_frames": frames})
    make_missing(view.jobs(), "tracing a focus pull")
    return out / name


def _trace(views: Sequence[StackView], workers: int) -> None:
    if workers == 1:
        make_missing((job for view in views for job in view.jobs()), "tracing stacks")
        return
    waiting = [view for view in views if not all(job.done for job in view.jobs())]
    threads = max(1, (os.cpu_count() or 1) // workers)
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=load, initargs=(threads,)) as pool:
        running = [pool.submit(view.make) for view in waiting]
        try:
            for done in track(as_completed(running), "tracing views", total=len(running)):
                done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _claim(out: Path, plan: StacksPlan, views: list[StackView], overwrite: bool, more: dict[str, int] | None = None) -> None:
    document = asdict(plan) | {"size": asdict(plan.size) | {"scenes": list(plan.size.scenes)}} | (more or {})
    claim_set(out, document, [each for view in views for job in view.jobs() for each in job.paths], overwrite)


def _dataset(out: Path, plan: StacksPlan) -> FocalStackDataset:
    records = tuple(stack_record(out, name, part) for name, part in plan.parts().items())
    floors_db = {record.name: noise_floors_db(read_focal_stack(out / record.name)) for record in records}
    every_db = [each for floors in floors_db.values() for each in floors]
    metadata: dict[str, Any] = {
        "made_by": "datasets_scripts.bokeh_stacks",
        "plan": asdict(plan),
        "opening": plan.opening.document(),
        "noise_floor_db": {"lowest": min(every_db), "median": float(np.median(every_db)), "by_stack": floors_db},
        "noise_floor_is": "PSNR of a slice against one without noise, linear radiance clipped to [0, 1], from two halves of the samples",
        "split_by": "whole scenes, and the last viewpoints of the others",
    }
    return write_dataset(out, LICENCE, records, metadata)


def noise_floors_db(stack: FocalStack) -> list[float]:
    return [round(float(read_exr(stack.folder / each.path)[0].attributes[NOISE_FLOOR]), 2) for each in stack.slices]


def _place(name: str) -> tuple[str, int]:
    scene, view = name.split("/view_")
    return scene, int(view)


def _require_scenes(plan: StacksPlan, only: tuple[str, ...]) -> None:
    unknown = set(only) - set(plan.size.scenes)
    if unknown:
        raise InputError(f"expected scenes out of {', '.join(plan.size.scenes)}, got {', '.join(sorted(unknown))}")


def _summary(dataset: FocalStackDataset) -> str:
    floor = dataset.metadata["noise_floor_db"]
    return (
        f"{len(dataset.stacks)} stacks, largest circle of confusion {dataset.largest_coc_px:.1f} px, radiance up to "
        f"{dataset.radiance_scale:.1f}, noise floor {floor['lowest']:.1f} dB at worst, {floor['median']:.1f} dB in the middle"
    )


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the set.")],
    shape: Annotated[str, typer.Option(help=f"Opening of the lens: {', '.join(SHAPES)}.")],
    size: Annotated[str, typer.Option(help=f"{', '.join(SIZES)}; docs/datasets.md says how long they take.")] = "small",
    scenes: Annotated[str, typer.Option(help="Only these, with commas between: a share of the work.")] = "",
    samples: Annotated[int, typer.Option(help="Camera rays per pixel, 0 for those of the size.")] = 0,
    f_number: Annotated[float, typer.Option(help="Of the lens, 0 for that of the size; sets of several make a family of lenses.")] = 0.0,
    pull: Annotated[int, typer.Option(help="Also OUT.pull: one test view at so many focus distances.")] = 0,
    seed: Annotated[int, typer.Option(help="Viewpoints and sampling; scenes are numbered.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Processes that trace, each a view; not for --pull.")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Trace the missing pictures of a set of focal stacks."""
    with mistakes_told():
        if size not in SIZES:
            raise InputError(f"expected a size out of {', '.join(SIZES)}, got {size!r}")
        chosen = replace(SIZES[size], samples=samples) if samples else SIZES[size]
        chosen = replace(chosen, f_number=f_number) if f_number else chosen
        plan = StacksPlan(shape, chosen, seed)
        dataset = make_bokeh_stacks(out, plan, tuple(scenes.split(",")) if scenes else (), workers=workers, overwrite=overwrite)
        if pull:
            typer.echo(f"{make_pull(out.with_name(out.name + '.pull'), plan, pull, overwrite=overwrite)}: focus pull complete")
    typer.echo(f"{out}: " + ("other scenes are missing still" if dataset is None else _summary(dataset)))


if __name__ == "__main__":
    typer.run(main)
