"""The page of the device benchmark: what it ran on, rows of each part and what failed, as JSON and as Markdown."""

import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from tests.bench.device.rows import Row
from tests.bench.machine import processor_name

PACKAGES = ("torch", "triton", "numpy", "numba", "scipy", "jaxtyping", "pytest")
ROOT = Path(__file__).resolve().parents[3]
COLUMNS = (
    "what", "size", "device ms", "with transfers ms", "memory MB", "CPU ms", "cores", "times as fast", "largest difference", "PSNR dB",
    "published", "bar", "met", "note",
)  # fmt: skip


@dataclass
class PartResult:
    """What became of a part. failed: the last lines of its traceback, or in words why it was stopped or left out; "" if all is well."""

    name: str
    about: str = ""
    rows: list[Row] = field(default_factory=list)
    seconds: float = 0.0
    failed: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return it for the process that writes the page; infinity stays a number."""
        return asdict(self)

    @classmethod
    def of(cls, document: dict[str, Any]) -> "PartResult":
        return cls(**{**document, "rows": [Row(**row) for row in document["rows"]]})


@dataclass
class Page:
    """Everything that is written. lacking: sentences about packages that are not there."""

    folder: Path
    facts: dict[str, Any]
    lacking: list[str] = field(default_factory=list)
    parts: list[PartResult] = field(default_factory=list)

    def write(self) -> None:
        """Write both files anew; what was there is replaced only when the new one is whole."""
        parts = [{**vars(part), "rows": [as_numbers(row) for row in part.rows]} for part in self.parts]
        document = {"format": "mrbokeh-device-benchmark", "version": 1, **self.facts, "lacking": self.lacking, "parts": parts}
        written(self.folder / "device.json", json.dumps(document, indent=1) + "\n")
        written(self.folder / "device.md", self.markdown())

    def markdown(self) -> str:
        lines = [f"{self.facts['first_line']}", "", "# Device benchmark", ""]
        lines += [f"- {name.replace('_', ' ')}: {value}" for name, value in self.facts.items() if name != "first_line"]
        lines += [f"- {sentence}" for sentence in self.lacking]
        lines += ["", "Times are medians after warming up. With transfers, inputs come from the host's memory and the result goes back."]
        for part in self.parts:
            lines += ["", f"## {part.name}: {part.about} ({part.seconds:.0f} s)", "", *_table(part.rows)]
            lines += ["", "Failed:", "", "```", part.failed, "```"] if part.failed else []
        return "\n".join(lines) + "\n"


def as_numbers(row: Row) -> dict[str, Any]:
    """Return the row for JSON, in which infinity is a word."""
    every = {**asdict(row), "ratio": row.ratio, "met": row.met}
    return {name: str(value) if isinstance(value, float) and not math.isfinite(value) else value for name, value in every.items()}


def in_words(row: Row) -> str:
    """Return one line for the screen."""
    parts = [f"{row.name} {row.size}".strip()]
    named = ("device_ms", "ms"), ("transfers_ms", "ms with transfers"), ("cpu_ms", "ms CPU"), ("ratio", "times"), ("psnr_db", "dB")
    parts += [f"{_short(getattr(row, name))} {unit}" for name, unit in named if getattr(row, name) is not None]
    parts += [f"bar {row.bar}: {_met(row)}"] if row.bar else []
    return ", ".join([*parts, row.note] if row.note else parts)


def machine_facts(device: str, first_line: str, commit: str = "") -> dict[str, Any]:
    """Return what the run is of and on; commit: given, or asked of git."""
    versions = {name: _version(name) for name in PACKAGES}
    return {
        "first_line": first_line,
        "device": device,
        "nvidia_smi": _said("nvidia-smi", "--query-gpu=name,driver_version,memory.total,power.limit", "--format=csv,noheader") or "none",
        "processor": f"{processor_name()}, {len(os.sched_getaffinity(0))} cores, load before the run {os.getloadavg()[0]:.1f}",
        "python": platform.python_version(),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "commit": commit or _said("git", "describe", "--always", "--dirty") or "unknown (no git here)",
        "date": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"


def _said(*command: str) -> str:
    """Return what a command prints; "" where it is not there or fails."""
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _table(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return ["No rows."]
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    return lines + [f"| {' | '.join(_cells(row))} |" for row in rows]


def _cells(row: Row) -> list[str]:
    numbers = row.device_ms, row.transfers_ms, row.memory_mb, row.cpu_ms, row.cpu_cores, row.ratio, row.largest_difference, row.psnr_db
    note = row.note.replace("|", "/").replace("\n", " ")
    return [row.name, row.size, *map(_short, numbers), row.published, row.bar, _met(row), note]


def _met(row: Row) -> str:
    return {True: "yes", False: "no", None: ""}[row.met]


def _short(number: float | None) -> str:
    if number is None or isinstance(number, int):
        return "" if number is None else str(number)
    if number == 0 or not math.isfinite(number):
        return f"{number:g}"
    return f"{number:.2e}" if abs(number) < 0.01 else f"{number:.{2 if abs(number) < 100 else 0}f}"


def written(path: Path, text: str) -> None:
    """Write a file under another name and rename it; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
