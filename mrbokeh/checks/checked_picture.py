"""One picture to check: its light, its alpha and the layers that a layered EXR keeps, with how finely its file can store light."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import ExrPart, read_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES, read_image, read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

VIRTUAL, SHARP, SHADOW = "virtual", "sharp", "shadow"
"""Names of layers in a layered EXR: what was put in, blurred; the same before the blur; what it takes from the photograph."""

_HALF_STEP, _CODE_STEP_16, _CODE_STEP_8 = 2.0**-10, 1.5 / 65535, 1.5 / 255
_LOSSY_STEP = 12 / 255
_STEEPEST = 12.92


@dataclass(frozen=True)
class Storage:
    """is_linear: steps are shares of the value (EXR), else of the sRGB code (integer files, films). step: what rounding may change."""

    is_linear: bool
    step: float

    @property
    def dark_step(self) -> float:
        """How far below 0 storing can bring light: an EXR holds what was written; colours of lossy films ring over the dark beside them."""
        if self.is_linear:
            return 0.0
        return float("inf") if self.step >= _LOSSY_STEP else self.step / _STEEPEST

    def changed(self, rgb: Rgb, plate_rgb: Rgb) -> Bool[np.ndarray, "height width"]:
        """Where two pictures differ by more than storing them explains. Not a number differs from everything."""
        if self.is_linear:
            known = np.nan_to_num(rgb, posinf=0.0, neginf=0.0)
            allowed = self.step * np.maximum(np.abs(known), np.abs(plate_rgb)) + (1e-7 if self.step else 0.0)
            return ~((np.abs(known - plate_rgb) <= allowed) & np.isfinite(rgb)).all(axis=2)
        # The curve is nowhere steeper than its foot: what differs less in light than that can hide need not be encoded.
        differs = ~(np.abs(rgb - plate_rgb) <= self.step / _STEEPEST).all(axis=2)
        shown, stored = (np.clip(linear_to_srgb(each[differs]), 0.0, 1.0) for each in (rgb, plate_rgb))
        differs[differs] = ~(np.abs(shown - stored) <= self.step).all(axis=1)
        return differs


LOSSLESS_FILM, LOSSY_FILM = Storage(False, 4.0 * _CODE_STEP_16), Storage(False, _LOSSY_STEP)


@dataclass(frozen=True)
class CheckedPicture:
    """rgb: linear Rec.709; alpha: None where the file has none; layers by name; time_s: of a frame of a film, else None."""

    name: str
    rgb: Rgb
    storage: Storage
    alpha: Plane | None = None
    layers: Mapping[str, Layer] = field(default_factory=dict)
    time_s: float | None = None


def read_picture(path: Path, name: str = "") -> CheckedPicture:
    """EXR with its layers, or any other picture. Raises InputError where it cannot be read."""
    name = name or path.name
    if path.suffix.lower() != ".exr":
        return CheckedPicture(name, read_image(path), _integer_storage(path))
    parts = read_exr(path)
    layer = read_layer(path)
    has_alpha = any("A" in part.channels for part in parts)
    is_half = any(part.channels.get("R", np.empty(0)).dtype == np.float16 for part in parts)
    return CheckedPicture(
        name, layer.rgb, Storage(True, _HALF_STEP if is_half else 0.0), layer.alpha if has_alpha else None, _layers(parts)
    )


def with_layers(picture: CheckedPicture, layers: Mapping[str, Layer]) -> CheckedPicture:
    """With layers from files of their own. Raises InputError where one is of another size."""
    for name, layer in layers.items():
        if layer.alpha.shape != picture.rgb.shape[:2]:
            height, width = picture.rgb.shape[:2]
            raise InputError(f"the {name} layer is {layer.width_px}x{layer.height_px} px, {picture.name} is {width}x{height} px: resize it")
    return replace(picture, layers={**picture.layers, **layers})


def _integer_storage(path: Path) -> Storage:
    suffix = path.suffix.lower()
    if suffix not in INTEGER_SUFFIXES:
        return Storage(True, 2.0**-7)
    if suffix in (".jpg", ".jpeg"):
        return LOSSY_FILM
    pixels = stored_pixels(path)
    if pixels.dtype.kind == "f":
        return Storage(True, 0.0)
    return Storage(False, _CODE_STEP_16 if pixels.dtype == np.uint16 else _CODE_STEP_8)


def _layers(parts: list[ExrPart]) -> dict[str, Layer]:
    """NAME.R, NAME.G, NAME.B with NAME.A and NAME.Z in any part, and parts of that name with R, G, B."""
    named = {name: part.channels for part in parts for name in (VIRTUAL, SHARP, SHADOW) if part.name == name and "R" in part.channels}
    for part in parts:
        for name in (VIRTUAL, SHARP, SHADOW):
            own = {key.removeprefix(f"{name}."): pixels for key, pixels in part.channels.items() if key.startswith(f"{name}.")}
            if own:
                named[name] = own
    return {name: _layer(channels) for name, channels in named.items()}


def _layer(channels: Mapping[str, np.ndarray]) -> Layer:
    shape = next(iter(channels.values())).shape
    rgb = np.stack([channels.get(c, np.zeros(shape)) for c in "RGB"], axis=2).astype(np.float32)
    depth_m = channels.get("Z", np.full(shape, np.inf)).astype(np.float32)
    return Layer(rgb, channels.get("A", np.ones(shape)).astype(np.float32), depth_m)
