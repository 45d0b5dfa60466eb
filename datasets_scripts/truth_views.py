"""The files of one view: sharp picture with depth, layers, defocused truth and a sheet, each made only where it is missing."""

from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from datasets_scripts.file_job import Job
from datasets_scripts.truth_plan import truth_name, view_document
from datasets_scripts.truth_scene import PackedScene, TruthScene, pack
from datasets_scripts.truth_scenes import make_scene
from datasets_scripts.truth_set import ViewFiles
from datasets_scripts.truth_sharp import sharp_layer
from datasets_scripts.truth_sheet import write_sheet
from datasets_scripts.truth_tracer import Part, Picture, TruthTracer
from datasets_scripts.truth_tracer_choice import make_tracer
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image, write_layer


class View(ViewFiles):
    """One camera's look at one scene; what is costly is made when it is first needed."""

    @cached_property
    def scene(self) -> TruthScene:
        return make_scene(self._name, self._plan.seed)

    @cached_property
    def _packed(self) -> PackedScene:
        return pack(self.scene, self._plan.camera(self._number))

    @cached_property
    def tracer(self) -> TruthTracer:
        return self._tracer("all")

    def _tracer(self, part: Part) -> TruthTracer:
        return make_tracer(self._packed, self._plan.camera(self._number), part, self._plan.seed, self._variant)

    def document(self) -> dict[str, object]:
        return view_document(self._plan, self._name, self.scene, self._number)

    def write_sheet(self) -> None:
        write_sheet(self.folder)

    def jobs(self) -> Iterator[Job]:
        folder = self.folder
        yield Job((folder / "all_in_focus.exr", folder / "depth.exr"), self._make_sharp)
        if self.scene.kind == "thin":
            parts: tuple[Part, ...] = ("thin", "rest")
            for index, part in enumerate(parts):
                path = folder / "layers" / f"{index:02d}.exr"
                yield Job((path,), partial(self._make_layer, part, path))
        for shape in self._plan.shapes:
            for index, distance_m in enumerate(self.scene.focus_distances_m):
                path = folder / "truth" / truth_name(shape, index)
                yield Job((path,), partial(self._make_truth, shape, distance_m, path))
        if "cat_eye" in self._plan.shapes:
            share = folder / "truth" / "cat_eye_open_share.exr"
            yield Job((share,), partial(self._make_open_share, share))

    def defocused(self, shape: str, focus_distance_m: float) -> Picture:
        opening = self._plan.opening(shape, focus_distance_m)
        return self.tracer.traced(opening, self._plan.samples).rgb + self.tracer.lamp_light(opening, self._plan.lamp_rays)

    def _make_sharp(self) -> None:
        layer = sharp_layer(self.tracer, self._plan.samples, self._plan.lamp_rays)
        comment = "metres along the optical axis, not antialiased"
        write_exr(self.folder / "depth.exr", ExrPart({"Z": layer.depth_m}, attributes={"comments": comment}))
        write_image(self.folder / "all_in_focus.exr", layer.rgb)

    def _make_layer(self, part: Part, path: Path) -> None:
        write_layer(path, sharp_layer(self._tracer(part), self._plan.samples, self._plan.lamp_rays))

    def _make_truth(self, shape: str, focus_distance_m: float, path: Path) -> None:
        write_image(path, self.defocused(shape, focus_distance_m))

    def _make_open_share(self, path: Path) -> None:
        """What the cat-eye's rim leaves of the light, focused on the farthest distance: the vignetting that the truth leaves out."""
        opening = self._plan.opening("cat_eye", max(self.scene.focus_distances_m))
        share = self.tracer.traced(opening, self._plan.samples).open_share
        write_exr(path, ExrPart({"Y": share.astype(np.float16)}, attributes={"comments": "share of the pupil that is open"}))
