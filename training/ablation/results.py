"""The result of one run of a table, kept beside its network, and what several runs say together."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mrbokeh.system.atomic_files import read_json, write_json
from training.ablation.rows import Row
from training.evaluation.scores import mean_known

FILE_NAME = "result.json"
SCORES_NAME = "scores.csv"
FORMAT = "mrbokeh-ablation-result"


@dataclass(frozen=True)
class RunResult:
    """measures: means over the held-out slices by name (training.evaluation.scores.MEASURES, and flicker); nan where not measured.

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
    """None where the run is not finished and measured yet."""
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
    """Sum up the seeds that are finished on all of the sets; None where there are none."""
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
