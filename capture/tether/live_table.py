"""The live view in a terminal: sharpness against the best so far, clipped shares and a histogram, renewed frame by frame."""

import threading
from collections.abc import Callable

from rich.console import Console
from rich.live import Live
from rich.table import Table

from capture.tether.camera_driver import CameraDriver
from capture.tether.live_reading import LiveReading, Spot, read_live

_BAR = 40
_FRAMES_PER_S = 8


def show_live(camera: CameraDriver, stopped: Callable[[], bool], console: Console, spot: Spot | None = None) -> LiveReading:
    """Read and show frames until `stopped`; at least one. Ends with the last reading."""
    best = 0.0
    with Live(console=console, refresh_per_second=_FRAMES_PER_S, transient=True) as live:
        while True:
            reading = read_live(camera.preview(), spot)
            best = max(best, reading.sharpness)
            live.update(live_table(reading, best))
            if stopped():
                return reading


def live_table(reading: LiveReading, best: float) -> Table:
    """One reading; the sharpness also as a share of the best one."""
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
    """Whether somebody has pressed Enter since; standard input that ends counts as Enter."""
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
