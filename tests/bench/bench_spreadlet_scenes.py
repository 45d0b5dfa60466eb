"""Tables 2 and 3 of Leimkuehler et al. 2018 on our own scenes: spreadlets, dense splatting, filtering and the reference.

    python -m tests.bench.bench_spreadlet_scenes OUT [--width 512 --height 320 --reference-spp 1024 --rows whirl_combined,...]

OUT/rows/ROW.json holds what was measured of each row, OUT/pictures the pictures, OUT/tables.md all rows that are there.
Finished rows are kept, so an interrupted run goes on where it stopped; banks and scenes are made in
OUT and kept as well. Times are medians of the methods in turns, kernels computed before.
"""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from jaxtyping import Float32

from datasets_scripts.render_samples import SamplesPlan, SamplesSet, render_samples
from datasets_scripts.tracers.traced_scene import MovingScene
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.image_metrics import psnr, ssim
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED
from mrbokeh.stacks.light_field_samples_file import read_samples
from mrbokeh.system.atomic_files import atomic_path, read_json, write_json
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError
from tests.bench.blur_methods import SPARSIFICATIONS, BlurMethods, bank_of, composited, read_global_layers, read_moving_layers

_TIMED_SHARE = 16
_RIM_PX = 2
_TRACED = ("simple", "combined")
_GAMMA, _STRENGTHS = 2.2, (4.0, 8.0, 16.0, 32.0, 64.0)
Picture = Float32[np.ndarray, "height width 3"]
SCENES = ("whirl", "coins", "rain", "gear")
_SPP = 4
_NOT_THERE = "-"


