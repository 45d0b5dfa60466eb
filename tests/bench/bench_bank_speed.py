"""A measured bank through polygons against a network of full size: `python -m tests.bench.bench_bank_speed [--only bank] [--bank FOLDER]`.

A heart-shaped opening photographed at 640x360 px (through its own polygons, 1 % noise), blurred by up to 49 px on both sides of the focus;
`fit_lens` measures it. The bank, the opening itself and the plain export of the published network with N = 25 then take the same picture
in turns, the lowest of some rounds: once with a slanted plane of all circles of confusion, once with those in no order, which is the worst
there is for a renderer with slices. A network takes the same time for both. Prints also how near bank and opening are.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrbokeh.images.image_io import write_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.lens_measuring.fitting.fit_results import bank_of
from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings, fit_lens
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import read_bank, write_bank
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from tests.bench.machine import in_turns, tell

HEIGHT_PX, WIDTH_PX, LARGEST_PX, BLOCKS = 360, 640, 49.0, 25
LENS = Lens(35.0, 1.0, 0.6, 23.5, aperture=Aperture.heart())
FOCI_M = (0.5, 0.54, 0.58, 0.62, 0.68, 0.75)
WALL_PX, VIEWS = 38.0, 3
NOISE, PIXELS = 0.01, 40_000


def depth_m(coc_px: np.ndarray, lens: Lens) -> np.ndarray:
    return (1.0 / (1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(WIDTH_PX))).astype(np.float32)


def ramp_px(largest_px: float) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(np.linspace(-largest_px, largest_px, WIDTH_PX, dtype=np.float32), (HEIGHT_PX, WIDTH_PX)))


def texture(rng: np.random.Generator) -> np.ndarray:
    coarse = np.kron(rng.random((HEIGHT_PX // 8, WIDTH_PX // 8, 3)), np.ones((8, 8, 1)))
    return (0.05 + 0.5 * coarse + 0.15 * rng.random((HEIGHT_PX, WIDTH_PX, 3))).astype(np.float32)


def stack(folder: Path, seed: int) -> FocalStack:
    """A slanted, textured wall at six focus distances."""
    folder.mkdir()
    rng, depth = np.random.default_rng(seed), depth_m(ramp_px(WALL_PX), LENS)
    rgb, slices = texture(rng), tuple(Slice(f"{i}.exr", each) for i, each in enumerate(FOCI_M))
    made = FocalStack(folder, slices, replace(LENS, aperture=Aperture.disc()), None, 0, True, True)
    for index in range(len(made)):
        sharp = [opaque(rgb, depth)]
        blurred = PolygonDifferences().render(sharp, replace(made.lens_of(index), aperture=LENS.aperture)).rgb
        write_image(folder / f"{index}.exr", blurred * (1.0 + NOISE * rng.standard_normal(blurred.shape)).astype(np.float32), half=False)
    write_merged(folder, rgb, np.zeros(depth.shape, np.float32), np.ones(depth.shape, np.float32), depth)
    write_focal_stack(made)
    return made


def measured(kept: Path | None) -> PsfBank:
    """From the folder where it is kept, if it is there already."""
    if kept is not None and kept.is_dir():
        return read_bank(kept)
    with tempfile.TemporaryDirectory() as folder:
        stacks = [stack(Path(folder) / f"view_{seed}", seed) for seed in range(VIEWS)]
        fit = fit_lens(stacks, [], FitSettings(regions=(1, 1), pixels=PIXELS))
    print(f"pupil of {fit.grid.side} cells a side, circles up to {fit.largest_px:.0f} px, shared: {fit.sharing}")
    bank = bank_of(fit)
    if kept is not None:
        write_bank(kept, bank, overwrite=False)
    return bank


def network(folder: Path) -> Callable[[np.ndarray, np.ndarray], object]:
    """The published form, one tile, untrained: its weights do not change its time."""
    from mrbokeh.renderers.onnx_network import OnnxNetwork
    from training.export.onnx_export import export_network
    from training.fitting.run_folder import RunFacts, build_network
    from training.fitting.settings import TrainSettings
    from training.networks.network_settings import NetworkSettings

    settings = NetworkSettings(tile_px=0, overlap_px=0, blocks=BLOCKS)
    facts = RunFacts(Lens(35.0, 2.8, 1.0, 23.5), WIDTH_PX, HEIGHT_PX, 51.0, 20.0, (), (), None)
    export_network(build_network(TrainSettings(network=settings), facts).eval(), settings, facts, folder / "plain.onnx")
    return OnnxNetwork(folder / "plain.onnx").blur


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=["bank"], help="leave the network out")
    parser.add_argument("--bank", type=Path, help="where the measured bank is kept for the next run")
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    bank, rng = measured(asked.bank), np.random.default_rng(1)
    rgb = texture(rng)
    through = PolygonDifferences(bank=bank), PolygonDifferences()
    no_order = LARGEST_PX * rng.uniform(-1.0, 1.0, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    print("| picture | renderer | ms | processor ms | network over it |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        blur = None if asked.only else network(Path(folder))
        for picture, coc_px in (("slanted plane", ramp_px(LARGEST_PX)), ("every circle in no order", no_order)):
            layers: list[Layer] = [opaque(rgb, depth_m(coc_px, LENS))]
            runs: dict[str, Callable[[], object]] = {
                name: lambda layers=layers, each=each: each.render(layers, LENS)  # type: ignore[misc]
                for name, each in zip(("measured bank, polygon", "its opening, polygon"), through, strict=True)
            }
            if blur is not None:
                runs["plain network, N = 25"] = lambda coc_px=coc_px: blur(rgb, coc_px)  # type: ignore[misc]
            times = dict(zip(runs, in_turns(*runs.values(), repeats=asked.rounds, of=min), strict=True))
            whole_ms = times["plain network, N = 25"].wall_ms if blur is not None else np.nan
            for name, (wall_ms, cpu_ms) in times.items():
                print(f"| {picture} | {name} | {wall_ms:.0f} | {cpu_ms:.0f} | {whole_ms / wall_ms:.1f} |", flush=True)
            seen = [each.render(layers, LENS).rgb for each in through]
            near = psnr(seen[0], seen[1], 1.0)
            print(f"{picture}: bank and opening agree to {near:.1f} dB")
    tell()


if __name__ == "__main__":
    main()
