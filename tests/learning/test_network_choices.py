"""Every design choice of Neural Bokeh as a setting (Mandl et al. 2024, Table 1), the other forms, and what cannot be combined."""

import importlib.util
import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from mrbokeh.system.errors import InputError
from training.fitting.settings import PRESETS, TrainSettings, better_settings, demo_settings
from training.networks.network import BlurNetwork, TileGrid, assemble
from training.networks.network_settings import NetworkSettings

ONE_TILE = NetworkSettings(tile_px=0, overlap_px=0)


def _pictures(height: int = 24, width: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(1, 3, height, width, generator=generator)
    return rgb, torch.rand(1, 1, height, width, generator=generator) * 14.0 - 7.0


def test_small_kernels_in_as_many_blocks() -> None:
    """CoC 7 px gives N = 3 either way. 3x3: two convolutions of radius 1 in each of 3 blocks reach 6 px, and have
    2 * 3 * 3 (9 + 1) = 180 parameters; growing ones 2 * 3 * (9 + 25 + 49 + 3) = 516 and 12 px."""
    growing, small = BlurNetwork(ONE_TILE, 7.0, 1.0), BlurNetwork(replace(ONE_TILE, kernels="3x3"), 7.0, 1.0)
    assert [len(each.tiles.blocks) for each in (growing, small)] == [3, 3]
    assert [sum(p.numel() for p in each.tiles.blocks.parameters()) for each in (growing, small)] == [516, 180]
    assert (growing.reach_px, small.reach_px) == (12, 6)
    assert [block.first.kernel_size for block in small.tiles.blocks] == [(3, 3)] * 3


@pytest.mark.parametrize("overlap_px", [0, 8])
@pytest.mark.parametrize("settings", [NetworkSettings(), demo_settings().network], ids=["published", "gated"])
def test_tile_outputs_are_what_the_picture_is_assembled_from(settings: NetworkSettings, overlap_px: int) -> None:
    """Of 40 x 24 px, tiles of 24 px: two with an overlap of 8 px; without, the second is shifted back to column 16 all the same."""
    grid = TileGrid(24, 40, 24, overlap_px)
    network = BlurNetwork(settings, 7.0, 3.0, grid)
    outputs = network.tile_outputs(*_pictures())
    assert outputs.shape == (1, 3 * len(grid), 24, 24) == (1, 6, 24, 24)
    assert torch.allclose(assemble(outputs, grid), network(*_pictures()), atol=1e-5)


def test_without_tiles_the_picture_is_the_only_tile() -> None:
    network = BlurNetwork(ONE_TILE, 7.0, 1.0)
    assert torch.equal(network.tile_outputs(*_pictures()), network(*_pictures()))


@pytest.mark.parametrize(("headroom", "expected"), [(1.0, 8.0 * (1 + math.tanh(2.0)) / 2), (1.5, 8.0), (2.0, 8.0)])
def test_headroom_lets_a_light_at_the_scale_through(headroom: float, expected: float) -> None:
    """The output that should be the radiance scale, 8, is 2 / headroom - 1 in [-1, 1]. With headroom 1.5 and 2 tanh reaches it at
    -artanh, 0.35 and 0; with 1 not at any number: at 2 it is (1 + tanh 2) / 2 = 98.2 % of the way."""
    network = BlurNetwork(replace(ONE_TILE, headroom=headroom), 7.0, 8.0)
    with torch.no_grad():
        network.tiles.c2.weight.zero_()
        network.tiles.c2.bias.fill_(2.0 if headroom == 1.0 else math.atanh(2.0 / headroom - 1.0))
    assert network(*_pictures()).unique().item() == pytest.approx(expected, rel=1e-5)


def test_black_and_the_scale_are_the_ends_of_the_inputs_range() -> None:
    """Without headroom 0 and 8 become -1 and 1; with a headroom of 2 the scale lies in the middle."""
    rgb = torch.tensor([0.0, 8.0, 8.0])[None, :, None, None]
    coc_px = torch.full((1, 1, 1, 1), 3.5)
    assert BlurNetwork(ONE_TILE, 7.0, 8.0).encode(rgb, coc_px).flatten().tolist() == [-1.0, 1.0, 1.0, 0.0]
    assert BlurNetwork(replace(ONE_TILE, headroom=2.0), 7.0, 8.0).encode(rgb, coc_px).flatten().tolist() == [-1.0, 0.0, 0.0, 0.0]


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
    with pytest.raises(InputError, match=message):
        NetworkSettings(**choices)


def test_presets() -> None:
    """As published; the demo, whose quality others rely on; and everything that we add."""
    assert set(PRESETS) == {"paper", "demo", "better"} and PRESETS["paper"]() == TrainSettings()
    demo, better = demo_settings().network, better_settings().network
    assert (demo.form, demo.field_position, demo.field_bases, demo.kernels_per_colour) == ("gated", False, 1, False)
    assert better == replace(demo, field_position=True, field_bases=4, kernels_per_colour=True)


def test_modules_of_all_forms_exist() -> None:
    for name in ("published_network", "gated_network", "baseline_networks"):
        assert importlib.util.find_spec(f"training.networks.{name}") is not None
