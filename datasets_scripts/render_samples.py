"""Render stochastic samples of scenes with defocus and motion, their converged reference, and the sharp layers.

    python -m datasets_scripts.render_samples OUT [--scene fence,whirl,coins,rain,gear --seed 1 --width 512 --height 320 --spp 4]

OUT/SCENE_SEED/ holds meta.json (settings, conventions), lens.json, samples.npz (LightFieldSamples: layering/light_field_samples.py),
reference.exr, all_in_focus.exr with Z and motion, layers/NN.exr where a foreground hides what is behind it, and, if asked for,
noise.json. Finished files are kept, so an interrupted run goes on where it stopped.
"""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.samples_plan import SamplesPlan, SamplesSet
from datasets_scripts.samples_scenes import SCENES
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError


def render_samples(out: Path, plan: SamplesPlan, *, measure: bool = False, overwrite: bool = False, threads: int = 0) -> int:
    """Write all that is missing of the plan into `out`; returns how many files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    files = SamplesSet(out, plan, threads)
    files.claim(overwrite)
    waiting = [job for job in files.jobs(measure) if not job.path.is_file()]
    with progress_bars() as bars:
        for job in waiting:
            task = bars.add_task(f"{files.folder.name}/{job.path.name}", total=job.steps)
            job.make(partial(bars.advance, task))
    return len(waiting)


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the sets.")],
    scene: Annotated[str, typer.Option(help=f"With commas between them: {', '.join(SCENES)}.")] = ",".join(SCENES),
    seed: Annotated[int, typer.Option(help="Chooses the scenes' contents and the sampling.")] = 1,
    width: int = 512,
    height: int = 320,
    spp: Annotated[int, typer.Option(help="Samples per pixel, best a power of two.")] = 4,
    reference_spp: Annotated[int, typer.Option(help="Rays per pixel of the reference.")] = 1024,
    measure_noise: Annotated[bool, typer.Option("--measure-noise", help="Make the reference twice and write noise.json.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace sets made with other settings.")] = False,
) -> None:
    """Render the missing files of sets of samples."""
    try:
        plans = [SamplesPlan(name, seed, width, height, spp, reference_spp) for name in scene.split(",")]
        made = sum(render_samples(out, plan, measure=measure_noise, overwrite=overwrite) for plan in plans)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")


if __name__ == "__main__":
    typer.run(main)
