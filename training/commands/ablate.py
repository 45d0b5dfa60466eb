"""The command `mrbokeh train ablate`."""

import os
import shlex
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell, warn

if TYPE_CHECKING:
    from training.ablation.plan import Ablation, PlannedRun, Row, TableName


class Table(StrEnum):
    variants = "1"
    others = "3"
    improvements = "improvements"


def ablate_command(
    data: Annotated[list[Path], typer.Argument(help="Data sets or folders of merged focal stacks; each is trained on by itself.")],
    out: Annotated[Path, typer.Option(help="Folder of the runs, tables and pages.")],
    table: Annotated[
        list[Table] | None,
        typer.Option(help="1: variants of the design; 3: other networks; improvements (repeat for more); else all."),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.01, help="Budget of every run in minutes; else 10.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Budget of every run in epochs, instead of minutes.")] = None,
    rows: Annotated[str, typer.Option(help="Only these rows, with commas between them, by the names that --dry-run prints.")] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Every row is trained so many times; tables then say how far results spread.")] = 1,
    tile_px: Annotated[
        int | None, typer.Option(min=2, help="Side of the tiles; else 200 px for pictures of 1920 px, and others in proportion.")
    ] = None,
    overlap_px: Annotated[int | None, typer.Option(min=0, help="Overlap of the tiles; else 60 px, in the same proportion.")] = None,
    settings: Annotated[
        Path | None, typer.Option(help="A settings.json that the rows of the published form start from, instead of the preset `paper`.")
    ] = None,
    lpips: Annotated[
        Path | None, typer.Option(help="Weights of LPIPS as .onnx, which are not shipped; without them it is left out.")
    ] = None,
    threads: Annotated[int, typer.Option(min=0, max=4096, help="CPU threads, 0 takes all.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print rows, settings and estimated time, and train nothing.")] = False,
) -> None:
    """Train the rows of the paper's tables and of our improvements, and put the results beside the paper's numbers.

    Every row is a run of `mrbokeh train fit` in OUT/runs/DATA/ROW/seed_K. Tables are written after each of them, so that one can stop at
    any time; the same command goes on, and what is finished is not trained again. Several sets are averaged, but in table 3.

    Example: mrbokeh train ablate bokeh_stacks/* --table 1 --minutes 30 --seeds 3 --out ablation

    Example: mrbokeh train ablate scenes/attic --table improvements --rows published,signed_coc,gated --out ablation --dry-run
    """
    # Threads that wait for one another in a busy loop make training many times slower as soon as anything else uses a core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read by OpenMP when torch is loaded, in the next lines
    from training.ablation.plan import Ablation, planned_runs, read_data_sets
    from training.evaluation.scores import OnnxPerceptualDistance
    from training.fitting.settings import load_settings

    tables = _tables(table)
    chosen = _rows(tables, rows)
    base = None if settings is None else load_settings(settings)
    shared = Ablation(
        minutes=_minutes(minutes, epochs),
        epochs=epochs,
        seeds=seeds,
        tile_px=tile_px,
        overlap_px=overlap_px,
        device=device,
        threads=threads,
        base=base,
    )
    sets = read_data_sets(data)
    planned = planned_runs(chosen, sets, out, shared)
    if dry_run:
        _print_plan(planned)
        return
    _run(planned, out, tables, shared, None if lpips is None else OnnxPerceptualDistance(lpips))


def _run(planned: "Sequence[PlannedRun]", out: Path, tables: "tuple[TableName, ...]", shared: "Ablation", lpips: object) -> None:
    from mrbokeh.system.console import kept_when_interrupted
    from training.ablation.report import Report
    from training.ablation.runs import result_of
    from training.fitting.record import DivergedError

    report = Report(out, tables, planned, _command_line())
    with kept_when_interrupted(f"finished runs are kept in {out}"):
        for number, each in enumerate(planned, 1):
            try:
                result = result_of(each, lpips)  # type: ignore[arg-type]
            except DivergedError as error:
                warn(f"{each.folder.relative_to(out)} has no result: {error}")
                continue
            say(
                f"{number}/{len(planned)} {each.folder.relative_to(out)}: {result.measures['psnr_db']:.2f} dB, SSIM "
                f"{result.measures['ssim']:.4f}, {result.steps} steps in {result.seconds:.0f} s"
            )
            report.write()
    report.write_sheets(shared.device)
    tell(f"written to {out}: results.html, results.md, {', '.join(report.table_files())}")


def _tables(table: list[Table] | None) -> "tuple[TableName, ...]":
    names = [each.value for each in (table or list(Table))]
    return tuple(dict.fromkeys(names))  # type: ignore[arg-type]


def _rows(tables: "tuple[TableName, ...]", names: str) -> "list[Row]":
    from training.ablation.plan import rows_of

    rows = rows_of(tables)
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    unknown = set(wanted) - {row.name for row in rows}
    if unknown:
        raise InputError(f"expected rows among {', '.join(row.name for row in rows)}, got {', '.join(sorted(unknown))}: see --dry-run")
    return [row for row in rows if not wanted or row.name in wanted]


def _minutes(minutes: float | None, epochs: int | None) -> float | None:
    if minutes is not None and epochs is not None:
        raise InputError(f"give the budget either in minutes or in epochs, got {minutes:g} minutes and {epochs} epochs")
    return minutes if minutes is not None or epochs is not None else 10.0


def _print_plan(planned: "Sequence[PlannedRun]") -> None:
    from training.ablation.runs import estimated_minutes, is_finished
    from training.fitting.settings import TrainSettings, changed_settings

    estimated = estimated_minutes(planned)
    for each, minutes in zip(planned, estimated, strict=True):
        when = "finished" if is_finished(each) else f"{minutes:.1f} min"
        changed = " ".join(changed_settings(each.settings, TrainSettings()))
        tell(f"{each.row.name:15s} {each.data_set.name} seed {each.seed}  {when:>10s}  {changed}")
    tell(f"{len(planned)} runs, about {sum(estimated):.0f} min of training; measuring comes on top")


def _command_line() -> str:
    import sys

    return shlex.join(["mrbokeh", *sys.argv[1:]])
