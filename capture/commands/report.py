"""`mrbokeh capture report`: what proves or disproves the stacks of a scene, on one page."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.errors import InputError

HELP = "\n\n".join(
    (
        "Judge the stacks of a scene: re-blur the all-in-focus picture and compare it with every photograph, look for missing and swapped "
        "slices, drift of exposure and registration, movement, wrong focus distances, depth or scale.",
        "Writes SCENE/report.html (one file, pictures and 3D view inside), SCENE/report.json with the same numbers, and each stack's "
        "exclusion.exr. What is not there yet (poses, scale, depth in metres) is named as absent.",
        "What was found of a stack is kept in STACK/report and used again while the stack, --width and --renderer stay the same: an "
        "interrupted report goes on where it stopped. The pages are written anew each time; --overwrite examines everything again.",
        "Example:  mrbokeh capture report scene/",
        "Example:  mrbokeh capture report scene/ --strict && mrbokeh train fit scene/",
    )
)


def report_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with merged stacks")],
    strict: Annotated[bool, typer.Option("--strict", help="exit with 1 when a gate fails")] = False,
    renderer: Annotated[str, typer.Option(help="that re-blurs: polygon, scatter (exact, slow) or another of mrbokeh's")] = "polygon",
    width: Annotated[int, typer.Option(min=64, help="wider pictures are judged at this width, in pixels; blur is then smaller too")] = 960,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="examine again what was examined already")] = False,
) -> None:
    from capture.report.reblur import reblur_by
    from capture.report.scene_page import HTML_NAME
    from capture.report.scene_report import report_scene
    from mrbokeh.interrupts import kept_when_interrupted

    if not scene.is_dir():
        raise InputError(f"expected a folder with focal stacks, but {scene} is none")
    with kept_when_interrupted(f"what was found of finished stacks is kept in {scene}", overwrite):
        report = report_scene(scene, reblur_by(renderer), width, overwrite=overwrite)
    for each in report.failures:
        typer.echo(f"failed: {each.where}: {each.name}: {each.measured} (wanted: {each.limit})")
    reused = sum(each.reused for each in report.stacks)
    before = f" ({reused} of {len(report.stacks)} stacks were examined before; --overwrite examines them again)" if reused else ""
    typer.echo(f"{scene / HTML_NAME}: {len(report.gates)} gates, {len(report.failures)} failed{before}")
    if strict and report.failures:
        raise typer.Exit(1)
