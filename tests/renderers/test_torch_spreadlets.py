"""Spreadlets by torch agree with the compiled ones; whole-number sums are the same bits however they are divided."""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.psf_models.build import Combined, build_bank
from mrbokeh.renderers.bank.tables import BankTables, Place
from mrbokeh.renderers.kernels.laplacian_integration import integrate as integrate_compiled
from mrbokeh.renderers.kernels.laplacian_tables import Points, by_rows, joined_points, taps_of
from mrbokeh.renderers.kernels.laplacian_tables import stands_out as stands_out_compiled
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, sparsify, whole_laplacian
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.renderers.spreadlets.sums import add_light, window_of
from mrbokeh.system.errors import InputError
from tests.support.spreadlet_references import integrate_reference, splat_reference

torch = pytest.importorskip("torch")

from mrbokeh.renderers.spreadlets.torch_spreadlets import DeviceLayer, TorchSpreadlets  # noqa: E402
from mrbokeh.renderers.spreadlets.torch_spreadlets._kernels import BankCells, stands_out, table_of  # noqa: E402
from mrbokeh.renderers.spreadlets.torch_spreadlets._sums import add_light_on, integrate, splat, splat_in_chunks  # noqa: E402
from tests.support.torch_device import DEVICE, KERNELS_ON, NAME, here, printed_with_kernels  # noqa: E402

