"""Light tracing by torch against the compiled loops: the same rays land in the same places, with the same light.

Where nothing else is said, tolerances are rounding: 1e-12 mm is some hundred roundings of a place some mm from the axis, and
kernels are float32.
"""

import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mrbokeh.commands.lens import app
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank_file import cell_path, read_bank
from mrbokeh.psf_models.base import PsfModel, sobol_blocks
from mrbokeh.psf_models.build import Combined, bank_head, build_bank
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.simple_lens import SimpleLens, Stylized
from mrbokeh.psf_models.volume import Volume
from mrbokeh.system.errors import InputError, MissingExtraError
from tests.psf_models.test_physical_lens import pair
from tests.support.command_line import printed_by

torch = pytest.importorskip("torch")

from mrbokeh.psf_models.torch_tracing._rays import summed  # noqa: E402
from tests.support.torch_device import NAME  # noqa: E402

DEVICES = [NAME]
RAYS = 1 << 13
Model = Callable[..., PsfModel]


def picture() -> np.ndarray:
    """Rows without light, at the border and within, and every other pixel at random."""
    light = np.random.default_rng(0).random((24, 37, 3)) ** 3
    light[:4], light[10] = 0.0, 0.0
    return light


def seidel() -> Aperture:
    """An opening whose sides of the focus differ, in three colours."""
    return Aperture(Aperture.heart().outlines, Aperture.heart().weights, spherical_aberration=0.5, axial_chromatic=(0.1, 0.0, -0.1))


physical = partial(PhysicalLens, pair(22.0), image_width_px=1000)
"""Whose rims cut the beam off the axis, of glass that disperses."""
MODELS: dict[str, tuple[Model, list[list[float]]]] = {
    "physical on the axis": (physical, [[1.0, 1.0], [0.0, 0.0]]),
    "physical, cut by rims": (physical, [[0.7, 0.8], [0.5, 0.9]]),
    "physical, biconvex": (PhysicalLens, [[1.0, 1.3], [0.2, 0.5]]),
    "volume": (Volume, [[1.0, 1.5]]),
    "volume, absorbing": (partial(Volume, albedo=(0.5, 0.9, 0.0), density_per_m=2.0, anisotropy=-0.3), [[1.0, 1.0]]),
    "volume, tentative collisions": (partial(Volume, majorant_per_m=2.7), [[2.0, 2.0]]),
    "simple": (SimpleLens, [[10.0, 40.0]]),
    "combined": (Combined, [[10.0, 40.0], [0.0, 30.0]]),
    "combined, in focus at rest": (Combined, [[0.0, 0.0], [0.0, 0.0]]),
    "stylized": (partial(Stylized, picture()), [[10.0, 40.0]]),
}
if find_spec("shapely"):
    MODELS["simple, signed colours"] = (partial(SimpleLens, seidel()), [[-9.0, 4.0]])
    MODELS["simple, ring"] = (partial(SimpleLens, Aperture.ring(0.4)), [[30.0, 30.0]])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", MODELS)
def test_kernels_are_those_of_the_compiled_loops(name: str, device: str) -> None:
    """To float32. Another seed gives another kernel (so that equality means something) where there is any blur."""
    model, box = MODELS[name][0], np.array(MODELS[name][1])
    expected = model().kernel(box, RAYS, 3)
    traced = model(device=device).kernel(box, RAYS, 3)
    assert traced.shape == expected.shape and traced.dtype == np.float32
    assert_allclose(traced, expected, rtol=2e-6, atol=1e-9 * float(expected.max()))
    if "focus" not in name:
        other = model().kernel(box, RAYS, 4)
        assert other.shape != expected.shape or np.abs(other - expected).sum() > 1e-3 * expected.sum()


@pytest.mark.parametrize("device", DEVICES)
def test_blocks_are_no_matter(device: str) -> None:
    """A GPU takes more points at once: they are the same points, and the light is the same."""
    rays, box = 1 << 13, np.array([[0.7, 0.8], [0.5, 0.9]])
    model = physical(device=device)
    (shares,) = sobol_blocks(5, rays, 2)
    whole, parts = model.landed(box, rays, [shares]), model.landed(box, rays, np.split(shares, 8))
    assert_allclose(parts, whole, rtol=0.0, atol=1e-12 * whole.max())
    few, many = (list(sobol_blocks(3, 300_000, 5, where)) for where in ("", "cuda"))
    assert len(few) == 5 and len(many) == 2
    assert_array_equal(np.concatenate(few), np.concatenate(many))


@pytest.mark.parametrize("device", DEVICES)
def test_sums_are_the_same_bits_in_any_order(device: str) -> None:
    rng = np.random.default_rng(1)
    bins, weights, order = rng.integers(0, 50, 20_000), rng.normal(size=20_000), rng.permutation(20_000)
    first, second = (
        summed(torch.from_numpy(bins[each]).to(device), torch.from_numpy(weights[each]).to(device), 50)
        for each in (np.arange(20_000), order)
    )
    assert_array_equal(first, second)
    assert_allclose(first, np.bincount(bins, weights, 50), atol=1e-11)


def test_a_half_built_bank_goes_on_on_a_device(tmp_path: Path) -> None:
    """The head of a bank does not name the device, so cells that are there are kept, and the rest come out the same."""
    model = partial(Combined, 9.0, 9.0, (5, 5))
    assert bank_head(model(), 4000, 1) == bank_head(model(device="cpu"), 4000, 1)
    whole = build_bank(model(), tmp_path / "bank", 4000, 1, progress=False, threads=1)
    for cell in range(2, len(whole.kernels)):
        cell_path(tmp_path / "bank", cell).unlink()
    kept = cell_path(tmp_path / "bank", 1).stat().st_mtime_ns
    resumed = build_bank(model(device="cpu"), tmp_path / "bank", 4000, 1, progress=False)
    assert cell_path(tmp_path / "bank", 1).stat().st_mtime_ns == kept and len(resumed.kernels) == len(whole.kernels)
    for first, second in zip(whole.kernels, resumed.kernels, strict=True):
        assert_allclose(second, first, atol=1e-8)


def test_the_command_takes_a_device(tmp_path: Path) -> None:
    for words in (["compiled"], ["torch", "--device", "cpu"]):
        printed_by(app, "psf", "volume", "--counts", "2", "--rays", "2048", "--out", tmp_path / words[0], *words[1:])
    for first, second in zip(read_bank(tmp_path / "compiled").kernels, read_bank(tmp_path / "torch").kernels, strict=True):
        assert_allclose(second, first, atol=1e-8)


def test_a_device_that_is_not_there_is_a_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for model, box in MODELS.values():
        for name, said in (("gpu", r"expected a device with double precision.*'gpu'"), ("cuda:99", "'cuda:99' is not there")):
            with pytest.raises(InputError, match=said):
                model(device=name).kernel(np.array(box), 1024, 0)
    with pytest.raises(InputError, match="closed form of combined is not traced"):
        build_bank(Combined(9.0, 9.0, (3, 3), device="cpu"), tmp_path / "bank", 0)
    assert not (tmp_path / "bank").exists()
    for module in [each for each in sys.modules if each.startswith("mrbokeh.psf_models.torch_tracing")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[train\]"):
        SimpleLens(device="cpu").kernel(np.array([[3.0, 4.0]]), 1024, 0)
