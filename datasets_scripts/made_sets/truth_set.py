"""A set of traced truth: views, whose files are made only where they are missing, and the command that makes them.

Its plan names scenes, views, the five openings, focus distances, and the camera and lenses that see them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from datasets_scripts.made_sets.set_files import Job, Overwrite, claim_folder, distant_camera, make_missing, mistakes_told
from datasets_scripts.scenes.truth_scenes import SCENES, make_scene
from datasets_scripts.tracers.truth import Opening, Part, Picture, TruthTracer
from datasets_scripts.tracers.truth_layer import make_tracer, sharp_layer
from datasets_scripts.tracers.truth_scene import PackedScene, TruthScene, pack
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import SheetRow, read_image, read_layer, write_contact_sheet, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.system.atomic_files import read_json
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


LENS = Lens(focal_length_mm=50.0, f_number=1.2, focus_distance_m=1.0, sensor_width_mm=36.0)
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
        angle_rad, aside_m = 2.4 * view, _STEP_ASIDE_M * min(view, 1)
        camera_from_world = np.eye(4)
        camera_from_world[:2, 3] = -aside_m * np.array([np.cos(angle_rad), 0.5 * np.sin(angle_rad)])
        return replace(distant_camera(LENS, self.width_px, self.height_px), camera_from_world=camera_from_world)

    def lens(self, shape: str, focus_distance_m: float) -> Lens:
        return replace(LENS, focus_distance_m=focus_distance_m, aperture=lens_shape(shape))

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
    distances_m = list(scene.focus_distances_m)
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
        "lens": {key: getattr(LENS, key) for key in ("focal_length_mm", "f_number", "sensor_width_mm")},
        "focus_distances_m": distances_m,
        "coc_px_per_dioptre": [plan.lens("disc", each).coc_px_per_dioptre(plan.width_px) for each in distances_m],
        "pupil_diameters_m": [plan.opening("disc", each).diameter_m for each in distances_m],
        "camera": camera_to_json(plan.camera(view)),
        "apertures": {shape: _aperture_document(shape) for shape in plan.shapes},
        "truth": {shape: [f"truth/{truth_name(shape, index)}" for index in range(len(distances_m))] for shape in plan.shapes},
        "layers": ["layers/00.exr", "layers/01.exr"] if scene.kind == "thin" else [],
        "conventions": CONVENTIONS,
    }


def _aperture_document(shape: str) -> dict[str, object]:
    aperture = lens_shape(shape)
    outlines = [np.round(outline, 9).tolist() for outline in aperture.outlines]
    return {"outlines": outlines, "weights": list(aperture.weights), "cat_eye": aperture.cat_eye}


class ViewFiles(ABC):
    """One camera's look at one scene, in OUT/SCENE_SEED/view_NN; what is costly is made when it is first needed."""

    def __init__(self, out: Path, plan: TruthPlan, name: str, number: int) -> None:
        self.folder = out / f"{name}_{plan.seed}" / f"view_{number:02d}"
        self._plan, self._name, self._number = plan, name, number

    @abstractmethod
    def document(self) -> dict[str, object]:
        """Return the content of meta.json."""

    @abstractmethod
    def jobs(self) -> Iterator[Job]:
        """Yield the files of the view, in the order in which they are made."""

    @abstractmethod
    def sheet_rows(self, meta: dict[str, Any]) -> Iterator[SheetRow]:
        """Return the rows of the contact sheet of the finished files, which meta.json names."""

    def claim(self, overwrite: bool) -> None:
        files = (path for job in self.jobs() for path in job.paths)
        claim_folder(self.folder / "meta.json", self.document(), files, overwrite)

    def write_sheet(self) -> None:
        meta = read_json(self.folder / "meta.json", "the description of a view (meta.json)")
        write_contact_sheet(self.folder / "sheet.png", list(self.sheet_rows(meta)))

    def focus_row(self, title: str, paths: Sequence[Path], meta: dict[str, Any]) -> SheetRow:
        captions = [f"focus {distance_m:.2f} m" for distance_m in meta["focus_distances_m"]]
        return SheetRow(title, {caption: read_image(path) for caption, path in zip(captions, paths, strict=True)})

    def sharp_job(self, folder: Path, tracer: Callable[[], TruthTracer]) -> Job:
        """Return all_in_focus.exr and depth.exr in a folder."""

        def make() -> None:
            layer = self._sharp(tracer())
            comment = "metres along the optical axis, not antialiased"
            write_exr(folder / "depth.exr", ExrPart({"Z": layer.depth_m}, attributes={"comments": comment}))
            write_image(folder / "all_in_focus.exr", layer.rgb)

        return Job((folder / "all_in_focus.exr", folder / "depth.exr"), make)

    def layer_job(self, path: Path, tracer: Callable[[], TruthTracer]) -> Job:
        return Job((path,), lambda: write_layer(path, self._sharp(tracer())))

    def defocused_job(self, path: Path, tracer: Callable[[], TruthTracer], shape: str, focus_distance_m: float) -> Job:
        return Job((path,), lambda: write_image(path, self.defocused(tracer(), shape, focus_distance_m)))

    def defocused(self, tracer: TruthTracer, shape: str, focus_distance_m: float) -> Picture:
        opening = self._plan.opening(shape, focus_distance_m)
        return tracer.traced(opening, self._plan.samples).rgb + tracer.lamp_light(opening, self._plan.lamp_rays)

    def _sharp(self, tracer: TruthTracer) -> Layer:
        return sharp_layer(tracer, self._plan.samples, self._plan.lamp_rays)


