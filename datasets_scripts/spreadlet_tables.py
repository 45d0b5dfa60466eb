"""Tables 2 and 3 of Leimkuehler et al. 2018 on our own scenes: spreadlets, dense splatting, filtering and the reference.

    python -m datasets_scripts.spreadlet_tables OUT [--width 512 --height 320 --reference-spp 1024 --rows whirl_combined,...]

OUT/rows/ROW.json holds what was measured of each row, OUT/pictures the pictures, OUT/tables.md all rows that are there and
OUT/details.png details of them. Finished rows are kept, so an interrupted run goes on where it stopped; banks and scenes are
made in OUT and kept as well. Times are medians of the methods in turns, kernels computed before.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from datasets_scripts.blur_rows import ROWS, Measurement, Methods, Row
from datasets_scripts.samples_plan import SamplesPlan
from datasets_scripts.spreadlet_sheet import write_details
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError

_SPP = 4
_NOT_THERE = "-"


def make_tables(out: Path, rows: Sequence[Row], width_px: int, height_px: int, reference_spp: int, repeats: int) -> int:
    """Measure the rows that are missing and write the tables of all that are there; returns how many were measured."""
    settings = {"width_px": width_px, "height_px": height_px, "reference_spp": reference_spp}
    waiting, methods = [row for row in rows if not _is_measured(out, row, settings)], Methods(out)
    with progress_bars() as bars:
        task = bars.add_task("rows", total=len(waiting))
        for row in waiting:
            plan = SamplesPlan(row.scene, 1, width_px, height_px, _SPP, reference_spp)
            measurement = Measurement(row, out, plan, methods)
            likeness = measurement.likeness(measurement.prepare())
            write_json(_path(out, row), {"settings": settings, "times_ms": measurement.times_ms(repeats), **likeness})
            bars.advance(task)
    there = [(row, read_json(_path(out, row), "a measured row")) for row in ROWS if _path(out, row).is_file()]
    with atomic_path(out / "tables.md") as temporary:
        temporary.write_text(as_markdown(there), encoding="utf-8")
    write_details(out / "pictures", [row for row in ROWS if row.model == "combined" and row.way == "layers"], out / "details.png")
    return len(waiting)


def as_markdown(measured: Sequence[tuple[Row, dict[str, Any]]]) -> str:
    """One table for each way."""
    ways = {
        "layers": ("Synthesis from two global layers", "filter", "FILTER"),
        "slices": ("Synthesis from the same layers by the renderer's own slices", "", "-"),
        "samples": ("Reconstruction from one sample a pixel", "denoised", "denoised"),
    }
    return "\n\n".join(
        f"{title}\n\n" + _table([pair for pair in measured if pair[0].way == way], other, head)
        for way, (title, other, head) in ways.items()
    )


def _table(measured: Sequence[tuple[Row, dict[str, Any]]], other: str, title: str) -> str:
    heads = ("scene", "model", "OURS", "SSIM", title, "SSIM", "SPLAT", "SSIM", "SPLAT / OURS", "points / taps", "REFERENCE")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(_cells(row, found, other)) + " |" for row, found in measured]
    return "\n".join(lines)


def _cells(row: Row, found: dict[str, Any], other: str) -> list[str]:
    times, methods = found["times_ms"], found["methods"]
    each = [
        text
        for name in ("ours", other, "splat")
        for text in (
            f"{times[name]:.0f} ms" if name in times else _NOT_THERE,
            f"{methods[name]['ssim']:.3f}" if name in methods else _NOT_THERE,
        )
    ]
    reference = found["reference"] if found["reference_s"] is None else f"{found['reference_s']:.0f} s"
    return [row.scene, row.model, *each, f"{times['splat'] / times['ours']:.1f}", f"{100 * found['points_over_taps']:.1f} %", reference]


def _is_measured(out: Path, row: Row, settings: dict[str, Any]) -> bool:
    if not _path(out, row).is_file():
        return False
    if read_json(_path(out, row), "a measured row")["settings"] != settings:
        raise InputError(f"{_path(out, row)} was measured with other settings: choose another folder, or remove it")
    return True


def _path(out: Path, row: Row) -> Path:
    return out / "rows" / f"{row.name}.json"


def _chosen(names: str) -> list[Row]:
    by_name = {row.name: row for row in ROWS}
    if unknown := [name for name in names.split(",") if name not in by_name]:
        raise InputError(f"expected rows out of {', '.join(by_name)}, got {', '.join(unknown)}")
    return [by_name[name] for name in names.split(",")]


def main(
    out: Annotated[Path, typer.Argument(help="Folder for scenes, banks, rows and tables.")],
    rows: Annotated[str, typer.Option(help="With commas between them; all unless given.")] = ",".join(row.name for row in ROWS),
    width: int = 512,
    height: int = 320,
    reference_spp: Annotated[int, typer.Option(help="Rays per pixel of the path-traced reference.")] = 1024,
    repeats: Annotated[int, typer.Option(help="How often each method is timed.")] = 3,
) -> None:
    """Measure the missing rows of both tables."""
    try:
        measured = make_tables(out, _chosen(rows), width, height, reference_spp, repeats)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out / 'tables.md'}: {measured} rows measured")


if __name__ == "__main__":
    typer.run(main)
