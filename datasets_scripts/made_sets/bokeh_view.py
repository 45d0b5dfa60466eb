"""One viewpoint of a set of bokeh stacks as a FocalStack folder, each file made once, and the manifest of all of them."""

from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from datasets_scripts.made_sets.bokeh_plan import StacksPlan
from datasets_scripts.made_sets.set_files import LICENCE, Job, focus_index, slice_name, stack_record
from datasets_scripts.scenes.bokeh_scenes import bokeh_scene
from datasets_scripts.tracers.truth import Opening, Picture, TruthTracer, make_tracer, sharp_layer
from datasets_scripts.tracers.truth_scene import pack
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_metrics import psnr
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset
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
        size = self._plan.size
        first, second = (
            tracer.traced(opening, self._plan.samples // 2).rgb + tracer.lamp_light(opening, size.lamp_rays // 2)
            for tracer in self._tracers
        )
        return 0.5 * (first + second), float(psnr(first, second) + _MEAN_OVER_DIFFERENCE_DB)

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


def dataset_of(out: Path, plan: StacksPlan) -> FocalStackDataset:
    """Return the data set of finished stacks. Its radiance scale is the largest radiance: nothing is cut off."""
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
    return FocalStackDataset(
        folder=out, licence=LICENCE, radiance_scale=max(each.radiance.largest for each in records), stacks=records, metadata=metadata
    )


def noise_floors_db(stack: FocalStack) -> list[float]:
    return [round(float(read_exr(stack.folder / each.path)[0].attributes[NOISE_FLOOR]), 2) for each in stack.slices]
