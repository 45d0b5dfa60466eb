"""Textures made from numbers: linear reflectance, detail at several scales, none finer than asked for.

All but `page_of_text` repeat without a seam. Sizes are texels; `finest` is the shortest wavelength in texels.
"""

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

from datasets_scripts.tracers.traced_scene import Texture, Vector

_GLYPH_ROWS, _GLYPH_COLUMNS = 7, 5


def fractal_noise(
    height: int,
    width: int,
    rng: np.random.Generator,
    finest: float = 4.0,
    coarsest: float = 128.0,
    slope: float = 1.0,
    stretch: float = 1.0,
) -> Float[np.ndarray, "height width"]:
    """Return (H, W) noise of mean 0, deviation 1 and amplitude ~ frequency^-slope per octave, between two wavelengths.

    stretch: how many times longer features are along x than along y.
    """
    frequency_y, frequency_x = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    frequency = np.hypot(frequency_y, frequency_x * stretch)
    # A soft end instead of a sharp one: no ringing around features.
    band = np.exp(-((frequency * finest) ** 4)) * (1.0 - np.exp(-((frequency * coarsest) ** 4)))
    amplitude = np.where(frequency > 0, band / np.maximum(frequency, 1e-9) ** (slope + 1.0), 0.0)
    noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(height, width))) * amplitude, s=(height, width))
    return (noise - noise.mean()) / noise.std()


def coloured(shade: Float[np.ndarray, "height width"], dark: Vector, light: Vector) -> Texture:
    """Mix from `dark` at shade 0 to `light` at shade 1, kept within [0.01, 0.95]."""
    mixed = np.asarray(dark) + shade[..., None] * (np.asarray(light) - np.asarray(dark))
    return np.clip(mixed, 0.01, 0.95).astype(np.float32)


def mottled(
    size: int, rng: np.random.Generator, dark: Vector, light: Vector, finest: float = 4.0, slope: float = 0.8, contrast: float = 0.22
) -> Texture:
    """Plaster, stone, felt: noise of all scales, with a slow drift of the hue."""
    shade = 0.5 + contrast * fractal_noise(size, size, rng, finest, size / 3.0, slope)
    hue = 1.0 + 0.06 * np.stack([fractal_noise(size, size, rng, 12.0, size / 2.0) for _ in range(3)], axis=-1)
    return np.clip(coloured(shade, dark, light) * hue, 0.01, 0.95).astype(np.float32)


def wood(size: int, rng: np.random.Generator, dark: Vector, light: Vector, planks: int = 6) -> Texture:
    """Planks along x with a grain, each with its own brightness, dark joints between them."""
    grain = fractal_noise(size, size, rng, 4.0, size / 4.0, 0.7, stretch=8.0) * 0.17 + fractal_noise(size, size, rng, 4.0, 64.0, 0.1) * 0.1
    plank = np.arange(size) * planks // size
    joint = np.abs((np.arange(size) + 0.5) * planks / size % 1.0 - 0.5) > 0.5 - 2.5 * planks / size
    soft_joint = ndimage.gaussian_filter1d(joint.astype(float), 1.2, mode="wrap")
    shade = 0.5 + grain + rng.normal(0.0, 0.1, planks)[plank][:, None] - 0.45 * soft_joint[:, None]
    return coloured(shade, dark, light)


def bricks(
    size: int,
    rng: np.random.Generator,
    rows: int = 8,
    columns: int = 4,
    brick: Vector = (0.42, 0.17, 0.11),
    mortar: Vector = (0.5, 0.47, 0.42),
) -> Texture:
    """Running bond: every second row is shifted by half a brick; each brick has its own tone."""
    y, x = np.mgrid[:size, :size] + 0.5
    row = (y * rows / size).astype(int)
    along = x * columns / size + 0.5 * (row % 2)
    edge = np.minimum(0.5 - np.abs(along % 1.0 - 0.5), (0.5 - np.abs(y * rows / size % 1.0 - 0.5)) * columns / rows)
    face = ndimage.gaussian_filter((edge > 0.05).astype(float), 1.5, mode="wrap")[..., None]
    tone = rng.uniform(0.65, 1.3, (rows, columns))[row, along.astype(int) % columns]
    rough = 1.0 + 0.2 * fractal_noise(size, size, rng, 4.0, size / 6.0, 0.6)
    wall = face * np.asarray(brick) * tone[..., None] + (1 - face) * np.asarray(mortar)
    return np.clip(wall * rough[..., None], 0.01, 0.95).astype(np.float32)


