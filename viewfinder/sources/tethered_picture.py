"""A photograph that another program writes: read when it is whole, with what its Exif tells of the lens."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from viewfinder.flow.frames import Bgr, LensState
from viewfinder.sources.size_limit import SizeLimit

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


class NotWholeError(Exception):
    """The file is still being written, damaged, or no picture."""


@dataclass(frozen=True)
class TetheredPicture:
    """bgr: upright 8-bit codes (H, W, 3), blue first. full: reads the file once more, at its own size."""

    bgr: Bgr
    lens: LensState
    full: Callable[[], Bgr]


def read_tethered(path: Path, limit: SizeLimit) -> TetheredPicture:
    """Decodes to the last byte, so that a file cut short raises NotWholeError."""
    from PIL import Image

    try:
        # A TIFF that is still being written makes Pillow warn before it fails.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            size_px = picture.size
            # JPEG can be decoded at an 8th of its size and more; at least twice what is wanted keeps the scaling by areas.
            wanted = limit.fit(*size_px)
            picture.draft("RGB", (2 * wanted[0], 2 * wanted[1]))
            picture.load()
            bgr = limit.applied(_upright_bgr(picture))
    except (OSError, SyntaxError, ValueError) as error:
        raise NotWholeError(f"{path.name} cannot be read: {error}") from None
    facts = read_facts(path, size_px)
    lens = LensState(facts.focus_distance_m, facts.f_number, facts.focal_length_mm)
    return TetheredPicture(bgr, lens, lambda: read_tethered(path, SizeLimit()).bgr)


def _upright_bgr(picture: Any) -> Bgr:
    from PIL import ImageOps

    upright = ImageOps.exif_transpose(picture)
    if upright.mode.startswith("I;16"):
        grey = (np.asarray(upright) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    return np.ascontiguousarray(np.asarray(upright.convert("RGB"))[..., ::-1])
