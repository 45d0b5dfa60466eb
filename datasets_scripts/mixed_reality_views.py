"""The files of one view of the mixed-reality truth: the scene alone, the object alone, and both traced together."""

from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

from datasets_scripts.file_job import Job
from datasets_scripts.mixed_reality_objects import OBJECT_DISTANCES_M, scene_around, virtual_object, with_object, without_shadows
from datasets_scripts.mixed_reality_sheet import write_sheet
from datasets_scripts.truth_plan import truth_name, view_document
from datasets_scripts.truth_scene import TruthScene, pack
from datasets_scripts.truth_set import ViewFiles
from datasets_scripts.truth_sharp import sharp_layer
from datasets_scripts.truth_tracer import TruthTracer
from datasets_scripts.truth_tracer_choice import make_tracer
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image, write_layer

What = Literal["scene", "both"]

OBJECT_CONVENTIONS = {
    "scene": "scene/ holds the scene without the object and without lamps that would hang before it: all_in_focus.exr, depth.exr and "
    "the photographs that the object goes into",
    "object": "object.exr is the object alone in focus, premultiplied RGBA with Z in metres, nothing before it and nothing behind",
    "both": "both/ holds scene and object traced together, of the same random numbers as scene/",
    "light": "nothing throws a shadow and nothing is mirrored, so the light on the scene and on the object is what it is alone",
}


class MixedView(ViewFiles):
    """One camera's look at one scene with and without its object."""

    @cached_property
    def scene(self) -> TruthScene:
        return scene_around(self._name, self._plan.seed)

    @cached_property
    def virtual(self) -> TruthScene:
        return virtual_object(self._name, self._plan.seed)

    @cached_property
    def _tracers(self) -> dict[What, TruthTracer]:
        return {"scene": self._tracer(self.scene), "both": self._tracer(with_object(self.scene, self.virtual))}

    def _tracer(self, scene: TruthScene, part: Literal["all", "thin"] = "all") -> TruthTracer:
        camera = self._plan.camera(self._number)
        return make_tracer(without_shadows(pack(scene, camera)), camera, part, self._plan.seed, self._variant)

    def document(self) -> dict[str, object]:
        """meta.json: that of the scene's own truth, and what is added."""
        document = view_document(self._plan, self._name, self.scene, self._number)
        conventions = {key: text for key, text in dict(document["conventions"]).items() if key != "layers"}  # type: ignore[call-overload]
        truth = {shape: [truth_name(shape, k) for k in range(len(self.scene.focus_distances_m))] for shape in self._plan.shapes}
        return document | {
            "format": "mrbokeh-mixed-reality",
            "truth": truth,
            "layers": ["object.exr"],
            "object_distance_m": OBJECT_DISTANCES_M[self._name],
            "conventions": conventions | OBJECT_CONVENTIONS,
        }

    def jobs(self) -> Iterator[Job]:
        folder = self.folder
        yield Job((folder / "scene" / "all_in_focus.exr", folder / "scene" / "depth.exr"), self._make_sharp)
        yield Job((folder / "object.exr",), self._make_object)
        for shape in self._plan.shapes:
            for index, distance_m in enumerate(self.scene.focus_distances_m):
                both: tuple[What, What] = ("scene", "both")
                for what in both:
                    path = folder / what / truth_name(shape, index)
                    yield Job((path,), partial(self._make_defocused, what, shape, distance_m, path))

    def write_sheet(self) -> None:
        write_sheet(self.folder)

    def _make_sharp(self) -> None:
        layer = self._sharp(self._tracers["scene"])
        comment = "metres along the optical axis, not antialiased"
        write_exr(self.folder / "scene" / "depth.exr", ExrPart({"Z": layer.depth_m}, attributes={"comments": comment}))
        write_image(self.folder / "scene" / "all_in_focus.exr", layer.rgb)

    def _make_object(self) -> None:
        write_layer(self.folder / "object.exr", self._sharp(self._tracer(self.virtual, "thin")))

    def _sharp(self, tracer: TruthTracer):  # type: ignore[no-untyped-def]
        return sharp_layer(tracer, self._plan.samples, self._plan.lamp_rays)

    def _make_defocused(self, what: What, shape: str, focus_distance_m: float, path: Path) -> None:
        opening, tracer = self._plan.opening(shape, focus_distance_m), self._tracers[what]
        write_image(path, tracer.traced(opening, self._plan.samples).rgb + tracer.lamp_light(opening, self._plan.lamp_rays))
