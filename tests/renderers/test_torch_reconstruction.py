"""Layered reconstruction by torch agrees with the compiled one in its pictures and partitions, whatever the settings."""

import importlib
import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.layering.light_field_samples import LightFieldSamples, read_samples
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from mrbokeh.system.errors import InputError, MissingExtraError
from tests.support.sampled_planes import LENS, fence_scene, sample_planes

torch = pytest.importorskip("torch")

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import AT_ONCE, TorchReconstruction  # noqa: E402
from tests.support.torch_device import DEVICE, KERNELS_ON, NAME, printed_with_kernels  # noqa: E402

SIZE_PX = 37
SHIPPED = Path(__file__).parents[1] / "data" / "samples"


@cache
def fence_samples(per_pixel: int = 4) -> LightFieldSamples:
    """No multiple of a tile: the last tiles are cut."""
    return sample_planes(fence_scene(SIZE_PX), SIZE_PX, per_pixel)


def middle(samples: LightFieldSamples, lens: Lens, size_px: int = 40) -> tuple[LightFieldSamples, Lens]:
    """The middle of the samples, no multiple of a tile either, and a lens whose sensor is as much smaller: as blurred as in the whole."""
    corner = np.array([(samples.width_px - size_px) // 2, (samples.height_px - size_px) // 2], np.float32)
    kept = ((samples.xy_px >= corner) & (samples.xy_px < corner + size_px)).all(axis=1)
    arrays = {name: getattr(samples, name)[kept] for name in ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")}
    arrays["xy_px"] = arrays["xy_px"] - corner
    part = size_px / samples.width_px
    return LightFieldSamples(size_px, size_px, **arrays), replace(lens, sensor_width_mm=part * lens.sensor_width_mm)


def by_torch(samples: LightFieldSamples, settings: Settings | None = None, seed: int = 0) -> np.ndarray:
    return TorchReconstruction(settings or Settings(), NAME, seed).reconstruct(samples, LENS).rgb


# Agreement with the compiled renderer. Both do the same in single precision, but for the order of sums and for the screen-space
# filter (running sums there, transforms in double precision here). A sample whose place rounds to the other side of a pixel
# could show; none does by more than 100 dB here, and 60 dB is what is promised.


@pytest.mark.parametrize(("name", "screen_filter"), [("fence_1", "windows"), ("whirl_1", "sheared"), ("fence_1", "direct")])
def test_shipped_samples_give_the_picture_of_the_compiled_renderer(name: str, screen_filter: str) -> None:
    samples, lens = middle(read_samples(SHIPPED / name / "samples.npz"), read_lens(SHIPPED / name / "lens.json"))
    settings = Settings(screen_filter=screen_filter)  # type: ignore[arg-type]
    known, known_counts = LayeredReconstruction(settings).reconstruct_values(samples, samples.rgb, lens)
    found, counts = TorchReconstruction(settings, NAME).reconstruct_values(samples, samples.rgb, samples.coc_px(lens), lens.aperture)
    assert counts == pytest.approx((known_counts.before, known_counts.after), abs=1e-9), "the same partitions"
    assert psnr(found, known) > 90.0
    assert np.abs(found - known).max() < 1e-3


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param({"merge": False}, marks=pytest.mark.slow),
        pytest.param({"sparse_statistics": False}, marks=pytest.mark.slow),
        {"merge": False, "sparse_statistics": False, "screen_filter": "sheared", "recursive_passes": 1, "enough": np.inf},
        {"motion": False},
        pytest.param({"tile_px": 16}, marks=pytest.mark.slow),
        {"tile_px": 64},
        pytest.param({"sigma_x_px": 1.0}, marks=pytest.mark.slow),
        {"sigma_x_px": 0.8, "screen_filter": "sheared", "recursive_passes": 3},
        {"bandwidth": 0.0},
        pytest.param({"part_tolerance": 0.0}, marks=pytest.mark.slow),
        {"part_tolerance": 0.1, "faint": 0.1},
        {"faint": 0.0, "merge_tolerance": 0.1},
        pytest.param({"pupil_parts": 1, "shutter_parts": 1}, marks=pytest.mark.slow),
        {"pupil_parts": 2, "shutter_parts": 4},
    ],
)
def test_every_setting_means_the_same(changed: dict) -> None:
    settings = replace(Settings(), **changed)
    known = LayeredReconstruction(settings, seed=5).reconstruct(fence_samples(), LENS).rgb
    found = by_torch(fence_samples(), settings, seed=5)
    assert psnr(found, known) > 90.0
    assert np.abs(found - known).max() < 1e-3


@pytest.mark.slow
def test_lamps_and_pixels_without_samples_are_the_same() -> None:
    """A lamp of 1e4, and a corner that nothing was sampled in; relative to the lamp single precision is good for 1e-6."""
    whole = fence_samples()
    kept = (whole.xy_px[:, 0] > 9.0) | (whole.xy_px[:, 1] > 9.0)
    arrays = {name: getattr(whole, name)[kept] for name in ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")}
    arrays["rgb"] = arrays["rgb"] + 1e4 * (np.abs(arrays["xy_px"] - 30.5) < 0.5).all(axis=1)[:, None].astype(np.float32)
    samples = LightFieldSamples(SIZE_PX, SIZE_PX, **arrays)
    known = LayeredReconstruction().reconstruct(samples, LENS)
    found = TorchReconstruction(device=NAME).reconstruct(samples, LENS)
    assert known.rgb.max() > 100.0
    assert np.abs(found.rgb - known.rgb).max() < 1e-6 * 1e4
    np.testing.assert_array_equal(found.depth_m, known.depth_m)


@pytest.mark.parametrize(("size_px", "count", "nearest_m", "farthest_m"), [
    ((1, 1), 1, 2.0, 2.0), ((20, 33), 700, np.inf, np.inf), ((40, 35), 120, 0.3, 3.0),
    pytest.param((70, 40), 500, 0.3, 3.0, marks=pytest.mark.slow),
])  # fmt: skip
@pytest.mark.slow
def test_few_samples_and_bare_background_are_the_same(size_px: tuple[int, int], count: int, nearest_m: float, farthest_m: float) -> None:
    """One sample, nothing but background, and less than a sample a pixel with depth and motion all by chance."""
    rng = np.random.default_rng(4)
    radius, angle = np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * np.pi, count)
    depth_m = rng.uniform(nearest_m, farthest_m, count) if np.isfinite(farthest_m) else np.full(count, np.inf)
    xy_px, uv = rng.uniform(size=(count, 2)) * size_px, np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    arrays = xy_px, uv, rng.uniform(size=count), rng.uniform(size=(count, 3)), depth_m, rng.normal(0.0, 20.0, (count, 2))
    samples = LightFieldSamples(*size_px, *(each.astype(np.float32) for each in arrays))
    known, found = LayeredReconstruction().reconstruct(samples, LENS), TorchReconstruction(device=NAME).reconstruct(samples, LENS)
    np.testing.assert_allclose(found.rgb, known.rgb, atol=2e-5)
    np.testing.assert_array_equal(found.depth_m, known.depth_m)


def test_samples_that_keep_their_pixels_are_the_same_and_what_is_not_there_refused() -> None:
    """As `render` takes those of layers."""
    samples = fence_samples()
    task = samples, samples.rgb, samples.coc_px(LENS), LENS.aperture
    known, _ = LayeredReconstruction()._reconstructed(*task, shared_out=False)
    found, _ = TorchReconstruction(device=NAME).reconstruct_values(*task, shared_out=False)
    assert psnr(found, known) > 90.0 > psnr(by_torch(samples), known)
    for device in ("tpu", "cuda:99", "mps"):
        with pytest.raises(InputError, match="device"):
            TorchReconstruction(device=device)
    with pytest.raises(InputError, match="windows, sheared, direct"):
        by_torch(fence_samples(), Settings(screen_filter="texture"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no NVIDIA GPU")
@pytest.mark.parametrize("screen_filter", ["windows", "sheared", "direct"])
def test_a_gpu_gives_the_same_picture(screen_filter: str) -> None:
    settings = Settings(screen_filter=screen_filter)  # type: ignore[arg-type]
    found = TorchReconstruction(settings, "cuda").reconstruct(fence_samples(), LENS)
    known = LayeredReconstruction(settings).reconstruct(fence_samples(), LENS)
    assert psnr(found.rgb, known.rgb) > 60.0
    np.testing.assert_array_equal(found.depth_m, known.depth_m)


@pytest.mark.slow
def test_how_much_is_done_at_a_time_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = by_torch(fence_samples())
    monkeypatch.setitem(AT_ONCE, DEVICE.type, (3000, 6000, 2000))
    np.testing.assert_allclose(by_torch(fence_samples()), whole, atol=2e-6)


@pytest.mark.parametrize("module", ["layered_reconstruction.torch_reconstruction", "spreadlets.torch_spreadlets"])
def test_without_torch_it_says_what_to_install(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, name := f"mrbokeh.renderers.{module}", raising=False)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[train\]"):
        importlib.import_module(name)


# Kernels for GPUs: interpreted, on the device where there is one, and compiled for one that is not there.


@pytest.mark.parametrize("device", KERNELS_ON)
def test_the_kernels_for_gpus_do_what_torch_does(device: str) -> None:
    pytest.importorskip("triton")
    code = """
import sys
import torch
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction import TorchReconstruction, _jobs, _partitions
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import splat_by_kernel
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import sweep_by_kernel
from tests.support.sampled_planes import LENS, fence_scene, sample_planes

torch.set_num_threads(1)
plain_sweep, plain_splat = _partitions.sweep_row_by_row, _jobs.splat_in_chunks
_partitions.has_triton = _jobs.has_triton = lambda: False  # what is patched here calls the kernels

def sweep(*task):
    print(all(torch.equal(a, b) for a, b in zip(sweep_by_kernel(*task), plain_sweep(*task))), "merged" if len(task[0].tile) > 20 else "few")
    return plain_sweep(*task)

def splat(planes, light, slope, facts, place, entry, block, side, pairs):
    some = torch.arange(0, len(entry), 7, device=entry.device)
    found, known = torch.zeros_like(planes), torch.zeros_like(planes)
    splat_by_kernel(found, light, slope, facts, place, entry[some], block[some], side)
    plain_splat(known, light, slope, facts, place, entry[some], block[some], side, pairs)
    print(torch.allclose(found, known, atol=1e-4), "light" if float(known.sum()) > 100 else "dark")
    plain_splat(planes, light, slope, facts, place, entry, block, side, pairs)

_partitions.sweep_row_by_row, _jobs.splat_in_chunks = sweep, splat
TorchReconstruction(device=sys.argv[1]).reconstruct(sample_planes(fence_scene(32), 32, 4), LENS)
"""
    words = printed_with_kernels(code, device).split()
    assert words[:2] == ["True", "merged"]
    assert len(words) >= 4 and set(words[2::2]) == {"True"} and "light" in words


def test_the_kernels_compile_for_gpus() -> None:
    """For Hopper, without one. Products are not fused with sums, so that a sample falls on the same side of a pixel's border."""
    pytest.importorskip("triton")
    code = """
from triton import compile
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import _splat
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import _sweep

def ptx(kernel, types, sizes, **options):
    signature = {name: "constexpr" if name in sizes else types.get(name, "*i64") for name in kernel.arg_names}
    constants = {(kernel.arg_names.index(name),): size for name, size in sizes.items()}
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants)
    return compile(source, target=GPUTarget("cuda", 90, 32), options={"enable_fp_fusion": False, **options}).asm["ptx"]

singles = dict.fromkeys(("planes", "geometry", "values", "slope"), "*fp32")
print(ptx(_splat, {**singles, "buckets": "i32", "side": "i32"}, {"CHANNELS": 3, "WIDE": 8, "SAMPLES": 64}))
print(ptx(_sweep, dict.fromkeys(("sums", "widths", "limits", "window", "chosen"), "*fp64"), {"BACK": 8}, num_warps=1))
"""
    printed = printed_with_kernels(code)
    assert re.search(r"(red|atom)\.global\.gpu\.relaxed\.add\.f32", printed)
    assert "fma." not in printed
