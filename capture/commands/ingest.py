"""`mrbokeh capture ingest`: photographs into focal stacks."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

HELP = "\n\n".join(
    (
        "Develop photographs into focal stacks: slices in linear camera RGB, one white balance and one exposure scale for all "
        "stacks of the scene (kept in SCENE/session.json), lens and focus distances.",
        "A folder is a stack. A folder whose shots lie far apart in time, or in which the focus goes back, is split only with "
        "--group time or --group focus. Slices are ordered by focus distance, nearest first, where all distances are known, "
        "else by file name. Pictures are not rotated.",
        "What metadata lacks is read from a lens.toml (lens) and a focus.csv (file,focus_distance_m,nearest_m,farthest_m) beside "
        "the photographs. Infinity that a camera states by a sentinel (0xFFFFFFFF, 655.35 m) is a value to start from, said and not "
        "trusted; a focus.csv overrides it. Slices that are there already are kept.",
        "Files that cannot be read, are of another size, almost all saturated or black, the same photograph as another or of another scene "
        "than most of their stack are named and left out; --group none leaves out other sizes only.",
        "Example:  mrbokeh capture ingest shoot/ --out scene/",
        "Example:  mrbokeh capture ingest a.NEF b.NEF c.NEF --out scene/ --sidecar lens.toml --max-width 1500",
    )
)


def ingest_command(
    photographs: Annotated[list[Path], typer.Argument(metavar="FILES|DIR...", help="photographs, or folders to search for them")],
    out: Annotated[Path, typer.Option(metavar="SCENE", help="folder for the stacks, one folder each")],
    group: Annotated[str, typer.Option(help="what makes a stack: folder, time (pauses), focus (sweeps) or none (all in one)")] = "folder",
    white_balance: Annotated[
        str, typer.Option(metavar="camera|R,G,B", help="for RAW: the camera's of the scene's first file, for all stacks; or multipliers")
    ] = "camera",
    sidecar: Annotated[
        Path | None, typer.Option(metavar="lens.toml|focus.csv", help="for all photographs, instead of those beside them")
    ] = None,
    half_size: Annotated[bool, typer.Option("--half-size", help="half the size, without demosaicing: a quick look")] = False,
    max_width: Annotated[int | None, typer.Option(min=16, metavar="N", help="reduce wider pictures to N pixels (area averages)")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="make all slices again")] = False,
) -> None:
    from capture.stacks.grouping import Grouping
    from capture.stacks.ingest import IngestSettings, ingest, print_report
    from capture.stacks.stack_ingest import Development
    from mrbokeh.system.console import kept_when_interrupted
    from mrbokeh.system.resources import keep_freed_pictures

    if group not in list(Grouping):
        raise InputError(f"--group must be one of {', '.join(Grouping)}, got {group!r}")
    keep_freed_pictures()
    development = Development(parse_white_balance(white_balance), half_size, max_width)
    with kept_when_interrupted(f"finished slices are kept in {out}", overwrite):
        report = ingest(photographs, out, IngestSettings(Grouping(group), development, sidecar, overwrite))
    print_report(report)


def parse_white_balance(text: str) -> tuple[float, float, float] | None:
    """Parse "camera" to None, "R,G,B" to three multipliers with green at 1."""
    if text.strip().lower() == "camera":
        return None
    expected = '--white-balance must be "camera" or three multipliers R,G,B such as 2.1,1,1.5'
    red, green, blue = numbers_in(text, expected, (3,))
    if not min(red, green, blue) > 0 or max(red, green, blue) == float("inf"):
        raise InputError(f"--white-balance needs positive multipliers, got {text!r}")
    return red / green, 1.0, blue / green