SIZE = (48, 54)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small pictures gain nothing from threads, which wait for one another where tests run side by side."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def picture(seed: int = 0, size: tuple[int, int] = SIZE, lamp: float = 0.0) -> np.ndarray:
    """Patches of 6 px between 0.1 and 1 in three channels, coverage 1, but for a hole; perhaps a lamp."""
    patches = np.random.default_rng(seed).uniform(0.1, 1.0, (size[0] // 6, size[1] // 6, 4)).astype(np.float32)
    values = np.kron(patches, np.ones((6, 6, 1), np.float32))
    values[..., 3] = 1.0
    values[6:12, 30:42] = 0.0
    values[20, 10, :3] += np.float32(lamp)
    return np.ascontiguousarray(values)


def slope_px(low: float, high: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.broadcast_to(np.linspace(low, high, size[1], dtype=np.float32), size).copy()


@cache
def combined(counts: tuple[int, ...] | None = None) -> PsfBank:
    """COMBINED up to 20 px of defocus and 16 px of motion; its larger kernels are not on the fast track."""
    with TemporaryDirectory() as folder:
        return build_bank(Combined(20.0, 16.0, counts, cells=12), Path(folder) / "bank", progress=False)


def motion_px(size: tuple[int, int] = SIZE) -> np.ndarray:
    """Up to 16 px, in three directions that no axis of symmetry makes easy."""
    rows, columns = np.indices(size)
    angle = 0.4 + 1.9 * (columns * 3 // size[1])
    return (np.stack([np.cos(angle), np.sin(angle)], axis=2) * (16.0 * rows / size[0])[..., None]).astype(np.float32)


def layer_of(values: np.ndarray, coc_px: np.ndarray, motion: np.ndarray | None = None) -> DeviceLayer:
    return DeviceLayer(here(values), here(coc_px), None if motion is None else here(motion))


@pytest.mark.parametrize("size", [(3, 3), (4, 3), (3, 4), (21, 30), (30, 21), (16, 27)])
def test_integration_by_transforms_is_that_by_sweeps(size: tuple[int, int]) -> None:
    """Even and odd, and to rounding: the largest values are about 10."""
    source = np.random.default_rng(1).standard_normal((*size, 2))
    found = integrate(here(source).permute(2, 0, 1)).permute(1, 2, 0).cpu().numpy()
    np.testing.assert_allclose(found, integrate_compiled(source), atol=1e-12)
    np.testing.assert_allclose(found, integrate_reference(source), atol=1e-12)


def test_the_number_of_threads_changes_no_bit_of_the_integration() -> None:
    """Sums of whole numbers cannot change; this is the rest of what is long enough to be shared out."""
    source = here(np.random.default_rng(14).standard_normal((2, 150, 400)))
    one = integrate(source)
    torch.set_num_threads(2)
    assert torch.equal(integrate(source), one)


def some_points() -> Points:
    return joined_points([by_rows(taps_of(Aperture.disc().rasterize(size).kernel)) for size in (3.0, 7.5, 12.0)])


def test_sums_are_the_plain_ones_and_the_same_bits_in_chunks_of_any_size() -> None:
    """Two colours of weights, dark pixels; a unit is 2**-61 of the bound on sums, here about 6."""
    rng = np.random.default_rng(2)
    points, values, cells = some_points(), rng.uniform(size=(17, 19, 3)).astype(np.float32), rng.integers(-1, 3, (17, 19)).astype(np.int32)
    window = window_of(cells, points.reach_px, is_integrated=False)
    table = table_of(points, DEVICE)
    table = replace(table, weights=torch.cat([table.weights, -0.5 * table.weights], dim=1))
    light, where = here(values), here(cells)
    plain = np.zeros((window.height, window.width, 3))
    splat_reference(plain, values * np.float32([1.0, -0.5, 1.0]), cells, points, (window.top, window.left))
    found = splat(light, where, table, window, 1.0, (0, 1, 0))
    np.testing.assert_allclose(found.permute(1, 2, 0).cpu().numpy(), plain, atol=1e-14)
    sums = [torch.zeros((window.height, window.width, 3), dtype=torch.int64, device=DEVICE) for _ in range(3)]
    for each, at_once in zip(sums, (1, 1000, 1 << 20), strict=True):
        splat_in_chunks(each, light, where, table, window, 2.0**50, (0, 1, 0), at_once)
    assert torch.equal(sums[0], sums[1]) and torch.equal(sums[0], sums[2])


def test_no_sum_leaves_the_range_of_whole_numbers() -> None:
    """All pixels as bright as the brightest, with the kernel that is largest everywhere: the bound is reached and holds."""
    points = joined_points([by_rows(taps_of(np.ones((9, 9)) / 81.0))])
    cells = np.zeros((20, 20), np.int32)
    window = window_of(cells, points.reach_px, is_integrated=False)
    table = table_of(points, DEVICE)
    assert table.largest_sum == pytest.approx(1.0)
    for brightest in (1e-12, 1.0, 3e9):
        values = np.full((20, 20, 1), brightest, np.float32)
        found = splat(here(values), here(cells), table, window, float(values.max()))
        assert float(found.max()) == pytest.approx(brightest, rel=1e-6)


def bank_named(name: str) -> PsfBank:
    """All kinds of grids, axes and turns; only the way to a cell matters here."""
    dot = np.ones((1, 1, 1), np.float32)
    signed = PsfBank("signed", (Axis("diameter_px", -30.0, 30.0, 2.0),), (7,), (dot,) * 7, nested=False)
    depth = (Axis("depth_m", 0.5, np.inf, 1.0, in_dioptres=True), Axis("eccentricity", 0.0, 1.0, 1.0))
    field = PsfBank("field", depth, (3, 2), (dot,) * 6, turns="field", near_side_turned=True, nested=False)
    measured = (Axis("diameter_px", -30.0, 30.0, 1.0), Axis("field_x", -0.8, 0.8, 1.0), Axis("field_y", -0.6, 0.6, 1.0))
    frame = PsfBank("frame", measured, (5, 3, 2), (dot,) * 30, nested=False)
    return {"proportional": combined(), "nested": combined((9, 9)), "signed": signed, "field": field, "frame": frame}[name]


@pytest.mark.parametrize("name", ["proportional", "nested", "signed", "field", "frame"])
def test_each_pixel_takes_the_kernel_that_it_takes_on_the_cpu(name: str) -> None:
    bank, rng, size = bank_named(name), np.random.default_rng(3), (80, 90)
    coc_px, depth_m = rng.uniform(-33, 33, size).astype(np.float32), rng.uniform(0.3, 9.0, size).astype(np.float32)
    depth_m[0] = np.inf
    ways = rng.uniform(-14, 14, (2, *size, 2)).astype(np.float32)
    bright = rng.uniform(size=size) < 0.1
    tables = BankTables(bank, UNRELAXED)
    known = tables.codes(coc_px, bright, Place(ways[0], ways[1] / 14, depth_m))
    on_device = [here(each) for each in (bright, coc_px, ways[0], ways[1] / 14, depth_m)]
    np.testing.assert_array_equal(BankCells(tables, DEVICE).codes(*on_device).cpu().numpy(), known)


@pytest.mark.parametrize("size", [(48, 54), (6, 12)])
def test_the_same_pixels_stand_out(size: tuple[int, int]) -> None:
    values = np.random.default_rng(4).uniform(size=(*size, 4)).astype(np.float32) ** 12
    found, known = stands_out(here(values)).cpu().numpy(), stands_out_compiled(values)
    np.testing.assert_array_equal(found, known)
    assert 0 < known.sum() < known.size / 2


@pytest.mark.parametrize("integration", ["exact", None])
@pytest.mark.parametrize("name", ["disc", "pentagon", "ring"])
def test_sums_for_plain_apertures_are_those_of_the_cpu(name: str, integration: str | None) -> None:
    """Two sparse kernels and a whole Laplacian, integrated, or all their taps: the windows are the same, so is the far field."""
    if name == "ring":
        pytest.importorskip("shapely")
    aperture = Aperture.ring(0.5) if name == "ring" else Aperture.blades(5) if name == "pentagon" else Aperture.disc()
    kernels = [aperture.rasterize(size).kernel for size in (14.0, 18.0, 9.0)]
    makers = [taps_of] * 3 if integration is None else [sparsify, sparsify, whole_laplacian]
    points = joined_points([by_rows(make(kernel)) for make, kernel in zip(makers, kernels, strict=True)])
    values = picture(5, lamp=50.0)
    cells = np.where(values[..., 3] > 0, np.indices(SIZE)[1] * 3 // SIZE[1], -1).astype(np.int32)
    found, known = np.zeros_like(values), np.zeros_like(values)
    add_light(known, values, cells, points, integration, 1)
    add_light_on(NAME)(found, values, cells, points, integration, 1)
    # Taps are summed in single precision on the CPU, whose sums of 250 terms may be off by 250 * 2**-25.
    np.testing.assert_allclose(found, known, atol=1e-6 if integration else 1e-5)


def test_combined_and_coloured_banks_are_those_of_the_cpu() -> None:
    """Whole Laplacians and taps are exact on both: what differs is the rounding to single precision, of values up to 1000."""
    values, coc_px, motion = picture(6, lamp=1e5), slope_px(-20.0, 20.0), motion_px()
    known = LaplacianSpreadlets(combined(), sparsification=None).sum_bank_kernels(values, coc_px, Place(motion_px=motion))
    found = TorchSpreadlets(combined(), NAME, None).sum_kernels(layer_of(values, coc_px, motion)).cpu().numpy()
    np.testing.assert_allclose(found, known, rtol=3e-6, atol=3e-6)
    values, coc_px = picture(9), slope_px(2.0, 38.0)
    known = LaplacianSpreadlets(chromatic(), sparsification=None).sum_bank_kernels(values, coc_px, Place())
    found = TorchSpreadlets(chromatic(), NAME, None).sum_kernels(layer_of(values, coc_px)).cpu().numpy()
    assert found.shape == (*SIZE, 6), "a coverage for each colour"
    np.testing.assert_allclose(found, known, atol=3e-6)


def test_sparse_points_differ_by_their_far_field_only() -> None:
    """Sparse points reach a little farther than they should, up to a border that lies elsewhere."""
    values, coc_px, motion = picture(7), slope_px(-20.0, 20.0), motion_px()
    known = LaplacianSpreadlets(combined()).sum_bank_kernels(values, coc_px, Place(motion_px=motion))
    on_device = TorchSpreadlets(combined(), NAME)
    found = on_device.sum_kernels(layer_of(values, coc_px, motion))
    np.testing.assert_allclose(found.cpu().numpy(), known, atol=1e-4)
    rest = on_device.sum_kernels(layer_of(picture(8, lamp=30.0), -coc_px, motion[::-1].copy()))
    assert not torch.equal(rest, found)
    again = on_device.sum_kernels(layer_of(values, coc_px, motion))
    assert torch.equal(again, found), "what was asked in between changes no bit"


def chromatic() -> PsfBank:
    """Discs of three sizes, of which blue loses a fifth of its light."""

    def kernel(size: float) -> np.ndarray:
        colours = [Aperture.disc().rasterize(size * scale).kernel * light for scale, light in ((1.1, 1.0), (1.0, 0.9), (0.8, 0.8))]
        side = max(map(len, colours))
        return np.stack([np.pad(each, (side - len(each)) // 2) for each in colours], axis=2).astype(np.float32)

    return PsfBank("glass", (Axis("diameter_px", 0.0, 40.0, 1.0),), (2,), (kernel(10.0), kernel(30.0)), nested=False)


def two_layers() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """In front a board with a hole, half there; behind an opaque picture."""
    board = 0.5 * picture(11)
    board[:, 40:] = 0.0
    return [(board, slope_px(-14.0, -6.0), motion_px()), (picture(12), slope_px(3.0, 18.0), -motion_px())]


def test_two_layers_are_laid_over_one_another_and_an_even_one_stays_even_beyond_the_frame() -> None:
    cpu, on_device = LaplacianSpreadlets(combined(), sparsification=None), TorchSpreadlets(combined(), NAME, None)
    front, behind = (cpu.sum_bank_kernels(values, coc_px, Place(motion_px=motion)) for values, coc_px, motion in two_layers())
    found = on_device.picture([layer_of(*each) for each in two_layers()])
    np.testing.assert_allclose(found.cpu().numpy(), front + (1.0 - np.clip(front[..., 3:], 0, 1)) * behind, atol=3e-6)
    # By more than the kernels reach: as much light comes in as goes out. Without it the border darkens.
    values = np.ones((*SIZE, 4), np.float32) * np.float32([0.2, 0.5, 3.0, 1.0])
    layer = layer_of(values, np.full(SIZE, 12.0, np.float32), np.broadcast_to(np.float32([6.0, 8.0]), (*SIZE, 2)).copy())
    on_device = TorchSpreadlets(combined(), NAME, None)
    np.testing.assert_allclose(on_device.picture([layer], continued_px=24).cpu().numpy(), values, rtol=1e-5)
    assert float(on_device.picture([layer])[0, 0, 3]) < 0.5


def test_mistakes() -> None:
    bank, layer = combined(), layer_of(picture(), slope_px(1, 9), motion_px())
    for name in ("mps", "gpu", "cuda:99"):
        with pytest.raises(InputError, match=f"device.*{name}"):
            TorchSpreadlets(bank, name)
    on_device = TorchSpreadlets(bank, NAME, None)
    with pytest.raises(InputError, match="at least one layer"):
        on_device.picture([])
    with pytest.raises(InputError, match="needs motion"):
        on_device.sum_kernels(replace(layer, motion_px=None))
    for wrong in ({"coc_px": layer.coc_px * math.nan}, {"motion_px": layer.motion_px / 0.0}):
        with pytest.raises(InputError, match="finite circle of confusion"):
            on_device.sum_kernels(replace(layer, **wrong))
    with pytest.raises(InputError, match="light must be finite"):
        on_device.sum_kernels(replace(layer, rgba=layer.rgba * math.inf))
    with pytest.raises(InputError, match="'exact'"):
        add_light_on(NAME)(picture(), picture(), np.zeros(SIZE, np.int32), some_points(), "pyramid", 1)
    with pytest.raises(InputError, match="3 x 3"):
        integrate(torch.zeros(1, 2, 5))


@pytest.mark.parametrize("device", KERNELS_ON)
def test_the_kernel_for_gpus_gives_the_same_bits(device: str) -> None:
    """Two colours, dark pixels, more points than one program takes; on the processor interpreted."""
    pytest.importorskip("triton")
    code = """
import sys
from dataclasses import replace
import numpy as np
import torch
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.spreadlets.sums import window_of
from mrbokeh.renderers.kernels.laplacian_tables import by_rows, joined_points, taps_of
from mrbokeh.renderers.spreadlets.torch_spreadlets._kernels import table_of
from mrbokeh.renderers.spreadlets.torch_spreadlets._sums import splat_in_chunks
from mrbokeh.renderers.spreadlets.torch_spreadlets._splat_triton import _SEGMENT, splat_by_kernel

rng = np.random.default_rng(13)
points = joined_points([by_rows(taps_of(Aperture.disc().rasterize(size).kernel)) for size in (3.0, 14.0)])
values, cells = rng.uniform(size=(7, 15, 3)).astype(np.float32), rng.integers(-1, 2, (7, 15)).astype(np.int32)
window, device = window_of(cells, points.reach_px, is_integrated=False), torch.device(sys.argv[1])
one = table_of(points, device)
assert one.most > _SEGMENT
two = replace(one, weights=torch.cat([one.weights, -0.5 * one.weights], dim=1))
for table, colours in ((one, (0, 0, 0)), (two, (0, 1, 0))):
    sums = [torch.zeros((window.height, window.width, 3), dtype=torch.int64, device=device) for _ in range(2)]
    for each, splat in zip(sums, (splat_by_kernel, splat_in_chunks)):
        splat(each, torch.from_numpy(values).to(device), torch.from_numpy(cells).to(device), table, window, 2.0**50, colours)
    print(torch.equal(*sums), int(torch.count_nonzero(sums[0])) > 500)
"""
    assert printed_with_kernels(code, device).split() == ["True"] * 4


def test_the_kernel_compiles_for_gpus_with_atomic_whole_numbers() -> None:
    """For Hopper, without one: products may not be fused with the rounding, else the bits would be others."""
    pytest.importorskip("triton")
    code = """
from triton import compile
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from mrbokeh.renderers.spreadlets.torch_spreadlets._splat_triton import _splat
sizes = {"CHANNELS": 6, "COLUMNS": 3, "WIDE": 8, "PIXELS": 64, "SEGMENT": 128}
types = {"sums": "*i64", "values": "*fp32", "weights": "*fp64", **dict.fromkeys(("pixels", "width", "window_width", "corner"), "i32")}
signature = {name: "constexpr" if name in sizes else types.get(name, "*i32") for name in _splat.arg_names}
constants = {(_splat.arg_names.index(name),): size for name, size in sizes.items()}
target, options = GPUTarget("cuda", 90, 32), {"enable_fp_fusion": False}
print(compile(ASTSource(fn=_splat, signature=signature, constexprs=constants), target=target, options=options).asm["ptx"])
"""
    printed = printed_with_kernels(code)
    assert re.search(r"(red|atom)\.global\.gpu\.relaxed\.add\.u64", printed)
    assert "fma" not in printed
