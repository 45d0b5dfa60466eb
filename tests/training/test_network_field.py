"""Networks that know the place and the lens: light stays light, bases begin apart, and blur that varies with both is learned."""

import math
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import field_positions
from mrbokeh.renderers.onnx_network import METADATA_KEY, OnnxNetwork
from mrbokeh.system.errors import InputError
from tests.renderers.test_onnx_network import LARGEST_COC_PX, LENS, card
from tests.renderers.test_onnx_network import SIZE as ITS_SIZE
from tests.support.made_networks import coarser_model, jittered
from tests.support.refusals import refused
from training.export.onnx_export import export_network, network_facts_of
from training.fitting.run_folder import RunFacts, build_network, facts_from_json
from training.fitting.settings import TrainSettings, demo_settings
from training.networks.kernels import disc_kernel, fresh_kernels
from training.networks.network import BlurNetwork, LensScale
from training.networks.network_settings import NetworkSettings

SIZE = (32, 56)
COC_PX = 7.0
CAT_EYE = replace(Aperture.disc(sides=48), cat_eye=1.0)
UNIFORM = replace(demo_settings().network, width=1, hidden=8)
VARYING = replace(UNIFORM, field_position=True, field_bases=4)


def _place(size: tuple[int, int] = SIZE) -> Tensor:
    return torch.from_numpy(field_positions(size).transpose(2, 0, 1).copy())[None]


def _jittered(settings: NetworkSettings) -> BlurNetwork:
    torch.manual_seed(2)  # by which networks begin, whatever ran before
    return jittered(BlurNetwork(settings, COC_PX, 4.0), 0.5)


def test_places_and_bases_begin_apart_and_their_mean_leans_nowhere() -> None:
    """A frame of 4 x 3 px has a half diagonal of 2.5 px: the centre of its first pixel lies 1.5 px left and 1 px up of the middle."""
    whole = field_positions((3, 4))
    assert whole[0, 0].tolist() == pytest.approx([-0.6, -0.4])
    assert whole[1, :, 1].tolist() == [0.0] * 4
    assert np.array_equal(field_positions((2, 2), frame_px=(3, 4), origin_px=(1, 2)), whole[1:, 2:])
    # Four kernels of one bin: none like another, together symmetric; a single one is the disc that it always was.
    # In focus (n = 1) only the floor of 0.5 % differs: of neighbouring sides by 0.005 * LEAN * 2 / sqrt(2) = 0.0035 in a corner.
    for n, knot in ((1, 0.0), (4, 7.0)):
        kernels = fresh_kernels(n, [knot], 4, "disc")
        assert kernels.shape == (4, 2 * n + 1, 2 * n + 1)
        assert min(float((kernels[i] - kernels[j]).abs().max()) for i in range(4) for j in range(i)) > 0.0035
        mean = kernels.mean(dim=0)
        assert torch.allclose(mean, mean.flip(0), atol=2e-3) and torch.allclose(mean, mean.flip(1), atol=2e-3)
    assert torch.allclose(fresh_kernels(4, [7.0], 1, "disc")[0] / 81, 0.95 * disc_kernel(9, 7.0) + 0.05 / 81)


@torch.no_grad()
@pytest.mark.parametrize("blur_px", [-7.0, -2.0, 0.0, 4.0, 7.0])
def test_light_of_every_place_is_kept(blur_px: float) -> None:
    """A bin's shares sum to 1 and so does every kernel: what the bins throw of a light, and of its coverage, is the light itself."""
    network = _jittered(VARYING)
    rgb, coc_px = torch.zeros(1, 3, *SIZE), torch.full((1, 1, *SIZE), blur_px)
    rgb[..., 12, 48] = torch.tensor([3.0, 2.0, 1.0])
    x = network.encode(rgb, coc_px, _place())[:, None]
    tiles = network.tiles
    gates = tiles.gates(x[:, :, 3:4])
    spread = tiles._spread(0.5 * (x[:, :, :3] + 1.0), gates, x[:, :, 4:], tiles._used_bins(gates)).sum(dim=2)
    assert spread[0, 0, :3].sum(dim=(1, 2)).tolist() == pytest.approx([3.0 / 4.0, 2.0 / 4.0, 1.0 / 4.0], rel=1e-4)
    assert torch.allclose(spread[0, 0, 3:, 8:-8, 8:-8].mean(), torch.tensor(1.0), atol=0.05)


