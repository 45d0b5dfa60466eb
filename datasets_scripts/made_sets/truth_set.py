"""A set of traced truth: views, whose files are made only where they are missing, and the command that makes them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from datasets_scripts.made_sets.set_files import Job, claim_folder
from datasets_scripts.made_sets.truth_plan import SHAPE_NAMES, TruthPlan, truth_name, view_document
from datasets_scripts.scenes.truth_scenes import make_scene
from datasets_scripts.tracers.truth import Part, Picture, TruthTracer
from datasets_scripts.tracers.truth_layer import make_tracer, sharp_layer
from datasets_scripts.tracers.truth_scene import PackedScene, TruthScene, pack
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import SheetRow, read_image, read_layer, write_contact_sheet, write_image, write_layer
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


class ViewFiles(ABC):
    """One camera's look at one scene, in OUT/SCENE_SEED/view_NN."""

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
    def write_sheet(self) -> None:
        """Write sheet.png, a contact sheet of the finished files."""

    def claim(self, overwrite: bool) -> None:
        files = (path for job in self.jobs() for path in job.paths)
        claim_folder(self.folder / "meta.json", self.document(), files, overwrite)


def make_missing(make_view: type[ViewFiles], out: Path, plan: TruthPlan, *, overwrite: bool = False) -> int:
    """Write all that is missing of the plan into `out` and return how many files or pairs of files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    load()
    views = [make_view(out, plan, name, number) for name in plan.scenes for number in range(plan.views)]
    for view in views:
        view.claim(overwrite)
    waiting = [(view, job) for view in views for job in view.jobs() if not job.done]
    for _, job in track(waiting, "rendering truth"):
        job.make()
    changed = [view for view, _ in waiting]
    for view in views:
        if view in changed or not (view.folder / "sheet.png").is_file():
            view.write_sheet()
    return len(waiting)


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
        overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a set made with other settings.")] = False,
    ) -> None:
        """Render the missing files of a truth set."""
        try:
            plan = TruthPlan(
                width_px=width,
                height_px=height,
                samples=samples,
                seed=seed,
                views=views,
                scenes=tuple(scenes.split(",")),
                shapes=tuple(shapes.split(",")),
            )
            made = make_set(out, plan, overwrite=overwrite)
        except InputError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None
        typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")

    return main


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
        return make_tracer(self._packed, self._plan.camera(self._number), part, self._plan.seed)

    def document(self) -> dict[str, object]:
        return view_document(self._plan, self._name, self.scene, self._number)

    def write_sheet(self) -> None:
        """Write what is sharp, its depth and layers, then every opening at every focus, three pictures to a row."""
        folder = self.folder
        meta = read_json(folder / "meta.json", "the description of a view (meta.json)")
        sharp, depth_m = read_image(folder / "all_in_focus.exr"), read_exr(folder / "depth.exr")[0].channels["Z"]
        lamps = np.maximum(sharp - 1.0, 0.0)
        dioptres = _grey(1.0 / depth_m / 1.5)
        rows = [SheetRow("sharp", {"all in focus": sharp, "dioptres, 1.5 is white": dioptres, "what is brighter than 1": lamps})]
        if meta["layers"]:
            front, rest = (read_layer(folder / name) for name in meta["layers"])
            rows.append(SheetRow("layers", {"foreground": front.rgb, "its coverage": _grey(front.alpha), "the rest without it": rest.rgb}))
        captions = [f"focus {distance_m:.2f} m" for distance_m in meta["focus_distances_m"]]
        for shape, names in meta["truth"].items():
            rows.append(SheetRow(shape, {caption: read_image(folder / name) for caption, name in zip(captions, names, strict=True)}))
        write_contact_sheet(folder / "sheet.png", rows)

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
        """Write the share of the light that the cat-eye's rim passes, focused on the farthest distance: the truth leaves it out."""
        opening = self._plan.opening("cat_eye", max(self.scene.focus_distances_m))
        share = self.tracer.traced(opening, self._plan.samples).open_share
        write_exr(path, ExrPart({"Y": share.astype(np.float16)}, attributes={"comments": "share of the pupil that is open"}))


def _grey(plane: np.ndarray) -> Picture:
    return np.repeat(plane[..., None], 3, axis=-1).astype(np.float32)
