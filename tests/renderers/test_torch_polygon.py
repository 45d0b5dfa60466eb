"""Polygonal differences by torch agree with the compiled loops; the kernels for GPUs agree with plain torch and with compiled layering."""

import importlib
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.system.errors import InputError
from tests.support import layering_twin

torch = pytest.importorskip("torch")

from mrbokeh.layering.torch_layering.slicing import Box, Slices  # noqa: E402
from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons, _highlights, _loops  # noqa: E402
from tests.support.torch_device import KERNELS_ON, NAME, here, printed_with_kernels  # noqa: E402

OCTAGON = Aperture.blades(8, np.pi / 8)
SIZE = (60, 90)
SINGLE, DOUBLE = 1e-5, 1e-6
"""What is allowed beside the strongest light: the rounding of impulses of 32 bits, and that of the picture in single precision."""


def texture(seed: int = 0) -> np.ndarray:
    """Noise between 0.05 and 1 in four channels, with a dark hole."""
    values = np.random.default_rng(seed).uniform(0.05, 1.0, (*SIZE, 4)).astype(np.float32)
    values[20:30, 40:50] = 0.0
    return values


def slope_px(low: float, high: float) -> np.ndarray:
    """Diameters that rise to the right, uneven by a pixel."""
    noise = np.random.default_rng(1).standard_normal(SIZE).astype(np.float32)
    return np.linspace(low, high, SIZE[1], dtype=np.float32) + noise


@pytest.mark.parametrize("aperture", [OCTAGON, Aperture.disc(), Aperture.blades(7)], ids=["octagon", "disc", "heptagon"])
@pytest.mark.parametrize(("precision", "allowed"), [("single", SINGLE), ("double", DOUBLE)])
def test_sums_on_a_device_are_the_compiled_ones(aperture: Aperture, precision: str, allowed: float) -> None:
    """From the focus through small kernels to large ones on both sides; all diameters occur, and 35 px reach beyond the border."""
    values, coc_px = texture(), slope_px(-30.0, 35.0)
    known = PolygonDifferences(precision="double").sum_kernels(values, coc_px, aperture)
    found = TorchPolygons(NAME, precision=precision).sum_kernels(here(values), here(coc_px), aperture).cpu().numpy()  # type: ignore[arg-type]
    np.testing.assert_allclose(found, known, atol=allowed)


def test_a_lamp_is_spread_by_the_kernel_of_the_aperture_itself() -> None:
    """It gives more than a tenth of the light around; the corners of its heptagon show, which rectified edges would blunt."""
    values, coc_px, aperture = texture(), slope_px(20.0, 25.0), Aperture.blades(7)
    values[30, 60, :3] = 300.0
    known = PolygonDifferences(precision="double").sum_kernels(values, coc_px, aperture)
    found = PolygonDifferences(device=NAME).sum_kernels(values, coc_px, aperture)
    np.testing.assert_allclose(found, known, atol=1e-5)
    blunted = PolygonDifferences(device=NAME, exact_highlights=False).sum_kernels(values, coc_px, aperture)
    assert np.abs(blunted - known).max() > 0.01


def test_what_is_negative_stays_so_and_what_is_not_does_not_become_so() -> None:
    values, coc_px = texture(), slope_px(10.0, 30.0)
    values[..., 0] -= 0.5
    found = TorchPolygons(NAME).sum_kernels(here(values), here(coc_px), OCTAGON).cpu().numpy()
    assert found[..., 0].min() < -0.01
    assert found[..., 1:].min() >= 0.0


def test_any_number_of_channels_goes_through_in_fours() -> None:
    values, coc_px = np.concatenate([texture(2), texture(3)[..., :2]], axis=2), slope_px(5.0, 20.0)
    known = PolygonDifferences(precision="double").sum_kernels(values, coc_px, OCTAGON)
    np.testing.assert_allclose(PolygonDifferences(device=NAME).sum_kernels(values, coc_px, OCTAGON), known, atol=DOUBLE)


def test_a_diameter_that_is_no_number_is_named() -> None:
    values, coc_px = texture(), slope_px(5.0, 20.0)
    coc_px[3, 3] = np.nan
    with pytest.raises(InputError, match="finite circle of confusion"):
        TorchPolygons(NAME).sum_kernels(here(values), here(coc_px), OCTAGON)


def test_polygons_are_rendered_on_a_device_when_asked() -> None:
    """The whole way of the command: a picture with depth, in slices."""
    rgb, depth_m, lens = post()
    known, found = (make_renderer("polygon", device=device).render([opaque(rgb, depth_m)], lens).rgb for device in ("", NAME))
    np.testing.assert_allclose(found, known, atol=2e-4)