@torch.no_grad()
def test_result_is_linear_in_radiance_and_all_bases_give_what_the_used_ones_do() -> None:
    """Two lights far apart give the sum of what each gives; and the same light elsewhere is blurred otherwise."""
    network, place = _jittered(VARYING), _place()
    coc_px = torch.full((1, 1, *SIZE), COC_PX)
    left, right = torch.zeros(1, 3, *SIZE), torch.zeros(1, 3, *SIZE)
    left[..., 16, 10], right[..., 16, 46] = 1.0, 1.0
    of_left, of_right = network(left, coc_px, place), network(right, coc_px, place)
    assert torch.allclose(network(1000.0 * left + right, coc_px, place), 1000.0 * of_left + of_right, rtol=1e-3, atol=1e-3)
    assert (of_left[..., 11:22, 5:16] - of_right[..., 11:22, 41:52]).abs().max() > 0.002
    of_left, of_right = (network(each, coc_px, place * 0.0) for each in (left, right))
    assert torch.allclose(of_left[..., 11:22, 5:16], of_right[..., 11:22, 41:52])
    network = _jittered(replace(VARYING, width=2, kernels_per_colour=True))
    rgb, coc_px = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(1)), torch.full((1, 1, *SIZE), 4.3)
    few = network(rgb, coc_px, _place())
    network.tiles._used_bins = lambda _: list(range(len(network.tiles.knots)))
    assert torch.allclose(few, network(rgb, coc_px, _place()), atol=1e-5)


def test_the_place_reaches_the_published_form_through_c1() -> None:
    """C1 has two inputs more: 6 -> 3. Place 0 everywhere and place as it is give different pictures."""
    network = BlurNetwork(NetworkSettings(tile_px=0, field_position=True), COC_PX, 4.0)
    assert network.tiles.c1.weight.shape == (3, 6, 1, 1)
    rgb, coc_px = torch.rand(1, 3, *SIZE), torch.zeros(1, 1, *SIZE)
    assert not torch.allclose(network(rgb, coc_px, _place()), network(rgb, coc_px, _place() * 0.0))
    refused("made with field_position, so it needs place", network, rgb, coc_px)


def _lights(seed: int) -> tuple[Tensor, Tensor]:
    """(lights on black, what a lens with cat-eyes makes of them): each light is its own rasterised outline, by the aperture's geometry."""
    rng, place = np.random.default_rng(seed), field_positions(SIZE)
    sharp, margin = np.zeros((3, *SIZE), np.float32), 8
    blurred = np.zeros((3, SIZE[0] + 2 * margin, SIZE[1] + 2 * margin), np.float32)
    for _ in range(20):
        y, x, colour = rng.integers(SIZE[0]), rng.integers(SIZE[1]), rng.uniform(0.5, 4.0, 3).astype(np.float32)
        kernel = CAT_EYE.seen(1, (float(place[y, x, 0]), float(place[y, x, 1]))).rasterize(COC_PX).kernel
        first = margin - kernel.shape[0] // 2
        sharp[:, y, x] += colour
        rows, columns = (slice(each + first, each + first + len(kernel)) for each in (y, x))
        blurred[:, rows, columns] += colour[:, None, None] * kernel.astype(np.float32)
    return torch.from_numpy(sharp), torch.from_numpy(blurred[:, margin:-margin, margin:-margin].copy())