@dataclass(frozen=True)
class BlurScene:
    """A scene in OUT/scenes; what is missing is rendered."""

    out: Path
    plan: SamplesPlan

    @cached_property
    def folder(self) -> Path:
        render_samples(self.out / "scenes", self.plan)
        return SamplesSet(self.out / "scenes", self.plan).folder

    @property
    def lens(self) -> Lens:
        return self.plan.lens

    def truth(self, *, moves: bool) -> Float32[np.ndarray, "height width 3"]:
        """The path-traced picture; moves: False with everything at rest where it is at half time."""
        if moves:
            return read_image(self.folder / "reference.exr")
        path = self.folder / "reference_at_rest.exr"
        if not path.is_file():
            write_image(path, self.plan.tracer(self._scene(moves=False)).mean(self.plan.reference_spp))
        return read_image(path)

    def truth_seconds(self, *, moves: bool) -> float:
        """How long the path tracer takes for it; measured on a sixteenth of the rays."""
        rays = max(1, self.plan.reference_spp // _TIMED_SHARE)
        started_s = time.perf_counter()
        self.plan.tracer(self._scene(moves=moves)).mean(rays)
        return (time.perf_counter() - started_s) * self.plan.reference_spp / rays

    def samples(self, per_pixel: int) -> LightFieldSamples:
        """The first samples of every pixel."""
        every = read_samples(self.folder / "samples.npz")
        kept = np.arange(every.count) % round(every.per_pixel) < per_pixel
        names = ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")
        return LightFieldSamples(every.width_px, every.height_px, *(getattr(every, name)[kept] for name in names))

    def _scene(self, *, moves: bool) -> MovingScene:
        scene = SamplesSet(self.out / "scenes", self.plan).scene
        return scene if moves else replace(scene, movers=tuple(replace(each, velocity_m=(0.0, 0.0, 0.0)) for each in scene.movers))


@dataclass(frozen=True)
class Row:
    """A scene seen through a PSF model.

    way: "layers", two global layers (Table 2); "slices", the same by the renderer's own layering; "samples", reconstructed from one
    sample a pixel (Table 3).
    """

    scene: str
    model: str
    way: str = "layers"

    @property
    def name(self) -> str:
        return f"{self.scene}_{self.model}" + ("" if self.way == "layers" else f"_{self.way}")


ROWS: tuple[Row, ...] = (
    *(Row(scene, "combined") for scene in SCENES),
    Row("rain", "physical"),
    *(Row(scene, "simple") for scene in SCENES),
    Row("whirl", "stylized"),
    Row("coins", "volume"),
    *(Row(scene, "combined", "slices") for scene in SCENES),
    *(Row(scene, "combined", "samples") for scene in SCENES),
)


class Methods:
    """The methods of each model, which share what they have computed among rows. out: folder of the banks."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._made: dict[tuple[str, int, bool], BlurMethods] = {}

    def of(self, model: str, plan: SamplesPlan, *, finer: bool = False) -> BlurMethods:
        key = model, plan.width_px, finer
        if key not in self._made:
            folder = self._out / "banks" / (f"{model}_{plan.width_px}" + ("_finer" if finer else ""))
            bank = bank_of(model, folder, plan.lens, plan.width_px, finer=finer)
            self._made[key] = BlurMethods(bank, SPARSIFICATIONS.get(model, UNRELAXED))
        return self._made[key]


class Measurement:
    """One row: pictures by each method, their times in turns, their likeness to the reference."""

    def __init__(self, row: Row, out: Path, plan: SamplesPlan, methods: Methods) -> None:
        self.row, self._out, self._plan, self._all = row, out, plan, methods
        self._scene = BlurScene(out, plan)
        self._moves = row.model == "combined"
        self._methods = methods.of(row.model, plan)
        self._bank = self._methods.bank
        self.runs: Mapping[str, Callable[[], Picture]] = self._runs_of()[row.way]()

    def prepare(self) -> Mapping[str, Picture]:
        """The pictures; kernels that are met for the first time are computed and kept."""
        return {name: run() for name, run in self.runs.items()}

    def times_ms(self, repeats: int) -> dict[str, float]:
        """Medians, the methods in turns; after `prepare`."""
        took = [{name: _milliseconds(run) for name, run in self.runs.items()} for _ in range(repeats)]
        return {name: statistics.median(each[name] for each in took) for name in self.runs}

    def likeness(self, pictures: Mapping[str, Picture]) -> dict[str, Any]:
        """SSIM and PSNR to the reference in clipped linear light, and of spreadlets to splatting the same kernels densely."""
        truth, facts = self._reference()
        pairs = {name: (np.clip(picture, 0.0, 1.0), np.clip(truth, 0.0, 1.0)) for name, picture in pictures.items()}
        if self.row.way == "samples":
            pairs["denoised"] = (_denoised(self._scene.samples(1).raw_picture(), truth), np.clip(truth, 0.0, 1.0))
        found = {name: {"ssim": ssim(*pair), "psnr_db": psnr(*pair)} for name, pair in pairs.items()}
        same = ssim(pairs["ours"][0], pairs["splat"][0])
        self._keep({**pictures, "reference": truth})
        return {"methods": found, "ours_to_splat_ssim": same, **facts, **self._sparsity()}

    def _runs_of(self) -> Mapping[str, Callable[[], Mapping[str, Callable[[], Picture]]]]:
        return {"layers": self._syntheses, "slices": self._renderings, "samples": self._reconstructions}

    def _syntheses(self) -> dict[str, Callable[[], Picture]]:
        margin_px = self._bank.radius_px + _RIM_PX
        layers = read_global_layers(self._scene.folder, self._plan.lens, margin_px, moves=self._moves)
        by_name = self._methods.by_name()
        names = [name for name in by_name if name != "filter" or self.row.model != "physical"]  # as in the paper: it would not fit
        return {name: partial(composited, layers, by_name[name], margin_px) for name in names}

    def _renderings(self) -> Mapping[str, Callable[[], Picture]]:
        return self._methods.renderings(read_moving_layers(self._scene.folder), self._plan.lens)

    def _reconstructions(self) -> Mapping[str, Callable[[], Picture]]:
        return self._methods.reconstructions(self._scene.samples(1), self._plan.lens)

    def _reference(self) -> tuple[Picture, dict[str, Any]]:
        """Path-traced where the model is that of the path tracer, else dense splatting of a finer bank."""
        if self.row.model in _TRACED:
            seconds = self._scene.truth_seconds(moves=self._moves)
            return self._scene.truth(moves=self._moves), {"reference": "path traced", "reference_s": seconds}
        finer = self._all.of(self.row.model, self._plan, finer=True)
        margin_px = finer.bank.radius_px + _RIM_PX
        layers = read_global_layers(self._scene.folder, self._plan.lens, margin_px, moves=False)
        return composited(layers, finer.splat, margin_px), {"reference": "finer bank, splatted", "reference_s": None}

    def _sparsity(self) -> dict[str, Any]:
        return {"cells": len(self._bank.kernels), "points_over_taps": self._methods.points_over_taps()}

    def _keep(self, pictures: Mapping[str, Picture]) -> None:
        for name, picture in pictures.items():
            write_image(self._out / "pictures" / f"{self.row.name}_{name}.exr", picture.astype(np.float32))


def _denoised(noisy: Picture, truth: Picture) -> Picture:
    """Non-local means, on gamma-encoded 8 bit, with the strength that suits the truth best (which nobody knows in earnest)."""
    encoded = np.round(255.0 * np.clip(noisy, 0.0, 1.0) ** (1.0 / _GAMMA)).astype(np.uint8)
    tried = [cv2.fastNlMeansDenoisingColored(encoded, None, strength, strength, 5, 15) for strength in _STRENGTHS]
    linear = [((each / 255.0) ** _GAMMA).astype(np.float32) for each in tried]
    return max(linear, key=lambda each: ssim(each, np.clip(truth, 0.0, 1.0)))


def _milliseconds(run: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - started_s)


def make_tables(out: Path, rows: Sequence[Row], width_px: int, height_px: int, reference_spp: int, repeats: int) -> int:
    """Measure the rows that are missing and write the tables of all that are there; returns how many were measured."""
    settings = {"width_px": width_px, "height_px": height_px, "reference_spp": reference_spp}
    waiting, methods = [row for row in rows if not _is_measured(out, row, settings)], Methods(out)
    with progress_bars() as bars:
        task = bars.add_task("rows", total=len(waiting))
        for row in waiting:
            plan = SamplesPlan(row.scene, 1, width_px, height_px, _SPP, reference_spp)
            measurement = Measurement(row, out, plan, methods)
            likeness = measurement.likeness(measurement.prepare())
            write_json(_path(out, row), {"settings": settings, "times_ms": measurement.times_ms(repeats), **likeness})
            bars.advance(task)
    there = [(row, read_json(_path(out, row), "a measured row")) for row in ROWS if _path(out, row).is_file()]
    with atomic_path(out / "tables.md") as temporary:
        temporary.write_text(as_markdown(there), encoding="utf-8")
    return len(waiting)


def as_markdown(measured: Sequence[tuple[Row, dict[str, Any]]]) -> str:
    """One table for each way."""
    ways = {
        "layers": ("Synthesis from two global layers", "filter", "FILTER"),
        "slices": ("Synthesis from the same layers by the renderer's own slices", "", "-"),
        "samples": ("Reconstruction from one sample a pixel", "denoised", "denoised"),
    }
    return "\n\n".join(
        f"{title}\n\n" + _table([pair for pair in measured if pair[0].way == way], other, head)
        for way, (title, other, head) in ways.items()
    )


def _table(measured: Sequence[tuple[Row, dict[str, Any]]], other: str, title: str) -> str:
    heads = ("scene", "model", "OURS", "SSIM", title, "SSIM", "SPLAT", "SSIM", "SPLAT / OURS", "points / taps", "REFERENCE")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(_cells(row, found, other)) + " |" for row, found in measured]
    return "\n".join(lines)


def _cells(row: Row, found: dict[str, Any], other: str) -> list[str]:
    times, methods = found["times_ms"], found["methods"]
    each = [
        text
        for name in ("ours", other, "splat")
        for text in (
            f"{times[name]:.0f} ms" if name in times else _NOT_THERE,
            f"{methods[name]['ssim']:.3f}" if name in methods else _NOT_THERE,
        )
    ]
    reference = found["reference"] if found["reference_s"] is None else f"{found['reference_s']:.0f} s"
    return [row.scene, row.model, *each, f"{times['splat'] / times['ours']:.1f}", f"{100 * found['points_over_taps']:.1f} %", reference]


def _is_measured(out: Path, row: Row, settings: dict[str, Any]) -> bool:
    if not _path(out, row).is_file():
        return False
    if read_json(_path(out, row), "a measured row")["settings"] != settings:
        raise InputError(f"{_path(out, row)} was measured with other settings: choose another folder, or remove it")
    return True


def _path(out: Path, row: Row) -> Path:
    return out / "rows" / f"{row.name}.json"


def _chosen(names: str) -> list[Row]:
    by_name = {row.name: row for row in ROWS}
    if unknown := [name for name in names.split(",") if name not in by_name]:
        raise InputError(f"expected rows out of {', '.join(by_name)}, got {', '.join(unknown)}")
    return [by_name[name] for name in names.split(",")]


def main(
    out: Annotated[Path, typer.Argument(help="Folder for scenes, banks, rows and tables.")],
    rows: Annotated[str, typer.Option(help="With commas between them; all unless given.")] = ",".join(row.name for row in ROWS),
    width: int = 512,
    height: int = 320,
    reference_spp: Annotated[int, typer.Option(help="Rays per pixel of the path-traced reference.")] = 1024,
    repeats: Annotated[int, typer.Option(help="How often each method is timed.")] = 3,
) -> None:
    """Measure the missing rows of both tables."""
    try:
        measured = make_tables(out, _chosen(rows), width, height, reference_spp, repeats)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out / 'tables.md'}: {measured} rows measured")


if __name__ == "__main__":
    typer.run(main)
