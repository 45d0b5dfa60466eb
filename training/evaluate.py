"""Compare a network with what it must beat, on stacks that it has not seen: a table, its numbers and a sheet of pictures."""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.atomic_files import atomic_path
from mrbokeh.contact_sheet import SheetRow, write_contact_sheet
from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack
from mrbokeh.image_metrics import psnr, ssim
from mrbokeh.progress import track
from training.baselines import gaussian_gather, gaussian_scatter, scatter_reference, sigma_per_coc
from training.dataset import Pair, PairSet
from training.stacks import stack_name
from training.weights import WHERE_TRUTH_IS_KNOWN

NETWORK, NO_BLUR, SCATTERED, GATHERED, REFERENCE = "network", "no blur", "Gaussian, scattered", "Gaussian, gathered", "scatter reference"

Image = Float32[np.ndarray, "height width 3"]
Blur = Callable[[Image, Float32[np.ndarray, "height width"]], Image]


@dataclass(frozen=True)
class Score:
    """One method on one slice. psnr_db, ssim: linear radiance clipped to [0, 1], all pixels but those that moved, have no data or show
    a calibration board."""

    stack: str
    slice_index: int
    method: str
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class Evaluation:
    scores: tuple[Score, ...]

    def mean_psnr_db(self, method: str) -> float:
        return float(np.mean([each.psnr_db for each in self.scores if each.method == method]))

    def mean_ssim(self, method: str) -> float:
        return float(np.mean([each.ssim for each in self.scores if each.method == method]))

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(each.method for each in self.scores))

    @property
    def gain_over_gaussian_db(self) -> float:
        """Network over the better of the two Gaussians, mean over slices."""
        return self.mean_psnr_db(NETWORK) - max(self.mean_psnr_db(SCATTERED), self.mean_psnr_db(GATHERED))

    @property
    def gain_over_no_blur_db(self) -> float:
        return self.mean_psnr_db(NETWORK) - self.mean_psnr_db(NO_BLUR)


def evaluate(blur: Blur, stacks: Sequence[FocalStack], out: Path, *, reference: bool = True) -> Evaluation:
    """Every slice of the stacks by every method; writes evaluation.md, evaluation.csv and evaluation.png into `out`.

    reference: also the scatter reference with the lens's aperture (slow, exact).
    """
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    scores: list[Score] = []
    rows: list[SheetRow] = []
    for index in track(range(len(pairs)), "evaluate"):
        stack, slice_index = pairs.keys[index]
        pair = pairs[index]
        results = _results(blur, pair, stack, slice_index, reference)
        for method, picture in results.items():
            scores.append(Score(stack_name(stack), slice_index, method, *_likeness(picture, pair)))
        rows.append(_sheet_row(pairs.label(index), pair, results))
    result = Evaluation(tuple(scores))
    _write_table(out / "evaluation.md", result)
    _write_numbers(out / "evaluation.csv", result)
    write_contact_sheet(out / "evaluation.png", rows)
    return result


def unseen(stacks: Sequence[FocalStack], trained_on: Sequence[str]) -> list[FocalStack]:
    """The stacks that a network was not trained on; raises InputError where none is left."""
    left = [stack for stack in stacks if stack_name(stack) not in trained_on]
    if not left:
        raise InputError(
            f"the network was trained on all of these stacks ({', '.join(trained_on)}): give a scene with a stack it has not seen"
        )
    return left


def _likeness(picture: Image, pair: Pair) -> tuple[float, float]:
    """(PSNR in dB, SSIM) over the pixels that count; for SSIM, whose windows want whole pictures, the others are those of the slice."""
    counted = pair.weight > 0
    return psnr(picture, pair.target, mask=counted), ssim(np.where(counted[..., None], picture, pair.target), pair.target)


def _results(blur: Blur, pair: Pair, stack: FocalStack, slice_index: int, reference: bool) -> dict[str, Image]:
    sharp, coc_px, lens = pair.all_in_focus, pair.coc_px, stack.lens_of(slice_index)
    ratio = sigma_per_coc(lens.aperture)
    results = {
        NETWORK: blur(sharp, coc_px),
        NO_BLUR: sharp,
        SCATTERED: gaussian_scatter(sharp, coc_px, ratio),
        GATHERED: gaussian_gather(sharp, coc_px, ratio),
    }
    return results | ({REFERENCE: scatter_reference(sharp, coc_px, lens.aperture)} if reference else {})


def _sheet_row(label: str, pair: Pair, results: dict[str, Image]) -> SheetRow:
    gaussian = max((SCATTERED, GATHERED), key=lambda name: _likeness(results[name], pair)[0])
    shown = {
        "input": pair.all_in_focus,
        "truth": pair.target,
        f"network {_likeness(results[NETWORK], pair)[0]:.1f} dB": results[NETWORK],
        f"Gaussian {_likeness(results[gaussian], pair)[0]:.1f} dB": results[gaussian],
        f"no blur {_likeness(results[NO_BLUR], pair)[0]:.1f} dB": results[NO_BLUR],
        "network - truth, x4": 0.5 + 4.0 * (np.clip(results[NETWORK], 0, 1) - np.clip(pair.target, 0, 1)),
    }
    return SheetRow(label, shown)


def table(result: Evaluation) -> list[tuple[str, str, str]]:
    """(method, mean PSNR, mean SSIM), best first."""
    ranked = sorted(result.methods, key=result.mean_psnr_db, reverse=True)
    return [(name, f"{result.mean_psnr_db(name):.2f}", f"{result.mean_ssim(name):.4f}") for name in ranked]


def _write_table(path: Path, result: Evaluation) -> None:
    slices = len({(each.stack, each.slice_index) for each in result.scores})
    lines = [
        f"Mean over {slices} slices of stacks not trained on; linear radiance clipped to [0, 1], all pixels with a truth.",
        "",
        "| method | PSNR dB | SSIM |",
        "|---|---|---|",
        *(f"| {name} | {decibel} | {similarity} |" for name, decibel, similarity in table(result)),
        "",
        f"Network over no blur {result.gain_over_no_blur_db:+.2f} dB, over the better Gaussian {result.gain_over_gaussian_db:+.2f} dB.",
        "",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _write_numbers(path: Path, result: Evaluation) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows: Any = csv.DictWriter(file, ["stack", "slice_index", "method", "psnr_db", "ssim"])
        rows.writeheader()
        rows.writerows(vars(each) for each in result.scores)
