"""The four usual measures of fused pictures without truth, written from their papers: Q_AB/F, Q_NCIE, Q_P and Q_CB.

Each takes two sources and the fused picture, grey, 0 to 255, and is larger for a better fusion. They were chosen and compared by Z. Liu et
al., "Objective Assessment of Multiresolution Image Fusion Algorithms for Context Enhancement in Night Vision", TPAMI 34(1), 2012. Where a
paper leaves a constant open, the one is taken that gives the values published for the Lytro pairs (tests.bench.bench_real compares).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Complex64, Float32, Float64, Int64, UInt8
from scipy import fft

Grey = Float64[np.ndarray, "height width"]
Map = Float32[np.ndarray, "height width"]
TINY = 1e-12


class FusionScores(NamedTuple):
    gradients: float
    entropy: float
    phase: float
    contrast: float


MEASURES = ("Q_AB/F", "Q_NCIE", "Q_P", "Q_CB")
"""Their names."""


@dataclass(frozen=True)
class Picture:
    """A source or a fused picture. What the measures need of it is worked out once."""

    grey: Grey

    @classmethod
    def of(cls, rgb8: UInt8[np.ndarray, "height width 3"]) -> "Picture":
        """Take the luma of 8-bit sRGB (Rec.601, rounded), as published values do."""
        return cls(np.round(rgb8.astype(np.float64) @ np.array([0.2989, 0.5870, 0.1140])))

    @cached_property
    def edges(self) -> "Edges":
        return sobel_edges(self.grey)

    @cached_property
    def codes(self) -> Int64[np.ndarray, " pixels"]:
        return np.clip(np.round(self.grey), 0, LEVELS - 1).astype(np.int64).ravel()

    @cached_property
    def features(self) -> "Features":
        return phase_congruency(self.grey)

    @cached_property
    def seen(self) -> Grey:
        return masked_contrast(self.grey)


def fusion_scores(a: Picture, b: Picture, fused: Picture) -> FusionScores:
    return FusionScores(
        gradient_transfer(a, b, fused), correlation_entropy(a, b, fused), phase_transfer(a, b, fused), contrast_transfer(a, b, fused)
    )


# Q_AB/F: C. Xydeas and V. Petrovic, "Objective image fusion performance measure", Electronics Letters 36(4), 2000.

STRENGTH, ORIENTATION = (0.9994, -15.0, 0.5), (0.9879, -22.0, 0.8)
"""Gamma, kappa and sigma of the sigmoids of edge strength and orientation."""


class Edges(NamedTuple):
    strength: Grey
    angle: Grey


def gradient_transfer(a: Picture, b: Picture, fused: Picture) -> float:
    """Return Q_AB/F: how much of the strength and orientation of the sources' edges is kept, weighted by strength."""
    kept = sum((_edges_kept(each.edges, fused.edges) * each.edges.strength).sum() for each in (a, b))
    return float(kept / max((a.edges.strength + b.edges.strength).sum(), TINY))


def sobel_edges(picture: Grey) -> Edges:
    """Find edges; beyond the frame lies 0."""
    right, down = (cv2.Sobel(picture, cv2.CV_64F, *axis, borderType=cv2.BORDER_CONSTANT) for axis in ((1, 0), (0, 1)))
    return Edges(np.hypot(right, down), np.arctan(down / np.where(right == 0.0, 1e-5, right)))


def _edges_kept(source: Edges, fused: Edges) -> Grey:
    strength = np.minimum(source.strength, fused.strength) / np.maximum(np.maximum(source.strength, fused.strength), 1e-5)
    angle = 1.0 - np.abs(source.angle - fused.angle) / (np.pi / 2.0)
    return _sigmoid(strength, *STRENGTH) * _sigmoid(angle, *ORIENTATION)


def _sigmoid(value: Grey, most: float, slope: float, middle: float) -> Grey:
    return most / (1.0 + np.exp(slope * (value - middle)))


# Q_NCIE: Q. Wang, Y. Shen and J. Q. Zhang, "A nonlinear correlation measure for multivariable data set", Physica D 200, 2005.

LEVELS = 256


def correlation_entropy(a: Picture, b: Picture, fused: Picture) -> float:
    """Return Q_NCIE: 1 less the entropy of the eigenvalues of the three pictures' nonlinear correlations."""
    correlation, codes = np.eye(3), [each.codes for each in (a, b, fused)]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        correlation[one, other] = correlation[other, one] = _nonlinear_correlation(codes[one], codes[other])
    return 1.0 - _entropy(np.abs(np.linalg.eigvalsh(correlation)) / 3.0)


def _nonlinear_correlation(one: Int64[np.ndarray, " pixels"], other: Int64[np.ndarray, " pixels"]) -> float:
    """Mutual information of two pictures' codes, which is 1 at most."""
    joint = np.bincount(one * LEVELS + other, minlength=LEVELS * LEVELS).reshape(LEVELS, LEVELS) / len(one)
    return _entropy(joint.sum(axis=0)) + _entropy(joint.sum(axis=1)) - _entropy(joint)


