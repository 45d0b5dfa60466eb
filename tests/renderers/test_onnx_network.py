"""A network as a Renderer. The network here is the gated form as it starts, its kernels discs with a flat floor: a known blur.

So expected numbers are those of light itself (coverage, support, linearity); what a trained network adds is tested in test_train.py.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import pytest

import mrbokeh
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import lens_and_renderer, read_lens
from mrbokeh.renderers.onnx_network import METADATA_KEY, OnnxNetwork
from mrbokeh.system.errors import InputError
from tests.support.made_networks import coarser_model, jittered
from training.export.onnx_export import export_network, network_facts_of
from training.export.published_graph import BlockPlan, PublishedGraph
from training.fitting.run_folder import RunFacts, build_network
from training.fitting.settings import TrainSettings, demo_settings
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

LENS = Lens(35.0, 2.8, 0.5, 5.0)
SIZE = (64, 96)
LARGEST_COC_PX = 7.0
FACTS = RunFacts(LENS, SIZE[1], SIZE[0], LARGEST_COC_PX, 4.0, ("a/view_0",), (), None)


@cache
def _exported(settings: NetworkSettings, jitter: float) -> tuple[OnnxNetwork, bytes]:
    network = jittered(build_network(TrainSettings(network=settings), FACTS).eval(), jitter)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "lens.onnx"
        _write(network, settings, path)
        return OnnxNetwork(path, threads=1), path.read_bytes()


def _write(network: BlurNetwork, settings: NetworkSettings, path: Path) -> None:
    """As a graph of the fast export that computes all of it, written in a hundredth of the time. With tiles there is none."""
    if settings.tile_px:
        export_network(network, settings, FACTS, path)
        return
    whole = [BlockPlan()] * len(network.tiles.blocks) if settings.form == "published" else []
    model = PublishedGraph(network, whole).model() if whole else coarser_model(network)
    onnx.helper.set_model_props(model, {METADATA_KEY: network_facts_of(network, settings, FACTS).to_json()})
    onnx.save(model, path)


def exported(settings: NetworkSettings, jitter: float = 0.0) -> OnnxNetwork:
    return _exported(settings, jitter)[0]


@pytest.fixture
def network() -> OnnxNetwork:
    return exported(demo_settings().network)


@pytest.fixture
def published() -> OnnxNetwork:
    """The published form, which has a range (tanh), jittered so that black does not come out black."""
    return exported(NetworkSettings(tile_px=0, overlap_px=0), jitter=0.02)


def depth_for(coc_px: float) -> float:
    """The depth at which a point has this signed circle of confusion, from the lens equation in dioptres."""
    return 1.0 / (1.0 / LENS.focus_distance_m - coc_px / LENS.coc_px_per_dioptre(SIZE[1]))


def card(coc_px: float, rgb: tuple[float, float, float] = (0.5, 0.25, 1.0), half_px: int = 10) -> Layer:
    """A rectangle in the middle of an otherwise empty layer, at the depth with this blur."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[SIZE[0] // 2 - half_px : SIZE[0] // 2 + half_px, SIZE[1] // 2 - half_px : SIZE[1] // 2 + half_px] = 1.0
    colour = (alpha[..., None] * np.float32(rgb)).astype(np.float32)
    return Layer(colour, alpha, np.where(alpha > 0, depth_for(coc_px), np.inf).astype(np.float32))


def test_a_network_is_a_lens_that_keeps_its_own_blur(tmp_path: Path) -> None:
    """By its path, and read as a Lens, which another renderer may spread by the opening that it was trained with."""
    path = tmp_path / "lens.onnx"
    path.write_bytes(_exported(demo_settings().network, 0.0)[1])
    lens, sharp, depth_m = read_lens(path), np.full((*SIZE, 3), 0.5, np.float32), np.full(SIZE, depth_for(5.0), np.float32)
    sharp[::8] = 0.0
    assert lens.spread_by == path and isinstance(lens_and_renderer(path, None)[1], OnnxNetwork)
    np.testing.assert_array_equal(mrbokeh.render(sharp, depth_m, lens), mrbokeh.render(sharp, depth_m, path))
    plain = lens_and_renderer(path, "polygon")[1].render([opaque(sharp, depth_m)], LENS).rgb
    np.testing.assert_array_equal(mrbokeh.render(sharp, depth_m, lens, renderer="polygon"), plain)