def make_views(make_view: type[ViewFiles], out: Path, plan: TruthPlan, *, overwrite: bool = False) -> int:
    """Write all that is missing of the plan into `out` and return how many files or pairs of files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    load()
    views = [make_view(out, plan, name, number) for name in plan.scenes for number in range(plan.views)]
    for view in views:
        view.claim(overwrite)
    changed = [view for view in views if not all(job.done for job in view.jobs())]
    made = make_missing((job for view in views for job in view.jobs()), "rendering truth")
    for view in views:
        if view in changed or not (view.folder / "sheet.png").is_file():
            view.write_sheet()
    return made


def truth_command(make_set: Callable[..., int], scene_names: Sequence[str], shape_names: Sequence[str]) -> Callable[..., None]:
    """Return the command of `make_set(OUT, plan, overwrite=)`."""

    def main(
        out: Annotated[Path, typer.Argument(help="Folder for the set.")],
        scenes: Annotated[str, typer.Option(help=f"With commas between them: {', '.join(scene_names)}.")] = ",".join(scene_names),
        shapes: Annotated[str, typer.Option(help=f"Openings: {', '.join(SHAPE_NAMES)}.")] = ",".join(shape_names),
        width: int = 640,
        height: int = 360,
        samples: Annotated[int, typer.Option(help="Rays per pixel, best a power of two; 256 gives a noise floor of about 50 dB.")] = 256,
        seed: Annotated[int, typer.Option(help="Chooses the scenes' contents and the sampling.")] = 1,
        views: Annotated[int, typer.Option(help="Cameras per scene.")] = 1,
        overwrite: Overwrite = False,
    ) -> None:
        """Render the missing files of a truth set."""
        with mistakes_told():
            wanted: dict[str, Any] = {"scenes": tuple(scenes.split(",")), "shapes": tuple(shapes.split(","))}
            plan = TruthPlan(width_px=width, height_px=height, samples=samples, seed=seed, views=views, **wanted)
            made = make_set(out, plan, overwrite=overwrite)
        typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")

    return main


class View(ViewFiles):
    """All of a scene: sharp, in layers, and through every opening."""

    @cached_property
    def scene(self) -> TruthScene:
        return make_scene(self._name, self._plan.seed)

    @cached_property
    def _packed(self) -> PackedScene:
        return pack(self.scene, self._plan.camera(self._number))

    @cached_property
    def tracer(self) -> TruthTracer:
        return self._tracer_of("all")

    def _tracer_of(self, part: Part) -> TruthTracer:
        return make_tracer(self._packed, self._plan.camera(self._number), part, self._plan.seed)

    def document(self) -> dict[str, object]:
        return view_document(self._plan, self._name, self.scene, self._number)

    def sheet_rows(self, meta: dict[str, Any]) -> Iterator[SheetRow]:
        """Yield what is sharp, its depth and layers, then every opening at every focus."""
        folder = self.folder
        sharp, depth_m = read_image(folder / "all_in_focus.exr"), read_exr(folder / "depth.exr")[0].channels["Z"]
        lamps, dioptres = np.maximum(sharp - 1.0, 0.0), grey(1.0 / depth_m / 1.5)
        yield SheetRow("sharp", {"all in focus": sharp, "dioptres, 1.5 is white": dioptres, "what is brighter than 1": lamps})
        if meta["layers"]:
            front, rest = (read_layer(folder / name) for name in meta["layers"])
            yield SheetRow("layers", {"foreground": front.rgb, "its coverage": grey(front.alpha), "the rest without it": rest.rgb})
        for shape, names in meta["truth"].items():
            yield self.focus_row(shape, [folder / name for name in names], meta)

    def jobs(self) -> Iterator[Job]:
        folder = self.folder
        yield self.sharp_job(folder, lambda: self.tracer)
        parts: tuple[Part, ...] = ("thin", "rest") if self.scene.kind == "thin" else ()
        for index, part in enumerate(parts):
            yield self.layer_job(folder / "layers" / f"{index:02d}.exr", partial(self._tracer_of, part))
        for shape in self._plan.shapes:
            for index, distance_m in enumerate(self.scene.focus_distances_m):
                yield self.defocused_job(folder / "truth" / truth_name(shape, index), lambda: self.tracer, shape, distance_m)
        if "cat_eye" in self._plan.shapes:
            share = folder / "truth" / "cat_eye_open_share.exr"
            yield Job((share,), partial(self._make_open_share, share))

    def _make_open_share(self, path: Path) -> None:
        """Write the share of the light that the cat-eye's rim passes, focused on the farthest distance: the truth leaves it out."""
        opening = self._plan.opening("cat_eye", max(self.scene.focus_distances_m))
        share = self.tracer.traced(opening, self._plan.samples).open_share
        write_exr(path, ExrPart({"Y": share.astype(np.float16)}, attributes={"comments": "share of the pupil that is open"}))


def grey(plane: np.ndarray) -> Picture:
    return np.repeat(plane[..., None], 3, axis=-1).astype(np.float32)
