"""`mrbokeh capture process`: everything from photographs to a report in one go."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mrbokeh.system.messages import say

if TYPE_CHECKING:
    from mrbokeh.stacks.focal_stack import FocalStack

HELP = "\n\n".join(
    (
        "Run ingest, merge, poses, scale, depth and report one after the other. What is finished in SCENE is kept, an interrupted "
        "stage goes on, and only the pages of the report are written anew each time; --overwrite makes everything again. "
        "A new scene is taken away again where no stack of it can be merged. "
        "With one viewpoint, or where camera poses cannot be found, depth comes from focus alone, and the report says so.",
        "Example:  mrbokeh capture process shoot/ --out scene/",
        "Example:  mrbokeh capture process shoot/ --out scene/ --board 8x6 --square 30 --marker 22 --strict",
    )
)


def process_command(
    photographs: Annotated[list[Path], typer.Argument(metavar="FILES|DIR...", help="photographs, or folders to search for them")],
    out: Annotated[Path, typer.Option(metavar="SCENE", help="folder for the stacks, one folder each")],
    sidecar: Annotated[Path | None, typer.Option(metavar="lens.toml", help="for all photographs, instead of those beside them")] = None,
    max_width: Annotated[int | None, typer.Option(min=16, metavar="N", help="reduce wider pictures to N pixels (area averages)")] = None,
    board: Annotated[str | None, typer.Option(metavar="COLUMNSxROWS|board.toml", help="squares of a ChArUco board in the scene")] = None,
    square_mm: Annotated[float | None, typer.Option("--square", metavar="MM", help="side of a square as measured on the print")] = None,
    marker_mm: Annotated[float | None, typer.Option("--marker", metavar="MM", help="side of a marker")] = None,
    distance: Annotated[str | None, typer.Option(metavar="VIEW_A,VIEW_B,METRES", help="between two camera centres")] = None,
    prefer: Annotated[
        Literal["near", "far"] | None, typer.Option(help="of two things that are both seen sharp in one place, for `capture merge`")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="exit with 1 when a gate fails or is not judged")] = False,
    allow_absent: Annotated[
        list[str] | None, typer.Option("--allow-absent", metavar="NAME", help="a gate that --strict may leave unjudged (repeatable)")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="make all stages again, from the photographs on")] = False,
) -> None:
    from capture.commands.depth import depth_command
    from capture.commands.ingest import ingest_command
    from capture.commands.merge import merge_aloud
    from capture.commands.poses import poses_command
    from capture.commands.report import report_command
    from capture.commands.scale import scale_command
    from capture.report.scene_report import require_gates
    from capture.scale.answer import parse_distance
    from capture.scale.board import board_from_options
    from capture.stacks.session import FILE_NAME as SESSION_NAME
    from capture.stacks.session import undone_when_refused
    from mrbokeh.stacks.focal_stack import find_focal_stacks
    from mrbokeh.system.errors import InputError

    require_gates(allow_absent or [], strict)
    if distance is not None:
        parse_distance(distance)
    if board is not None:
        board_from_options(board, square_mm, marker_mm, "DICT_4X4_50")
    if (out / SESSION_NAME).exists() and not overwrite:
        say(f"{out} is there already: what is finished is kept, the rest goes on (--overwrite makes all of it again)")
    with undone_when_refused(out, _is_of_use):
        ingest_command(photographs, out, sidecar=sidecar, max_width=max_width, overwrite=overwrite)
        merge_aloud(out, prefer=prefer, overwrite=overwrite)
    if len(find_focal_stacks(out)) < 2:
        say("one viewpoint: depth comes from focus alone (photograph five or more for depth from several views)")
    else:
        try:
            poses_command(out, overwrite=overwrite)
        except InputError as error:
            unused = " (--board and --distance are not used)" if board or distance else ""
            say(f"no camera poses, so depth comes from focus alone{unused}: {error}")
        else:
            scale_command(out, board=board, square_mm=square_mm, marker_mm=marker_mm, distance=distance, overwrite=overwrite)
            depth_command(out, overwrite=overwrite)
    report_command(out, strict=strict, allow_absent=allow_absent, overwrite=overwrite)


def _is_of_use(stacks: "Sequence[FocalStack]") -> bool:
    """Return whether one is merged, or may be once the first, at which merging stopped, is mended."""
    from capture.stacks.stack_description import FEWEST_TO_MERGE

    return any(each.merged for each in stacks) or any(len(each) >= FEWEST_TO_MERGE for each in stacks[1:])
