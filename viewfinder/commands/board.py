"""`mrbokeh viewfinder board`: the board to print, for the camera to be tracked by."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError


def board_command(
    out: Annotated[Path, typer.Option(help="Where the page goes: BOARD.pdf; beside it BOARD.json, for --board.")],
    lens: Annotated[Path | None, typer.Option(help="The lens that will see it; chooses the size of the markers by its blur.")] = None,
    distance_m: Annotated[
        str, typer.Option(help="NEAREST,FARTHEST: how far the camera will be, in metres.", metavar="NEAREST,FARTHEST")
    ] = "0.4,1.0",
    width_px: Annotated[int, typer.Option(min=64, help="Width of the camera's picture.")] = 1280,
    paper: Annotated[str, typer.Option(help="a4, a3, letter, or board: a page of the board's own size.")] = "a4",
    overwrite: Annotated[bool, typer.Option(help="Replace files that exist.")] = False,
) -> None:
    """Print a tracking board at true size: markers large enough to be read through the lens's blur, on one paper.

    Print without scaling, and check the ruler at its foot.

    Example: mrbokeh viewfinder board --lens lens.json --distance-m 0.5,1.2 --paper a4 --out board.pdf
    """
    from mrbokeh.optics.lens_file import read_lens
    from mrbokeh.system.atomic_files import refuse_existing
    from mrbokeh.tracking.charuco.board import write_board
    from viewfinder.tracking.printed_board import View, plan_board, write_board_pdf

    if out.suffix.lower() != ".pdf":
        raise InputError(f"--out: expected a name that ends in .pdf, got {out}")
    for path in (out, out.with_suffix(".json")):
        refuse_existing(path, overwrite)
    nearest_m, farthest_m = _range(distance_m)
    used = read_lens(lens) if lens is not None else sharp_lens(nearest_m, farthest_m)
    plan = plan_board(View(used, nearest_m, farthest_m, width_px), paper)
    typer.echo(plan.sentence)
    if plan.board is None or plan.paper is None:
        raise InputError("no paper holds a board that this lens can read: take a larger f-number, or stand farther away")
    write_board_pdf(out, plan.board, plan.paper, overwrite=overwrite)
    write_board(out.with_suffix(".json"), plan.board)
    typer.echo(f"wrote {out} (print it at 100 %) and {out.with_suffix('.json')} (for --board)")


def sharp_lens(nearest_m: float, farthest_m: float) -> Lens:
    """A phone's: everything on the table is nearly sharp."""
    return Lens(5.0, 2.0, 2.0 / (1.0 / nearest_m + 1.0 / farthest_m), 6.4)


def _range(text: str) -> tuple[float, float]:
    try:
        nearest, farthest = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--distance-m: expected NEAREST,FARTHEST in metres, got {text!r}") from None
    return nearest, farthest
