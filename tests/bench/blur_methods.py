"""OURS, SPLAT and FILTER of Leimkuehler et al. 2018, Section 7: three ways to add up light with the kernels of one bank.

Layers are global, as in their Section 6: light is added up linearly within a layer, layers lie over one another. They are those of the
sampler: what is far in front of the focus, and everything else as if that were not there. Coverage goes through the same PSFs as
colour; where several PSFs do not add up to 1, colour is weighted anew by it (Lee et al. 2008). It is plainer than
mrbokeh.layering.layering, which cuts every layer into slices: comparisons made with it compare the ways to add up light, nothing else.

FILTER gathers: every pixel takes light with its own PSF instead of giving it away. Where all pixels share one PSF that is the same as
splatting. Where they do not, a pixel in focus takes no light from a blurred neighbour, and a blurred one takes it from what is sharp.

Banks are of the five PSF models of their Table 1, in the range of blur of the sampler's scenes: circles of confusion reach 0.105 and
motion 0.135 widths of the frame, depths 1.2 to 6.6 m.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32
from scipy.ndimage import distance_transform_edt

from mrbokeh.images.image_io import read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.layering.motion import MOTION
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import HEAD, missing_cells, read_bank, read_head
from mrbokeh.psf_models.base import PsfModel
from mrbokeh.psf_models.build import Combined, bank_head, build_bank
from mrbokeh.psf_models.physical_lens import PhysicalLens, biconvex_lens
from mrbokeh.psf_models.simple_lens import SimpleLens, Stylized
from mrbokeh.psf_models.volume import Volume
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.renderers.kernels.laplacian_tables import Points
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, Sparsification
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.stacks.exr_layers.render_channels import taken_from_channels
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import cores

_STRIP_ROWS = 16
_LEAST = np.float32(1e-6)
_OPAQUE = 0.999
Light = Float32[np.ndarray, "height width _"]
COC_SHARE, MOTION_SHARE = 0.125, 0.14
NEAREST_M, FARTHEST_M = 1.2, 6.6
BICONVEX_F_NUMBER = 4.0
_WINDOW_SHARE = 0.25
_DUST = 1e-6
_RAYS = {"physical": 1 << 18, "volume": 1 << 19}
_FINER, _SEED = 4, 0
SPARSIFICATIONS: Mapping[str, Sparsification] = {
    # Points are counted by the length of a kernel's outline. A caustic within a wide halo has a short one, and the light that a medium
    # does not scatter, all in one pixel, a shorter one yet: fewer points than the thirty that hold all moments.
    "physical": Sparsification(points_per_px=4.0, lloyd_steps=0, annealing_steps=0),
    "volume": Sparsification(points_per_px=60.0, lloyd_steps=0, annealing_steps=0),
}


def gathered(
    values: Float32[np.ndarray, "rows columns channels"],
    cells: Int32[np.ndarray, "height width"],
    taps: Points,
    margin_px: int,
    threads: int = 0,
) -> Float32[np.ndarray, "height width channels"]:
    """Return at every pixel x the sum over the taps p of its kernel of weight(p) times values(x - p).

    values: with a margin all around, at least as wide as the taps reach. cells: which of the kernels a pixel takes, from 0.
    """
    from tests.bench._gathering_filter_numba import gather_rows

    height, width = cells.shape
    channels = values.shape[2]
    if taps.reach_px > margin_px or values.shape[:2] != (height + 2 * margin_px, width + 2 * margin_px):
        raise InputError(
            f"kernels that reach {taps.reach_px} px need light with such a margin around the {width}x{height} px to be filled, "
            f"but it came with {values.shape[1]}x{values.shape[0]} px and a margin of {margin_px} px: continue it"
        )
    out = np.zeros((height, width * channels), np.float32)
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    weights = taps.weights.astype(np.float32)

    def run(first: int) -> None:
        end = min(first + _STRIP_ROWS, height)
        gather_rows(out, flat, cells, taps.xy, weights, taps.starts, margin_px, channels, first, end)

    with ThreadPoolExecutor(threads or cores()) as pool:
        list(pool.map(run, range(0, height, _STRIP_ROWS)))
    return out.reshape(height, width, channels)


def gathered_reference(
    values: Float32[np.ndarray, "rows columns channels"], cells: Int32[np.ndarray, "height width"], taps: Points, margin_px: int
) -> Float[np.ndarray, "height width channels"]:
    """Gather as `gathered` does, slowly and obviously, in double precision."""
    out = np.zeros((*cells.shape, values.shape[2]))
    for y, x in np.ndindex(*cells.shape):
        part = slice(taps.starts[cells[y, x]], taps.starts[cells[y, x] + 1])
        for (right, down), weight in zip(taps.xy[part], taps.weights[part], strict=True):
            out[y, x] += weight * values[y + margin_px - down, x + margin_px - right]
    return out


@dataclass(frozen=True)
class GlobalLayer:
    """Light of one layer, continued beyond the frame by a margin where it is opaque.

    values: (H, W, 4) premultiplied R, G, B and coverage. coc_px: (H, W) signed diameters. place: motion, field and depth of each pixel.
    """

    values: Float32[np.ndarray, "height width 4"]
    coc_px: Float32[np.ndarray, "height width"]
    place: Place
    is_opaque: bool


Spread = Callable[[GlobalLayer, int], Float32[np.ndarray, "height width _"]]
"""All light of a layer where it lands within the frame, given the layer and its margin: R, G, B and one coverage or one for each."""


def read_global_layers(folder: Path, lens: Lens, margin_px: int, *, moves: bool = True) -> list[GlobalLayer]:
    """Return the layers of a set of samples (datasets_scripts.render_samples), front first; moves: False takes them as at rest."""
    return [global_layer(layer, lens, margin_px, moves=moves) for layer in read_moving_layers(folder)]


def read_moving_layers(folder: Path) -> list[Layer]:
    """Return the layers with their motion as renderers take it, front first."""
    return [taken_from_channels(read_layer(path, extra=True), 1.0) for path in sorted((folder / "layers").glob("*.exr"))]


def global_layer(layer: Layer, lens: Lens, margin_px: int, *, moves: bool = True) -> GlobalLayer:
    """Return a layer with its motion in pixels, continued beyond the frame as its border pixels do if it covers all of it."""
    covered, is_opaque = layer.alpha > 0, bool(layer.alpha.min() > _OPAQUE)
    motion_px = np.zeros((*covered.shape, 2), np.float32)
    if moves and MOTION in layer.extra:
        motion_px = layer.extra[MOTION] / np.maximum(layer.alpha, _LEAST)[..., None]
    coc_px = np.where(covered, lens.coc_px(layer.depth_m, layer.width_px), 0.0).astype(np.float32)
    depth_m = np.where(covered, layer.depth_m, np.float32(lens.focus_distance_m)).astype(np.float32)
    light = np.dstack([layer.rgb, layer.alpha]).astype(np.float32)
    sides = ((margin_px, margin_px), (margin_px, margin_px))
    values = np.pad(light, (*sides, (0, 0)), mode="edge" if is_opaque else "constant")
    wide_motion_px = np.pad(motion_px.astype(np.float32), (*sides, (0, 0)), mode="edge")
    field_xy = _field_xy(layer.width_px, layer.height_px, margin_px)
    place = Place(wide_motion_px, field_xy, np.pad(depth_m, sides, mode="edge"))
    return GlobalLayer(values, np.pad(coc_px, sides, mode="edge"), place, is_opaque)


def composited(layers: Sequence[GlobalLayer], spread: Spread, margin_px: int) -> Float32[np.ndarray, "height width 3"]:
    """Return all layers spread and laid over one another, front first; what the last leaves open is shared out."""
    size = [length - 2 * margin_px for length in layers[0].coc_px.shape]
    colour, free = np.zeros((*size, 3)), np.ones((*size, 1))
    for layer in layers:
        light = spread(layer, margin_px)
        weight = np.maximum(light[..., 3:], _LEAST)
        coverage = np.ones_like(weight) if layer.is_opaque else np.clip(light[..., 3:], 0.0, 1.0)
        colour = colour + free * coverage * light[..., :3] / weight
        free = free * (1.0 - coverage)
    return np.maximum(colour / np.maximum(1.0 - free, _LEAST), 0.0).astype(np.float32)


def _field_xy(width_px: int, height_px: int, margin_px: int) -> Float32[np.ndarray, "height width 2"]:
    """Position in half diagonals from the middle of the frame; what lies beyond the frame takes the PSFs of its border."""
    rows, columns = np.indices((height_px + 2 * margin_px, width_px + 2 * margin_px)) + 0.5 - margin_px
    x, y = np.clip(columns, 0, width_px) - 0.5 * width_px, np.clip(rows, 0, height_px) - 0.5 * height_px
    return (np.stack([x, y], axis=2) / (0.5 * np.hypot(width_px, height_px))).astype(np.float32)


@dataclass(frozen=True)
class _Densely(LaplacianSpreadlets):
    """The same renderer with all taps of the same kernels."""

    def sum_bank_kernels(self, values: np.ndarray, coc_px: np.ndarray, place: Place, densely: bool = True) -> np.ndarray:  # noqa: ARG002
        return super().sum_bank_kernels(values, coc_px, place, densely=True)


class BlurMethods:
    """Tables of one bank; they are filled when a method first meets a kernel and kept."""

    def __init__(self, bank: PsfBank, sparsification: Sparsification = UNRELAXED, threads: int = 0) -> None:
        self.bank, self.threads = bank, threads
        self._sparse = LaplacianSpreadlets(bank, threads=threads, sparsification=sparsification)
        self._dense = _Densely(bank, threads=threads)
        self._taps = BankTables(bank, None)

    def ours(self, layer: GlobalLayer, margin_px: int) -> Light:
        """Splat spreadlets."""
        return _inside(self._sparse.sum_bank_kernels(layer.values, layer.coc_px, layer.place), margin_px)

    def splat(self, layer: GlobalLayer, margin_px: int) -> Light:
        """Splat all taps of the bank's kernels."""
        return _inside(self._dense.sum_bank_kernels(layer.values, layer.coc_px, layer.place), margin_px)

    def filter(self, layer: GlobalLayer, margin_px: int) -> Light:
        """Gather at every pixel with its own kernel; where the layer is empty, with that of its nearest pixel."""
        whole = layer if layer.is_opaque else _continued(layer)
        coc_px, place = _inside(whole.coc_px, margin_px), _place_inside(whole.place, margin_px)
        codes = self._taps.codes(coc_px, np.zeros(coc_px.shape, np.bool_), place)
        used, cells = np.unique(codes, return_inverse=True)
        cells = cells.reshape(codes.shape).astype(np.int32)
        run = partial(gathered, cells=cells, margin_px=margin_px, threads=self.threads)
        if self.bank.channels == 1:
            return run(whole.values, taps=self._taps.points(used.tolist(), True, 0))
        light = self.bank.throughput.astype(np.float32)[used // 2 // self._taps.angles][cells]
        pairs = [np.ascontiguousarray(whole.values[..., [c, 3]]) for c in range(3)]
        each = [run(pair, taps=self._taps.points(used.tolist(), True, c)) for c, pair in enumerate(pairs)]
        coverages = [both[..., 1] / light[..., c] for c, both in enumerate(each)]
        return np.stack([*(both[..., 0] for both in each), *coverages], axis=2)

    def points_over_taps(self) -> float:
        """Mean over the kernels that have been used and are not splatted densely anyway: points of the spreadlet per tap."""
        tables = self._sparse._bank_tables
        assert tables is not None
        pairs = {
            code // 2 // tables.angles: len(found.points)
            for (code, dense), found in tables._kept.items()
            if not dense and code % 2 == 0 and not tables.is_dense(code)
        }
        shares = [count / np.count_nonzero(self.bank.kernels[cell].any(axis=2)) for cell, count in pairs.items()]
        return float(np.mean(shares)) if shares else 1.0

    def by_name(self) -> Mapping[str, Callable[[GlobalLayer, int], Light]]:
        return {"ours": self.ours, "filter": self.filter, "splat": self.splat}

    def renderings(self, layers: Sequence[Layer], lens: Lens) -> Mapping[str, Callable[[], np.ndarray]]:
        """Pictures with the slices and the hidden background of mrbokeh.layering.layering, by points and by taps."""
        return {
            "ours": lambda: self._sparse.render(layers, lens).rgb,
            "splat": lambda: self._dense.render(layers, lens).rgb,
        }

    def reconstructions(self, samples: LightFieldSamples, lens: Lens) -> Mapping[str, Callable[[], np.ndarray]]:
        """Pictures from noisy samples (Section 6.2), by points and by taps."""
        return {
            "ours": lambda: self._sparse.reconstruct(samples, lens).rgb,
            "splat": lambda: self._dense.reconstruct(samples, lens).rgb,
        }


def _inside(plane: np.ndarray, margin_px: int) -> np.ndarray:
    part = slice(margin_px, -margin_px or None)
    return plane[part, part]


def _place_inside(place: Place, margin_px: int) -> Place:
    planes = (place.motion_px, place.field_xy, place.depth_m)
    return Place(*(None if plane is None else _inside(plane, margin_px) for plane in planes))


def _continued(layer: GlobalLayer) -> GlobalLayer:
    """Continue what decides on the kernels from the nearest covered pixel."""
    covered: Bool[np.ndarray, "height width"] = layer.values[..., 3] > 0
    if not covered.any():
        return layer
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    planes = (layer.place.motion_px, layer.place.field_xy, layer.place.depth_m)
    place = Place(*(None if plane is None else plane[rows, columns] for plane in planes))
    return replace(layer, coc_px=layer.coc_px[rows, columns], place=place)


def _simple(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return SimpleLens(diameter_px=COC_SHARE * width_px, counts=(100 * finer,))


def _combined(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return Combined(COC_SHARE * width_px, MOTION_SHARE * width_px, cells=400 * finer)


def _physical(lens: Lens, width_px: int, finer: int) -> PsfModel:
    return PhysicalLens(
        biconvex_lens(lens.focal_length_mm, BICONVEX_F_NUMBER),
        focus_distance_m=lens.focus_distance_m,
        sensor_mm=(lens.sensor_width_mm, 0.625 * lens.sensor_width_mm),
        image_width_px=width_px,
        nearest_m=NEAREST_M,
        farthest_m=FARTHEST_M,
        counts=(60 * round(finer**0.5), 60 * round(finer**0.5)),
    )


def _volume(lens: Lens, width_px: int, finer: int) -> PsfModel:
    size_px = 2 * round(0.5 * _WINDOW_SHARE * width_px) + 1
    return Volume(focal_px=lens.focal_px(width_px), farthest_m=FARTHEST_M, size_px=size_px, counts=(60 * finer,))


def _stylized(lens: Lens, width_px: int, finer: int) -> PsfModel:  # noqa: ARG001
    return Stylized(star(), diameter_px=COC_SHARE * width_px, counts=(60 * finer,))


MODELS: Mapping[str, Callable[[Lens, int, int], PsfModel]] = {
    "simple": _simple,
    "combined": _combined,
    "physical": _physical,
    "volume": _volume,
    "stylized": _stylized,
}


def bank_of(model: str, folder: Path, lens: Lens, width_px: int, *, finer: bool = False) -> PsfBank:
    """Return a bank, built in FOLDER unless it is there. finer: with four times the steps of the grid in all, to stand for exact kernels.

    Raises InputError where the folder holds another bank.
    """
    made, rays = MODELS[model](lens, width_px, _FINER if finer else 1), _RAYS.get(model, 0)
    head = bank_head(made, rays, _SEED)
    is_there = (folder / HEAD).is_file() and read_head(folder) == head and not missing_cells(folder, head)
    return without_dust(read_bank(folder) if is_there else build_bank(made, folder, rays, _SEED))


def without_dust(bank: PsfBank) -> PsfBank:
    """Kernels without what is less than a millionth of their peak: rounding errors, but each would cost a splat."""
    cleaned = []
    for kernel in bank.kernels:
        kept = np.where(kernel.max(axis=2, keepdims=True) > _DUST * kernel.max(), kernel, 0.0).astype(np.float64)
        cleaned.append((kept * (kernel.sum(axis=(0, 1), dtype=np.float64) / kept.sum(axis=(0, 1)))).astype(np.float32))
    return replace(bank, kernels=tuple(cleaned))


def star(size_px: int = 128) -> Float32[np.ndarray, "size size 3"]:
    """Return the picture of the stylised PSF: a five-pointed star in a ring."""
    place: Float64[np.ndarray, "2 size size"] = (np.indices((size_px, size_px)) + 0.5) / size_px * 2.0 - 1.0
    radius, angle = np.hypot(*place), np.arctan2(place[1], -place[0])
    fifth = np.abs((angle * 5.0 / (2.0 * np.pi)) % 1.0 - 0.5) * 2.0  # 1 at the points, 0 between them
    inside = radius < 0.3 / (1.0 - 0.62 * fifth)
    ring = (radius > 0.88) & (radius < 0.98)
    return np.repeat((inside | ring)[..., None], 3, axis=2).astype(np.float32)
