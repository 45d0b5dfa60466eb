"""A real lens: photographs of a Pixel 4 predicted from their all-in-focus truth: `python -m tests.bench.bench_pixel4 DATA [--out PAGE]`.

DATA is the folder of the set (`DP_data_pixel_4`, `gt_all_in_focus_im`, `gt_defocus_map`, `calibration`, see `pixel4_set`). Each scene's
truth is registered to its photograph (`lens_measuring.fitting.blur_pairs`: one affine map a scene, found through a disc, the same for
all that are compared), blurred by our renderer through a Gaussian, a disc, the published kernels and the kernels that `mrbokeh lens fit`
finds in the other scenes, and compared with the photograph: PSNR of linear light, 1 being what 0.1 % of the photograph's pixels exceed.

Gain and black are fitted for each picture. The truths of some scenes were taken in other light (shiny boxes mirror something else): the
second figure of each pair lets the gain change slowly over the frame (a quadratic, five numbers more), and "in even light" the light of a
prediction is made that of the photograph over windows three times as wide as the largest kernel. "rims" judges what lies between surfaces
as well, by published kernels. "exact" is the disc through the renderer that sums every pixel's (`scatter`). "noise" is the photograph's
own, by its second differences where it is blurred by 15 px or more.

With --networks RUNS a network is among them: our gated form with kernels that change over the frame, trained by `mrbokeh train fit` on the
other scenes at several scales (each shows kernels of further diameters), in RUNS/SCENE; one that is there is taken as it is.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean

import cv2
import numpy as np

from mrbokeh.images.layer import opaque
from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair, match
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import field_positions
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import read_bank
from mrbokeh.renderers.scatter_reference import scatter
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from tests.bench.machine import machine_line, memory_line
from tests.bench.pixel4_measures import decibels, in_even_light, in_even_light_db, looks, noise_db
from tests.bench.pixel4_page import write_pixel4_page
from tests.bench.pixel4_set import COLUMNS, KERNEL_PX, ROWS, SIZE, Scene, bank_of_kernels, centred, published_kernels, read_scene, scenes
from tests.bench.process_cost import mrbokeh
from tests.support.blur_pair_files import write_blur_pair

BAR_DB, FITTED_BAR_DB, CORRELATION_BAR = 35.0, 0.5, 0.97
METHODS = ("no blur", "Gaussian", "disc", "exact", "published", "ours", "network")
SCALES = (1.0, 0.8, 0.64, 0.5)
NETWORK = (
    *("--preset", "demo", "--threads", "1"),
    *(each for name in ("signed_coc=false", "field_position=true", "field_bases=4") for each in ("--set", f"network.{name}")),
    *(each for name in ("sensor_white=none", "ema_decay=0.99", "learning_rate=0.01", "test_fraction=0") for each in ("--set", name)),
)
FIT = ("--regions", f"{COLUMNS // 2}x{ROWS // 2}", "--diameters", f"{KERNEL_PX:g}", "--smoothness", "0.3")
_GAUGE = Lens(focal_length_mm=50.0, f_number=1.8, focus_distance_m=0.5)  # any lens: depths are those at which it has the map's diameters


@dataclass(frozen=True)
class Measured:
    """pictures: of each method, as linear as the photograph. decibels: by gain and black, and by slowly changing gain."""

    scene: Scene
    pictures: dict[str, np.ndarray]
    decibels: dict[str, tuple[float, float]]
    even_light_db: dict[str, float]
    looks: dict[str, tuple[float, float]]
    rims_db: float
    noise_db: float
    correlation: float
    render_s: float
    fit_s: float


def shape_kernels() -> dict[str, np.ndarray]:
    """A disc and the Gaussian with as wide a spread, drawn as the published kernels are."""
    off = np.arange(-30, 31)
    apart = np.hypot(*np.meshgrid(off, off))
    disc, gaussian = np.clip(0.5 * KERNEL_PX + 0.5 - apart, 0.0, 1.0), np.exp(-0.5 * (apart / (0.25 * KERNEL_PX)) ** 2)
    return {name: (kernel / kernel.sum())[None] for name, kernel in (("disc", disc), ("Gaussian", gaussian))}


def rendered(sharp: np.ndarray, coc_px: np.ndarray, bank: PsfBank) -> np.ndarray:
    dioptres = 1.0 / _GAUGE.focus_distance_m - coc_px.astype(np.float64) / _GAUGE.coc_px_per_dioptre(coc_px.shape[1])
    layer = opaque(np.repeat(sharp[..., None], 3, axis=2), (1.0 / dioptres).astype(np.float32))
    return LaplacianSpreadlets(bank=bank).render([layer], _GAUGE).rgb[..., 1]


def registered(scene: Scene) -> Scene:
    """The scene with its truths as they lie under the photograph."""
    rgb = [np.repeat(each[..., None], 3, axis=2) for each in (scene.sharp, scene.photograph)]
    found = match(rgb[0], scene.coc_px, rgb[1], scene.judged)
    known = found.registered(scene.known.astype(np.uint8), nearest=True) > 0
    return replace(scene, sharp=found.registered(scene.sharp), coc_px=found.registered(scene.coc_px, nearest=True), known=known)


def pair_of(scene: Scene, folder: Path) -> BlurPair:
    """The scene as `mrbokeh lens fit` takes it, as it lies, unknown diameters as such."""
    sharp, blurred = (np.repeat(each[..., None], 3, axis=2) for each in (scene.sharp, scene.photograph))
    return BlurPair(folder, sharp, blurred, np.where(scene.known, scene.coc_px, np.float32(np.nan)))


def fitted(pairs: Sequence[Path], out: Path) -> tuple[PsfBank, float]:
    """The bank that the command makes of these pairs, and its CPU seconds."""
    cpu_s, _ = mrbokeh("lens", "fit", *pairs, "--out", out, *FIT)
    return read_bank(out), cpu_s


def shrunken(pair: BlurPair, scale: float, folder: Path) -> BlurPair:
    """The pair at another scale: an average over the pixels that become one, diameters as much smaller."""
    size = tuple(round(each * scale) for each in pair.size)
    sharp, blurred = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (pair.sharp, pair.blurred))
    coc_px = cv2.resize(pair.coc_px, size, interpolation=cv2.INTER_NEAREST) * np.float32(scale)
    return BlurPair(folder, sharp, blurred, coc_px)


def network_picture(scene: Scene, others: Sequence[Path], run: Path, minutes: float) -> np.ndarray:
    """What the network of a run makes of a scene; it is trained on the others first if there is none."""
    import torch

    from training.fitting.run_folder import NETWORK_NAME, load_run

    if not (run / NETWORK_NAME).is_file():
        mrbokeh("train", "fit", *others, "--out", run, "--minutes", minutes, *NETWORK)
    rgb, coc_px = np.repeat(scene.sharp[None], 3, axis=0), scene.coc_px[None]
    place = np.moveaxis(field_positions(SIZE, SIZE), 2, 0)
    with torch.inference_mode():
        return load_run(run)[0](*(torch.from_numpy(np.ascontiguousarray(each))[None] for each in (rgb, coc_px, place)))[0, 1].numpy()


def correlation(bank: PsfBank, published: np.ndarray) -> float:
    """The mean over the frame of the correlation of a bank's kernels with the published ones, each centred."""
    half = np.array(SIZE[::-1]) / np.hypot(*SIZE)
    found = []
    for row, column in np.ndindex(ROWS, COLUMNS):
        x, y = half * ((2.0 * np.array([column, row]) + 1.0) / (COLUMNS, ROWS) - 1.0)
        where = {"diameter_px": KERNEL_PX, "field_x": x, "field_y": y}
        kernel = bank.kernel_at(np.array([where[axis.name] for axis in bank.axes]))[..., bank.channels // 2].astype(np.float64)
        border = (len(published[0]) - len(kernel)) // 2
        found.append(np.corrcoef(centred(np.pad(kernel, border)).ravel(), published[row * COLUMNS + column].ravel())[0, 1])
    return fmean(map(float, found))


def exact(scene: Scene) -> np.ndarray:
    """The scene through a disc, every pixel's summed."""
    light = scatter(np.stack([scene.sharp, np.ones_like(scene.sharp)], axis=-1).astype(np.float64), scene.coc_px, Aperture.disc())
    return light[..., 0] / np.maximum(light[..., 1], 1e-6)


def measure(scene: Scene, banks: dict[str, PsfBank], fit_s: float, published: np.ndarray, network: np.ndarray | None) -> Measured:
    started_s = time.process_time()
    pictures = {"no blur": scene.sharp} | {method: rendered(scene.sharp, scene.coc_px, bank) for method, bank in banks.items()}
    render_s = (time.process_time() - started_s) / max(1, len(banks))
    pictures |= {"exact": exact(scene)} | ({} if network is None else {"network": network})
    lit = {method: in_even_light(picture, scene) for method, picture in pictures.items()}
    figures = {method: decibels(picture, scene) for method, picture in pictures.items()}
    like = correlation(banks["ours"], published) if "ours" in banks else float("nan")
    return Measured(
        scene=scene,
        pictures=pictures,
        decibels=figures,
        even_light_db={method: in_even_light_db(picture, scene) for method, picture in lit.items()},
        looks={method: looks(picture, scene) for method, picture in lit.items()},
        rims_db=decibels(pictures["published"], scene, scene.rims)[0],
        noise_db=noise_db(scene),
        correlation=like,
        render_s=render_s,
        fit_s=fit_s,
    )


def lines(results: Sequence[Measured]) -> list[str]:
    methods = [method for method in METHODS if method in results[0].pictures]
    columns = " ".join(f"{method:>13}" for method in methods)
    out = [f"{'scene':>6} {'judged':>6} {columns}  {'rims':>6}  {'noise':>6}  correlation  render_s  fit_s (CPU)"]
    out += [_line(each) for each in results]
    means = {method: np.mean([each.decibels[method] for each in results], axis=0) for method in methods}
    rims_db = fmean(each.rims_db for each in results)
    out.append(f"{'mean':>6} {'':>6} " + " ".join("{:6.2f} {:6.2f}".format(*means[method]) for method in methods) + f"  {rims_db:6.2f}")
    out.append("in even light: " + ", ".join(f"{method} {fmean(each.even_light_db[method] for each in results):.2f}" for method in methods))
    for place, name in enumerate(("SSIM", "FLIP")):
        out.append(f"{name}: " + ", ".join(f"{method} {fmean(each.looks[method][place] for each in results):.4f}" for method in methods))
    worse = max(each.decibels["published"][0] - each.decibels["ours"][0] for each in results)
    like = fmean(each.correlation for each in results)
    held = {"published": means["published"][0] >= BAR_DB, "ours": worse <= FITTED_BAR_DB, "correlation": like >= CORRELATION_BAR}
    found = f"published: {means['published'][0]:.2f} dB (wanted {BAR_DB:g}); ours at most {worse:.2f} dB below (wanted {FITTED_BAR_DB:g})"
    verdict = ", ".join(f"{name} {'held' if is_held else 'MISSED'}" for name, is_held in held.items())
    return [*out, found, f"correlation: {like:.4f} (wanted {CORRELATION_BAR}); {verdict}"]


def _line(each: Measured) -> str:
    methods = [method for method in METHODS if method in each.pictures]
    row = " ".join("{:6.2f} {:6.2f}".format(*each.decibels[method]) for method in methods)
    told = f"{each.rims_db:6.2f}  {each.noise_db:6.1f}  {each.correlation:11.4f}  {each.render_s:8.1f}  {each.fit_s:6.1f}"
    lit = ", ".join(f"{method} {each.even_light_db[method]:.2f}" for method in methods)
    return f"{each.scene.name:>6} {each.scene.judged.mean():6.0%} {row}  {told}   in even light: {lit}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, help="an HTML page with crops")
    parser.add_argument("--scenes", nargs="*", help="names, such as 003 (all)")
    parser.add_argument("--networks", type=Path, help="runs of networks, one a scene, trained here if they are not there")
    parser.add_argument("--minutes", type=float, default=5.0, help="budget of each network (5)")
    given = parser.parse_args()
    names, published = scenes(given.data), published_kernels(given.data)
    plain = {method: bank_of_kernels(kernels) for method, kernels in shape_kernels().items()} | {"published": bank_of_kernels(published)}
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for name, scale in product(names, SCALES if given.networks else SCALES[:1]):
            pair = pair_of(read_scene(given.data, name), Path(folder) / f"{SCALES[0]:g}" / name)
            write_blur_pair(pair if scale == SCALES[0] else shrunken(pair, scale, Path(folder) / f"{scale:g}" / name))
        for name in given.scenes or names:
            others = [each for each in names if each != name]
            bank, fit_s = fitted([Path(folder) / f"{SCALES[0]:g}" / each for each in others], Path(folder) / f"bank_{name}")
            scene, network = registered(read_scene(given.data, name)), None
            if given.networks:
                pairs = [Path(folder) / f"{scale:g}" / each for scale, each in product(SCALES, others)]
                network = network_picture(scene, pairs, given.networks / name, given.minutes)
            results.append(measure(scene, plain | {"ours": bank}, fit_s, published, network))
            print(lines(results)[len(results)], flush=True)
    told = [*lines(results), memory_line(), machine_line()]
    print("\n".join(told))
    if given.out:
        write_pixel4_page(given.out, results, told)


if __name__ == "__main__":
    main()