@pytest.mark.parametrize("coc_px", [-6.5, -3.0, 0.5, 4.0, 6.9])
def test_light_and_coverage_are_kept_and_agree(network: OnnxNetwork, coc_px: float) -> None:
    """A card of one depth loses nothing but the corners of the square that the floor of an untrained kernel fills, where light is not
    allowed to reach: less than 1 %. Colour and coverage go through the same weights, so their ratio is the card's colour."""
    layer = card(coc_px)
    result = network.render([layer], LENS)
    assert network.lens.focal_length_mm == 35.0
    assert result.alpha.sum() == pytest.approx(layer.alpha.sum(), rel=0.01)
    assert result.rgb.sum() == pytest.approx(layer.rgb.sum(), rel=0.01)
    assert np.allclose(result.rgb, result.alpha[..., None] * np.float32((0.5, 0.25, 1.0)), atol=1e-4)
    assert result.alpha.min() >= 0.0 and result.alpha.max() <= 1.0


def test_blur_reaches_as_far_as_its_radius_and_front_covers_what_is_behind(network: OnnxNetwork) -> None:
    """6 px of blur reach 3 px, one more is left to the sensor: the edge between columns 57 and 58 shows from 4 px before to 4 px after."""
    row = network.render([card(6.0)], LENS).alpha[32]
    assert row[59] > 0.05 and row[56] < 0.95
    assert row[52] == pytest.approx(1.0, abs=1e-3)
    assert row[60] > 0.01 and (row[62:] == 0.0).all()
    behind = opaque(np.full((*SIZE, 3), 0.5, np.float32), np.full(SIZE, depth_for(5.0), np.float32))
    result = network.render([card(-4.0, rgb=(0.0, 0.0, 0.0)), behind], LENS)
    assert np.allclose(result.rgb[32, 48], 0.0, atol=1e-3)
    assert np.allclose(result.rgb[5, 5], 0.5, atol=1e-3)
    assert np.allclose(result.alpha, 1.0, atol=1e-4)


def test_what_is_in_focus_stays_wherever_that_is(network: OnnxNetwork) -> None:
    """Up to the floor of the untrained 3 px kernel: of 0.5 % of the light, 5 ninths leave through the corner pixel of the card."""
    layer = card(0.0)
    result = network.render([layer], LENS)
    assert np.allclose(result.rgb, layer.rgb, atol=0.003) and np.allclose(result.alpha, layer.alpha, atol=0.003)
    assert np.array_equal(result.depth_m, layer.depth_m)
    # Focused on the card, it stays sharp (up to the floor of the kernel, as above).
    layer = card(5.0)
    result = network.render([layer], LENS.focused_at(depth_for(5.0)))
    assert np.allclose(result.alpha, layer.alpha, atol=0.003)


def test_cropping_empty_layers_and_highlights_change_nothing_else(network: OnnxNetwork) -> None:
    empty = Layer(np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32), np.full(SIZE, np.inf, np.float32))
    assert np.array_equal(network.render([empty, card(3.0)], LENS).rgb, network.render([card(3.0)], LENS).rgb)
    # A card beside nothing and the whole picture by hand agree.
    layer = card(5.0)
    whole = network.blur(layer.rgb, np.full(SIZE, 5.0, np.float32))
    assert np.allclose(network.render([layer], LENS).rgb, whole, atol=1e-5)
    # The gated form is linear in radiance: a light of 4000, a thousand times its scale, is blurred like any other.
    rgb = np.zeros((*SIZE, 3), np.float32)
    rgb[32, 48] = 4000.0
    coc_px = np.full(SIZE, 6.0, np.float32)
    assert network.blur(rgb, coc_px).sum() == pytest.approx(3 * 4000.0, rel=1e-3)
    assert np.allclose(network.blur(rgb, coc_px), 1000.0 * network.blur(rgb / 1000.0, coc_px), rtol=1e-3, atol=1e-2)


