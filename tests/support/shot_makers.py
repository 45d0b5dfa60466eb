"""Small recipes and layers for tests of the engine, in a module that worker processes can import."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.shots.inputs import CameraSource, LayerSource, Moment
from mrbokeh.shots.shot import Picture, Rgba


@dataclass(frozen=True)
class Brighter:
    """Adds `amount` to every frame, more for later ones, so that a frame in the wrong place is seen.

    gate: a file without which no frame from number `held_from` on is made: all of them wait until it is there. killing: a file that,
    while it exists, costs the worker its life after it deleted it; pids: a folder in which every worker leaves its number.
    """

    amount: float = 0.1
    gate: Path | None = None
    held_from: int = 0
    killing: Path | None = None
    pids: Path | None = None
    as_layer: bool = False
    reads: tuple[Path, ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        return self.reads

    def build(self, threads: int) -> "Brightening":  # noqa: ARG002
        if self.pids is not None:
            (self.pids / str(os.getpid())).touch()
        return Brightening(self)


class Brightening:
    def __init__(self, recipe: Brighter) -> None:
        self._recipe = recipe

    def make(self, index: int, rgb: np.ndarray, time_s: float, alpha: np.ndarray | None = None) -> Picture:  # noqa: ARG002
        recipe = self._recipe
        if recipe.gate is not None and index >= recipe.held_from:
            wait_for(recipe.gate.exists)
        if recipe.killing is not None and recipe.killing.exists() and index % 7 == 3:
            recipe.killing.unlink()
            os.kill(os.getpid(), 9)
        result = (0.5 * rgb + np.float32(recipe.amount * (index % 5 + 1) / 5)).astype(np.float32)
        if recipe.as_layer:
            half = np.full(rgb.shape[:2], 0.5, np.float32)
            return Layer(result * half[..., None], half, np.full_like(half, 2.0))
        return result if alpha is None else Rgba(result * alpha[..., None], alpha)


def wait_for(reached: Callable[[], object], seconds: float = 60.0) -> None:
    """Look every 10 ms. Raises AssertionError where it takes too long."""
    deadline_s = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.01)


@dataclass(frozen=True)
class MovingDisc:
    """Description of a textured disc that wanders across the frame, step_px to the right a frame, at depths around depth_m."""

    radius_px: int = 240
    step_px: int = 3
    depth_m: float = 1.2

    @property
    def files(self) -> tuple[Path, ...]:
        return ()

    def opened(self, threads: int) -> LayerSource:  # noqa: ARG002
        return _Moving(self)


class _Moving:
    def __init__(self, described: MovingDisc) -> None:
        radius, rng = described.radius_px, np.random.default_rng(5)
        y, x = np.mgrid[-radius:radius, -radius:radius] + 0.5
        self._alpha = np.clip(radius - np.hypot(x, y), 0.0, 1.0).astype(np.float32)
        self._rgb = (self._alpha[..., None] * rng.random((2 * radius, 2 * radius, 3))).astype(np.float32)
        depth_m = described.depth_m * (1.0 + 0.1 * x / radius)
        self._depth_m = np.where(self._alpha > 0, depth_m, np.inf).astype(np.float32)
        self._described = described

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:  # noqa: ARG002
        width, height = moment.size_px
        size = 2 * self._described.radius_px
        left, top = moment.number * self._described.step_px % (width - size), (height - size) // 2
        box = np.s_[top : top + size, left : left + size]
        rgb, alpha = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
        depth_m = np.full((height, width), np.inf, np.float32)
        rgb[box], alpha[box], depth_m[box] = self._rgb, self._alpha, self._depth_m
        return [Layer(rgb, alpha, depth_m)]
