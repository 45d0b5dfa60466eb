"""report.html of the demo: pictures of every stage, numbers against truth, times and versions."""

import html
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mrbokeh import __version__
from mrbokeh.demo.measurements import Measurement
from mrbokeh.demo.stages import Done
from mrbokeh.system.html_page import cell, section, table, write_page

PACKAGES = ("numpy", "opencv-python-headless", "OpenEXR", "rawpy", "pycolmap", "torch", "onnxruntime", "embreex", "numba")


def write_report(path: Path, measurements: Sequence[Measurement], sections: Sequence[str], done: Sequence[Done]) -> None:
    """One page beside its pictures; sections are made by `section`."""
    total_s = sum(each.seconds for each in done)
    body = "\n".join(
        [
            "<h1>mrbokeh: from RAW photographs to a virtual object with the blur of their lens</h1>",
            f"<p>{len(done)} stages, {total_s:.0f} s in all when each last ran.</p>",
            section("Numbers", "Measured against the truth that the simulated photographs were made from.", [numbers_table(measurements)]),
            *sections,
            section("Stages", "Every stage is a command that you can run yourself.", [_stage_table(done)]),
            section("Versions", "", [_versions()]),
        ]
    )
    write_page(path, "mrbokeh demo", [body])


def figure(picture: Path, page: Path, caption: str) -> str:
    """A picture by its path relative to the page, so that the folder can be moved."""
    source = html.escape(os.path.relpath(picture, page.parent))
    return f'<figure><img src="{source}" alt="{html.escape(caption)}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def link(target: Path, page: Path, text: str) -> str:
    """A paragraph that leads to another page, by its relative path."""
    return f'<p><a href="{html.escape(os.path.relpath(target, page.parent))}">{html.escape(text)}</a></p>'


def numbers_table(measurements: Sequence[Measurement]) -> str:
    rows = [(cell(each.what), cell(each.text, "number"), cell(each.wanted, "met" if each.met else "missed")) for each in measurements]
    return table(("what", "measured", "wanted"), rows)


def _stage_table(done: Sequence[Done]) -> str:
    rows = [
        (
            cell(each.stage.purpose),
            cell("failed", "missed") if each.failed else cell(f"{each.seconds:.1f} s", "number"),
            f"<td><code>{html.escape(each.stage.command_line)}</code></td>",
        )
        for each in done
    ]
    return table(("stage", "time", "command"), rows)


def _versions() -> str:
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    numbers = [("mrbokeh", __version__), ("Python", platform.python_version()), *((name, _version(name)) for name in PACKAGES)]
    return table(("what", "version"), [(cell(name), cell(number)) for name, number in (*numbers, ("machine", machine))])


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
