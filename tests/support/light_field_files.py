"""Files of light field samples as other renderers write them."""

from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.layering.light_field_samples import CHANNELS, UPWARDS, VERSION, LightFieldSamples


def write_samples(path: Path | str, samples: LightFieldSamples) -> None:
    """Write samples to .npz (any samples) or .exr (sorted by pixel)."""
    if Path(path).suffix == ".npz":
        arrays: dict[str, Any] = {name: getattr(samples, name) for name in CHANNELS}
        np.savez_compressed(path, version=VERSION, width_px=samples.width_px, height_px=samples.height_px, **arrays)
    else:
        write_exr(path, _parts(samples))


def _parts(samples: LightFieldSamples) -> list[ExrPart]:
    """Return parts, of which part k holds the k-th sample of each pixel, in the order in which they come."""
    x, y = samples.pixels()
    place = y * samples.width_px + x
    order = np.argsort(place, kind="stable")
    place = place[order]
    rank = np.arange(samples.count) - np.searchsorted(place, place)
    parts = []
    for k in range(int(rank.max()) + 1):
        here, where = order[rank == k], np.unravel_index(place[rank == k], (samples.height_px, samples.width_px))
        channels = {}
        for name, letters in CHANNELS.items():
            values = getattr(samples, name)[here].reshape(len(here), -1)
            for c, letter in enumerate(letters):
                channels[letter] = np.zeros((samples.height_px, samples.width_px), np.float32)
                channels[letter][where] = -values[:, c] if letter == UPWARDS else values[:, c]
        parts.append(ExrPart(channels, f"sample{k:02d}"))
    return parts
