"""`mrbokeh capture report`: what proves or disproves the stacks of a scene, on one page."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say

FEW = 3
"""Of more failed gates only the names are printed: a wall of text hid that the picture was good. The page and --strict tell all."""
HELP = "\n\n".join(
    (
        "Judge the stacks of a scene. Of every stack: is the all-in-focus picture as sharp as its slices, without seams and invented "
        "light, and do the slices lie on one another. With lens and focus distances: re-blur it and compare it with every photograph, "
        "look for missing and swapped slices, drift of exposure and registration, movement, wrong focus distances, depth or scale.",
        "Writes SCENE/report.html (one file, pictures and 3D view inside), SCENE/report.json with the same numbers, and each stack's "
        "exclusion.exr. What is not there yet (poses, scale, depth in metres) is named as absent: such gates are not judged. --strict "
        "exits with 1 where a gate failed or was not judged; --allow-absent NAME, once for each gate, says which may stay unjudged.",
        "What was found of a stack is kept in STACK/report and used again while the stack, --max-width and --renderer stay the same: an "
        "interrupted report goes on where it stopped. The pages are written anew each time; --overwrite examines everything again.",
        "Example:  mrbokeh capture report scene/",
        "Example:  mrbokeh capture report scene/ --strict && mrbokeh train fit scene/",
        'Example:  mrbokeh capture report scene/ --strict --allow-absent "scales agree"',
    )
)


def report_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with merged stacks")],
    strict: Annotated[bool, typer.Option("--strict", help="exit with 1 when a gate fails or is not judged")] = False,
    allow_absent: Annotated[
        list[str] | None, typer.Option("--allow-absent", metavar="NAME", help="a gate that --strict may leave unjudged (repeatable)")
    ] = None,
    renderer: Annotated[str, typer.Option(help="that re-blurs: polygon, scatter (exact, slow) or another of mrbokeh's")] = "polygon",
    max_width: Annotated[int, typer.Option(min=64, help="wider pictures are re-blurred at this width, in pixels")] = 960,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="examine again what was examined already")] = False,
) -> None:
    from capture.report import HTML_NAME
    from capture.report.gates import PICTURES, by_use, failed, tally, verdict_line, verdict_lines
    from capture.report.scene_report import report_scene, require_gates, unmet
    from capture.report.stack_view import reblur_by
    from mrbokeh.system.console import kept_when_interrupted

    allowed = require_gates(allow_absent or [], strict)
    if not scene.is_dir():
        raise InputError(f"expected a folder with focal stacks, but {scene} is none")
    with kept_when_interrupted(f"what was found of finished stacks is kept in {scene}", overwrite):
        report = report_scene(scene, reblur_by(renderer), max_width, overwrite=overwrite)
    for use, gates in by_use(report.gates).items():
        say(verdict_line(use, gates))
        for line in verdict_lines(gates) if strict or use == PICTURES or len(report.failures) <= FEW else []:
            say(f"  {line}")
    reused = sum(each.reused for each in report.stacks)
    before = f" ({reused} of {len(report.stacks)} stacks were examined before; --overwrite examines them again)" if reused else ""
    say(f"{scene / HTML_NAME} shows the worst places and what to do: {tally(report.gates)}{before}")
    if report.failures and not strict:
        count = "1 gate failed" if len(report.failures) == 1 else f"{len(report.failures)} gates failed"
        if not failed(by_use(report.gates).get(PICTURES, [])):
            count = f"the pictures are good; {count} that only refocusing and training need"
        say(f"{count}: --strict would make this an error (exit code 1)")
    short_of = unmet(report, allowed) if strict else []
    if any(not each.failed for each in short_of):
        say('--strict: gates that may stay unjudged are named one by one, as in --allow-absent "scales agree"')
    if short_of:
        raise typer.Exit(1)
