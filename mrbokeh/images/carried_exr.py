"""CarriedExr: metadata, windows and overscan of a plate's EXR, carried on to the EXR that is made of it.

Metadata are all header entries that say nothing about pixels or colour: time code, rate, pixel aspect, exposure, camera, name of the take.
Virtual things are put into the display window. Overscan, which lies around it, stays the plate's.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32

from mrbokeh.images.alpha_io import Picture, Plane, exr_part, in_named_space
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import ATTRIBUTE, INTEROP_ID, SPACE_NAME, ExrPart, header_of, headers_of, in_rec709, read_exr, stated_primaries

_OF_PIXELS = {
    *("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "type", "name", "version", "chunkCount", "tiles", "preview"),
    *("deepImageState", "maxSamplesPerPixel", "multiView", "whiteLuminance", "adoptedNeutral", "acesImageContainerFlag"),
    *(ATTRIBUTE, SPACE_NAME, INTEROP_ID, "comments", "mrbokehLayers"),
}
"""Entries that are another picture's: how it is stored, and its colours."""

Window = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class CarriedExr:
    """Header entries, and the plate around its display window.

    attributes: by name, as OpenEXR takes them. origin_px: (x, y) of the display window. margins_px: of the data window around it, left,
    top, right and bottom. rgb, alpha: of the whole, linear Rec.709, premultiplied; None without margins.
    views: of a stereo file, the one that is taken first.
    """

    attributes: Mapping[str, Any] = field(default_factory=dict)
    origin_px: tuple[int, int] = (0, 0)
    margins_px: Window = (0, 0, 0, 0)
    rgb: Picture | None = None
    alpha: Plane | None = None
    views: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: Path | None, space: NamedSpace | None = None) -> "CarriedExr":
        """Read what a plate has; nothing where it is no EXR. space: of its numbers, as the user names it."""
        if path is None or path.suffix.lower() != ".exr" or not path.is_file():
            return cls()
        header = header_of(path)
        told = {key: value for key, value in header.items() if key not in _OF_PIXELS and not key.startswith("cryptomatte/")}
        attributes = {key: value for key, value in told.items() if type(value).__name__ in _WRITABLE}
        bare = cls(attributes, tuple(header["displayWindow"][0].tolist()), views=_views(path, header))
        if (header["dataWindow"][0] >= header["displayWindow"][0]).all() and (header["dataWindow"][1] <= header["displayWindow"][1]).all():
            return bare
        parts = read_exr(path, overscan=True)
        part = next((each for each in parts if set("RGB") <= each.channels.keys()), None)
        if part is None:
            return bare
        numbers = part.stacked("RGB")
        rgb = in_rec709(numbers, stated_primaries(part, parts), path) if space is None else space.to_rec709(numbers)
        alpha = part.stacked("A")[..., 0] if "A" in part.channels else None
        return replace(bare, margins_px=part.margins_px, rgb=rgb, alpha=alpha)

    def told(self, path: Path) -> str:
        """Return what the user should know of a plate: views that are left out, and overscan; else ""."""
        told = []
        if len(self.views) > 1:
            told.append(f"{path} holds the views {', '.join(self.views)}: {self.views[0]} is taken, and written alone")
        if self.rgb is not None:
            around = ", ".join(map(str, self.margins_px))
            told.append(f"{path} has overscan ({around} px left, top, right, bottom): it is kept, and virtual things end where it begins")
        return "; ".join(told)

    def onto(self, part: ExrPart, space: NamedSpace | None = None) -> ExrPart:
        """Return a finished picture with what is carried. space: of its numbers; layers and data are empty around the display window."""
        height, width = next(iter(part.channels.values())).shape
        (x, y), (left, top, right, bottom) = self.origin_px, self.margins_px
        windows = {
            "displayWindow": _window(x, y, x + width - 1, y + height - 1),
            "dataWindow": _window(x - left, y - top, x + width - 1 + right, y + height - 1 + bottom),
        }
        attributes = {**self.attributes, **windows, **part.attributes}
        if self.rgb is None:
            return replace(part, attributes=attributes)
        around = exr_part(in_named_space(self.rgb, self.alpha, space), self.alpha, space).channels
        channels = {}
        for name, plane in part.channels.items():
            empty = np.inf if name == "Z" or name.endswith(".Z") else float(name == "A")
            whole = around[name].astype(plane.dtype) if name in around else np.full(self.rgb.shape[:2], empty, plane.dtype)
            whole[top : top + height, left : left + width] = plane
            channels[name] = whole
        return replace(part, channels=channels, attributes=attributes)


def _views(path: Path, header: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the views of a stereo file, the first of them that of this header."""
    if "view" not in header:
        return tuple(header.get("multiView", ()))
    return tuple(dict.fromkeys([str(header["view"]), *(str(each["view"]) for each in headers_of(path) if "view" in each)]))


_WRITABLE = ("int", "float", "str", "Fraction", "list", "ndarray", "tuple", "TimeCode", "KeyCode", "Envmap")
"""Types of header entries that OpenEXR's Python reads and writes."""


def _window(left: int, top: int, right: int, bottom: int) -> tuple[Int32[np.ndarray, "2"], Int32[np.ndarray, "2"]]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)
