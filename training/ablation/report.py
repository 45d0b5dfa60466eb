"""Everything that is written beside the runs, from the results that lie in their folders."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from shlex import quote

from training.ablation.page import write_results
from training.ablation.plan import DataSet, PlannedRun, run_folder
from training.ablation.results import RunResult, read_result
from training.ablation.rows import FILE_NAMES, TABLES, Row, TableName
from training.ablation.sheets import write_sheet
from training.ablation.tables import Line, lines_of, write_table
from training.run_folder import NETWORK_NAME
from training.settings import FILE_NAME as SETTINGS_NAME
from training.settings import TrainSettings

_WHERE = ("device", "threads", "seed", "minutes", "epochs")


class Report:
    """Tables, pictures and pages of an ablation. tables: those asked for; command: the line that started it."""

    def __init__(self, out: Path, tables: Sequence[TableName], planned: Sequence[PlannedRun], command: str) -> None:
        self._out, self._tables, self._planned, self._command = out, tables, planned, command
        self._sets: list[DataSet] = list({each.data_set.name: each.data_set for each in planned}.values())

    def write(self) -> None:
        """Tables and pages of what is finished so far."""
        lines = self._lines()
        for table, mine in lines.items():
            write_table(self._out, table, mine)
        write_results(self._out, lines, self._commands())

    def write_sheets(self, device: str = "cpu") -> None:
        """The picture of every table, and the pages once more with them."""
        for table in self._lines():
            rows = [row for row in TABLES[table] if self._is_trained(row)]
            if rows:
                write_sheet(self._out, table, rows, self._sets, device)
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
        """The whole, and the finished rows one by one, on the first data with the first seed; the others are alike."""
        first = [each for each in self._planned if each.seed == 0 and each.data_set is self._sets[0]]
        finished = [each for each in first if read_result(each.folder) is not None]
        return [self._command, *(fit_command_line(each) for each in finished)]


def fit_command_line(planned: PlannedRun) -> str:
    """`mrbokeh train fit` with the settings and the split of a run."""
    apart = "".join(f" --held-out {quote(name)}" for name in planned.data_set.held_out)
    settings = quote(str(planned.folder / SETTINGS_NAME))
    return f"mrbokeh train fit {quote(str(planned.data_set.folder))} --settings {settings}{apart} --out {quote(str(planned.folder))}"


def changed_settings(settings: TrainSettings) -> list[str]:
    """name=value of what differs from the defaults, which are the published network's."""
    plain, now = TrainSettings(), asdict(settings)
    own = {name: value for name, value in now.items() if name not in ("network", *_WHERE) and value != getattr(plain, name)}
    network = {f"network.{name}": value for name, value in now["network"].items() if value != getattr(plain.network, name)}
    return [f"{name}={value}" for name, value in (network | own).items()]