def _trained_snr_db(settings: NetworkSettings, pairs: list[tuple[Tensor, Tensor]], steps: int = 60) -> float:
    """Signal over error on the last four pairs, which are not trained on; borders, where light is missing, do not count."""
    torch.manual_seed(0)
    network = BlurNetwork(settings, COC_PX, 4.0)
    optimizer, rng = torch.optim.Adam(network.parameters(), 0.03, betas=(0.9, 0.99)), np.random.default_rng(0)

    def error(chosen: list[int]) -> tuple[Tensor, Tensor]:
        rgb, target = (torch.stack(each) for each in zip(*(pairs[i] for i in chosen), strict=True))
        places = _place().expand(len(chosen), -1, -1, -1)
        result = network(rgb, torch.full((len(chosen), 1, *SIZE), COC_PX), places)
        return (result - target)[..., 5:-5, 5:-5].square().mean(), target[..., 5:-5, 5:-5].square().mean()

    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 0.015 * (1.0 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        error(rng.integers(len(pairs) - 4, size=2).tolist())[0].backward()
        optimizer.step()
    with torch.no_grad():
        noise, signal = error(list(range(len(pairs) - 4, len(pairs))))
    return 10.0 * math.log10(float(signal / noise))


@pytest.mark.slow
def test_a_network_that_knows_the_place_learns_cat_eyes() -> None:
    """Discs clipped by a rim that moves with the place: one kernel can only learn their mean (8.3 dB, against 13.4 with four)."""
    pairs = [_lights(seed) for seed in range(16)]
    without, with_place = _trained_snr_db(UNIFORM, pairs), _trained_snr_db(VARYING, pairs)
    assert with_place > without + 3.0


FACTS = RunFacts(LENS, ITS_SIZE[1], ITS_SIZE[0], LARGEST_COC_PX, 4.0, ("a/view_0",), (), None, (1.4, 5.6), (35.0, 35.0))
SETTINGS = replace(demo_settings().network, field_position=True, lens_inputs=True, field_bases=3)


def _network(settings: NetworkSettings = SETTINGS, facts: RunFacts = FACTS) -> BlurNetwork:
    return jittered(build_network(TrainSettings(network=settings), facts).eval(), 0.3)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> OnnxNetwork:
    path = tmp_path_factory.mktemp("lens") / "lens.onnx"
    export_network(_network(), SETTINGS, FACTS, path)
    return OnnxNetwork(path, threads=1)


@pytest.fixture(scope="module")
def fast(tmp_path_factory: pytest.TempPathFactory) -> OnnxNetwork:
    """The same as a graph of the fast export that computes all of it: written in a hundredth of the time."""
    path, network = tmp_path_factory.mktemp("lens") / "fast.onnx", _network()
    model = coarser_model(network)
    onnx.helper.set_model_props(model, {METADATA_KEY: network_facts_of(network, SETTINGS, FACTS).to_json()})
    onnx.save(model, path)
    return OnnxNetwork(path, threads=1)


def test_the_trained_range_goes_from_minus_1_to_1_in_stops_and_little_is_hardly_amplified() -> None:
    """f/1.4 to f/5.6 are four stops with f/2.8 in the middle; 24 to 96 mm two octaves with 48 mm in the middle."""
    scale = LensScale(((1.4, 5.6), (24.0, 96.0)))
    lenses = torch.tensor([[1.4, 24.0], [2.8, 48.0], [5.6, 96.0]])
    assert torch.allclose(scale(lenses), torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]]), atol=1e-6)
    # A single f-number counts as a range of a factor 2: 0.5 % beside it is 2 * 0.005 / ln 2 = 0.0144.
    scale = LensScale(((2.8, 2.8), (35.0, 35.0)))
    assert scale(torch.tensor([[2.8, 35.0]])).abs().max() < 1e-6
    assert scale(torch.tensor([[2.8 * 1.005, 35.0]]))[0, 0].item() == pytest.approx(0.0144, abs=1e-4)


@pytest.mark.slow
def test_ranges_are_the_runs_not_the_weights_and_one_lens_is_one(exported: OnnxNetwork) -> None:
    """Weights of a run load into a network that is built from its facts; without ranges in the facts those of its one lens hold."""
    network = _network()
    assert not [name for name in network.state_dict() if "lens_scale" in name]
    assert replace(FACTS, f_numbers=None, focal_lengths_mm=None).lens_ranges == ((2.8, 2.8), (35.0, 35.0))
    assert facts_from_json(FACTS.to_json(), "here").f_numbers == (1.4, 5.6)
    old = {name: value for name, value in FACTS.to_json().items() if name not in ("f_numbers", "focal_lengths_mm")}
    assert facts_from_json(old, "here").f_numbers is None
    refused("needs the ranges of f-number", BlurNetwork, SETTINGS, 7.0, 4.0)
    # Trained on one lens alone, with lens_inputs it takes that lens and no other; without them no range is written.
    facts = replace(FACTS, f_numbers=None, focal_lengths_mm=None)
    of_one = network_facts_of(_network(facts=facts), SETTINGS, facts)
    assert (of_one.f_numbers, of_one.focal_lengths_mm) == ((2.8, 2.8), (35.0, 35.0)) and of_one.lens_inputs
    assert exported.facts.f_numbers == (1.4, 5.6)
    plain = replace(SETTINGS, lens_inputs=False)
    assert not network_facts_of(_network(plain), plain, FACTS).lens_inputs


