"""The networks: parameter counts by hand from Section 3.1 of Mandl et al. 2024, independence of tiles, the laws of light that the gated
form holds by construction, every design choice (Table 1) as a setting, and convolutions with a gradient of their own."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from mrbokeh.stacks.focal_stack_dataset import network_blocks
from tests.support.refusals import refused
from training.fitting.settings import PRESETS, TrainSettings, better_settings, demo_settings, settings_from_json, settings_to_json
from training.networks.gated_network import GatedTiles, bins_px, blocks_for_gates
from training.networks.kernels import LEAST_SIZE, _TransformedDepthwise, depthwise, disc_kernel, pointwise_product
from training.networks.network import BlurNetwork, TileGrid, assemble
from training.networks.network_settings import NetworkSettings
from training.networks.published_network import PublishedTiles

ONE_TILE = NetworkSettings(tile_px=0, overlap_px=0)
GATED = demo_settings().network


def _pictures(height: int = 24, width: int = 40, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(1, 3, height, width, generator=generator)
    return rgb, torch.rand(1, 1, height, width, generator=generator) * 14.0 - 7.0


def _count(module: torch.nn.Module) -> int:
    return sum(each.numel() for each in module.parameters())


def test_the_largest_kernel_covers_the_largest_circle_of_confusion() -> None:
    """N is the smallest number with 2N + 1 >= |CoC|; 81 px is the largest lens of the paper's Table 2. Gated kernels cover a pixel more:
    2N - 1 >= |CoC|, so that 5 px need N = 3, 5.1 px N = 4; without blur one size is left."""
    assert [network_blocks(each) for each in (0.3, 3.0, 3.1, 7.2, -13.0, 13.5, 81.0)] == [1, 1, 2, 4, 6, 7, 40]
    assert [blocks_for_gates(each) for each in (0.0, 1.0, -5.0, 5.1, 13.0)] == [1, 1, 3, 4, 7]


def test_published_form_has_the_parameters_and_the_reach_of_the_paper() -> None:
    """Per tile: C1 is 4 -> 3 (12 + 3), C2 is 3 + 3 -> 3 (18 + 3), and R_n has two convolutions of 3 kernels (2n+1)^2 with 3 biases.

    N = 4: 2 * 3 * (9 + 25 + 49 + 81) + 4 * 2 * 3 = 1008, and 36 more; a picture of 40 x 24 px has 2 * 1 tiles of 24 px with overlap 8.
    """
    assert _count(PublishedTiles(NetworkSettings(), blocks=4, largest_coc_px=9.0, tiles=1)) == 1008 + 36
    grid = TileGrid(24, 40, 24, 8)
    assert len(grid) == 2
    assert _count(BlurNetwork(NetworkSettings(), 9.0, 1.0, grid)) == 2 * (1008 + 36)
    # Two convolutions of radius n per block reach 2 (1 + ... + N) = N (N + 1) px; N = 3 gives 12.
    torch.manual_seed(0)  # some random weights around the blocks close every rectifier, and then nothing is seen
    network = BlurNetwork(replace(ONE_TILE, activation="identity", initialisation="default"), 7.0, 1.0)
    assert network.reach_px == 12
    assert [block.first.kernel_size for block in network.tiles.blocks] == [(3, 3), (5, 5), (7, 7)]
    for block in network.tiles.blocks:
        for parameter in block.parameters():
            torch.nn.init.constant_(parameter, 0.01)
    rgb = torch.zeros(1, 3, 41, 41, requires_grad=True)
    network(rgb, torch.zeros(1, 1, 41, 41))[0, 0, 20, 20].backward()
    touched = torch.nonzero(rgb.grad[0, 0])
    assert touched.amin(0).tolist() == [8, 8] and touched.amax(0).tolist() == [32, 32]
    # CoC 7 px gives N = 3 either way. 3x3: two convolutions of radius 1 in each of 3 blocks reach 6 px, and have
    # 2 * 3 * 3 (9 + 1) = 180 parameters; growing ones 2 * 3 * (9 + 25 + 49 + 3) = 516 and 12 px.
    growing, small = BlurNetwork(ONE_TILE, 7.0, 1.0), BlurNetwork(replace(ONE_TILE, kernels="3x3"), 7.0, 1.0)
    assert [len(each.tiles.blocks) for each in (growing, small)] == [3, 3]
    assert [sum(p.numel() for p in each.tiles.blocks.parameters()) for each in (growing, small)] == [516, 180]
    assert (growing.reach_px, small.reach_px) == (12, 6)
    assert [block.first.kernel_size for block in small.tiles.blocks] == [(3, 3)] * 3


@pytest.mark.parametrize(
    ("mixing", "expected"),
    [("none", 2 * 6 * 34 + 24), ("colour", 2 * 12 * 34 + 24), ("tile", 2 * 6 * 34 + 24 + 2 * (36 + 6))],
)
def test_width_and_mixing(mixing: str, expected: int) -> None:
    """Width 2 makes 6 features; N = 2 has kernels of 9 + 25 = 34. Depthwise: 6 of them per convolution; per colour: 6 * 2 (two inputs
    each); 2 convolutions and 2 * 2 * 6 = 24 biases. "tile" adds a 6 x 6 mixture with 6 biases per block."""
    tiles = PublishedTiles(replace(ONE_TILE, width=2, mixing=mixing), blocks=2, largest_coc_px=5.0, tiles=1)
    assert _count(tiles.blocks) == expected


@pytest.mark.parametrize("settings", [NetworkSettings(), GATED], ids=["published", "gated"])
def test_tiles_do_not_see_each_other(settings: NetworkSettings) -> None:
    """Without overlap, what changes in the left tile leaves the right one exactly as it was."""
    network = BlurNetwork(settings, 5.0, 1.0, TileGrid(16, 32, 16, 0))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    rgb, coc_px = _pictures(16, 32)
    changed = rgb.clone()
    changed[..., :16] += 0.5
    before, after = network(rgb, coc_px), network(changed, coc_px)
    assert torch.equal(before[..., 16:], after[..., 16:])
    assert not torch.allclose(before[..., :16], after[..., :16])


@pytest.mark.parametrize(
    "settings",
    [ONE_TILE, replace(ONE_TILE, width=2, mixing="tile"), GATED, replace(GATED, width=1, signed_coc=False, kernels_per_colour=True)],
)
def test_output_keeps_the_size_and_every_parameter_learns(settings: NetworkSettings) -> None:
    network = BlurNetwork(settings, 7.0, 1.0)
    optimizer = torch.optim.SGD(network.parameters(), 1e-3)
    for seed in range(2):  # the first step wakes up what starts at zero
        rgb, coc_px = _pictures(seed=seed)
        optimizer.zero_grad()
        result = network(rgb, coc_px)
        (result - rgb.roll(1, -1)).square().mean().backward()
        optimizer.step()
    assert result.shape == rgb.shape
    assert all(each.grad is not None and each.grad.abs().sum() > 0 for each in network.parameters())


def test_output_of_the_published_form_stays_in_its_range_and_near_is_not_far_without_signs() -> None:
    """tanh in [-1, 1] is [0, radiance scale] outside, whatever comes in."""
    network = BlurNetwork(ONE_TILE, 7.0, radiance_scale=8.0)
    rgb, coc_px = _pictures()
    result = network(rgb * 100.0, coc_px)
    assert result.min() >= 0.0 and result.max() <= 8.0
    rgb, coc_px = _pictures()
    unsigned, signed = BlurNetwork(ONE_TILE, 7.0, 1.0), BlurNetwork(replace(ONE_TILE, signed_coc=True), 7.0, 1.0)
    assert torch.equal(unsigned(rgb, coc_px), unsigned(rgb, -coc_px))
    assert not torch.allclose(signed(rgb, coc_px), signed(rgb, -coc_px))
    # Without headroom 0 and 8 become -1 and 1; with a headroom of 2 the scale lies in the middle.
    rgb = torch.tensor([0.0, 8.0, 8.0])[None, :, None, None]
    coc_px = torch.full((1, 1, 1, 1), 3.5)
    assert BlurNetwork(ONE_TILE, 7.0, 8.0).encode(rgb, coc_px).flatten().tolist() == [-1.0, 1.0, 1.0, 0.0]
    assert BlurNetwork(replace(ONE_TILE, headroom=2.0), 7.0, 8.0).encode(rgb, coc_px).flatten().tolist() == [-1.0, 0.0, 0.0, 0.0]
    network = BlurNetwork(ONE_TILE, 7.0, 1.0)
    assert torch.equal(network.tile_outputs(*_pictures()), network(*_pictures()))


@pytest.mark.parametrize("signed", [False, True])
def test_gates_share_every_pixel_out(signed: bool) -> None:
    """Hats sum to 1 everywhere; at its own peak a gate is 1. N = 3: peaks at 1 (0 when signed), 3 and 5 px, both signs."""
    knots, radii = bins_px(3, 1, signed)
    assert (knots, radii) == (([0.0, -3.0, 3.0, -5.0, 5.0], [1, 2, 2, 3, 3]) if signed else ([1.0, 3.0, 5.0], [1, 2, 3]))
    tiles = GatedTiles(replace(GATED, width=1, signed_coc=signed), blocks=3, largest_coc_px=5.0, tiles=1)
    coc = torch.linspace(-1, 1, 101).reshape(1, 1, 1, 1, 101)
    gates = tiles.gates(coc)[0, 0, :, 0]
    assert torch.allclose(gates.sum(0), torch.ones(101), atol=1e-5)
    assert gates[knots.index(5.0), -1] == pytest.approx(1.0)


@torch.no_grad()
def test_gated_form_keeps_light_and_covers_the_largest_circle_of_confusion() -> None:
    """All pixels at 5 px blur: the gate of n = 3 alone is open, so a light becomes its kernel of 7 px, 95 % a disc and 5 % flat, and
    keeps its energy."""
    network = BlurNetwork(GATED, largest_coc_px=5.0, radiance_scale=1.0)
    rgb = torch.zeros(1, 3, 21, 21)
    rgb[..., 10, 10] = 40.0
    result = network(rgb, torch.full((1, 1, 21, 21), 5.0))[0, 0, 7:14, 7:14] / 40.0
    expected = 0.95 * disc_kernel(7, 5.0) + 0.05 / 49.0
    assert torch.allclose(result, expected, atol=1e-5)
    assert result.sum() == pytest.approx(1.0, abs=1e-4)
    # The weights come from the circles of confusion alone; they are divided by their sum.
    network = BlurNetwork(GATED, 7.0, 3.0)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    rgb, coc_px = _pictures()
    assert torch.allclose(network(rgb * 1000.0, coc_px), network(rgb, coc_px) * 1000.0, rtol=1e-3, atol=1e-2)
    grey = torch.full_like(rgb, 0.18)
    assert torch.allclose(network(grey, coc_px), grey, atol=1e-4)
    # A picture wholly behind the focus uses half of the bins; computing all of them gives the same.
    network = BlurNetwork(GATED, 7.0, 1.0)
    torch.nn.init.normal_(network.tiles.hide_out.weight)
    rgb, coc_px = _pictures()
    few = network(rgb, coc_px.abs())
    network.tiles._used_bins = lambda _: list(range(len(network.tiles.knots)))
    assert torch.allclose(few, network(rgb, coc_px.abs()), atol=1e-6)


def test_settings_survive_json_and_presets_are_what_they_were() -> None:
    for settings in (TrainSettings(), demo_settings(1.5)):
        assert settings_from_json(settings_to_json(settings)) == settings
    refused("unknown settings \\['depth'\\]", settings_from_json, settings_to_json(TrainSettings()) | {"depth": 3})
    # Section 3: tiles of 200 px with 60 px overlap, three channels, tanh, unsigned circle of confusion, unweighted MSE.
    network = TrainSettings().network
    assert (network.form, network.tile_px, network.overlap_px, network.width, network.mixing) == ("published", 200, 60, 1, "none")
    assert (network.activation, network.signed_coc) == ("tanh", False)
    assert (TrainSettings().loss_weighting, TrainSettings().crop_px) == ("uniform", 0)
    refused("overlap_px < tile_px", NetworkSettings, tile_px=50, overlap_px=60)
    refused("either in minutes or in epochs", TrainSettings, minutes=1.0, epochs=3)
    # As published; the demo, whose quality others rely on; and everything that we add.
    assert set(PRESETS) == {"paper", "demo", "better"} and PRESETS["paper"]() == TrainSettings()
    demo, better = demo_settings().network, better_settings().network
    assert (demo.form, demo.field_position, demo.field_bases, demo.kernels_per_colour) == ("gated", False, 1, False)
    assert better == replace(demo, field_position=True, field_bases=4, kernels_per_colour=True)


@pytest.mark.parametrize("overlap_px", [0, 8])
@pytest.mark.parametrize("settings", [NetworkSettings(), demo_settings().network], ids=["published", "gated"])
def test_tile_outputs_are_what_the_picture_is_assembled_from(settings: NetworkSettings, overlap_px: int) -> None:
    """Of 40 x 24 px, tiles of 24 px: two with an overlap of 8 px; without, the second is shifted back to column 16 all the same."""
    grid = TileGrid(24, 40, 24, overlap_px)
    network = BlurNetwork(settings, 7.0, 3.0, grid)
    outputs = network.tile_outputs(*_pictures())
    assert outputs.shape == (1, 3 * len(grid), 24, 24) == (1, 6, 24, 24)
    assert torch.allclose(assemble(outputs, grid), network(*_pictures()), atol=1e-5)


@pytest.mark.parametrize(("headroom", "expected"), [(1.0, 8.0 * (1 + math.tanh(2.0)) / 2), (1.5, 8.0), (2.0, 8.0)])
def test_headroom_lets_a_light_at_the_scale_through(headroom: float, expected: float) -> None:
    """The output that should be the radiance scale, 8, is 2 / headroom - 1 in [-1, 1]. With headroom 1.5 and 2 tanh reaches it at
    -artanh, 0.35 and 0; with 1 not at any number: at 2 it is (1 + tanh 2) / 2 = 98.2 % of the way."""
    network = BlurNetwork(replace(ONE_TILE, headroom=headroom), 7.0, 8.0)
    with torch.no_grad():
        network.tiles.c2.weight.zero_()
        network.tiles.c2.bias.fill_(2.0 if headroom == 1.0 else math.atanh(2.0 / headroom - 1.0))
    assert network(*_pictures()).unique().item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("form", ["published", "gated", "deepfocus", "neural_camera"])
@pytest.mark.parametrize("further", [{}, {"field_position": True, "lens_inputs": True}], ids=["plain", "place and lens"])
def test_every_form_takes_the_same_inputs(form: Any, further: dict[str, Any]) -> None:
    bases = {"field_bases": 3} if form == "gated" and further else {}
    settings = NetworkSettings(form=form, tile_px=0, overlap_px=0, blocks=2, hidden=8, **further, **bases)
    network = BlurNetwork(settings, 5.0, 2.0, lens_ranges=((1.4, 8.0), (35.0, 35.0)))
    rgb, coc_px = _pictures()
    result = network(rgb, coc_px, torch.zeros(1, 2, 24, 40), torch.tensor([[2.0, 35.0]]))
    assert result.shape == rgb.shape and result.isfinite().all()
    assert isinstance(network.reach_px, int) and network.reach_px > 0 and not (network.linear_in_radiance and form != "gated")


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"form": "deepfocus"}, "has no tiles, got tile_px 200: set tile_px to 0"),
        ({"form": "gated", "kernels": "3x3"}, "variant of the published form"),
        ({"field_bases": 4, "field_position": True}, "only the gated form chooses between field_bases"),
        ({"form": "gated", "field_bases": 0}, "only the gated form chooses between field_bases, got 0"),
        ({"form": "gated", "field_bases": 4}, "set one of these two and field_bases above 1"),
        ({"form": "gated", "field_position": True}, "got field_bases 1 with field_position True"),
        ({"headroom": 0.5}, "at least 1 on the largest radiance"),
        ({"hidden": 0}, "of at least 1"),
    ],
)
def test_what_cannot_be_combined_is_refused(choices: dict[str, Any], message: str) -> None:
    refused(message, NetworkSettings, **choices)


def plain(maps: Tensor, kernels: Tensor, bias: Tensor | None, padding: int) -> Tensor:
    return functional.conv2d(maps, kernels, bias, padding=padding, groups=kernels.shape[0])


@pytest.mark.parametrize(("size", "padding"), [(LEAST_SIZE, LEAST_SIZE // 2), (15, 0), (21, 10)])
def test_value_and_gradients_are_those_of_pytorch(size: int, padding: int) -> None:
    """Two pictures of 70 channels (more than are transformed at once) and sides that are no round numbers; to the rounding of sums of
    some thousand products in single precision."""
    torch.manual_seed(size)
    maps, kernels = torch.rand(2, 70, 37, 43, requires_grad=True), torch.rand(70, 1, size, size, requires_grad=True)
    bias, weight = torch.rand(70, requires_grad=True), torch.rand(2, 70, 37 + 2 * padding - size + 1, 43 + 2 * padding - size + 1)
    results = []
    for convolution in (plain, depthwise):
        blurred = convolution(maps, kernels, bias, padding)
        results.append((blurred.detach(), *torch.autograd.grad((weight * blurred).sum(), (maps, kernels, bias))))
    for expected, got in zip(*results, strict=True):
        assert got.shape == expected.shape
        assert float((got - expected).abs().max()) < 2e-6 * float(expected.abs().max())


def test_no_light_no_gradient() -> None:
    """What Adam divides by its own size must not be noise: a channel without light, or without error, has a gradient of exactly 0."""
    maps, kernels = torch.rand(1, 2, 32, 32), torch.rand(2, 1, 11, 11, requires_grad=True)
    maps[:, 0] = 0.0
    assert (torch.autograd.grad(depthwise(maps, kernels, padding=5).square().sum(), kernels)[0][0] == 0).all()
    weight = torch.tensor([1.0, 0.0])[None, :, None, None]
    assert (torch.autograd.grad((weight * depthwise(maps + 1.0, kernels, padding=5)).sum(), kernels)[0][1] == 0).all()


@pytest.mark.parametrize(("size", "transformed"), [(LEAST_SIZE - 2, False), (LEAST_SIZE, True), (25, True)])
def test_wide_kernels_do_not_take_the_slow_gradient(size: int, transformed: bool) -> None:
    """PyTorch's own takes 20 to 60 times as long at 25 x 25; tests/bench/bench_network.py measures it."""
    maps, kernels = torch.rand(1, 4, 32, 32), torch.rand(4, 1, size, size, requires_grad=True)
    taken = depthwise(maps, kernels, padding=size // 2).grad_fn
    assert (type(taken).__name__ == "ConvolutionBackward0") != transformed


@pytest.mark.parametrize(("size", "padding", "batch"), [(5, 0, 2), (7, 3, 1), (15, 5, 3), (15, 0, 2)])
def test_convolutions_of_a_gpu_by_transforms_are_the_plain_ones(size: int, padding: int, batch: int) -> None:
    """In value and in both gradients, to rounding; on the processor, in double precision."""
    generator = torch.Generator().manual_seed(size)
    maps, kernels = (torch.randn(*shape, dtype=torch.float64, generator=generator) for shape in ((batch, 5, 40, 33), (5, 1, size, size)))
    results = []
    for convolve in (
        lambda x, k: torch.nn.functional.conv2d(x, k, padding=padding, groups=5),
        lambda x, k: _TransformedDepthwise.apply(x, k, padding),
    ):
        inputs = maps.clone().requires_grad_(), kernels.clone().requires_grad_()
        out = convolve(*inputs)
        results.append((out, *torch.autograd.grad(out.sin().sum(), inputs)))
    for plain, transformed in zip(*results, strict=True):
        assert torch.allclose(plain, transformed, atol=1e-10)


def test_grouped_pointwise_convolutions_are_products_of_matrices() -> None:
    convolution, maps = torch.nn.Conv2d(12, 18, 1, groups=3), torch.randn(2, 12, 7, 5)
    assert torch.allclose(pointwise_product(maps, convolution), convolution(maps), atol=1e-6)
