"""Banks of every PSF model by every method, whichever side of the focus is blurred more: no light is lost, and discs are discs."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.psf_models.build import Combined, build_bank
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.simple_lens import SimpleLens, Stylized
from mrbokeh.psf_models.volume import Volume
from mrbokeh.renderers.scatter_reference import ScatterReference
from tests.support.renderer_banks import FEW, LENS, SIZE, depth_m, renderers, rings_bank, slanted

MODELS: dict[str, Any] = {
    "simple": lambda: SimpleLens(diameter_px=14.0, counts=(14,)),
    "signed": lambda: SimpleLens(replace(Aperture.disc(), spherical_aberration=0.4), diameter_px=14.0, counts=(14,)),
    "stylized": lambda: Stylized(np.ones((3, 2, 3), np.float32), diameter_px=14.0, counts=(7,)),
    "combined": lambda: Combined(diameter_px=14.0, motion_px=4.0, counts=(8, 4)),
    "physical": lambda: PhysicalLens(
        sensor_mm=(22.0, 14.7), focus_distance_m=0.5, image_width_px=96, nearest_m=0.3, farthest_m=2.0, counts=(4, 3)
    ),
    "volume": lambda: Volume(focal_px=64.0, size_px=15, farthest_m=2.0, counts=(4,)),
}
RAYS = 1 << 10
METHODS = ("scatter", "polygon", "low-rank", "laplacian")
WAYS = [
    *((name, method) for name in ("simple", "signed", "stylized", "measured") for method in METHODS),
    *((name, "laplacian") for name in ("combined", "physical", "volume")),
]
# Signed diameters of two lone pixels: the near one larger, the focus in front of everything, and behind it.
SIDES_PX = {"near larger": (-12.0, 4.0), "all behind the focus": (3.0, 11.0), "all before the focus": (-11.0, -3.0)}


@pytest.fixture(scope="module", name="of_model")
def fixture_of_model(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Banks, and their renderers with the tables that they make, by the name of the model."""
    folder: Path = tmp_path_factory.mktemp("banks")

    @cache
    def made(name: str) -> tuple[PsfBank, dict[str, Any]]:
        if name == "measured":
            return rings_bank(), renderers(rings_bank())
        model = MODELS[name]()
        bank = build_bank(model, folder / name, RAYS if model.default_rays else 0, progress=False)
        return bank, renderers(bank)

    return made


def lone_pixels(coc_px: tuple[float, float]) -> list[Layer]:
    """Two white pixels, far enough from each other and from the border for all their light."""
    rgb, alpha, depths_m = np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32), np.full(SIZE, np.inf, np.float32)
    for column, each in zip((30, 66), coc_px, strict=True):
        rgb[32, column], alpha[32, column], depths_m[32, column] = 1.0, 1.0, depth_m(each)[0, 0]
    return [Layer(rgb, alpha, depths_m)]


@pytest.mark.parametrize("sides", SIDES_PX)
@pytest.mark.parametrize(("name", "method"), WAYS)
def test_no_light_is_lost_on_either_side(name: str, method: str, sides: str, of_model: Any) -> None:
    """Each pixel gives what its kernel lets through: all of it, but in a medium, which absorbs blue, and at the rim of a real lens."""
    bank, by_name = of_model(name)
    seen = by_name[method].render(lone_pixels(SIDES_PX[sides]), LENS)
    light = seen.rgb.sum(axis=(0, 1), dtype=np.float64)
    least = 2.0 * bank.throughput.min(axis=0)
    assert (light >= least - 1e-3).all() and (light <= 2.0 + 1e-3).all(), light


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("ends_px", [(-12.0, 4.0), (3.0, 11.0), (-11.0, -3.0)])
def test_a_simple_bank_of_discs_is_the_disc_on_both_sides(method: str, ends_px: tuple[float, float], of_model: Any) -> None:
    scene = slanted(*ends_px)
    found = of_model("simple")[1][method].render(scene, LENS).rgb
    assert psnr(found, ScatterReference(FEW).render(scene, LENS).rgb, 2.0) > 30.0
