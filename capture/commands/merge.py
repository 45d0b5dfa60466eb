"""`mrbokeh capture merge`: registered slices, all-in-focus picture and depth of every stack."""

from pathlib import Path
from typing import Annotated

import typer

HELP = "\n\n".join(
    (
        "Register the slices of every stack, merge an all-in-focus picture and find depth from focus. Other commands read "
        "all_in_focus.exr and depth.exr; for people there are all_in_focus.png, all_in_focus.tif (16 bits), all_in_focus.dng (of RAW, "
        "linear) and depth.png (near is red, far is blue, grey is a guess), turned upright where the camera says how.",
        "Stacks that are merged already are left alone unless --overwrite is given; an interrupted run goes on where it stopped. "
        "registration.json in the folder of each stack says how its slices fit together. --registration uses such a file for all "
        "stacks instead: those taken with the same lens and the same focus distances from a firm tripod.",
        "Example:  mrbokeh capture merge scene/",
        "Example:  mrbokeh capture merge scene/ --registration scene/view_0/registration.json --overwrite",
    )
)


def merge_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with stacks that `mrbokeh capture ingest` made")],
    registration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="a registration.json to use for every stack instead of finding one")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="merge again what is merged already")] = False,
) -> None:
    from capture.merging.merge import merge_scene
    from capture.merging.merged_pictures import readable_names
    from capture.merging.relative_stack import METRES, ORDER
    from mrbokeh.interrupts import kept_when_interrupted
    from mrbokeh.stack_pictures import SHEET_NAME

    with kept_when_interrupted(f"finished stacks are kept in {scene}", overwrite):
        stacks = merge_scene(scene, overwrite, registration)
    for stack in stacks:
        depth = "depth in metres" if stack.metres_known else "depth in guessed metres"
        files = ", ".join([*readable_names(stack), SHEET_NAME])
        typer.echo(f"{stack.folder}: all_in_focus.exr, depth.exr ({depth}), {files}")
        for told in (stack.metadata.get(ORDER), (stack.metadata.get(METRES) or {}).get("why")):
            if told:
                typer.echo(f"  {told}")
