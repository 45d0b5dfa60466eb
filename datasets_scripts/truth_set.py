"""A set of traced truth: views whose missing files are made, and the command that makes them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.file_job import Job, claim_folder
from datasets_scripts.truth_mitsuba import SCALAR, VARIANTS, best_variant, load
from datasets_scripts.truth_plan import TruthPlan
from datasets_scripts.truth_shapes import SHAPE_NAMES
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


class ViewFiles(ABC):
    """One camera's look at one scene, in OUT/SCENE_SEED/view_NN.

    variant: of Mitsuba, None for the best that runs here.
    """

    def __init__(self, out: Path, plan: TruthPlan, name: str, number: int, variant: str | None = None) -> None:
        self.folder = out / f"{name}_{plan.seed}" / f"view_{number:02d}"
        self._plan, self._name, self._number, self._variant = plan, name, number, variant

    @abstractmethod
    def document(self) -> dict[str, object]:
        """meta.json."""

    @abstractmethod
    def jobs(self) -> Iterator[Job]: ...

    @abstractmethod
    def write_sheet(self) -> None:
        """sheet.png, of finished files."""

    def claim(self, overwrite: bool) -> None:
        files = (path for job in self.jobs() for path in job.paths)
        claim_folder(self.folder / "meta.json", self.document(), files, overwrite)


def make_missing(make_view: type[ViewFiles], out: Path, plan: TruthPlan, *, overwrite: bool = False, variant: str | None = None) -> int:
    """Write all that is missing of the plan into `out`; returns how many files or pairs of files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    load(variant or best_variant())
    views = [make_view(out, plan, name, number, variant) for name in plan.scenes for number in range(plan.views)]
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
    """The command of `make_set(OUT, plan, overwrite=, variant=)`."""

    def main(
        out: Annotated[Path, typer.Argument(help="Folder for the set.")],
        scenes: Annotated[str, typer.Option(help=f"With commas between them: {', '.join(scene_names)}.")] = ",".join(scene_names),
        shapes: Annotated[str, typer.Option(help=f"Openings: {', '.join(SHAPE_NAMES)}.")] = ",".join(shape_names),
        width: int = 640,
        height: int = 360,
        samples: Annotated[int, typer.Option(help="Rays per pixel, best a power of two; 256 gives a noise floor of about 50 dB.")] = 256,
        seed: Annotated[int, typer.Option(help="Chooses the scenes' contents and the sampling.")] = 1,
        views: Annotated[int, typer.Option(help="Cameras per scene.")] = 1,
        variant: Annotated[str, typer.Option(help=f"Of Mitsuba: {', '.join(VARIANTS)}, or empty for the best that runs here.")] = "",
        overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a set made with other settings.")] = False,
    ) -> None:
        """Render the missing files of a truth set."""
        try:
            _warn_of_scalar(variant)
            plan = TruthPlan(width, height, samples, seed, views, tuple(scenes.split(",")), tuple(shapes.split(",")))
            made = make_set(out, plan, overwrite=overwrite, variant=variant or None)
        except InputError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None
        typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")

    return main


def _warn_of_scalar(variant: str) -> None:
    if variant and variant not in VARIANTS:
        raise InputError(f"expected a variant out of {', '.join(VARIANTS)}, got {variant!r}")
    if (variant or best_variant()) == SCALAR:
        typer.echo("the scalar variant traces rays one by one, some hundred times slower than LLVM does (Debian: libllvm19)", err=True)
