"""Render truth for virtual objects in defocused photographs: scene alone, object alone, and both traced together through one lens.

    python -m datasets_scripts.mixed_reality OUT [--scenes fence,leaves --seed 1 --views 1 --width 640 --height 360 --samples 256]

The object hangs behind a fence or leaves and before everything else. OUT/SCENE_SEED/view_NN/ holds meta.json (lens, camera, openings,
conventions), scene/all_in_focus.exr, scene/depth.exr, scene/OPENING_FOCUS.exr (the photographs), object.exr (sharp, RGBA and Z),
both/OPENING_FOCUS.exr (the truth) and sheet.png. Finished files are kept, so an interrupted run goes on where it stopped. It needs
Mitsuba 3 (`pip install 'mrbokeh[datasets]'`) and is fast where LLVM's library is installed (Debian: libllvm19).
"""

from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.mixed_reality_objects import OBJECT_DISTANCES_M
from datasets_scripts.mixed_reality_sheet import write_sheet
from datasets_scripts.mixed_reality_views import MixedView
from datasets_scripts.truth_mitsuba import VARIANTS, best_variant, load
from datasets_scripts.truth_plan import TruthPlan
from datasets_scripts.truth_shapes import SHAPE_NAMES
from mrbokeh.errors import InputError
from mrbokeh.progress import track

DEFAULT_SHAPES = ("disc", "blades7", "cat_eye")


def mixed_reality(out: Path, plan: TruthPlan, *, overwrite: bool = False, variant: str | None = None) -> int:
    """Write all that is missing of the plan into `out`; returns how many files or pairs of files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it, and for scenes without an object.
    """
    if set(plan.scenes) - set(OBJECT_DISTANCES_M):
        raise InputError(f"expected scenes out of {','.join(OBJECT_DISTANCES_M)}, got {','.join(plan.scenes)}")
    load(variant or best_variant())
    views = [MixedView(out, plan, name, number, variant) for name in plan.scenes for number in range(plan.views)]
    for view in views:
        view.claim(overwrite)
    waiting = [(view, job) for view in views for job in view.jobs() if not job.done]
    for _, job in track(waiting, "rendering truth"):
        job.make()
    unseen = {view.folder for view, _ in waiting} | {view.folder for view in views if not (view.folder / "sheet.png").is_file()}
    for folder in sorted(unseen):
        write_sheet(folder)
    return len(waiting)


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the set.")],
    scenes: Annotated[str, typer.Option(help=f"With commas between them: {', '.join(OBJECT_DISTANCES_M)}.")] = ",".join(OBJECT_DISTANCES_M),
    shapes: Annotated[str, typer.Option(help=f"Openings: {', '.join(SHAPE_NAMES)}.")] = ",".join(DEFAULT_SHAPES),
    width: int = 640,
    height: int = 360,
    samples: Annotated[int, typer.Option(help="Rays per pixel, best a power of two; 256 gives a noise floor of about 50 dB.")] = 256,
    seed: Annotated[int, typer.Option(help="Chooses the scenes' contents and the sampling.")] = 1,
    views: Annotated[int, typer.Option(help="Cameras per scene.")] = 1,
    variant: Annotated[str, typer.Option(help=f"Of Mitsuba: {', '.join(VARIANTS)}, or empty for the best that runs here.")] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a set made with other settings.")] = False,
) -> None:
    """Render the missing files of a mixed-reality truth set."""
    try:
        if variant and variant not in VARIANTS:
            raise InputError(f"expected a variant out of {', '.join(VARIANTS)}, got {variant!r}")
        plan = TruthPlan(width, height, samples, seed, views, tuple(scenes.split(",")), tuple(shapes.split(",")))
        made = mixed_reality(out, plan, overwrite=overwrite, variant=variant or None)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")


if __name__ == "__main__":
    typer.run(main)
