"""Falloff of the plate's lens towards the corners, put on virtual light alone: the photograph has it already.

Coverage stays as it is: a dark corner of an opaque object hides what is behind it like a bright one. Lenses whose kernels lose light
towards the corners (measured banks) have their falloff in the blur already: use one or the other.

Coefficients can come from lensfun's measurements (lensfun.github.io; data CC-BY-SA 3.0, in the lensfunpy wheel of the capture extra).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.images.exif import exif_and_size
from mrbokeh.images.image_io import read_image
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box
from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.optics.camera import field_positions
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.system.typed_numbers import numbers_in

Gain = Float32[np.ndarray, "height width channels"]
_LEAST_GAIN = 1e-3
_DEGREE, _CELLS = 6, 64

FAR_M = 1000.0
_EXIF_IFD, _MAKER, _MODEL, _LENS_MODEL = 0x8769, 0x010F, 0x0110, 0xA434


@runtime_checkable
class Vignetting(Protocol):
    """Share of its light that a lens sends to each pixel, 1 in the middle of the frame."""

    def gain(self, box: Box, frame_px: tuple[int, int]) -> Gain:
        """Return the gain, (h, w, 1 or 3), of the pixels of a box within a frame of (height, width)."""
        ...


@dataclass(frozen=True)
class RadialFalloff:
    """Falloff 1 + k1 r^2 + k2 r^4 + k3 r^6, lensfun's "pa" model; r is 1 in the corner of the frame, times `reach`.

    reach: the frame's diagonal as a share of the one that the coefficients were measured on (a smaller sensor sees less of the
    falloff).
    """

    k1: float
    k2: float = 0.0
    k3: float = 0.0
    reach: float = 1.0

    def __post_init__(self) -> None:
        squared = np.linspace(0.0, self.reach**2, 101)
        least = float(self._polynomial(squared).min())
        if not least > _LEAST_GAIN:
            raise InputError(
                f"expected a falloff that leaves light in the corners, but {self.k1:g}, {self.k2:g}, {self.k3:g} falls to {least:g}: "
                f"give smaller coefficients"
            )

    @classmethod
    def parse(cls, text: str) -> "RadialFalloff":
        """ "K1,K2,K3", or fewer. Raises InputError."""
        expected = "--vignetting: expected K1,K2,K3 (such as -0.4,0.1,0)"
        numbers = numbers_in(text, expected, (1, 2, 3))
        if not np.isfinite(numbers).all():
            raise InputError(f"{expected}, got {text!r}")
        return cls(*numbers)

    def gain(self, box: Box, frame_px: tuple[int, int]) -> Gain:
        position = field_positions(box.size_px, frame_px, box.origin_px) * np.float32(self.reach)
        return self._polynomial((position * position).sum(axis=2, keepdims=True)).astype(np.float32)

    def _polynomial(self, squared: np.ndarray) -> np.ndarray:
        return 1.0 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))


@dataclass(frozen=True)
class FlatField:
    """The picture that the lens makes of an even surface, 1 in the middle, as a polynomial of the field position.

    coefficients: [i, j, channel] of y^i x^j, with x and y as in CONVENTIONS, "Field position". It is stretched to the frame.
    """

    coefficients: Float64[np.ndarray, "powers powers 3"]

    def gain(self, box: Box, frame_px: tuple[int, int]) -> Gain:
        position = field_positions(box.size_px, frame_px, box.origin_px)
        y, x = (np.polynomial.polynomial.polyvander(each, _DEGREE) for each in (position[:, 0, 1], position[0, :, 0]))
        gain = np.einsum("yi,ijc,xj->yxc", y, self.coefficients, x, optimize=True)
        return np.maximum(gain, _LEAST_GAIN).astype(np.float32)


def flat_field_of(rgb: Float32[np.ndarray, "height width 3"]) -> FlatField:
    """Fit a photograph of an even surface by a polynomial of degree 6 in x and y, with which any "pa" falloff is exact.

    Grain averages away; the hard shadow of a lens hood is no polynomial and is smoothed. Raises InputError if the middle is black.
    """
    import cv2

    height, width = rgb.shape[:2]
    scale = min(1.0, _CELLS / max(height, width))
    cells = cv2.resize(rgb, (max(_DEGREE + 1, round(width * scale)), max(_DEGREE + 1, round(height * scale))), interpolation=cv2.INTER_AREA)
    position = field_positions(cells.shape[:2]).reshape(-1, 2).astype(np.float64)
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    terms = np.stack([position[:, 1] ** i * position[:, 0] ** j for i, j in powers], axis=1)
    fitted = np.linalg.lstsq(terms, cells.reshape(-1, 3).astype(np.float64), rcond=None)[0]
    if not (fitted[0] > 0.0).all():
        raise InputError("expected a flat field that is bright in the middle, got black: photograph an evenly lit white surface")
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 3))
    for (i, j), values in zip(powers, fitted, strict=True):
        coefficients[i, j] = values / fitted[0]
    return FlatField(coefficients)


def read_flat_field(path: Path | str) -> FlatField:
    return flat_field_of(read_image(path))


def darkened(layer: Layer, gain: Gain) -> Layer:
    """A layer's light through a falloff."""
    return Layer(layer.rgb * gain, layer.alpha, layer.depth_m, layer.extra)


