"""What a measured lens is worth on real stacks: `python -m tests.bench.bench_lens_fitting SCENE [FITTED_VIEWS] [SYMMETRIC]`.

Fits a bank to the first views of a merged scene (5 of them), re-blurs four slices of the next one through it, through the aperture that
the stack states and through Gaussians of the same variance, all by the same renderer, and prints PSNR (peak 1) over pixels with
trusted depth, and over those of them that are blurred by more than 3 px and away from depth edges.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrbokeh.images.layer import opaque
from mrbokeh.lens_measuring.fitting.fit_results import bank_of
from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings, fit_lens
from mrbokeh.lens_measuring.fitting.stack_equations import SliceView, StackSlices, usable_pixels
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from tests.bench.machine import machine_line, memory_line

FITTED_VIEWS = 5
PIXELS = 120_000


def gaussians(largest_px: float) -> PsfBank:
    """Of the variance of a disc, (d / 4)^2 along each axis, over half pixels of diameter."""
    count = int(np.ceil(2.0 * largest_px)) + 1
    middles = (np.arange(count) + 0.5) / count * largest_px
    return PsfBank(
        "gaussian", (Axis("diameter_px", 0.0, largest_px),), (count,), tuple(_gaussian(each / 4.0) for each in middles), nested=False
    )


def _gaussian(sigma_px: float) -> np.ndarray:
    place = np.arange(-int(4.0 * sigma_px + 1.0), int(4.0 * sigma_px + 1.0) + 1)
    line = np.exp(-0.5 * (place / max(sigma_px, 0.05)) ** 2)
    kernel = np.outer(line, line)[..., None]
    return (kernel / kernel.sum()).astype(np.float32)


def psnr_over(view: SliceView, rgb: np.ndarray) -> tuple[float, float]:
    squares = ((rgb - view.blurred) ** 2).mean(axis=2)
    return tuple(float(-10.0 * np.log10(squares[mask].mean())) for mask in (view.known, usable_pixels(view)))  # type: ignore[return-value]


def compare(stack: FocalStack, renderers: dict[str, LaplacianSpreadlets]) -> dict[str, tuple[float, float]]:
    """Mean over slices of both PSNRs."""
    slices, depth_m = StackSlices.of([stack]), stack.depth_m()
    scores: dict[str, list[tuple[float, float]]] = {name: [] for name in ["not blurred", *renderers]}
    for index in np.linspace(0, len(stack) - 1, 4).astype(int).tolist():
        view, lens = slices.view(index), stack.lens_of(index)
        lens = replace(lens, f_number=lens.f_number / stack.slices[index].scale)
        scores["not blurred"].append(psnr_over(view, view.sharp))
        for name, renderer in renderers.items():
            scores[name].append(psnr_over(view, renderer.render([opaque(view.sharp, depth_m)], lens).rgb))
        print(
            f"slice {index}: " + ", ".join(f"{name} {each[-1][0]:.2f} / {each[-1][1]:.2f} dB" for name, each in scores.items()), flush=True
        )
    return {name: tuple(np.mean(each, axis=0)) for name, each in scores.items()}


def main() -> None:
    scene = Path(sys.argv[1])
    stacks = find_focal_stacks(scene)
    fitted_views = int(sys.argv[2]) if len(sys.argv) > 2 else FITTED_VIEWS
    started_s, used_s = time.perf_counter(), time.process_time()
    symmetric = len(sys.argv) > 3
    fit = fit_lens(stacks[:fitted_views], [], FitSettings(regions=(1, 1), rings=4 if symmetric else 0, pixels=PIXELS))
    bank = bank_of(fit)
    print(f"fit of {fitted_views} views: {time.perf_counter() - started_s:.0f} s, {time.process_time() - used_s:.0f} s of one core")
    print(f"pupil of {fit.grid.side} cells a side, {fit.pixels.sum()} pixels, largest circle {fit.largest_px:.1f} px")
    renderers = {
        "measured": LaplacianSpreadlets(bank=bank),
        "stated aperture": LaplacianSpreadlets(),
        "gaussian": LaplacianSpreadlets(bank=gaussians(fit.largest_px)),
    }
    for name, (known, usable) in compare(stacks[fitted_views], renderers).items():
        print(f"{name}: {known:.2f} dB over known pixels, {usable:.2f} dB over blurred ones away from edges")
    print(machine_line())
    print(memory_line())


if __name__ == "__main__":
    main()
