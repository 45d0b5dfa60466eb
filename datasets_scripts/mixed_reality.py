"""Render truth for virtual objects in defocused photographs: scene alone, object alone, and both traced together through one lens.

    python -m datasets_scripts.mixed_reality OUT [--scenes fence,leaves --seed 1 --views 1 --width 640 --height 360 --samples 256]

The object, a ball in a hoop, a box and leaves, hangs behind a fence or leaves and before everything else. OUT/SCENE_SEED/view_NN/ holds
meta.json (lens, camera, openings, conventions), scene/all_in_focus.exr, scene/depth.exr, scene/OPENING_FOCUS.exr (the photographs),
object.exr (sharp, RGBA and Z), both/OPENING_FOCUS.exr (the truth) and sheet.png. Finished files are kept, so an interrupted run goes on
where it stopped. It needs Mitsuba 3 (`pip install -e '.[datasets]'`) and LLVM's library (Debian: libllvm19).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer
from jaxtyping import Float

from datasets_scripts.made_sets.set_files import Job
from datasets_scripts.made_sets.truth_set import TruthPlan, ViewFiles, grey, make_views, truth_command, truth_name, view_document
from datasets_scripts.scenes.textures import checks, spots
from datasets_scripts.scenes.truth_scenes import colour, fine, make_scene
from datasets_scripts.tracers.truth import TruthTracer
from datasets_scripts.tracers.truth_layer import make_tracer
from datasets_scripts.tracers.truth_scene import Body, PackedScene, TruthScene, ball, box, leaf, pack, wire
from mrbokeh.images.image_io import SheetRow, read_image, read_layer
from mrbokeh.system.errors import InputError

_HOOP_POINTS = 96
_SUN, _SKY = slice(6, 9), slice(9, 12)
OBJECT_DISTANCES_M: dict[str, float] = {"fence": 1.25, "leaves": 1.9}
"""Scenes with near things, and the distance of the object's middle: behind all of those, before all of the rest."""
What = Literal["scene", "both"]
OBJECT_CONVENTIONS = {
    "scene": "scene/ holds the scene without the object and without lamps that would hang before it: all_in_focus.exr, depth.exr and "
    "the photographs that the object goes into",
    "object": "object.exr is the object alone in focus, premultiplied RGBA with Z in metres, nothing before it and nothing behind",
    "both": "both/ holds scene and object traced together, of the same random numbers as scene/",
    "light": "nothing throws a shadow and nothing is mirrored, so the light on the scene and on the object is what it is alone",
}
DEFAULT_SHAPES = ("disc", "blades7", "cat_eye")


def virtual_object(name: str, seed: int) -> TruthScene:
    """Build the object of a scene alone, as a thin foreground before nothing; the seed chooses textures and places."""
    rng = np.random.default_rng([seed, *f"object of {name}".encode()])
    distance_m = OBJECT_DISTANCES_M[name]
    centre_m = distance_m * np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.02, 0.02), 1.0])
    bodies = (
        [make(rng, centre_m, distance_m) for make in (_ball, _hoop)] + _box(rng, centre_m, distance_m) + _leaves(rng, centre_m, distance_m)
    )
    return TruthScene("thin", tuple(replace(body, thin=True) for body in bodies))


def scene_around(name: str, seed: int) -> TruthScene:
    """Build the truth scene of that name without the lamps that would hang before or in the object."""
    scene, virtual = make_scene(name, seed), virtual_object(name, seed)
    behind_m = max(float(body.vertices_m[:, 2].max()) for body in virtual.bodies)
    return replace(scene, lamps=tuple(lamp for lamp in scene.lamps if lamp.centre_m[2] > behind_m))


def with_object(scene: TruthScene, virtual: TruthScene) -> TruthScene:
    """Return scene and object in one world."""
    return replace(scene, bodies=(*scene.bodies, *(replace(body, thin=False) for body in virtual.bodies)))


def without_shadows(packed: PackedScene) -> PackedScene:
    """Let the sun reach whatever faces it: then neither of two things changes the light on the other."""
    facets = packed.facets.copy()
    facets[:, _SKY] += facets[:, _SUN]
    facets[:, _SUN] = 0.0
    return replace(packed, facets=facets)


