"""Reports of an ablation from the results in the folders of its runs: results.md, results.html, and a picture for each table.

A picture shows crops of a few held-out slices, truth first, then every row, as in the paper's Figures 4 and 5.
"""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote

import numpy as np

from mrbokeh.images.image_io import SheetRow, write_contact_sheet
from mrbokeh.images.image_metrics import psnr
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.html_page import cell, inline_figure, section, table, write_page
from training.ablation.plan import FILE_NAMES, TABLES, TITLES, DataSet, PlannedRun, Row, TableName, run_folder
from training.ablation.runs import device_of
from training.ablation.tables import Line, RunResult, lines_of, markdown_of, provenance, read_result, table_cells, write_table
from training.data.dataset import PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.stacks import stack_name
from training.evaluation.methods import Blur, blur_of
from training.evaluation.report import enlarged, informative_crops
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice
from training.fitting.run_folder import NETWORK_NAME
from training.fitting.settings import FILE_NAME as SETTINGS_NAME

Lines = Mapping[TableName, Sequence[Line]]
SLICES_OF_A_SET = 2


def write_results(out: Path, tables: Lines, commands: Sequence[str]) -> None:
    """Write the pages. commands: lines for a shell. Tables without a finished row are left out."""
    tables = {name: lines for name, lines in tables.items() if lines}
    _write_markdown(out, tables, commands)
    blocks = [_table_section(out, name, lines) for name, lines in tables.items()]
    write_page(out / "results.html", "mrbokeh: trained variants", ["<h1>Trained variants</h1>", *blocks, _command_section(commands)])


def _write_markdown(out: Path, tables: Lines, commands: Sequence[str]) -> None:
    lines = ["# Trained variants", ""]
    for name, rows in tables.items():
        lines += [*markdown_of(name, rows), *([f"![{TITLES[name]}]({FILE_NAMES[name]}.png)", ""] if _sheet(out, name).is_file() else [])]
    lines += ["## Commands", "", *(f"    {command}" for command in commands), ""]
    with atomic_path(out / "results.md") as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _table_section(out: Path, name: TableName, lines: Sequence[Line]) -> str:
    headings, rows = table_cells(lines)
    body = table(headings, [[cell(row[0]), cell(row[1]), *(cell(text, "number") for text in row[2:])] for row in rows])
    notes = dict.fromkeys(f"{line.summary.row.title}: {line.summary.row.note}." for line in lines if line.summary.row.note)
    remarks = "".join(f'<p class="muted">{html.escape(text)}</p>' for text in (*provenance(lines)[1:], *notes))
    sheet = _sheet(out, name)
    figures = [inline_figure(sheet.read_bytes(), "png", "input, truth and every row, enlarged")] if sheet.is_file() else []
    return section(TITLES[name], provenance(lines)[0], [body, remarks, *figures])


def _command_section(commands: Sequence[str]) -> str:
    listed = "".join(f"<p><code>{html.escape(command)}</code></p>" for command in commands)
    return section("Commands", "The first makes all of this, each of the others a single run.", [listed])


def _sheet(out: Path, name: TableName) -> Path:
    return out / f"{FILE_NAMES[name]}.png"


def write_sheet(out: Path, table: TableName, rows: Sequence[Row], data_sets: Sequence[DataSet], device: str = "cpu") -> Path:
    """Write a table's picture. rows: those that are finished on all of the sets, with seed 0."""
    path = out / f"{FILE_NAMES[table]}.png"
    sheet = []
    for each in data_sets:
        blurs = {row.title: blur_of(run_folder(out, each.name, row, 0), device_of(device))[0] for row in rows}
        sheet += [row for seen in _slices(each) for row in _sheet_rows(f"{each.name} slice {seen.index}", seen, blurs)]
    write_contact_sheet(path, sheet)
    return path


def _slices(data_set: DataSet) -> list[UnseenSlice]:
    """Return the first and the last slice of the first held-out stack: the nearest and the farthest focus, with the largest blur."""
    stacks = [stack for stack in data_set.data.stacks if stack_name(stack) in data_set.held_out][:1]
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    chosen = np.unique(np.linspace(0, len(pairs) - 1, SLICES_OF_A_SET).round().astype(int))
    return [unseen_slice(pairs, int(index)) for index in chosen]


def _sheet_rows(label: str, seen: UnseenSlice, blurs: dict[str, Blur]) -> list[SheetRow]:
    results = {title: blur(seen.pair) for title, blur in blurs.items()}
    truth = seen.pair.target
    captions = {title: f"{title} {psnr(picture, truth, mask=seen.counted):.1f} dB" for title, picture in results.items()}
    shown = {"input": seen.pair.all_in_focus, "truth": truth} | {captions[title]: picture for title, picture in results.items()}
    windows = informative_crops(seen, next(iter(results.values())))
    return [
        SheetRow(f"{label}, {what}", {caption: enlarged(picture[window]) for caption, picture in shown.items()})
        for what, window in windows.items()
    ]


class Report:
    """Tables, pictures and pages of an ablation. tables: those requested; command: the line that started it."""

    def __init__(self, out: Path, tables: Sequence[TableName], planned: Sequence[PlannedRun], command: str) -> None:
        self._out, self._tables, self._planned, self._command = out, tables, planned, command
        self._sets: list[DataSet] = list({each.data_set.name: each.data_set for each in planned}.values())

    def write(self) -> None:
        """Write tables and pages of what is finished so far."""
        lines = self._lines()
        for name, mine in lines.items():
            write_table(self._out, name, mine)
        write_results(self._out, lines, self._commands())

    def write_sheets(self, device: str = "cpu") -> None:
        """Write the picture of every table, and the pages once more with them."""
        for name in self._lines():
            rows = [row for row in TABLES[name] if self._is_trained(row)]
            if rows:
                write_sheet(self._out, name, rows, self._sets, device)
        self.write()

    def table_files(self) -> list[str]:
        return [f"{FILE_NAMES[table]}.{kind}" for table in self._lines() for kind in ("md", "csv", "png")]

    def _lines(self) -> dict[TableName, list[Line]]:
        found = {table: lines_of(table, self._results(), [each.name for each in self._sets]) for table in self._tables}
        return {table: lines for table, lines in found.items() if lines}

    def _results(self) -> list[RunResult]:
        """Read the results of all planned runs that are finished."""
        return [result for each in self._planned if (result := read_result(each.folder)) is not None]

    def _is_trained(self, row: Row) -> bool:
        return any(each.row == row for each in self._planned) and all(
            (run_folder(self._out, each.name, row, 0) / NETWORK_NAME).is_file() for each in self._sets
        )

    def _commands(self) -> list[str]:
        """Return the command of the whole, and of the finished rows one by one, on the first data with the first seed."""
        first = [each for each in self._planned if each.seed == 0 and each.data_set is self._sets[0]]
        finished = [each for each in first if read_result(each.folder) is not None]
        return [self._command, *(fit_command_line(each) for each in finished)]


def fit_command_line(planned: PlannedRun) -> str:
    """Return `mrbokeh train fit` with the settings and the split of a run."""
    apart = "".join(f" --held-out {quote(name)}" for name in planned.data_set.held_out)
    settings = quote(str(planned.folder / SETTINGS_NAME))
    return f"mrbokeh train fit {quote(str(planned.data_set.folder))} --settings {settings}{apart} --out {quote(str(planned.folder))}"
