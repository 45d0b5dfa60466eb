"""Compression of a JPEG photograph on what is put into it: the same blocks, tables and halved colour."""

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mrbokeh.compositing.plate import Inserted
from mrbokeh.images.color import srgb_codes, srgb_to_linear
from mrbokeh.images.exif import header_of, oriented_as_stored, stored_orientation

_BLOCK_PX = 16
"""Sides of the blocks whose colour is halved in both directions; all others fit into them."""


@dataclass(frozen=True)
class JpegCompression:
    """How a photograph was compressed. tables: of quantization, 64 numbers each. subsampling: of colour, as Pillow counts it."""

    tables: dict[int, list[int]]
    subsampling: int
    orientation: int

    @classmethod
    def of(cls, photo: Path) -> "JpegCompression | None":
        """Return how a file was compressed; None if it is no JPEG in colours, or of a kind that Pillow does not write."""
        from PIL import JpegImagePlugin, UnidentifiedImageError

        try:
            with header_of(photo) as picture:
                if not isinstance(picture, JpegImagePlugin.JpegImageFile) or picture.mode != "RGB":
                    return None
                subsampling = JpegImagePlugin.get_sampling(picture)
                tables = {number: list(table) for number, table in picture.quantization.items()}
        except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
            return None
        return cls(tables, subsampling, stored_orientation(photo)) if subsampling in (0, 1, 2) else None

    def compressed(self, inserted: Inserted) -> Inserted:
        """Return the picture with its virtual part compressed together with the photograph around it; what no code stands for stays.

        The photograph's own pixels stay too: they were compressed already.
        """
        from PIL import Image

        changed = inserted.virtual.rgb.copy()
        alpha, light, photo = (oriented_as_stored(each, self.orientation) for each in (inserted.virtual.alpha, changed, inserted.photo_rgb))
        rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
        if not len(rows):
            return inserted
        part = tuple(slice(each[0] // _BLOCK_PX * _BLOCK_PX, (each[-1] // _BLOCK_PX + 1) * _BLOCK_PX) for each in (rows, columns))
        whole = np.ascontiguousarray(photo[part] + light[part])
        stream = io.BytesIO()
        Image.fromarray(srgb_codes(whole, np.uint8)).save(stream, "JPEG", qtables=self.tables, subsampling=self.subsampling)
        decoded = srgb_to_linear(np.asarray(Image.open(stream), np.float32) / np.float32(255.0))
        virtual = (alpha[part] > 0.0)[..., None] & (whole >= 0.0) & (whole <= 1.0)
        light[part] = np.where(virtual, decoded - photo[part], light[part])
        return replace(inserted, virtual=replace(inserted.virtual, rgb=changed))
