"""Tables of trained rows as Markdown and CSV, with the paper's numbers beside ours and the gaps to the first row.

The result of each run is kept beside its network; results of several seeds are summed up.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from training.ablation.plan import FILE_NAMES, TABLES, TITLES, PaperNumbers, Row, TableName, paper_numbers
from training.evaluation.report import markdown_table, number
from training.evaluation.scores import NOT_MEASURED, mean_known

FILE_NAME = "result.json"
SCORES_NAME = "scores.csv"
FORMAT = "mrbokeh-ablation-result"
PAPER_MEASURES = {"psnr_db": ("PSNR dB", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 4)}
OUR_MEASURES = {
    "edge_psnr_db": ("edge PSNR dB", 2),
    "energy_ratio": ("energy", 3),
    "leak": ("leak", 4),
    "highlight_error": ("lights", 3),
    "flicker": ("flicker", 5),
}
_MEASURES = PAPER_MEASURES | OUR_MEASURES
NAN = float("nan")


@dataclass(frozen=True)
class RunResult:
    """The result of one run.

    measures: means over the held-out slices by name (training.evaluation.scores.MEASURES, and flicker); nan if not measured.
    seconds: of training; commit: of the code that trained, or None; machine: that it ended on.
    """

    data_set: str
    row: str
    seed: int
    slices: int
    measures: dict[str, float]
    parameters: int
    seconds: float
    steps: int
    commit: str | None
    machine: str


def write_result(folder: Path, result: RunResult) -> None:
    known = {name: None if np.isnan(value) else value for name, value in result.measures.items()}  # JSON has no nan
    write_json(folder / FILE_NAME, {"format": FORMAT, **asdict(result), "measures": known})


def read_result(folder: Path) -> RunResult | None:
    """Read a run's result; None if it is not finished and evaluated yet."""
    if not (folder / FILE_NAME).is_file():
        return None
    document = read_json(folder / FILE_NAME, "the result of a run of a table")
    document.pop("format")
    measures = {name: float("nan") if value is None else value for name, value in document.pop("measures").items()}
    return RunResult(measures=measures, **document)


@dataclass(frozen=True)
class Summary:
    """A row over data sets and seeds. means: over sets, then seeds; spreads: standard deviation over seeds, nan for a single one."""

    row: Row
    seeds: int
    slices: int
    means: Mapping[str, float]
    spreads: Mapping[str, float]
    parameters: float
    seconds: float
    steps: float
    commits: tuple[str, ...]
    machines: tuple[str, ...]


def summary(row: Row, results: Sequence[RunResult], sets: Sequence[str]) -> Summary | None:
    """Sum up the seeds that are finished on all of the sets; None if there are none."""
    mine = [each for each in results if each.row == row.name and each.data_set in sets]
    seeds = [seed for seed in sorted({each.seed for each in mine}) if {each.data_set for each in mine if each.seed == seed} == set(sets)]
    counted = [each for each in mine if each.seed in seeds]
    if not counted:
        return None
    by_seed = [[each for each in counted if each.seed == seed] for seed in seeds]
    values = {name: [mean_known([each.measures[name] for each in runs]) for runs in by_seed] for name in counted[0].measures}
    return Summary(
        row=row,
        seeds=len(seeds),
        slices=sum(each.slices for each in by_seed[0]),
        means={name: mean_known(of_seeds) for name, of_seeds in values.items()},
        spreads={name: float(np.std(of_seeds, ddof=1)) if len(seeds) > 1 else float("nan") for name, of_seeds in values.items()},
        parameters=float(np.mean([each.parameters for each in counted])),
        seconds=float(np.mean([each.seconds for each in counted])),
        steps=float(np.mean([each.steps for each in counted])),
        commits=tuple(sorted({each.commit or "unknown" for each in counted})),
        machines=tuple(sorted({each.machine for each in counted})),
    )


@dataclass(frozen=True)
class Line:
    """A finished row; sets: the data it averages. gap_db, paper_gap_db: to the first row of the table, negative is worse."""

    sets: tuple[str, ...]
    summary: Summary
    paper: PaperNumbers | None
    gap_db: float
    paper_gap_db: float


def lines_of(table: TableName, results: Sequence[RunResult], sets: Sequence[str]) -> list[Line]:
    """Return finished rows in the order of the table; Table 3 set by set, the others as the mean over all sets, as in the paper."""
    groups = [(each,) for each in sets] if table == "3" else [tuple(sets)]
    return [line for group in groups for line in _group(table, results, group)]


def _group(table: TableName, results: Sequence[RunResult], sets: tuple[str, ...]) -> list[Line]:
    found = {row.name: summary(row, results, sets) for row in TABLES[table]}
    first = TABLES[table][0]
    best, paper_best = found[first.name], paper_numbers(first, table, sets)
    lines = []
    for row in TABLES[table]:
        mine, paper = found[row.name], paper_numbers(row, table, sets)
        if mine is not None:
            gap_db = NAN if best is None else mine.means["psnr_db"] - best.means["psnr_db"]
            paper_gap_db = NAN if paper is None or paper_best is None else paper.psnr_db - paper_best.psnr_db
            lines.append(Line(sets=sets, summary=mine, paper=paper, gap_db=gap_db, paper_gap_db=paper_gap_db))
    return lines


