"""`mrbokeh capture merge`: registered slices, all-in-focus picture and depth of every stack."""

from pathlib import Path
from typing import Annotated

import typer

HELP = "\n\n".join(
    (
        "Register the slices of every stack, merge an all-in-focus picture and find depth from focus.",
        "Stacks that are merged already are left alone unless --overwrite is given.",
        "Example:  mrbokeh capture merge scene/",
    )
)


def merge_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with stacks that `mrbokeh capture ingest` made")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="merge again what is merged already")] = False,
) -> None:
    from capture.merging.merge import merge_scene
    from mrbokeh.stack_pictures import SHEET_NAME

    for stack in merge_scene(scene, overwrite):
        depth = "depth in metres" if stack.is_metric else "focus distances unknown: depth is the index of the sharpest slice, not metres"
        typer.echo(f"{stack.folder}: all_in_focus.exr, depth.exr ({depth}), {SHEET_NAME}")