def test_a_network_with_a_range_adds_highlights_and_leaves_empty_regions_empty(published: OnnxNetwork) -> None:
    """tanh ends at the radiance scale, 4: without the split nothing brighter could come out. What is black in the excess adds nothing."""
    rgb = np.full((*SIZE, 3), 0.2, np.float32)
    coc_px = np.full(SIZE, 2.0, np.float32)
    plain = published.blur(rgb, coc_px)
    lit = rgb.copy()
    lit[32, 48] = 400.0
    result = published.blur(lit, coc_px)
    assert not published.facts.linear_in_radiance
    assert result.max() > 40.0
    assert np.allclose(result[:8, :8], plain[:8, :8], atol=1e-3)
    assert np.array_equal(published.blur(rgb, coc_px), plain)
    result = published.render([card(4.0)], LENS)
    assert (result.alpha[:10] == 0).all() and (result.rgb[:10] == 0).all()


@pytest.mark.parametrize(("name", "value"), [("focal_length_mm", 50.0), ("f_number", 4.0), ("sensor_width_mm", 36.0)])
def test_another_lens_is_refused(network: OnnxNetwork, name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"trained for a lens with {name} .* train again"):
        network.render([card(1.0)], replace(LENS, **{name: value}))


def test_a_slice_of_a_breathing_lens_is_taken(network: OnnxNetwork) -> None:
    """Its registered slices state a sensor narrower by up to 3 %, and their f-numbers differ by 1.5 %: all blur that it saw in training."""
    network.render([card(1.0)], replace(LENS, sensor_width_mm=0.97 * LENS.sensor_width_mm, f_number=0.985 * LENS.f_number))


def test_the_trained_lens_may_be_held_upright(network: OnnxNetwork) -> None:
    """Two thirds of the sensor over two thirds of the pixels: the same circles of confusion."""
    long_mm = LENS.sensor_width_mm
    upright = replace(LENS, sensor_width_mm=long_mm * 2 / 3, sensor_height_mm=long_mm)
    whole = card(3.0)
    cut = Layer(whole.rgb[:, 16:80], whole.alpha[:, 16:80], whole.depth_m[:, 16:80])
    assert np.allclose(network.render([cut], upright).alpha, network.render([whole], LENS).alpha[:, 16:80], atol=1e-4)
    with pytest.raises(InputError, match="sensor_width_mm"):
        network.render([cut], replace(upright, sensor_height_mm=1.5 * long_mm))


def test_other_widths_work_while_the_blur_fits_and_more_is_refused_with_what_to_do(network: OnnxNetwork) -> None:
    """Twice the width doubles the circle of confusion: 3 px become 6, 5 become 10."""
    small = card(3.0)
    planes = (small.rgb, small.alpha, small.depth_m)
    large = [np.kron(each, np.ones((2, 2, 1) if each.ndim == 3 else (2, 2))).astype(np.float32) for each in planes]
    assert network.render([Layer(*large)], LENS).alpha.sum() == pytest.approx(4 * 400.0, rel=0.01)
    wide = replace(Layer(*large), depth_m=np.where(large[1] > 0, depth_for(5.0), np.inf).astype(np.float32))
    with pytest.raises(InputError, match="at a width of 192 px"):
        network.render([wide], LENS)
    # 9 px against 7: at 7/9 of 96 px, 74 px, it would fit.
    with pytest.raises(InputError, match=r"up to 7\.0 px.*9\.0 px at a width of 96 px.*at most 74 px wide, or train again"):
        network.render([card(9.0)], LENS)


@pytest.mark.slow
def test_tiles_belong_to_one_size() -> None:
    tiled = exported(replace(demo_settings().network, tile_px=40, overlap_px=10))
    assert tiled.render([card(3.0)], LENS).alpha.sum() == pytest.approx(400.0, rel=0.01)
    with pytest.raises(InputError, match="resize the picture, or train with tile_px 0"):
        tiled.blur(np.zeros((32, 32, 3), np.float32), np.zeros((32, 32), np.float32))
