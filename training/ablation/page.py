"""results.md and results.html: all tables that have results, their pictures, and the commands that made them."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.html_page import cell, inline_figure, section, table, write_page
from training.ablation.rows import FILE_NAMES, TITLES, TableName
from training.ablation.tables import Line, markdown_of, provenance, table_cells

Lines = Mapping[TableName, Sequence[Line]]


def write_results(out: Path, tables: Lines, commands: Sequence[str]) -> None:
    """commands: lines for a shell. Tables without a finished row are left out."""
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
