"""Files that a run writes while it trains: curve, sheets, checkpoints, a page, and the network at the end.

A few held-out slices show the network's progress, as a PSNR and as sheets of predictions; they are read on demand, not kept. The page,
RUN/index.html, has curves, predictions as they came along, settings, data and machine in one file.
"""

import html
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from mrbokeh.images.image_io import WIDEST_PX, SheetRow, write_contact_sheet
from mrbokeh.system.errors import InputError
from mrbokeh.system.html_page import cell, inline_figure, section, table, write_page
from training.data.batches import Batch, stack_pairs
from training.data.dataset import Pair, PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.stacks import ChosenSlices, Source, stacks_words
from training.fitting.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.fitting.checkpoint import CurvePoint, Learner, Progress, draw_curve, save_checkpoint, write_curve
from training.fitting.run_folder import RunFacts, save_network
from training.fitting.settings import TrainSettings, settings_words, tried_rates

PAGE_NAME = "index.html"
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
MOST_KEPT = 16
SLICES = 4
SIDE_PX = 384
"""Side of the middle of a picture that a look is at: with blur of 66 px a network took 20 s for a whole picture of 0.8 megapixels."""
# Drawing takes a moment, which looks that follow one another closely do not all need.
_DRAWN_EVERY_S = 20.0
# Of the curve, over the whole budget, beside those where held-out slices are looked at.
POINTS = 200


@dataclass(frozen=True)
class Look:
    """A look at held-out slices.

    psnr_db: mean over slices, of linear radiance clipped to [0, 1] where the truth is known; nan if nothing is held out.
    sharp_db: the same of the all-in-focus picture, before any blur.
    rows: for a sheet: the sharp picture, the network's prediction, and the photograph.
    """

    psnr_db: float
    sharp_db: float = math.nan
    rows: tuple[SheetRow, ...] = ()


class HeldOutSlices:
    """Some slices, spread over stacks and focus range: the middle of each, or all of it if tiles have their own places."""

    def __init__(self, stacks: Sequence[Source], slices: ChosenSlices | None = None) -> None:
        self._pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=slices)
        spread = np.linspace(0, len(self._pairs) - 1, SLICES if len(self._pairs) else 0)
        self._chosen = [int(index) for index in np.unique(spread.round())]

    def __len__(self) -> int:
        return len(self._chosen)

    @torch.no_grad()
    def look(self, network: torch.nn.Module, device: torch.device) -> Look:
        """Score and show the slices in full precision, whatever the training's."""
        scored = [self._scored(index, network, device) for index in self._chosen]
        found_db, sharp_db = (float(np.mean(each)) if scored else math.nan for each in ([s[0] for s in scored], [s[1] for s in scored]))
        return Look(found_db, sharp_db, tuple(row for *_, row in scored))

    def _scored(self, index: int, network: torch.nn.Module, device: torch.device) -> tuple[float, float, SheetRow]:
        tiled = getattr(network, "grid", None) is not None
        batch = stack_pairs([self._pairs[index] if tiled else _middle(self._pairs[index])]).to(device)
        result = network(batch.rgb, batch.coc_px, batch.place, batch.lens)
        psnr_db = _psnr_db(result, batch)
        pictures = {"sharp": batch.rgb, f"network {psnr_db:.2f} dB": result, "photograph": batch.target}
        small = {caption: small_picture(picture[0].permute(1, 2, 0).cpu().numpy()) for caption, picture in pictures.items()}
        return psnr_db, _psnr_db(batch.rgb, batch), SheetRow(self._pairs.label(index), small)


def _middle(pair: Pair) -> Pair:
    """Crop to at most SIDE_PX wide and high; pixels that get light from outside have no weight."""
    halo_px = math.ceil(float(np.abs(pair.coc_px).max()) / 2.0)
    parts, weights = [], []
    for length in pair.coc_px.shape:
        side = min(length, max(SIDE_PX, 4 * halo_px))
        start = (length - side) // 2
        weight = np.ones(side, np.float32)
        if side < length:
            weight[:halo_px] = weight[side - halo_px :] = 0.0
        parts.append(slice(start, start + side))
        weights.append(weight)
    return pair.cut(parts[0], parts[1]).weighted(weights[0][:, None] * weights[1])


def _psnr_db(result: torch.Tensor, batch: Batch) -> float:
    error = result.clamp(0, 1) - batch.target.clamp(0, 1)
    weight = batch.weight.expand_as(error)
    mean = float((weight * error.square()).sum() / weight.sum().clamp(min=1e-6))
    return -10.0 * math.log10(max(mean, 1e-12))


@dataclass(frozen=True)
class Task:
    """The task of a run: its folder, settings, training data and held-out slices."""

    folder: Path
    settings: TrainSettings
    facts: RunFacts
    pairs: PairSet
    held_out: HeldOutSlices


class DivergedError(InputError):
    """A training whose loss or weights are no longer numbers."""