def table_cells(lines: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Return (headings, rows of text)."""
    headings = ["row", "data"]
    for name, (title, _) in _MEASURES.items():
        headings += [title, "paper"] if name in PAPER_MEASURES else [title]
        headings += ["gap", "paper's gap"] if name == "psnr_db" else []
    return [*headings, "parameters", "training s", "steps", "s/picture", "seeds"], [_cells(line) for line in lines]


def _cells(line: Line) -> list[str]:
    mine, cells = line.summary, [line.summary.row.title, ", ".join(line.sets)]
    for name, (_, digits) in _MEASURES.items():
        cells.append(with_spread(mine, name, digits))
        cells += [number(_paper(line, name), 1 if name == "psnr_db" else 3)] if name in PAPER_MEASURES else []
        cells += [_signed(line.gap_db), _signed(line.paper_gap_db)] if name == "psnr_db" else []
    costs = (mine.parameters, mine.seconds, mine.steps)
    return [*cells, *(f"{value:.0f}" for value in costs), number(mine.means["seconds"], 3), str(mine.seeds)]


def with_spread(mine: Summary, measure: str, digits: int) -> str:
    """Format the mean, and with several seeds their standard deviation."""
    mean, spread = mine.means[measure], mine.spreads[measure]
    return number(mean, digits) + ("" if np.isnan(spread) else f" ± {number(spread, digits)}")


def _paper(line: Line, measure: str) -> float:
    return NAN if line.paper is None else float(getattr(line.paper, measure))


def _signed(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:+.2f}"


def markdown_of(table: TableName, lines: Sequence[Line]) -> list[str]:
    """Return title, table, its provenance and notes."""
    notes = [f"- {line.summary.row.title}: {line.summary.row.note}." for line in lines if line.summary.row.note]
    return [
        f"## {TITLES[table]}",
        "",
        *(_pivot(lines) if table == "3" else []),
        *markdown_table(*table_cells(lines)),
        "",
        *provenance(lines),
        *([NOT_MEASURED] if any(np.isnan(line.summary.means["lpips"]) for line in lines) else []),
        "",
        *dict.fromkeys(notes),
        "",
    ]


def provenance(lines: Sequence[Line]) -> list[str]:
    """Return one sentence each on what the numbers are of, and where they were made."""
    commits = sorted({commit for line in lines for commit in line.summary.commits})
    machines = sorted({machine for line in lines for machine in line.summary.machines})
    slices = sorted({line.summary.slices for line in lines})
    return [
        f"Means over {' or '.join(map(str, slices))} held-out slices of stacks not trained on, and over seeds (± standard deviation). "
        "The paper's numbers are of its own data, so that gaps compare and levels do not.",
        f"Trained at commit {', '.join(commits)} on {'; '.join(machines)}.",
    ]


def _pivot(lines: Sequence[Line]) -> list[str]:
    """Lay lines out as the paper's Table 3: a block of measures per data set, a column per network, the paper's number in brackets."""
    names = list(dict.fromkeys(line.summary.row.name for line in lines))
    titles = {line.summary.row.name: line.summary.row.title for line in lines}
    rows = []
    for sets in dict.fromkeys(line.sets for line in lines):
        mine = {line.summary.row.name: line for line in lines if line.sets == sets}
        for measure, (title, digits) in PAPER_MEASURES.items():
            rows.append([", ".join(sets), title, *(_with_paper(mine.get(name), measure, digits) for name in names)])
    return [*markdown_table(["data", "", *(titles[name] for name in names)], rows), ""]


def _with_paper(line: Line | None, measure: str, digits: int) -> str:
    if line is None:
        return "-"
    paper = _paper(line, measure)
    return with_spread(line.summary, measure, digits) + ("" if np.isnan(paper) else f" ({paper:g})")


def write_table(out: Path, table: TableName, lines: Sequence[Line]) -> None:
    """Write table_1.md and .csv and so on."""
    with atomic_path(out / f"{FILE_NAMES[table]}.md") as temporary:
        temporary.write_text("\n".join(markdown_of(table, lines)), encoding="utf-8")
    numbers = [_numbers(line) for line in lines]
    with atomic_path(out / f"{FILE_NAMES[table]}.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows: Any = csv.DictWriter(file, list(numbers[0]))
        rows.writeheader()
        rows.writerows(numbers)


def _numbers(line: Line) -> dict[str, object]:
    mine = line.summary
    values: dict[str, object] = {"row": mine.row.name, "data": " ".join(line.sets), "seeds": mine.seeds, "slices": mine.slices}
    for name in mine.means:
        values |= {name: mine.means[name], f"{name}_spread": mine.spreads[name]}
    values |= {f"paper_{name}": _paper(line, name) for name in PAPER_MEASURES}
    values |= {"gap_db": line.gap_db, "paper_gap_db": line.paper_gap_db, "parameters": mine.parameters, "training_s": mine.seconds}
    return values | {"steps": mine.steps, "commit": " ".join(mine.commits), "machine": "; ".join(mine.machines)}
