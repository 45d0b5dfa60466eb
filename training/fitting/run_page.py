"""The page of a run, RUN/index.html: curves, predictions on held-out slices as they came along, settings, data and machine, in one file."""

import html
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from mrbokeh.system.html_page import cell, inline_figure, section, table, write_page
from training.data.stacks import stacks_words
from training.fitting.checkpoint import Progress
from training.fitting.run_folder import RunFacts
from training.fitting.settings import TrainSettings, settings_words

FILE_NAME = "index.html"
SHEETS = "sheets"
_MOMENTS = 6
_COLUMNS = 3  # of a sheet: sharp picture, network, photograph
_QUALITY = 88
_RELOAD = '<meta http-equiv="refresh" content="60">'
_STYLE = """
.strip { overflow-x: auto; white-space: nowrap; } .strip figure { margin: 0 .3rem .3rem 0; max-width: none; }
.strip figcaption { font-size: 12px; } td { overflow-wrap: anywhere; }
.curve { max-width: 34rem; } .curve svg { width: 100%; height: auto; }
@media (max-width: 40rem) { body { margin: .5rem auto; } .strip img { width: 62vw; } td, th { padding-right: .5rem; } }
"""


def write_run_page(
    folder: Path, curve_svg: str, progress: Progress, made_of: tuple[TrainSettings, RunFacts], slices: tuple[int, int], stopped: bool
) -> None:
    """Write the page. slices: to learn from, and held-out ones that are looked at. stopped: before its end, to be gone on with."""
    settings, facts = made_of
    rows = facts_of_run(progress, settings, facts, slices[0], stopped)
    strips = list(_strips(folder / SHEETS, slices[1]))
    words = "The sharp picture, what the network made of it step by step, and the photograph. Scroll sideways."
    none = "Nothing is held out, so nothing can tell how good the network is." if not slices[1] else "No sheets are written (sheets=false)."
    blocks = [
        "" if progress.finished or stopped else _RELOAD,
        f"<h1>{html.escape(folder.resolve().name)}</h1>",
        table(("", ""), ([cell(name), cell(value)] for name, value in rows.items())),
        section("Curves", "Training loss (smoothed), PSNR of held-out slices, learning rate.", [f'<div class="curve">{curve_svg}</div>']),
        section("Held-out slices as they came along", words if strips else none, strips),
    ]
    write_page(folder / FILE_NAME, f"{folder.resolve().name}, step {progress.step}", blocks, _STYLE)


def facts_of_run(progress: Progress, settings: TrainSettings, facts: RunFacts, pairs: int, stopped: bool) -> dict[str, str]:
    """Return what a reader of a run wants to know first, as text by name. pairs: slices to learn from."""
    pictures = f"{progress.pictures} {'crops' if settings.crop_px else 'pictures'}, {progress.pictures / pairs:.1f} for each slice"
    lens = f"{facts.lens.focal_length_mm:g} mm f/{facts.lens.f_number:.3g}"
    size = f"{facts.width_px}x{facts.height_px} px, blur up to {facts.largest_coc_px:.1f} px, radiance up to {facts.radiance_scale:.3g}"
    return {
        "State": _state(progress, settings, pairs, stopped),
        "Seen": pictures,
        "Settings": settings_words(settings),
        "Lens": lens,
        "Learnt from": f"{pairs} slices of {len(facts.trained_on)} stacks ({stacks_words(facts.trained_on)}), {size}",
        "Held out": facts.held_out_words,
        "Licence of the data": facts.licence or "unknown",
        "Machine": facts.machine or "unknown",
        "Source": facts.commit or "unknown",
    }


def _state(progress: Progress, settings: TrainSettings, pairs: int, stopped: bool) -> str:
    budget = f"{settings.minutes:g} minutes" if settings.minutes is not None else f"{settings.epochs} epochs"
    steps = f"{progress.step} steps in {_duration(progress.elapsed_s)}"
    if progress.finished:
        return f"finished: {steps} ({budget})" + (", stopped early" if progress.stopped_early else "")
    now = "stopped, the same command goes on" if stopped else "training"
    done = progress.elapsed_s / (60.0 * settings.minutes) if settings.minutes else progress.pictures / ((settings.epochs or 1) * pairs)
    return f"{now}: {steps} of about {_duration(progress.elapsed_s / max(done, 1e-6))} ({budget})"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _strips(folder: Path, rows: int) -> Iterator[str]:
    """Yield a strip for each held-out slice, cut from the sheets that are kept."""
    paths = sorted(folder.glob("step_*.png"), key=step_of)
    if not paths or not rows:
        return
    chosen = [paths[index] for index in np.unique(np.linspace(0, len(paths) - 1, min(_MOMENTS, len(paths))).round().astype(int))]
    read = [(step_of(path), picture) for path in chosen if (picture := cv2.imread(str(path))) is not None]
    cells = [(step, _cells(picture, rows)) for step, picture in read]
    for row in range(rows if cells else 0):
        network = [inline_figure(each[row][1], "jpeg", f"step {step}") for step, each in cells]
        sharp, photograph = (inline_figure(cells[-1][1][row][column], "jpeg", name) for column, name in ((0, "sharp"), (2, "photograph")))
        yield f'<div class="strip">{sharp}{"".join(network)}{photograph}</div>'


def _cells(sheet: np.ndarray, rows: int) -> list[list[bytes]]:
    """Return the pictures of a sheet as JPEG, row by row; they are of one size."""
    parts = [np.array_split(row, _COLUMNS, axis=1) for row in np.array_split(sheet, rows, axis=0)]
    return [[cv2.imencode(".jpg", each, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))[1].tobytes() for each in row] for row in parts]


def step_of(sheet: Path) -> int:
    return int(re.sub(r"\D", "", sheet.stem))
