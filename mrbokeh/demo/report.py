"""report.html of the demo: pictures of every stage, numbers against truth, times and versions."""

import html
import os
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mrbokeh import __version__
from mrbokeh.atomic_files import atomic_path
from mrbokeh.demo.measurements import Measurement
from mrbokeh.demo.stages import Done

PACKAGES = ("numpy", "opencv-python-headless", "OpenEXR", "rawpy", "torch", "onnxruntime", "embreex", "numba")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 78rem; padding: 0 1rem; color: #222; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; } td, th { padding: .2rem .9rem .2rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
figure { display: inline-block; margin: .5rem .8rem .5rem 0; } figcaption { font-size: 13px; color: #555; max-width: 36rem; }
img { max-width: 100%; height: auto; border: 1px solid #ddd; } code { font-size: 12px; overflow-wrap: anywhere; }
.met { color: #1a7a2e; } .missed { color: #b00020; font-weight: bold; }
"""


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
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>mrbokeh demo</title><style>{_STYLE}</style>'
    page = f"{head}<body>{body}</body></html>\n"
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def section(title: str, text: str, blocks: Iterable[str]) -> str:
    return f"<h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>" + "\n".join(blocks)


def figure(picture: Path, page: Path, caption: str) -> str:
    """A picture by its path relative to the page, so that the folder can be moved."""
    source = html.escape(os.path.relpath(picture, page.parent))
    return f'<figure><img src="{source}" alt="{html.escape(caption)}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def numbers_table(measurements: Sequence[Measurement]) -> str:
    rows = [(_cell(each.what), _cell(each.text, "number"), _cell(each.wanted, "met" if each.met else "missed")) for each in measurements]
    return _table(("what", "measured", "wanted"), rows)


def _stage_table(done: Sequence[Done]) -> str:
    rows = [
        (
            _cell(each.stage.purpose),
            _cell(f"{each.seconds:.1f} s", "number"),
            f"<td><code>{html.escape(each.stage.command_line)}</code></td>",
        )
        for each in done
    ]
    return _table(("stage", "time", "command"), rows)


def _versions() -> str:
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    numbers = [("mrbokeh", __version__), ("Python", platform.python_version()), *((name, _version(name)) for name in PACKAGES)]
    return _table(("what", "version"), [(_cell(name), _cell(number)) for name, number in (*numbers, ("machine", machine))])


def _cell(text: str, kind: str = "text") -> str:
    return f'<td class="{kind}">{html.escape(text)}</td>'


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{''.join(cells)}</tr>" for cells in rows) + "</table>"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