def checks(size: int, rng: np.random.Generator, first: Vector, second: Vector, count: int = 8) -> Texture:
    """Return a woven check: squares of two colours with a thread pattern over them."""
    y, x = np.mgrid[:size, :size] * count // size
    squares = ndimage.gaussian_filter(((x + y) % 2).astype(float), 1.2, mode="wrap")
    shade = 0.12 + 0.76 * squares + 0.13 * fractal_noise(size, size, rng, 4.0, size / 4.0, 0.5)
    return coloured(shade, first, second)


def spots(
    size: int,
    rng: np.random.Generator,
    ground: Vector,
    colours: tuple[Vector, ...],
    count: int = 70,
    radius: tuple[float, float] = (4.0, 22.0),
) -> Texture:
    """Round spots of several colours and sizes on a mottled ground, soft-edged over four texels."""
    red, green, blue = ground
    dark, light = (0.8 * red, 0.8 * green, 0.8 * blue), (1.2 * red, 1.2 * green, 1.2 * blue)
    picture = mottled(size, rng, dark, light).astype(float)
    for index in range(count):
        (cy, cx), r = rng.uniform(0, size, 2), rng.uniform(*radius)
        rows, columns = (np.unique(np.arange(int(c - r) - 3, int(c + r) + 5) % size) for c in (cy, cx))
        y, x = rows[:, None] + 0.5, columns + 0.5
        away = np.hypot((y - cy + size / 2) % size - size / 2, (x - cx + size / 2) % size - size / 2)
        cover = np.clip((r - away) / 4.0 + 0.5, 0.0, 1.0)[..., None]
        under = picture[np.ix_(rows, columns)]
        picture[np.ix_(rows, columns)] = under * (1 - cover) + cover * np.asarray(colours[index % len(colours)]) * rng.uniform(0.8, 1.15)
    rough = 1.0 + 0.12 * fractal_noise(size, size, rng, 4.0, size / 4.0, 0.3)
    return np.clip(picture * rough[..., None], 0.01, 0.95).astype(np.float32)


def page_of_text(
    height: int, width: int, rng: np.random.Generator, ink: Vector, paper: Vector, cell: int = 4, headline: bool = True
) -> Texture:
    """Words of invented letters (symmetric 5x7 dot patterns), `cell` texels a dot, with a headline of doubled size."""
    page = np.zeros((height, width))
    top = 3 * cell
    while top + _GLYPH_ROWS * cell * 2 < height:
        size = cell * 2 if headline and top == 3 * cell else cell
        _print_line(page, top, size, rng)
        top += (_GLYPH_ROWS + 3) * size
    printed = ndimage.gaussian_filter(page, 0.35 * cell)
    shade = 1.0 - 0.92 * printed + 0.07 * fractal_noise(height, width, rng, 4.0, height / 3.0, 0.3)
    return coloured(shade, ink, paper)


def _print_line(page: Float[np.ndarray, "height width"], top: int, cell: int, rng: np.random.Generator) -> None:
    left, letters = 4 * cell, 0
    while left + (_GLYPH_COLUMNS + 4) * cell < page.shape[1]:
        glyph = np.kron(_invented_glyph(rng), np.ones((cell, cell)))
        page[top : top + glyph.shape[0], left : left + glyph.shape[1]] = glyph
        letters += 1
        end_of_word = letters > 2 and rng.random() < 0.25
        left += (_GLYPH_COLUMNS + (4 if end_of_word else 1)) * cell
        letters = 0 if end_of_word else letters


def _invented_glyph(rng: np.random.Generator) -> Float32[np.ndarray, "7 5"]:
    """Return a random pattern, mirrored left to right, which reads as a letter from afar."""
    half = rng.random((_GLYPH_ROWS, _GLYPH_COLUMNS // 2 + 1)) < 0.55
    return np.concatenate([half, half[:, -2::-1]], axis=1).astype(np.float32)
