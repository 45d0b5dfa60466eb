"""How long spreadlets take and how near they come: `python -m tests.bench.bench_laplacian_spreadlets [HEIGHT WIDTH]`.

Dense splatting is of the very same kernels, tabulated, with the same loop, tiles, threads and precision as the fast track; what it
takes and what spreadlets take is measured in turns, tables made before. Points that lie apart go for two neighbouring pixels at
once; taps do not, as it makes them five to ten times slower (each would wait for the one beside it to be written). "Exact kernels" is the
scatter reference.
"""

import os
import sys
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from mrbokeh.images.image_metrics import psnr, ssim
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels.laplacian_integration import integrate, integrate_by_pyramid, laplacian
from mrbokeh.renderers.kernels.laplacian_tables import DENSE, WHOLE, kind_of
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, Sparsification, Spreadlet, outline_px, sparsify, whole_laplacian
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from tests.bench.machine import in_turns, tell, took

REPEATS = 9
SIZE = (540, 960)
DISC = Aperture.disc()


def frame(size: tuple[int, int]) -> np.ndarray:
    """A texture from 0 to 1 with lamps of 30 (one pixel in 2000), coverage 1."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(size=(*size, 3)).astype(np.float32), (0, 0), 1.5)
    texture = (texture - texture.min()) / np.ptp(texture)
    texture[rng.uniform(size=size) < 1 / 2000] = 30.0
    return np.dstack([texture, np.ones(size, np.float32)]).astype(np.float32)


def hills_px(size: tuple[int, int], mean_px: float) -> np.ndarray:
    """Circles of confusion from 0.6 to 1.4 of the mean with a texture of 1 % of it."""
    y, x = np.mgrid[: size[0], : size[1]] * (1080.0 / size[0])
    noise = cv2.GaussianBlur(np.random.default_rng(1).standard_normal(size).astype(np.float32), (0, 0), 3)
    return (mean_px * (1.0 + 0.4 * np.sin(x / 300.0) * np.cos(y / 200.0) + 0.01 * noise / noise.std())).astype(np.float32)


def integration_rows() -> None:
    image = np.zeros((1024, 1024, 4))
    image[100:-100, 100:-100] = cv2.GaussianBlur(np.random.default_rng(2).uniform(size=(824, 824, 4)), (0, 0), 3)
    image /= image.max()
    source = laplacian(image)[1:-1, 1:-1]
    print("integration, 1024 x 1024, 4 channels; errors where there is light, as shares of the largest value")
    for name, run in (("exact", integrate), ("pyramid", integrate_by_pyramid)):
        for precision in (np.float64, np.float32):
            part = source.astype(precision)
            took_ms = in_turns(lambda r=run, p=part: r(p), repeats=REPEATS)[0].wall_ms
            error = np.abs(run(part) - image)[image > 0]
            print(f"  {name:<8} {precision.__name__:<8} {took_ms:7.1f} ms   mean error {error.mean():.1e}, largest {error.max():.1e}")


def sparsification_rows() -> None:
    """The paper's ablation, on discs and pentagons; errors relative to darts only, and with values fitted to all moments."""
    print("sparsification, discs and pentagons of 30, 47 and 90 px: L1 error, against darts with sums over cells; points over taps")
    kernels = [shape.rasterize(size).kernel for shape in (DISC, Aperture.blades(5)) for size in (30.0, 47.0, 90.0)]
    base = 0.0
    for fit in (False, True):
        for lloyd, annealing in ((0, 0), (50, 0), (0, 400), (50, 400)):
            settings = Sparsification(lloyd_steps=lloyd, annealing_steps=annealing, fit=fit)
            found: list[Spreadlet] = []
            each_ms = took(lambda s=settings, f=found: f.extend(sparsify(kernel, s) for kernel in kernels)).wall_ms / len(kernels)
            error = float(np.mean([l1_error(each, kernel) for each, kernel in zip(found, kernels, strict=True)]))
            base = base or error
            share = np.mean([len(each.points) / np.count_nonzero(kernel) for each, kernel in zip(found, kernels, strict=True)])
            steps = f"darts{' + Lloyd' if lloyd else ''}{' + annealing' if annealing else ''}{' + fit' if fit else ''}"
            errors = f"{100 * error / base:6.1f} %  (L1 {error:.4f})"
            print(f"  {steps:<36} {errors}  {100 * share:5.1f} %  {each_ms:6.0f} ms each")