def _entropy(shares: Float64[np.ndarray, "*shape"]) -> float:
    """To the base of LEVELS."""
    present = shares[shares > 0.0]
    return float(-(present * np.log(present)).sum() / np.log(LEVELS))


# Q_P: J. Zhao, R. Laganiere and Z. Liu, "Performance assessment of combinative pixel-level image fusion based on an absolute feature
# measurement", IJICIC 3(6A), 2007. Phase congruency and its moments: P. Kovesi, "Image features from phase congruency", Videre 1(3), 1999,
# and "Phase congruency detects corners and edges", DICTA 2003.

SCALES, ORIENTATIONS, FINEST_PX, SCALE_STEP = 4, 6, 3.0, 2.1
SIGMA_ON_F, ANGLE_STEP_ON_SIGMA = 0.55, 1.2
NOISE_SIGMAS, NOISE_DIVISOR = 2.0, 1.7
LEAST_WIDTH, WIDTH_GAIN = 0.5, 10.0
"""Where few scales respond, phase congruency says little: a sigmoid of the share of scales."""
EPSILON = 1e-4
FEATURE = 0.1
"""Phase congruency of what counts as a feature."""
WINDOW_PX, WINDOW_SIGMA_PX, CORRELATION_FLOOR = 11, 1.5, 1e-4


class Features(NamedTuple):
    congruency: Map
    largest_moment: Map
    smallest_moment: Map


def phase_transfer(a: Picture, b: Picture, fused: Picture) -> float:
    """Return Q_P: the product of the local correlations of phase congruency and its moments with those of the better source."""
    from_a = a.features.congruency > b.features.congruency
    both = Features(*(np.where(from_a, one, other) for one, other in zip(a.features, b.features, strict=True)))
    sources = [(each, each.congruency > FEATURE) for each in (a.features, b.features, both)]
    product = 1.0
    for index in range(len(both)):
        correlations = [_local_correlation(maps[index], known, fused.features[index]) for maps, known in sources]
        product *= float(np.maximum.reduce(correlations).sum() / max(int(sources[2][1].sum()), 1))
    return product


def _local_correlation(source: Map, known: Bool[np.ndarray, "height width"], fused: Map) -> Map:
    """In a Gaussian window; 0 where nothing is known."""
    source = np.where(known, source, np.float32(0.0))
    mean, mean_fused = _windowed(source), _windowed(fused)
    variances = np.abs((_windowed(source * source) - mean**2) * (_windowed(fused * fused) - mean_fused**2))
    covariance = _windowed(source * fused) - mean * mean_fused
    found = (covariance + CORRELATION_FLOOR) / (np.sqrt(variances) + CORRELATION_FLOOR)
    return np.where(known, np.maximum(found, 0.0), 0.0).astype(np.float32)


def _windowed(values: Map) -> Map:
    return cv2.GaussianBlur(values, (WINDOW_PX, WINDOW_PX), WINDOW_SIGMA_PX, borderType=cv2.BORDER_CONSTANT)


def phase_congruency(picture: Grey) -> Features:
    """Find phase congruency over all orientations, and the largest and smallest moment of that in each."""
    filters = _LogGabor.of(*picture.shape)
    spectrum = fft.fft2(picture).astype(np.complex64)
    energies, amplitudes, xx, yy, xy = np.zeros((5, *picture.shape), np.float32)
    for index in range(ORIENTATIONS):
        energy, amplitude = _energy([fft.ifft2(spectrum * each) for each in filters.transfer[index]], filters, index)
        congruency, angle = energy / amplitude, np.float32(index * np.pi / ORIENTATIONS)
        x, y = congruency * np.cos(angle), congruency * np.sin(angle)
        energies, amplitudes, xx, yy, xy = energies + energy, amplitudes + amplitude, xx + x * x, yy + y * y, xy + x * y
    xx, yy, twice_xy = xx * 2.0 / ORIENTATIONS, yy * 2.0 / ORIENTATIONS, xy * 4.0 / ORIENTATIONS
    apart = np.sqrt(twice_xy**2 + (xx - yy) ** 2)
    return Features(energies / amplitudes, (xx + yy + apart) / 2.0, (xx + yy - apart) / 2.0)


def _energy(responses: list[Complex64[np.ndarray, "height width"]], filters: "_LogGabor", index: int) -> tuple[Map, Map]:
    """(energy in phase, above the noise, weighted by the width of the spectrum; sum of amplitudes) of one orientation."""
    strengths = [np.abs(each) for each in responses]
    total, amplitude = np.sum(responses, axis=0), np.sum(strengths, axis=0)
    towards = np.conj(total) / (np.abs(total) + EPSILON)
    in_phase = np.sum([(turned := each * towards).real - np.abs(turned.imag) for each in responses], axis=0)
    width = amplitude / (np.maximum.reduce(strengths) + EPSILON) / SCALES
    weight = 1.0 / (1.0 + np.exp((LEAST_WIDTH - width) * WIDTH_GAIN))
    noise = filters.noise_energy(index, float(np.median(strengths[0] ** 2)))
    return (weight * np.maximum(in_phase - noise, 0.0)).astype(np.float32), amplitude + np.float32(EPSILON)


