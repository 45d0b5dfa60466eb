"""Networks that are told f-number and focal length."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.system.errors import InputError
from tests.renderers.test_onnx_network import LARGEST_COC_PX, LENS, SIZE, card
from training.export.onnx_export import export_network, network_facts_of
from training.fitting.run_folder import RunFacts, build_network, facts_from_json
from training.fitting.settings import TrainSettings, demo_settings
from training.networks.network import BlurNetwork, LensScale
from training.networks.network_settings import NetworkSettings

FACTS = RunFacts(LENS, SIZE[1], SIZE[0], LARGEST_COC_PX, 4.0, ("a/view_0",), (), None, (1.4, 5.6), (35.0, 35.0))
SETTINGS = replace(demo_settings().network, field_position=True, lens_inputs=True, field_bases=3)


def _network(settings: NetworkSettings = SETTINGS, facts: RunFacts = FACTS) -> BlurNetwork:
    network = build_network(TrainSettings(network=settings), facts).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    return network


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> OnnxNetwork:
    path = tmp_path_factory.mktemp("lens") / "lens.onnx"
    export_network(_network(), SETTINGS, FACTS, path)
    return OnnxNetwork(path, threads=1)


def test_the_trained_range_goes_from_minus_1_to_1_in_stops() -> None:
    """f/1.4 to f/5.6 are four stops with f/2.8 in the middle; 24 to 96 mm two octaves with 48 mm in the middle."""
    scale = LensScale(((1.4, 5.6), (24.0, 96.0)))
    lenses = torch.tensor([[1.4, 24.0], [2.8, 48.0], [5.6, 96.0]])
    assert torch.allclose(scale(lenses), torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]]), atol=1e-6)


def test_what_hardly_varies_is_hardly_amplified() -> None:
    """A single f-number counts as a range of a factor 2: 0.5 % beside it is 2 * 0.005 / ln 2 = 0.0144."""
    scale = LensScale(((2.8, 2.8), (35.0, 35.0)))
    assert scale(torch.tensor([[2.8, 35.0]])).abs().max() < 1e-6
    assert scale(torch.tensor([[2.8 * 1.005, 35.0]]))[0, 0].item() == pytest.approx(0.0144, abs=1e-4)


def test_ranges_are_the_runs_not_the_weights() -> None:
    """Weights of a run load into a network that is built from its facts; without ranges in the facts those of its one lens hold."""
    network = _network()
    assert not [name for name in network.state_dict() if "lens_scale" in name]
    assert replace(FACTS, f_numbers=None, focal_lengths_mm=None).lens_ranges == ((2.8, 2.8), (35.0, 35.0))
    assert facts_from_json(FACTS.to_json(), "here").f_numbers == (1.4, 5.6)
    old = {name: value for name, value in FACTS.to_json().items() if name not in ("f_numbers", "focal_lengths_mm")}
    assert facts_from_json(old, "here").f_numbers is None
    with pytest.raises(InputError, match="needs the ranges of f-number"):
        BlurNetwork(SETTINGS, 7.0, 4.0)


@torch.no_grad()
@pytest.mark.parametrize("settings", [SETTINGS, NetworkSettings(tile_px=0, lens_inputs=True)], ids=["gated", "published"])
def test_the_lens_changes_the_result_and_must_be_given(settings: NetworkSettings) -> None:
    network = _network(settings)
    rgb, coc_px = torch.rand(2, 3, 20, 30, generator=torch.Generator().manual_seed(0)), torch.full((2, 1, 20, 30), 5.0)
    rgb[1] = rgb[0]
    place = torch.zeros(2, 2, 20, 30)
    open_and_closed = network(rgb, coc_px, place, torch.tensor([[1.4, 35.0], [5.6, 35.0]]))
    assert not torch.allclose(open_and_closed[0], open_and_closed[1], atol=1e-3)
    with pytest.raises(InputError, match="made with lens_inputs, so it needs lens"):
        network(rgb, coc_px, place)


@pytest.mark.slow
def test_lenses_within_the_trained_range_are_rendered_as_they_are(exported: OnnxNetwork) -> None:
    """The aperture of the lens given chooses the kernels: f/1.8 and f/4 of the same picture differ, and each is what PyTorch says."""
    rgb = np.random.default_rng(0).random((*SIZE, 3), dtype=np.float32)
    coc_px = np.full(SIZE, 5.0, np.float32)
    wide, narrow = exported.blur(rgb, coc_px, lens=(1.8, 35.0)), exported.blur(rgb, coc_px, lens=(4.0, 35.0))
    assert np.abs(wide - narrow).max() > 1e-3
    assert np.array_equal(exported.blur(rgb, coc_px), exported.blur(rgb, coc_px, lens=(LENS.f_number, LENS.focal_length_mm)))
    for f_number in (1.4, 5.6):
        lens = replace(LENS, f_number=f_number)
        assert exported.render([card(1.0)], lens).alpha.sum() == pytest.approx(400.0, rel=0.05)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (replace(LENS, f_number=16.0), "trained for a lens with f_number from 1.4 to 5.6, but came with 16"),
        (replace(LENS, focal_length_mm=50.0), "trained for a lens with focal_length_mm 35, but came with 50"),
        (replace(LENS, sensor_width_mm=36.0), "trained for a lens with sensor_width_mm 5, but came with 36"),
    ],
)
def test_lenses_outside_the_trained_range_are_refused(exported: OnnxNetwork, lens: Lens, message: str) -> None:
    with pytest.raises(InputError, match=message):
        exported.render([card(1.0)], lens)


def test_a_picture_with_a_lens_outside_the_range_is_refused_too(exported: OnnxNetwork) -> None:
    with pytest.raises(InputError, match=r"f_number from 1\.4 to 5\.6, but came with 1"):
        exported.blur(np.zeros((8, 8, 3), np.float32), np.zeros((8, 8), np.float32), lens=(1.0, 35.0))


def test_a_layer_keeps_its_true_place_when_it_is_cropped(exported: OnnxNetwork) -> None:
    """A card in a corner: only a window around it is computed, but with the kernels of that corner, as in the whole picture."""
    layer = card(5.0, half_px=4)
    moved = replace(layer, **{name: np.roll(getattr(layer, name), (-24, 36), axis=(0, 1)) for name in ("rgb", "alpha", "depth_m")})
    whole = exported.blur(moved.rgb, np.full(SIZE, 5.0, np.float32))
    result = exported.render([moved], LENS)
    reached = result.alpha > 0
    assert reached.any() and np.allclose(result.rgb[reached], whole[reached], atol=1e-5)
    elsewhere = exported.render([layer], LENS)
    assert np.abs(np.roll(elsewhere.rgb, (-24, 36), axis=(0, 1)) - result.rgb).max() > 1e-3


def test_a_network_of_one_lens_says_so(exported: OnnxNetwork) -> None:
    """Trained on one lens alone, with lens_inputs it takes that lens and no other; without them no range is written."""
    facts = replace(FACTS, f_numbers=None, focal_lengths_mm=None)
    of_one = network_facts_of(_network(facts=facts), SETTINGS, facts)
    assert (of_one.f_numbers, of_one.focal_lengths_mm) == ((2.8, 2.8), (35.0, 35.0)) and of_one.lens_inputs
    assert exported.facts.f_numbers == (1.4, 5.6)
    plain = replace(SETTINGS, lens_inputs=False)
    assert not network_facts_of(_network(plain), plain, FACTS).lens_inputs
