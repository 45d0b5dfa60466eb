"""The page of `bench_pixel4`: its table, and crops at 100 % of what was photographed and predicted."""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mrbokeh.system.html_page import inline_figure, section, write_page
from tests.bench.pixel4_measures import in_even_light

if TYPE_CHECKING:
    from tests.bench.bench_pixel4 import Measured

CROP_PX = 240
_DIFFERENCE = 8.0
_STYLE = ".crops figure { max-width: none; } .crops img { max-width: none; }"
_PANELS = ("photograph", "no blur", "disc", "published", "ours", "network")
_COMPARED = ("published", "ours", "network")


def write_pixel4_page(path: Path, results: "Sequence[Measured]", told: Sequence[str]) -> None:
    blocks = [f"<pre>{html.escape(chr(10).join(told))}</pre>"]
    for result in results:
        compared = ", ".join(name for name in _COMPARED if name in result.pictures)
        shown = ", ".join(name for name in _PANELS if name in result.pictures or name == "photograph")
        caption = f"{shown}, photograph less {compared} (times {_DIFFERENCE:g}, grey is none)"
        figure = inline_figure(cv2.imencode(".png", crops(result))[1].tobytes(), "png", caption)
        blocks.append(
            section(f"Scene {result.scene.name}", "Where the published kernels do worst, and in the middle of what is judged.", [figure])
        )
    write_page(path, "A real lens: Pixel 4", blocks, _STYLE)


def crops(result: "Measured") -> np.ndarray:
    """Two rows of panels at 100 %, encoded for display."""
    scene = result.scene
    shown = {name: in_even_light(picture, scene) for name, picture in result.pictures.items()}
    shown["photograph"] = scene.photograph
    error = np.where(scene.judged, (shown["published"] - scene.photograph) ** 2, 0.0)
    places = [_place(error), _place(scene.judged.astype(np.float64))]
    rows = []
    for top, left in places:
        window = np.s_[top : top + CROP_PX, left : left + CROP_PX]
        panels = [255.0 * np.clip(shown[name][window], 0.0, 1.0) ** (1 / 2.2) for name in _PANELS if name in shown]
        panels += [127.5 * (1.0 + _DIFFERENCE * (scene.photograph - shown[name])[window]) for name in _COMPARED if name in shown]
        rows.append(np.hstack([np.pad(np.clip(panel, 0, 255), 2, constant_values=255) for panel in panels]))
    return np.vstack(rows).astype(np.uint8)


def _place(weight: np.ndarray) -> tuple[int, int]:
    """The corner of the window that holds most of a weight."""
    sums = cv2.boxFilter(weight, -1, (CROP_PX, CROP_PX), normalize=False, borderType=cv2.BORDER_CONSTANT)
    half = CROP_PX // 2
    inside = sums[half : weight.shape[0] - half, half : weight.shape[1] - half]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left)
