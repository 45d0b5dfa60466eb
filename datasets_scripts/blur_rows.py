"""Rows of Tables 2 and 3 of Leimkuehler et al. 2018: how long each method takes, and how near it comes to the reference."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from datasets_scripts.blur_banks import SPARSIFICATIONS, bank_of
from datasets_scripts.blur_methods import BlurMethods
from datasets_scripts.blur_scenes import BlurScene
from datasets_scripts.global_layers import composited, read_global_layers, read_moving_layers
from datasets_scripts.samples_plan import SamplesPlan
from mrbokeh.images.image_io import write_image
from mrbokeh.images.image_metrics import psnr, ssim
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED

_RIM_PX = 2
_TRACED = ("simple", "combined")
_GAMMA, _STRENGTHS = 2.2, (4.0, 8.0, 16.0, 32.0, 64.0)

Picture = Float32[np.ndarray, "height width 3"]


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


SCENES = ("whirl", "coins", "rain", "gear")
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
