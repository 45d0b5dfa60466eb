"""Sharpness and exposure of live view frames, and their display in a terminal."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8
from rich.console import Console
from rich.live import Live
from rich.table import Table

from capture.merging.focus_volume import focus_energy
from capture.tether.camera_driver import CameraDriver, Preview
from mrbokeh.images.color import luminance, srgb_to_linear
from mrbokeh.system.errors import InputError

HISTOGRAM_BINS = 32
_CLIPPED = 254
_BLACK = 1
_WINDOW_PX = 1.0
_BAR = 40
_FRAMES_PER_S = 8


@dataclass(frozen=True)
class Spot:
    """A square part of the picture: its centre in fractions of width and height, its side in fractions of the width."""

    x: float = 0.5
    y: float = 0.5
    side: float = 0.12

    def __post_init__(self) -> None:
        if not (0.0 <= self.x <= 1.0 and 0.0 <= self.y <= 1.0 and 0.0 < self.side <= 1.0):
            raise InputError(f"a spot needs x, y and a side from 0 to 1, got {self.x:g}, {self.y:g}, {self.side:g}")

    def cut(self, preview: Preview) -> UInt8[np.ndarray, "side_y side_x 3"]:
        """Return the pixels of the spot, at least 8 x 8."""
        height, width = preview.shape[:2]
        half = max(4, round(0.5 * self.side * width))
        column, row = (
            int(np.clip(round(share * size), half, max(half, size - half))) for share, size in ((self.x, width), (self.y, height))
        )
        return preview[max(0, row - half) : row + half, max(0, column - half) : column + half]


@dataclass(frozen=True)
class LiveReading:
    """Sharpness and exposure of one frame.

    sharpness: focus energy over mean light, independent of the exposure; no unit, comparable within a scene. clipped, black: fractions of
    the pixels with a channel at its end. histogram: fractions of the pixels by encoded brightness.
    """

    sharpness: float
    clipped: float
    black: float
    histogram: Float64[np.ndarray, " bins"]

    def bars(self) -> str:
        """Return the histogram as text, one character per bin."""
        top = float(self.histogram.max()) or 1.0
        return "".join(" ▁▂▃▄▅▆▇█"[int(np.ceil(8.0 * each / top))] for each in self.histogram)


def read_live(preview: Preview, spot: Spot | None = None) -> LiveReading:
    """Measure the sharpness of the spot, or of the whole frame, and the exposure of the frame."""
    brightest, mean = preview.max(axis=2), preview.mean(axis=2)
    counts = np.histogram(mean, HISTOGRAM_BINS, (0.0, 256.0))[0]
    return LiveReading(
        sharpness(preview if spot is None else spot.cut(preview)),
        float(np.mean(brightest >= _CLIPPED)),
        float(np.mean(brightest <= _BLACK)),
        counts / mean.size,
    )


def sharpness(preview: Preview) -> float:
    """Return the mean energy of fine detail over mean light. The energy of the square root of light is proportional to light."""
    light = srgb_to_linear(np.ascontiguousarray(preview).astype(np.float32) / np.float32(255.0)).astype(np.float32)
    return float(focus_energy(light, _WINDOW_PX).mean() / max(float(luminance(light).mean()), 1e-4))


def show_live(camera: CameraDriver, stopped: Callable[[], bool], console: Console, spot: Spot | None = None) -> LiveReading:
    """Read and show frames until `stopped`, at least one; return the last reading."""
    best = 0.0
    with Live(console=console, refresh_per_second=_FRAMES_PER_S, transient=True) as live:
        while True:
            reading = read_live(camera.preview(), spot)
            best = max(best, reading.sharpness)
            live.update(live_table(reading, best))
            if stopped():
                return reading


def live_table(reading: LiveReading, best: float) -> Table:
    """Return the table of one reading, with the sharpness also as a fraction of the best one."""
    share = reading.sharpness / best if best > 0.0 else 0.0
    table = Table(title="live view (Enter goes on)", show_header=False)
    table.add_row(
        "sharpness", f"{'█' * round(_BAR * share)}{'·' * (_BAR - round(_BAR * share))} {reading.sharpness:.3g}, {share:.0%} of the best"
    )
    table.add_row("clipped", f"{reading.clipped:.2%}" + (" too bright: shorten the exposure" if reading.clipped > 0.001 else ""))
    table.add_row("black", f"{reading.black:.2%}")
    table.add_row("brightness", f"│{reading.bars()}│")
    return table


def enter_pressed() -> Callable[[], bool]:
    """Return a function that tells whether Enter has been pressed since; the end of standard input counts as Enter."""
    pressed = threading.Event()

    def wait() -> None:
        try:
            input()
        except (EOFError, OSError):
            pass
        finally:
            pressed.set()

    threading.Thread(target=wait, daemon=True).start()
    return pressed.is_set