def test_outshining_pixels_are_few() -> None:
    """In even noise none gives a twentieth of its tile, at the border of the picture neither; a lamp does."""
    values = here(texture()[:45, :83] + np.float32(0.5))
    assert not _highlights.outshining(values).any()
    values[44, 82] = 50.0
    assert torch.nonzero(_highlights.outshining(values)).tolist() == [[44, 82]]


def post() -> tuple[np.ndarray, np.ndarray, Lens]:
    """A red post in front of the focus, a slanted wall behind it, and a plate almost in focus."""
    height, width = 40, 56
    lens = Lens(100.0, 1.2, 0.5, 36.0, OCTAGON)
    coc_px = np.linspace(11.0, 13.0, width, dtype=np.float32) + np.zeros((height, 1), np.float32)
    coc_px[8:26, 20:24], coc_px[22:36, 35:50] = -9.0, 2.0
    rgb = np.random.default_rng(3).uniform(0.2, 0.6, (height, width, 3)).astype(np.float32)
    rgb[coc_px < 0] = (0.9, 0.1, 0.1)
    depth_m = 1.0 / (1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(width))
    return rgb, depth_m.astype(np.float32), lens


def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import the module that cuts with plain twins in place of kernels, which cannot be imported without triton."""
    package = "mrbokeh.layering.torch_layering"
    nothing = dict.fromkeys(("look", "seeds_behind", "fill", "unmix"))
    monkeypatch.setitem(sys.modules, f"{package}._edges_triton", SimpleNamespace(**nothing))
    twins = SimpleNamespace(extents=layering_twin.extents, claimed=layering_twin.claimed)
    monkeypatch.setitem(sys.modules, f"{package}._slices_triton", twins)
    monkeypatch.delitem(sys.modules, f"{package}.cutting", raising=False)
    found = importlib.import_module(f"{package}.cutting")
    monkeypatch.setitem(sys.modules, f"{package}.cutting", found)
    return found


@pytest.mark.parametrize("is_behind", [False, True], ids=["both sides of the focus", "all behind it"])
def test_slices_on_a_device_are_put_together_as_the_compiled_ones(monkeypatch: pytest.MonkeyPatch, is_behind: bool) -> None:
    """Order of slices, what hides across the focus, windows and claims; plain twins stand for all kernels, so that no GPU is needed."""
    cutting = without_kernels(monkeypatch)

    def split(layer: Any, _farthest_px: int) -> tuple[Any, Any]:
        front, behind = layering_twin.split_edges(layer.values, layer.coc_px)
        return cutting.Pixels(*front), cutting.Pixels(*behind)

    monkeypatch.setattr(cutting, "split_edges", split)
    rgb, depth_m, lens = post()
    lens = lens.focused_at(float(depth_m.min()) * 0.9) if is_behind else lens
    known = PolygonDifferences(layering=Layering(slices=6, sees_rims=False), precision="double").render([opaque(rgb, depth_m)], lens).rgb
    coc_px = np.asarray(lens.coc_px(depth_m, rgb.shape[1]), np.float32)
    found = TorchPolygons("cpu", precision="double").render(torch.from_numpy(rgb), torch.from_numpy(coc_px), OCTAGON, 6)
    np.testing.assert_allclose(found[..., :3].numpy(), known, atol=DOUBLE)


def test_a_picture_without_depth_somewhere_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    without_kernels(monkeypatch)
    rgb, depth_m, lens = post()
    coc_px = np.asarray(lens.coc_px(depth_m, rgb.shape[1]), np.float32)
    coc_px[4, 4] = np.nan
    with pytest.raises(InputError, match="finite circle of confusion"):
        TorchPolygons("cpu").render(torch.from_numpy(rgb), torch.from_numpy(coc_px), OCTAGON, 6)


def test_small_kernels_that_reach_too_far_are_refused() -> None:
    with pytest.raises(InputError, match="exact_below_px"):
        TorchPolygons(NAME, exact_below_px=40.0).sum_kernels(here(texture()), here(slope_px(5.0, 20.0)), OCTAGON)


def test_a_slice_by_itself_is_what_it_is_among_others() -> None:
    """Windows are cut to what the light of a slice reaches: nothing may be missing at their borders."""
    values, coc_px = here(texture()), here(slope_px(15.0, 25.0))
    renderer = TorchPolygons(NAME, precision="double")
    tables, lowest = renderer.tables_of(OCTAGON), torch.full((4,), -1.0, device=values.device)
    whole = Slices.single(values, coc_px, 30.0)
    box = Box(25, 30, 12, 20)
    cut = values.clone()
    cut[:25], cut[37:], cut[:, :30], cut[:, 50:] = 0.0, 0.0, 0.0, 0.0
    part = Slices(
        cut[None], coc_px[None], whole.shares, [whole.slices[0]._replace(box=box)], whole.order, 0, whole.step_px, whole.frame, 30.0
    )
    light, batch = _loops.sum_slices(part, None, tables, 1.0, lowest, torch.int64)
    seen = Box(*batch.host[0][6:10])
    known = renderer.sum_kernels(cut, coc_px, OCTAGON)
    assert (seen.rows, seen.columns) != SIZE
    inside = known[seen.top : seen.top + seen.rows, seen.left : seen.left + seen.columns]
    torch.testing.assert_close(light.reshape(seen.rows, seen.columns, 4), inside, atol=1e-6, rtol=0.0)
    assert float(known.sum()) == pytest.approx(float(inside.sum()), rel=1e-6)


KERNELS = """
import sys
import numpy as np
import torch
from mrbokeh.layering.torch_layering import _edges_triton as edges, _slices_triton as slices
from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons, _loops, _triton
from tests.renderers.test_torch_polygon import OCTAGON, post
from tests.support import layering_twin