def _ball(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> Body:
    texture = spots(384, rng, colour(rng, 0.8), (colour(rng, 0.1), colour(rng, 0.3), colour(rng, 0.6)), 60, (6.0, 20.0))
    return ball(centre_m, 0.055 * size_m, texture)


def _hoop(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> Body:
    angle = np.linspace(0.0, 2.0 * np.pi, _HOOP_POINTS)
    lean = rng.uniform(0.3, 0.6)
    circle = np.stack([np.cos(angle), np.sin(angle), lean * np.cos(angle + rng.uniform(0, 6))], axis=1)
    return wire(centre_m + 0.085 * size_m * circle, 0.004 * size_m, fine(rng, (0.5, 0.3, 0.05), (0.9, 0.7, 0.3)))


def _box(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> list[Body]:
    texture = checks(384, rng, colour(rng, 0.08), colour(rng, 0.85), count=5)
    base_m = centre_m + size_m * np.array([0.17, 0.07, 0.0])
    return box(base_m, (0.1 * size_m, 0.14 * size_m, 0.08 * size_m), float(rng.uniform(-0.7, 0.7)), texture)


def _leaves(rng: np.random.Generator, centre_m: np.ndarray, size_m: float) -> list[Body]:
    texture = fine(rng, (0.3, 0.02, 0.05), (0.8, 0.2, 0.25))
    places: list[tuple[float, float]] = [(-0.15, -0.07), (-0.19, 0.01), (-0.14, 0.08)]
    return [leaf(centre_m + size_m * np.array([x, y, 0.0]), 0.09 * size_m, 0.035 * size_m, _turn(rng), texture) for x, y in places]


def _turn(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Draw a turn that faces the camera within about 30 degrees."""
    roll, yaw = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.5, 0.5)
    along = np.array([np.cos(roll) * np.cos(yaw), np.sin(roll), np.cos(roll) * np.sin(yaw)])
    towards = np.array([np.sin(yaw), 0.0, -np.cos(yaw)])
    return np.stack([along, np.cross(towards, along), towards])


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
        return {"scene": self._tracer_of(self.scene), "both": self._tracer_of(with_object(self.scene, self.virtual))}

    def _tracer_for(self, what: What) -> TruthTracer:
        return self._tracers[what]

    def _tracer_of(self, scene: TruthScene, part: Literal["all", "thin"] = "all") -> TruthTracer:
        camera = self._plan.camera(self._number)
        return make_tracer(without_shadows(pack(scene, camera)), camera, part, self._plan.seed)

    def document(self) -> dict[str, object]:
        """Return meta.json: that of the scene's own truth, and what is added."""
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
        yield self.sharp_job(self.folder / "scene", partial(self._tracer_for, "scene"))
        yield self.layer_job(self.folder / "object.exr", lambda: self._tracer_of(self.virtual, "thin"))
        both: tuple[What, What] = ("scene", "both")
        for shape in self._plan.shapes:
            for index, distance_m in enumerate(self.scene.focus_distances_m):
                for what in both:
                    path = self.folder / what / truth_name(shape, index)
                    yield self.defocused_job(path, partial(self._tracer_for, what), shape, distance_m)

    def sheet_rows(self, meta: dict[str, Any]) -> Iterator[SheetRow]:
        """Yield sharp scene and object, then per opening the photographs, and under them both traced together."""
        virtual, scene_rgb = read_layer(self.folder / "object.exr"), read_image(self.folder / "scene" / "all_in_focus.exr")
        yield SheetRow("sharp", {"all in focus": scene_rgb, "the object": virtual.rgb, "its coverage": grey(virtual.alpha)})
        for shape, names in meta["truth"].items():
            for what in ("scene", "both"):
                yield self.focus_row(f"{shape}, {what}", [self.folder / what / name for name in names], meta)


def mixed_reality(out: Path, plan: TruthPlan, *, overwrite: bool = False) -> int:
    """Make the missing files of a set, as `truth_set.make_views` does; raises InputError for scenes without an object too."""
    if set(plan.scenes) - set(OBJECT_DISTANCES_M):
        raise InputError(f"expected scenes out of {','.join(OBJECT_DISTANCES_M)}, got {','.join(plan.scenes)}")
    return make_views(MixedView, out, plan, overwrite=overwrite)


main = truth_command(mixed_reality, tuple(OBJECT_DISTANCES_M), DEFAULT_SHAPES)


if __name__ == "__main__":
    typer.run(main)
