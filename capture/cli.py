"""`mrbokeh capture`: photographs in, focal stacks with an all-in-focus picture and depth out."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Photographs to focal stacks: ingest RAW or pictures, then merge them.")

_INGEST_HELP = "\n\n".join(
    (
        "Develop photographs into focal stacks: scene-linear Rec.709 slices, evened-out exposure, lens and focus distances.",
        "A folder is a stack. A folder whose shots lie far apart in time, or in which the focus goes back, is split only with "
        "--group time or --group focus. Slices are ordered by focus distance, nearest first, where all distances are known, "
        "else by file name. Pictures are not rotated.",
        "What metadata lacks is read from a lens.toml beside the photographs. Unusable files are named and skipped; slices that "
        "are there already are kept.",
        "Example:  mrbokeh capture ingest shoot/ --out scene/",
        "Example:  mrbokeh capture ingest a.NEF b.NEF c.NEF --out scene/ --sidecar lens.toml --max-width 1500",
    )
)
_MERGE_HELP = "\n\n".join(
    (
        "Register the slices of every stack, merge an all-in-focus picture and find depth from focus.",
        "Stacks that are merged already are left alone unless --overwrite is given.",
        "Example:  mrbokeh capture merge scene/",
    )
)


@app.command("ingest", help=_INGEST_HELP)
def ingest_command(
    photographs: Annotated[list[Path], typer.Argument(metavar="FILES|DIR...", help="photographs, or folders to search for them")],
    out: Annotated[Path, typer.Option(metavar="SCENE", help="folder for the stacks, one folder each")],
    group: Annotated[str, typer.Option(help="what makes a stack: folder, time (pauses), focus (sweeps) or none (all in one)")] = "folder",
    white_balance: Annotated[
        str, typer.Option(metavar="camera|R,G,B", help="for RAW: the camera's of the first slice, for the whole stack; or multipliers")
    ] = "camera",
    sidecar: Annotated[Path | None, typer.Option(metavar="lens.toml", help="for all photographs, instead of those beside them")] = None,
    half_size: Annotated[bool, typer.Option("--half-size", help="half the size, without demosaicing: a quick look")] = False,
    max_width: Annotated[int | None, typer.Option(min=16, metavar="N", help="reduce wider pictures to N pixels (area averages)")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="make all slices again")] = False,
) -> None:
    from rich.console import Console

    from capture.grouping import Grouping
    from capture.ingest import IngestSettings, ingest
    from capture.ingest_table import print_report
    from capture.stack_ingest import Development

    if group not in list(Grouping):
        raise InputError(f"--group must be one of {', '.join(Grouping)}, got {group!r}")
    development = Development(parse_white_balance(white_balance), half_size, max_width)
    report = ingest(photographs, out, IngestSettings(Grouping(group), development, sidecar, overwrite))
    print_report(report, Console())


@app.command("merge", help=_MERGE_HELP)
def merge_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with stacks that `mrbokeh capture ingest` made")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="merge again what is merged already")] = False,
) -> None:
    from capture.merge import merge_scene
    from mrbokeh.stack_pictures import SHEET_NAME

    for stack in merge_scene(scene, overwrite):
        depth = "depth in metres" if stack.is_metric else "focus distances unknown: depth is the index of the sharpest slice, not metres"
        typer.echo(f"{stack.folder}: all_in_focus.exr, depth.exr ({depth}), {SHEET_NAME}")


def parse_white_balance(text: str) -> tuple[float, float, float] | None:
    """ "camera" to None, "R,G,B" to three multipliers with green at 1."""
    if text.strip().lower() == "camera":
        return None
    try:
        red, green, blue = (float(each) for each in text.split(","))
    except ValueError:
        raise InputError(f'--white-balance must be "camera" or three multipliers R,G,B such as 2.1,1,1.5, got {text!r}') from None
    if not min(red, green, blue) > 0 or max(red, green, blue) == float("inf"):
        raise InputError(f"--white-balance needs positive multipliers, got {text!r}")
    return red / green, 1.0, blue / green
