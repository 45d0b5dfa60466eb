"""A lens is a description, a bank or a network: what it brings, and which renderer spreads its light."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mrbokeh
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.psf_models.build import Combined, build_bank
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.volume import Volume
from mrbokeh.renderers.bank.apertures import relative_error
from mrbokeh.renderers.bank.bank_lens import lens_of, opening_of
from mrbokeh.renderers.choose import lens_and_renderer, read_lens, spreads_light
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder

HEART = Lens(85.0, 1.4, float("inf"), 24.0, Aperture.heart(), sensor_height_mm=16.0)


@pytest.fixture(scope="module", name="folder")
def fixture_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """heart: says its lens; disc: does not; moving: blur of motion too."""
    folder: Path = tmp_path_factory.mktemp("lenses")
    bank_folder(folder / "heart", HEART)
    bank_folder(folder / "disc", Lens.default(), says_lens=False)
    build_bank(Combined(6.0, 3.0, (3, 2)), folder / "moving", progress=False)
    write_lens(folder / "heart.json", HEART)
    return folder


def test_a_bank_brings_the_lens_it_was_made_for_and_polygons_where_they_suit(folder: Path) -> None:
    lens, renderer = lens_and_renderer(folder / "heart", None)
    assert lens is not None and isinstance(renderer, PolygonDifferences) and renderer.bank is not None
    assert replace(lens, aperture=HEART.aperture, spread_by=None) == HEART
    for side_px in (30.0, -30.0):
        assert relative_error(lens.aperture.rasterize(side_px).kernel, HEART.aperture.rasterize(side_px).kernel) < 0.1
    assert lens_and_renderer(folder / "disc", None)[0] is None
    assert isinstance(lens_and_renderer(folder / "disc", "scatter")[1], ScatterReference)
    assert isinstance(lens_and_renderer(folder / "moving", None)[1], LaplacianSpreadlets)
    described, plain = lens_and_renderer(folder / "heart.json", None)
    assert described is not None and described.aperture.weights == HEART.aperture.weights and plain.bank is None  # type: ignore[attr-defined]
    by_file, of_bank = lens_and_renderer(folder / "heart.json", str(folder / "disc"))
    assert by_file is not None and by_file.facts == HEART.facts and of_bank.bank is not None  # type: ignore[attr-defined]


def test_banks_are_refused_where_nothing_takes_them(folder: Path) -> None:
    refused("is for --renderer polygon, low-rank, laplacian, scatter, got lrdm", lens_and_renderer, folder / "disc", "lrdm")
    refused("got network.onnx", lens_and_renderer, folder / "disc", "network.onnx")
    refused("--device is for", lens_and_renderer, folder / "disc", "low-rank", device="cpu")
    refused("holds no bank of PSFs", lens_and_renderer, folder, None)
    refused("holds no bank of PSFs", lens_and_renderer, None, str(folder))


def test_a_bank_by_polygons_goes_to_a_device(folder: Path) -> None:
    """The same light, to the rounding of impulses."""
    pytest.importorskip("torch")
    picture, depth_m = np.random.default_rng(2).uniform(0.0, 1.0, (40, 60, 3)).astype(np.float32), np.full((40, 60), 2.0, np.float32)
    found = []
    for device in ("", "cpu"):
        _, renderer = lens_and_renderer(folder / "disc", "polygon", device=device)
        found.append(renderer.render([opaque(picture, depth_m)], read_lens(folder / "disc").focused_at(9.0)).rgb)
    np.testing.assert_allclose(found[1], found[0], atol=2e-5)


def test_in_python_a_lens_that_was_read_keeps_its_kernels(folder: Path) -> None:
    """The same picture by its path, and as a Lens with what it does not say; another renderer may be named."""
    rng, lens = np.random.default_rng(1), read_lens(folder / "heart")
    picture, depth_m = rng.uniform(0.0, 1.0, (40, 60, 3)).astype(np.float32), np.full((40, 60), 2.0, np.float32)
    depth_m[:, 30:] = 9.0
    assert lens.spread_by == folder / "heart" and spreads_light(lens.spread_by) and not spreads_light(folder / "heart.json")
    by_path = mrbokeh.render(picture, depth_m, folder / "heart", focus=9.0)
    np.testing.assert_array_equal(mrbokeh.render(picture, depth_m, lens.focused_at(9.0)), by_path)
    assert np.abs(mrbokeh.render(picture, depth_m, lens.focused_at(9.0), renderer=ScatterReference()) - by_path).max() > 1e-4
    exact = mrbokeh.render(picture, depth_m, replace(HEART, focus_distance_m=9.0), renderer="scatter")
    assert np.abs(mrbokeh.render(picture, depth_m, lens, focus=9.0, renderer="scatter") - exact).max() < 0.05
    unsaid = mrbokeh.read_lens(folder / "disc")
    assert unsaid.facts == Lens.default().facts and unsaid.aperture.unit_radius == pytest.approx(1.0, abs=0.1)


def test_the_opening_of_banks_without_diameters() -> None:
    """A lens by its prescription shows the round opening of its stop; a medium has none, for which a disc stands."""
    model = PhysicalLens(focus_distance_m=1.0, image_width_px=400, nearest_m=0.6, farthest_m=1.0e4, counts=(4, 2))
    made = [model.kernel(box, 1 << 10, 0) for box in _boxes(model)]
    traced = PsfBank("physical", model.axes, model.counts, tuple(made), "field", settings=model.settings)
    lens = lens_of(traced)
    assert lens is not None and lens.focal_length_mm == pytest.approx(50.0, rel=0.02) and lens.focus_distance_m == 1.0
    assert 0.7 < opening_of(traced).unit_radius < 1.4
    scene, renderer = [opaque(np.ones((20, 400, 3), np.float32), np.full((20, 400), 2.0, np.float32))], LaplacianSpreadlets(traced)
    assert renderer.render(scene, lens).rgb.max() > 0.0
    refused("is focused at 1 m from the lens.*--focus 2", renderer.render, scene, lens.focused_at(2.0))
    small = [opaque(each.rgb[:, :40], each.depth_m[:, :40]) for each in scene]
    refused("for pictures 400 px wide, but this one is 40 px", renderer.render, small, lens)
    fog = Volume(focal_px=64.0, size_px=15, counts=(1,))
    scattering = PsfBank("volume", fog.axes, (1,), (np.ones((1, 1, 3), np.float32),), nested=False)
    assert lens_of(scattering) is None and opening_of(scattering).unit_radius == pytest.approx(1.0, abs=0.01)


def _boxes(model: PhysicalLens) -> np.ndarray:
    from mrbokeh.optics.psf_bank import grid_over, physical_boxes

    return physical_boxes(model.axes, grid_over(model.axes, model.counts, True, None))