@torch.no_grad()
@pytest.mark.parametrize("settings", [SETTINGS, NetworkSettings(tile_px=0, lens_inputs=True)], ids=["gated", "published"])
def test_the_lens_changes_the_result_and_must_be_given(settings: NetworkSettings) -> None:
    network = _network(settings)
    rgb, coc_px = torch.rand(2, 3, 20, 30, generator=torch.Generator().manual_seed(0)), torch.full((2, 1, 20, 30), 5.0)
    rgb[1] = rgb[0]
    place = torch.zeros(2, 2, 20, 30)
    open_and_closed = network(rgb, coc_px, place, torch.tensor([[1.4, 35.0], [5.6, 35.0]]))
    assert not torch.allclose(open_and_closed[0], open_and_closed[1], atol=1e-3)
    refused("made with lens_inputs, so it needs lens", network, rgb, coc_px, place)


@pytest.mark.slow
def test_lenses_within_the_trained_range_are_rendered_as_they_are(exported: OnnxNetwork) -> None:
    """The aperture of the lens given chooses the kernels: f/1.8 and f/4 of the same picture differ, and each is what PyTorch says."""
    rgb = np.random.default_rng(0).random((*ITS_SIZE, 3), dtype=np.float32)
    coc_px = np.full(ITS_SIZE, 5.0, np.float32)
    wide, narrow = exported.blur(rgb, coc_px, lens=(1.8, 35.0)), exported.blur(rgb, coc_px, lens=(4.0, 35.0))
    assert np.abs(wide - narrow).max() > 1e-3
    assert np.array_equal(exported.blur(rgb, coc_px), exported.blur(rgb, coc_px, lens=(LENS.f_number, LENS.focal_length_mm)))
    for f_number in (1.4, 5.6):
        lens = replace(LENS, f_number=f_number)
        assert exported.render([card(1.0)], lens).alpha.sum() == pytest.approx(400.0, rel=0.05)


def test_lenses_outside_the_trained_range_are_refused(fast: OnnxNetwork) -> None:
    for lens, message in (
        (replace(LENS, f_number=16.0), "trained for a lens with f_number from 1.4 to 5.6, but came with 16"),
        (replace(LENS, focal_length_mm=50.0), "trained for a lens with focal_length_mm 35, but came with 50"),
        (replace(LENS, sensor_width_mm=36.0), "trained for a lens with sensor_width_mm 5, but came with 36"),
    ):
        refused(message, fast.render, [card(1.0)], lens)
    with pytest.raises(InputError, match=r"f_number from 1\.4 to 5\.6, but came with 1"):
        fast.blur(np.zeros((8, 8, 3), np.float32), np.zeros((8, 8), np.float32), lens=(1.0, 35.0))


def test_a_layer_keeps_its_true_place_when_it_is_cropped(fast: OnnxNetwork) -> None:
    """A card in a corner: only a window around it is computed, but with the kernels of that corner, as in the whole picture."""
    layer = card(5.0, half_px=4)
    moved = replace(layer, **{name: np.roll(getattr(layer, name), (-24, 36), axis=(0, 1)) for name in ("rgb", "alpha", "depth_m")})
    whole = fast.blur(moved.rgb, np.full(ITS_SIZE, 5.0, np.float32))
    result = fast.render([moved], LENS)
    reached = result.alpha > 0
    assert reached.any() and np.allclose(result.rgb[reached], whole[reached], atol=1e-5)
    elsewhere = fast.render([layer], LENS)
    assert np.abs(np.roll(elsewhere.rgb, (-24, 36), axis=(0, 1)) - result.rgb).max() > 1e-3