def diverged(task: Task, step: int, spoilt: bool = False) -> DivergedError:
    """Return the error for a loss or weights that are no numbers after so many steps. spoilt: the pictures of the step have none either."""
    settings, kept = task.settings, task.folder / CHECKPOINT_NAME
    if step == 0 or spoilt:
        return DivergedError(
            f"the loss of step {step + 1} is not a number, and learning is not to blame: expected pictures and circles of confusion "
            "that are finite where they count; look for NaN and inf in the slices, all_in_focus.exr and depth.exr"
        )
    half = " and precision=float32" if settings.precision != "float32" else ""
    left = f"{kept} keeps the last weights that were numbers" if kept.exists() else "nothing was written"
    return DivergedError(
        f"training diverged: after {step} steps loss or weights are not numbers; give {lower_rate(settings)}{half}, with --overwrite or "
        f"another --out; {left}"
    )


def lower_rate(settings: TrainSettings) -> str:
    """Return the option for a lower learning rate: a tenth, or that of a preset of this form if it is lower still."""
    rate = settings.learning_rate
    tried = max((each for each in tried_rates(settings.network.form).values() if each < rate), default=rate)
    return f"--set learning_rate={min(rate / 10.0, tried):.2g}"


class Record:
    """The writer of a run's files, in the first process only; progress, learner and rng are shared with the run."""

    def __init__(self, task: Task, learner: Learner, progress: Progress, rng: np.random.Generator) -> None:
        self._task, self._learner, self._progress, self._rng = task, learner, progress, rng
        self._checkpoint = task.folder / CHECKPOINT_NAME
        self._drawn_s = -math.inf

    def note(self, psnr_db: float = math.nan) -> None:
        """Append a point to the curve."""
        progress = self._progress
        elapsed_s, rate = round(progress.elapsed_s, 2), self._learner.learning_rate
        progress.curve.append(
            CurvePoint(step=progress.step, elapsed_s=elapsed_s, loss=progress.smoothed_loss, held_out_psnr_db=psnr_db, learning_rate=rate)
        )

    def note_if_due(self, done: float) -> None:
        """Append a point to the curve for every part of the budget; done: the used fraction of it."""
        if done * POINTS >= self._progress.points_due:
            self._progress.points_due = math.floor(done * POINTS) + 1
            self.note()

    def look(self) -> bool:
        """Look at held-out slices and tell whether patience is exhausted."""
        look = self._task.held_out.look(self._learner.average, self._learner.device)
        self._progress.sharp_psnr_db = look.sharp_db
        if self._progress.looked(look.psnr_db):
            self._learner.keep_best()
        self.note(look.psnr_db)
        if self._task.settings.sheets:
            write_sheet(self._task.folder, self._progress.step, look.rows)
        write_curve(self._task.folder, self._progress.curve)
        self._draw_if_due()
        return 0 < self._task.settings.patience <= self._progress.looks_since_best

    def stop(self) -> None:
        """Save a run that ends here for now; its page says so."""
        self.save()
        self._draw(stopped=True)

    def save(self) -> None:
        """Write the checkpoint and the curve; not with weights that are no numbers, of which the next step tells."""
        if not self._learner.is_finite():
            return
        save_checkpoint(self._checkpoint, self._progress, self._learner, self._rng)
        write_curve(self._task.folder, self._progress.curve)
        self._draw_if_due()

    def _draw_if_due(self) -> None:
        if self._progress.elapsed_s - self._drawn_s >= _DRAWN_EVERY_S:
            self._draw()

    def finish(self) -> None:
        """Take the last look and save the network: the last weights, or with patience the best ones.

        Raises DivergedError, and saves nothing, if the weights are no numbers.
        """
        if not self._learner.is_finite():
            raise diverged(self._task, self._progress.step)
        self._drawn_s = math.inf  # all of it is drawn below
        if not self._progress.stopped_early:
            self.look()
        self._progress.kept_step = self._progress.step
        if self._task.settings.patience and self._learner.best is not None:
            self._learner.take_best()
            self._progress.kept_step = self._progress.best_step
        save_network(self._task.folder, self._learner.average.cpu())
        self._progress.finished = True
        self.save()
        self._draw()

    def _draw(self, stopped: bool = False) -> None:
        drawn, task = draw_curve(self._task.folder, self._progress.curve), self._task
        slices = (len(task.pairs), len(task.held_out))
        write_run_page(task.folder, drawn, self._progress, (task.settings, task.facts), slices, stopped)
        self._drawn_s = self._progress.elapsed_s


def small_picture(picture: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "small_height small_width 3"]:
    """Shrink a picture to the width at which a sheet shows it, so that whole pictures need not be kept until it is written."""
    import cv2

    height, width = picture.shape[:2]
    scale = min(1.0, WIDEST_PX / width)
    return np.asarray(cv2.resize(picture, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA), np.float32)


def write_sheet(run_folder: Path, step: int, rows: Sequence[SheetRow]) -> None:
    """Write sheets/step_0000123.png. At most MOST_KEPT are kept: the first, the last, and others that are far apart."""
    if not rows:
        return
    folder = run_folder / SHEETS
    write_contact_sheet(folder / f"step_{step:07d}.png", rows)
    kept = sorted(folder.glob("step_*.png"), key=step_of)
    while len(kept) > MOST_KEPT:
        closest = min(range(1, len(kept) - 1), key=lambda i: step_of(kept[i + 1]) - step_of(kept[i - 1]))
        kept.pop(closest).unlink()


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
    write_page(folder / PAGE_NAME, f"{folder.resolve().name}, step {progress.step}", blocks, _STYLE)


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