def falloff_at(vignetting: Vignetting, x_px: int, y_px: int, frame_px: tuple[int, int]) -> Triple:
    """Return the falloff at one pixel of a frame (height, width), for `grey_card_match`."""
    return triple_of(np.broadcast_to(vignetting.gain(Box(y_px, y_px + 1, x_px, x_px + 1), frame_px)[0, 0], 3))


if TYPE_CHECKING:
    import lensfunpy


@dataclass(frozen=True)
class CameraAndLens:
    """Camera and lens by their names in Exif, such as Canon, Canon EOS 450D and EF100mm f/2.8 Macro USM."""

    camera_maker: str
    camera_model: str
    lens_model: str


def falloff_of_photo(path: Path | str) -> RadialFalloff:
    """Look up the falloff of the camera, lens, focal length, f-number and focus distance that a photograph's Exif states.

    Raises InputError if it does not state them.
    """
    names, size_px = _camera_and_lens(path)
    facts = read_facts(path, size_px)
    if facts.focal_length_mm is None or facts.f_number is None:
        raise InputError(f"{path}: expected its Exif to state focal length and f-number: give the falloff as K1,K2,K3 or a flat field")
    return lensfun_falloff(names, facts.focal_length_mm, facts.f_number, facts.focus_distance_m or FAR_M)


def _camera_and_lens(path: Path | str) -> tuple[CameraAndLens, tuple[int, int]]:
    found = exif_and_size(Path(path))
    if found is None:
        raise InputError(f"{path}: expected a photograph with Exif (JPEG, TIFF, HEIC): give the falloff as K1,K2,K3 or a flat field")
    exif, size_px = found
    texts = [exif.get(_MAKER), exif.get(_MODEL), exif.get_ifd(_EXIF_IFD).get(_LENS_MODEL)]
    if not all(isinstance(each, str) for each in texts):
        raise InputError(f"{path}: expected its Exif to name camera and lens: give the falloff as K1,K2,K3 or a flat field")
    maker, model, lens_model = (str(each).strip("\0 ") for each in texts)
    return CameraAndLens(maker, model, lens_model), size_px


def lensfun_falloff(names: CameraAndLens, focal_length_mm: float, f_number: float, focus_m: float = FAR_M) -> RadialFalloff:
    """Look up a lens in lensfun.

    Raises MissingExtraError without lensfunpy, InputError if lensfun knows no such lens or has not measured its vignetting.
    """
    try:
        import lensfunpy
    except ImportError as missing:
        raise MissingExtraError("lensfunpy", "capture") from missing
    database = lensfunpy.Database()
    camera = next(iter(database.find_cameras(names.camera_maker, names.camera_model)), None)
    if camera is None:
        raise InputError(
            f"lensfun does not know the camera {names.camera_maker} {names.camera_model}: give the falloff as K1,K2,K3 or a flat field"
        )
    measured = (each for each in database.find_lenses(camera, None, names.lens_model) if each.calib_vignetting)
    lens = next(measured, None)
    terms = None if lens is None else _terms(lens, focal_length_mm, f_number, focus_m)
    if lens is None or terms is None:
        raise InputError(
            f"lensfun has no vignetting of {names.lens_model} on {names.camera_model}: give the falloff as K1,K2,K3 or a flat field"
        )
    return RadialFalloff(*terms, reach=lens.crop_factor / camera.crop_factor)


def _terms(lens: "lensfunpy.Lens", focal_length_mm: float, f_number: float, focus_m: float) -> tuple[float, float, float] | None:
    found = lens.interpolate_vignetting(focal_length_mm, f_number, min(focus_m, FAR_M))
    if found is None:
        return None
    k1, k2, k3 = (float(each) for each in found.terms[:3])
    return k1, k2, k3
