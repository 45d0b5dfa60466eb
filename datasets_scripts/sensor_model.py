"""A simulated digital camera sensor: scene-linear Rec.709 in, Bayer mosaic of integers out, with photon and read noise."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from mrbokeh.images.color import XYZ_from_rec709
from mrbokeh.system.errors import InputError

CFA_PATTERNS = {"RGGB": (0, 1, 1, 2), "BGGR": (2, 1, 1, 0), "GRBG": (1, 0, 2, 1), "GBRG": (1, 2, 0, 1)}

# How a plausible white-balanced camera sees linear Rec.709 (rows sum to 1), and what it answers to D65 white before white balance.
_BALANCED_CAMERA_FROM_REC709 = np.array([[0.68, 0.26, 0.06], [0.16, 0.70, 0.14], [0.04, 0.22, 0.74]])
_ANSWER_TO_WHITE = np.array([0.5, 1.0, 0.625])
_MATRIX_DENOMINATOR = 10000


def _default_camera_from_xyz() -> Float[np.ndarray, "3 3"]:
    exact = np.diag(_ANSWER_TO_WHITE) @ _BALANCED_CAMERA_FROM_REC709 @ np.linalg.inv(XYZ_from_rec709)
    return np.round(exact * _MATRIX_DENOMINATOR) / _MATRIX_DENOMINATOR


@dataclass(frozen=True)
class SensorModel:
    """Colour, range and noise of a sensor.

    camera_from_xyz: the matrix that the DNG states as ColorMatrix1 (D65), already rounded to what the file can hold.
    exposure: raw green, as a share of its range, for scene-linear white (1, 1, 1).
    footprint_px: side of the square over which a photosite averages; above 1 by the optical low-pass filter before it.
    full_well_electrons: electrons at raw white. read_noise_electrons: standard deviation. Either None or 0 turns noise off.
    """

    bits: int = 14
    black_level: int = 1008
    pattern: str = "RGGB"
    exposure: float = 1.0
    footprint_px: float = 1.5
    full_well_electrons: float = 60000.0
    read_noise_electrons: float = 3.0
    camera_from_xyz: tuple[tuple[float, ...], ...] = tuple(map(tuple, _default_camera_from_xyz().tolist()))

    def __post_init__(self) -> None:
        if self.pattern not in CFA_PATTERNS or not 12 <= self.bits <= 16 or not 0 <= self.black_level < self.white_level:
            raise InputError(
                f"expected a pattern of {', '.join(CFA_PATTERNS)}, 12 to 16 bits and a black level below white, "
                f"got {self.pattern}, {self.bits} bits, black level {self.black_level}"
            )

    @property
    def white_level(self) -> int:
        return 2**self.bits - 1

    @property
    def camera_from_rec709(self) -> Float[np.ndarray, "3 3"]:
        """Raw camera RGB of linear Rec.709, scaled so that white (1, 1, 1) answers 1 in green."""
        matrix = np.asarray(self.camera_from_xyz) @ XYZ_from_rec709
        return matrix / matrix[1].sum()

    @property
    def as_shot_neutral(self) -> Float[np.ndarray, "3"]:
        """Camera RGB of white: the white balance multipliers are its inverse."""
        return self.camera_from_rec709.sum(axis=1)

    def cfa_colours(self, height: int, width: int) -> UInt8[np.ndarray, "height width"]:
        """(H, W): 0 red, 1 green, 2 blue under each photosite."""
        cell = np.asarray(CFA_PATTERNS[self.pattern], np.uint8).reshape(2, 2)
        return np.tile(cell, (height // 2 + 1, width // 2 + 1))[:height, :width]

    def linear_mosaic(self, rgb: Float[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width"]:
        """Scene-linear Rec.709 to the noise-free share of the raw range at each photosite; may exceed 1 (not clipped yet)."""
        camera_rgb = self.exposure * (rgb @ self.camera_from_rec709.T.astype(rgb.dtype))
        colours = self.cfa_colours(*rgb.shape[:2])
        return np.take_along_axis(camera_rgb, colours[..., None].astype(np.intp), axis=2)[..., 0].astype(np.float32)

    def expose(self, mosaic: Float[np.ndarray, "height width"], rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
        """Photon noise (Poisson, saturating at the full well) and read noise (Gaussian) on a noise-free mosaic."""
        if not self.full_well_electrons:
            return np.minimum(mosaic, 1.0).astype(np.float32)
        electrons = rng.poisson(np.maximum(mosaic, 0.0) * self.full_well_electrons)
        read = rng.normal(0.0, self.read_noise_electrons, mosaic.shape)
        return (np.minimum(electrons + read, self.full_well_electrons) / self.full_well_electrons).astype(np.float32)

    def quantise(self, mosaic: Float[np.ndarray, "height width"]) -> UInt16[np.ndarray, "height width"]:
        """Share of the raw range to integers: black level at 0, white level at 1, clipped to what the converter can say."""
        values = self.black_level + mosaic.astype(np.float64) * (self.white_level - self.black_level)
        return np.clip(np.round(values), 0, self.white_level).astype(np.uint16)

    def photograph(self, rgb: Float[np.ndarray, "height width 3"], rng: np.random.Generator) -> UInt16[np.ndarray, "height width"]:
        """Scene-linear Rec.709 to the raw integers of one exposure."""
        return self.quantise(self.expose(self.linear_mosaic(rgb), rng))
