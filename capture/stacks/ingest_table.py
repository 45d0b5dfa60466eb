"""What ingest did, for people: a table of stacks, remarks below it, and the files that were left out."""

import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from capture.stacks.ingest import IngestReport
from capture.stacks.stack_description import StackReport
from capture.stacks.stack_lens import lens_text
from mrbokeh.stacks.focal_stack import FocalStack

_MOST_NAMED = 5


def print_report(report: IngestReport, console: Console) -> None:
    """One line for each stack, then remarks and skipped files with their reasons."""
    table = Table("stack", "slices", "size", "focus (from the lens)", "lens", "skipped")
    for each in report.stacks:
        table.add_row(*_cells(each))
    console.print(table)
    for each in report.stacks:
        for remark in each.remarks:
            console.print(f"{each.name}: {remark}", highlight=False, markup=False, soft_wrap=True)
        if each.problem:
            console.print(f"no stack {each.name}: {each.problem}", style="yellow", highlight=False, markup=False, soft_wrap=True)
    for skipped in (*report.skipped, *(one for each in report.stacks for one in each.skipped)):
        console.print(f"skipped {skipped.path.name}: {skipped.reason}", style="yellow", highlight=False, markup=False, soft_wrap=True)
    if report.no_photographs:
        console.print(f"not photographs, left out: {_some_names(report.no_photographs)}", highlight=False, markup=False, soft_wrap=True)


def _some_names(paths: Sequence[Path]) -> str:
    """Name the first few, and say how many there are."""
    more = f" ... ({len(paths)} files)" if len(paths) > _MOST_NAMED else ""
    return ", ".join(each.name for each in paths[:_MOST_NAMED]) + more


def focus_text(stack: FocalStack) -> str:
    """The range of focus distances: "0.4 .. 2.1 m", "... inf", "unknown"."""
    known = [distance for distance in stack.focus_distances_m if distance is not None]
    if not known:
        return "unknown"
    ends = [f"{distance:.4g}" if math.isfinite(distance) else "inf" for distance in (min(known), max(known))]
    partly = "" if len(known) == len(stack) else f" ({len(known)} of {len(stack)} known)"
    return f"{' .. '.join(dict.fromkeys(ends))} m{partly}"


def _cells(report: StackReport) -> tuple[str, ...]:
    skipped = str(len(report.skipped) or "")
    if report.stack is None or report.size_px is None:
        return report.name, "none", "", "", "", skipped
    kept = f" ({report.kept} from before)" if report.kept else ""
    size = f"{report.size_px[0]}x{report.size_px[1]}"
    return report.name, f"{len(report.stack)}{kept}", size, focus_text(report.stack), lens_text(report.stack.lens), skipped