def l1_error(spreadlet: Spreadlet, kernel: np.ndarray, around_px: int = 30) -> float:
    size = kernel.shape[0] + 2 * around_px
    source = np.zeros((size, size, 1))
    x, y = spreadlet.points.T.astype(int) + size // 2
    np.add.at(source, (y, x), spreadlet.values)
    return float(np.abs(integrate(source)[..., 0] - np.pad(kernel, around_px)).sum())


def spread_rows(size: tuple[int, int]) -> None:
    print(f"{size[1]} x {size[0]}, 4 channels, all lit, lamps; time and likeness (peak 1) against dense splatting of the same kernels")
    values = frame(size)
    for mean_px in (20.0, 40.0, 60.0, 100.0):
        coc_px = hills_px(size, mean_px)
        for name, changed in (
            ("spreadlets", {}),
            ("half the points", {"sparsification": replace(UNRELAXED, points_per_px=0.5)}),
            ("whole Laplacians", {"sparsification": None}),
            ("pyramid", {"integration": "pyramid"}),
        ):
            renderer = LaplacianSpreadlets(**changed)
            first_ms = took(lambda r=renderer, c=coc_px: r.sum_kernels(values, c, DISC)).wall_ms
            dense = renderer.sum_kernels(values, coc_px, DISC, densely=True)
            ways = [partial(renderer.sum_kernels, values, coc_px, DISC, densely=densely) for densely in (False, True)]
            took_ms, dense_ms = (each.wall_ms for each in in_turns(*ways, repeats=REPEATS))
            found = renderer.sum_kernels(values, coc_px, DISC)
            like = f"SSIM {ssim(found[..., :3], dense[..., :3]):.4f}, {psnr(found[..., :3], dense[..., :3]):.1f} dB"
            times = f"{took_ms:7.0f} ms, dense {dense_ms:7.0f} ms: {dense_ms / took_ms:5.1f} times"
            print(f"  mean {coc_px.mean():5.1f} px {name:<17} {times}   {like}   (first {first_ms / 1e3:.1f} s)", flush=True)
        shares(LaplacianSpreadlets(), values, coc_px)


def shares(renderer: LaplacianSpreadlets, values: np.ndarray, coc_px: np.ndarray) -> None:
    codes = renderer._tables.codes(np.zeros_like(values), values, coc_px, DISC)
    kinds = np.array([kind_of(int(code)) for code in np.unique(codes)])
    counts = np.unique(codes, return_counts=True)[1]
    print(
        f"      {len(kinds)} kernels; {100 * counts[kinds == DENSE].sum() / codes.size:.1f} % of the pixels on the fast track, "
        f"{100 * counts[kinds == WHOLE].sum() / codes.size:.1f} % as whole Laplacians"
    )


def reference_row(size: tuple[int, int]) -> None:
    """Against exact kernels of every pixel, on a quarter of the picture."""
    size = size[0] // 2, size[1] // 2
    values, coc_px = frame(size), hills_px(size, 40.0)
    kept: list[np.ndarray] = []
    exact_ms = took(lambda: kept.append(ScatterReference().sum_kernels(values, coc_px, DISC))).wall_ms
    renderer = LaplacianSpreadlets()
    took_ms = in_turns(lambda: renderer.sum_kernels(values, coc_px, DISC), repeats=REPEATS)[0].wall_ms
    found, exact = renderer.sum_kernels(values, coc_px, DISC)[..., :3], kept[0][..., :3]
    print(
        f"{size[1]} x {size[0]}, mean 40 px, against exact kernels ({exact_ms:.0f} ms): {exact_ms / took_ms:.0f} times as fast, "
        f"SSIM {ssim(found, exact):.4f}, {psnr(found, exact):.1f} dB"
    )


def main() -> None:
    size = (int(sys.argv[1]), int(sys.argv[2])) if len(sys.argv) > 2 else SIZE
    print(f"all cores ({os.cpu_count()}), medians of {REPEATS}; load before the run {os.getloadavg()[0]:.1f}")
    kernel = DISC.rasterize(40.0).kernel
    points = len(whole_laplacian(kernel).points)
    print(f"disc of 40 px: {np.count_nonzero(kernel)} taps, {points} of its Laplacian, outline {outline_px(kernel):.0f} px")
    integration_rows()
    sparsification_rows()
    spread_rows(size)
    reference_row(size)
    tell()


if __name__ == "__main__":
    main()
