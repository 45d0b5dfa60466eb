"""How near a predicted photograph comes to the one that was taken, for `bench_pixel4`: decibels of linear light, how alike they look, and
what bounds them.

Perception is measured without weights: SSIM (Wang et al. 2004) and FLIP (`flip`), both of pictures encoded for display and in even light.
LPIPS and its like need a network's weights, which cannot be shipped and were trained on other people's photographs.
"""

import cv2
import numpy as np
from skimage.metrics import structural_similarity

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.lens_measuring.fitting.blur_pairs import even_light
from tests.bench.flip import flip
from tests.bench.pixel4_set import Scene


def explained(picture: np.ndarray, photograph: np.ndarray, judged: np.ndarray, degree: int) -> np.ndarray:
    """The picture with the black and the gain, a polynomial over the frame, that bring it nearest to the photograph."""
    y, x = (each / each.max() * 2.0 - 1.0 for each in np.indices(picture.shape))
    columns = [picture * x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)] + [np.ones_like(x)]
    found = np.linalg.lstsq(np.stack([each[judged] for each in columns], axis=1), photograph[judged], rcond=None)[0]
    return sum(share * each for share, each in zip(found, columns, strict=True))


def decibels(picture: np.ndarray, scene: Scene, judged: np.ndarray | None = None) -> tuple[float, float]:
    where = scene.judged if judged is None else judged
    errors = [(explained(picture, scene.photograph, where, degree) - scene.photograph)[where] for degree in (0, 2)]
    first, second = (-10.0 * float(np.log10((each.astype(np.float64) ** 2).mean())) for each in errors)
    return first, second


def in_even_light(picture: np.ndarray, scene: Scene) -> np.ndarray:
    """The picture with the photograph's gain, black and light, as far as these change over three of the largest kernels."""
    found = explained(picture, scene.photograph, scene.judged, 0).astype(np.float32)
    light = even_light(scene.photograph[..., None], found[..., None], scene.judged, 3.0 * float(scene.coc_px.max()))
    return np.asarray(found * light, np.float32)


def in_even_light_db(lit: np.ndarray, scene: Scene) -> float:
    return -10.0 * float(np.log10((((lit - scene.photograph)[scene.judged]).astype(np.float64) ** 2).mean()))


def looks(lit: np.ndarray, scene: Scene) -> tuple[float, float]:
    """SSIM and FLIP of a picture in even light; what is not judged is the photograph's own, so that it tells nothing."""
    shown = np.where(scene.judged, lit, scene.photograph)
    pair = [linear_to_srgb(np.clip(each, 0.0, 1.0)) for each in (scene.photograph, shown)]
    similarity = structural_similarity(*pair, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True)[1]
    differs = flip(*(np.repeat(np.clip(each, 0.0, 1.0)[..., None], 3, axis=2) for each in (scene.photograph, shown)))
    return float(similarity[scene.judged].mean()), float(differs[scene.judged].mean())


def noise_db(scene: Scene) -> float:
    """By second differences (Immerkaer 1996), which blur of 15 px leaves no detail for."""
    curves = cv2.filter2D(scene.photograph.astype(np.float64), -1, np.outer((1.0, -2.0, 1.0), (1.0, -2.0, 1.0))) / 6.0
    return -10.0 * float(np.log10((curves[scene.judged & (scene.coc_px > 15.0)] ** 2).mean()))