@dataclass(frozen=True)
class _LogGabor:
    """transfer: frequency 0 in the corner. finest: power of the finest filter. spread: how much energy white noise of power 1 gives."""

    transfer: Float32[np.ndarray, "orientations scales height width"]
    finest: Float64[np.ndarray, " orientations"]
    spread: Float64[np.ndarray, " orientations"]

    @classmethod
    @lru_cache(maxsize=2)
    def of(cls, rows: int, columns: int) -> "_LogGabor":
        y, x = np.meshgrid(fft.fftfreq(rows), fft.fftfreq(columns), indexing="ij")
        radius, angle = np.hypot(x, y), np.arctan2(-y, x)
        radius[0, 0] = 1.0
        low_pass = 1.0 / (1.0 + (radius / 0.45) ** 30)
        radial = [
            np.exp(-(np.log(radius * FINEST_PX * SCALE_STEP**scale) ** 2) / (2.0 * np.log(SIGMA_ON_F) ** 2)) * low_pass
            for scale in range(SCALES)
        ]
        for each in radial:
            each[0, 0] = 0.0
        sigma = np.pi / ORIENTATIONS / ANGLE_STEP_ON_SIGMA
        apart = [np.angle(np.exp(1j * (angle - index * np.pi / ORIENTATIONS))) for index in range(ORIENTATIONS)]
        transfer = np.array([[each * np.exp(-(turned**2) / (2.0 * sigma**2)) for each in radial] for turned in apart], np.float32)
        kernels = fft.ifft2(transfer.astype(np.complex64)).real * np.sqrt(rows * columns)
        powers = np.einsum("oshw,othw->ost", kernels, kernels, dtype=np.float64)
        return cls(transfer, (transfer[:, 0].astype(np.float64) ** 2).sum(axis=(1, 2)), powers.sum(axis=(1, 2)))

    def noise_energy(self, index: int, median_power: float) -> np.float32:
        """Energy that noise seldom exceeds; the median power of the finest responses is taken for noise, which is Rayleigh distributed."""
        tau = np.sqrt(median_power / np.log(2.0) / self.finest[index] * self.spread[index])
        return np.float32(tau * (np.sqrt(np.pi / 2.0) + NOISE_SIGMAS * np.sqrt(2.0 - np.pi / 2.0)) / NOISE_DIVISOR)


# Q_CB: Y. Chen and R. S. Blum, "A new automated quality assessment algorithm for image fusion", Image and Vision Computing 27, 2009.

EYE_COARSE, EYE_FINE, EYE_FINE_SHARE = 15.3870, 1.3456, 0.7622
"""Contrast sensitivity as a difference of Gaussians."""
PX_PER_DEGREE = 30.0
CONTRAST_SIGMAS_PX, CONTRAST_WINDOW_PX = (2.0, 4.0), 31
MASKING_POWER, MASKED_POWER, MASKING_FLOOR = 3.0, 2.0, 1e-4


def contrast_transfer(a: Picture, b: Picture, fused: Picture) -> float:
    """Return Q_CB: how much of the sources' contrast, as the eye sees it, is kept, weighted by saliency."""
    from_a = a.seen**2 / np.maximum(a.seen**2 + b.seen**2, TINY)
    return float((from_a * _contrast_kept(a.seen, fused.seen) + (1.0 - from_a) * _contrast_kept(b.seen, fused.seen)).mean())


def _contrast_kept(source: Grey, fused: Grey) -> Grey:
    """1 where they are the same, also where both have none."""
    return (np.minimum(source, fused) + TINY) / (np.maximum(source, fused) + TINY)


def masked_contrast(picture: Grey) -> Grey:
    """Return the contrast of a picture, stretched to 0 to 255 and seen through the contrast sensitivity of the eye, after masking."""
    stretched = np.round((picture - picture.min()) / max(picture.max() - picture.min(), TINY) * (LEVELS - 1))
    rows, columns = picture.shape
    # 1 is the Nyquist frequency; a degree of the eye is taken to have PX_PER_DEGREE pixels.
    y, x = np.meshgrid(2.0 * fft.fftfreq(rows) * rows, 2.0 * fft.fftfreq(columns) * columns, indexing="ij")
    radius = np.hypot(x, y) / PX_PER_DEGREE
    sensitivity = np.exp(-((radius / EYE_COARSE) ** 2)) - EYE_FINE_SHARE * np.exp(-((radius / EYE_FINE) ** 2))
    seen = fft.ifft2(fft.fft2(stretched) * sensitivity).real
    window = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
    fine, coarse = (cv2.GaussianBlur(seen, window, sigma, borderType=cv2.BORDER_CONSTANT) for sigma in CONTRAST_SIGMAS_PX)
    contrast = np.abs(fine / np.where(coarse == 0.0, TINY, coarse) - 1.0)
    return contrast**MASKING_POWER / (contrast**MASKED_POWER + MASKING_FLOOR)
