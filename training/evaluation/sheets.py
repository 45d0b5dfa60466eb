"""Sheets of pictures of an evaluation: whole slices, and crops where the network is worst and where the lights are."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import SheetRow, write_contact_sheet
from mrbokeh.images.image_metrics import psnr
from training.evaluation.methods import NO_BLUR, Method
from training.evaluation.places import light_discs
from training.evaluation.unseen_slice import UnseenSlice

MOST_ROWS = 12
CROP_PX = 96
CELL_PX = 192

Image = Float32[np.ndarray, "height width 3"]


class Sheets:
    """Rows of at most MOST_ROWS slices, spread over all, and their crops; filled slice by slice, so that few pictures are kept."""

    def __init__(self, methods: Sequence[Method], slices: int) -> None:
        self._kinds = {each.name: each.kind for each in methods}
        self._chosen = set(np.unique(np.linspace(0, slices - 1, min(MOST_ROWS, slices)).round().astype(int)).tolist())
        self._rows: list[SheetRow] = []
        self._crops: list[SheetRow] = []

    def note(self, index: int, seen: UnseenSlice, results: Mapping[str, Image]) -> None:
        if index not in self._chosen:
            return
        shown = self._shown(seen, results)
        self._rows.append(SheetRow(seen.label, shown))
        for what, window in telling_windows(seen, next(iter(results.values()))).items():
            self._crops.append(
                SheetRow(f"{seen.label}, {what}", {caption: enlarged(picture[window]) for caption, picture in shown.items()})
            )

    def write(self, out: Path) -> None:
        """evaluation.png and evaluation_crops.png."""
        write_contact_sheet(out / "evaluation.png", self._rows)
        write_contact_sheet(out / "evaluation_crops.png", self._crops)

    def _shown(self, seen: UnseenSlice, results: Mapping[str, Image]) -> dict[str, Image]:
        """Input, truth, the networks, the best of every other kind, and what the first network has wrong."""
        shown = {"input": seen.pair.all_in_focus, "truth": seen.pair.target}
        networks = [name for name in results if self._kinds[name] == "network"]
        rivals = [self._best(seen, results, kind) for kind in ("Gaussian", "renderer")]
        for name in (*networks, *(each for each in rivals if each), *([NO_BLUR] if NO_BLUR in results else [])):
            shown[f"{name} {psnr(results[name], seen.pair.target, mask=seen.counted):.1f} dB"] = results[name]
        if networks:
            shown[f"{networks[0]} - truth, x4"] = _difference(results[networks[0]], seen.pair.target)
        return shown

    def _best(self, seen: UnseenSlice, results: Mapping[str, Image], kind: str) -> str | None:
        names = [name for name in results if self._kinds[name] == kind]
        return max(names, key=lambda name: psnr(results[name], seen.pair.target, mask=seen.counted), default=None)


def telling_windows(seen: UnseenSlice, result: Image) -> dict[str, tuple[slice, slice]]:
    """Squares around the largest error of a result and, where there are any, around the brightest disc of a light."""
    error = (np.abs(np.clip(result, 0, 1) - np.clip(seen.pair.target, 0, 1)).sum(axis=2)) * seen.pair.weight
    windows = {"largest error": _window(error)}
    discs = light_discs(seen)
    return windows | ({"lights": _window(seen.pair.target.sum(axis=2) * discs)} if discs.any() else {})


def _window(interest: Float32[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """The square whose neighbourhood has most of it."""
    from scipy.ndimage import uniform_filter

    side = min(CROP_PX, *interest.shape)
    peak = np.unravel_index(int(uniform_filter(interest, max(1, side // 4)).argmax()), interest.shape)
    starts = [int(np.clip(at - side // 2, 0, length - side)) for at, length in zip(peak, interest.shape, strict=True)]
    return slice(starts[0], starts[0] + side), slice(starts[1], starts[1] + side)


def enlarged(crop: Image) -> Float32[np.ndarray, "enlarged_height enlarged_width 3"]:
    """Whole pixels, so that one sees them."""
    times = max(1, round(CELL_PX / crop.shape[1]))
    return crop.repeat(times, axis=0).repeat(times, axis=1)


def _difference(result: Image, truth: Image) -> Image:
    return (0.5 + 4.0 * (np.clip(result, 0, 1) - np.clip(truth, 0, 1))).astype(np.float32)