device = sys.argv[1]
rgb, depth_m, lens = post()
coc_px = torch.from_numpy(np.asarray(lens.coc_px(depth_m, rgb.shape[1]), np.float32))
values = torch.cat([torch.from_numpy(rgb), torch.ones(*coc_px.shape, 1)], dim=2)
snapped, lit = edges.look(values.to(device), coc_px.to(device), 4.0, 1.0)
seeds, of_rims, pure_px = edges.seeds_behind(snapped, lit, 1.0, 3, 20)
behind, behind_px = edges.fill(values.to(device), seeds, pure_px, 2.0, 20)
front, front_px = edges.unmix(values.to(device), snapped, lit, of_rims, behind, 1.0)
known = layering_twin.split_edges(values, coc_px)
for found, wanted in zip((front, front_px, behind, behind_px), (*known[0], *known[1])):
    print(float((found.cpu() - wanted).abs().max()) < 1e-4)
rgb[5, 5] = 40.0
found = []
for loops in (_loops, _triton):
    TorchPolygons._loops = property(lambda self: loops)
    found.append(TorchPolygons(device).render(torch.from_numpy(rgb).to(device), coc_px.to(device), OCTAGON, 6).cpu())
print(float((found[0] - found[1]).abs().max()) < 1e-5)
"""


@pytest.mark.parametrize("device", KERNELS_ON)
def test_the_kernels_for_gpus_find_the_same_edges_and_the_same_light(device: str) -> None:
    """Against the compiled search for edges, and against plain torch for slices, sums and claims, with a lamp."""
    pytest.importorskip("triton")
    assert printed_with_kernels(KERNELS, device).split() == ["True"] * 5


COMPILED = """
import torch
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

class Hopper:
    get_current_target = staticmethod(lambda: GPUTarget("cuda", 90, 32))
    get_current_device = staticmethod(lambda: 0)
    get_current_stream = staticmethod(lambda device=0: 0)

driver.set_active(Hopper())
launch, names = JITFunction.run, set()
def compiled(self, *arguments, grid, warmup, **options):
    names.add(self.fn.__name__)
    return launch(self, *arguments, grid=grid, warmup=True, **options)
JITFunction.run = compiled

from mrbokeh.layering.torch_layering import _edges_triton as edges, _slices_triton as slices
from mrbokeh.layering.torch_layering.slicing import Box, Slices
from mrbokeh.renderers.polygon.torch_polygon import TorchPolygons, _triton
from tests.renderers.test_torch_polygon import OCTAGON

values, plane, places = torch.rand(40, 60, 4), torch.rand(40, 60), torch.zeros((3, 11), dtype=torch.int32)
mask, whole = torch.zeros(40, 60, dtype=torch.bool), torch.zeros(40, 60, dtype=torch.int32)
edges.look(values, plane, 4.0, 1.0)
edges.seeds_behind(plane, mask, 1.0, 3, 20)
edges.fill(values, whole, plane, 2.0, 20)
edges.unmix(values, plane, mask, whole, values, 1.0)
slices.extents(torch.rand(2, 40, 60), torch.rand(4, 40, 60), -3, 9, 1.5)
slices.claimed(torch.rand(100, 4), places, torch.zeros((3, 2), dtype=torch.int64), Box(3, 3, 20, 30))
_triton.survey(values, plane)
tables = TorchPolygons("cpu").tables_of(OCTAGON)
for kept in (None, plane):
    for numbers in (torch.int32, torch.int64):
        _triton.sum_slices(Slices.single(values, plane, 30.0), kept, tables, 1.0, torch.zeros(4), numbers)
print(*sorted(names))
"""


def test_all_kernels_compile_for_gpus() -> None:
    """For Hopper, without one: compiled instead of launched."""
    pytest.importorskip("triton")
    names = printed_with_kernels(COMPILED).split()
    assert {"_splat", "_sum_chains", "_sum_rows", "_sum_columns", "_spread_small", "_fill", "_unmix", "_claimed", "_survey"} <= set(names)
