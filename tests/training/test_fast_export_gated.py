"""The fast graph of the gated form against its slow twin in PyTorch: whole, with fewer bins, in windows; light is kept, and linearity."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support.made_networks import GATED, PARITY, SIZE, blurred, coarser_model, pictures, session_of, twin, untrained
from training.export import gated_groups
from training.export.fast_onnx import plans
from training.export.gated_graph import gated_model
from training.export.gated_groups import cost, groups_of, reach_px, shared
from training.export.gated_weights import fewer_knots, hats, thinned, weights_of, widened, with_knots
from training.networks.gated_network import bins_px
from training.networks.network import BlurNetwork

FORMS: dict[str, dict] = {
    "demo": {},
    "unsigned": {"width": 1, "signed_coc": False, "kernels_per_colour": True},
    "field": {"field_bases": 3, "field_position": True},
    "field and lens": {"field_bases": 2, "field_position": True, "lens_inputs": True, "kernels_per_colour": True, "width": 1},
    "tanh": {"activation": "tanh"},
}


@torch.no_grad()
def _refined(coarse: BlurNetwork, changes: dict) -> BlurNetwork:
    """Twice the bins; everything that is new lies on lines between what `coarse` has. Kernels are doubled, for only their shape counts."""
    fine, few = untrained(replace(GATED, **changes)), weights_of(coarse.tiles)
    tiles, shares = fine.tiles, hats(np.array(fine.tiles.knots), few.knots_px)
    between = {name: torch.from_numpy(np.tensordot(shares, getattr(few, name), axes=1)) for name in ("of_gates", "of_coverages", "logits")}
    tiles.hide_in.weight[:, :, 0, 0] = torch.cat([between["of_gates"], between["of_coverages"]]).T
    tiles.hide_in.bias.copy_(coarse.tiles.hide_in.bias)
    tiles.hide_out.weight[:, :, 0, 0] = between["logits"]
    tiles.hide_out.bias.copy_(torch.from_numpy(shares @ few.logits_bias))
    if tiles.mixing is not None:
        tiles.mixing.enter.load_state_dict(coarse.tiles.mixing.enter.state_dict())
        tiles.mixing.weight[0] = torch.from_numpy(np.tensordot(shares, few.shares, axes=1))
        tiles.mixing.bias[0] = torch.from_numpy(shares @ few.shares_bias)
    size = 2 * len(tiles.kernels) + 1
    stacked = np.stack([widened(each, size) for each in few.kernels])
    for n, kernels in enumerate(tiles.kernels, start=1):
        margin = (size - 2 * n - 1) // 2
        bins = [index for index, radius in enumerate(tiles.radii) if radius == n]
        mixed = np.tensordot(shares[bins], stacked, axes=1)[..., margin : size - margin, margin : size - margin]
        kernels[0] = 2.0 * torch.from_numpy(mixed).flatten(0, 1)
    return fine


@pytest.mark.parametrize("changes", FORMS.values(), ids=FORMS)
def test_the_gated_graph_at_full_resolution_is_the_network(changes: dict) -> None:
    """Nothing is factorised, so that it agrees like a plain export; the size is odd and no multiple of anything."""
    network = untrained(replace(GATED, **changes))
    got, expected = blurred(session_of(coarser_model(network)), pictures()), twin(network, pictures())
    assert np.abs(got - expected).max() < PARITY


@pytest.mark.parametrize(("factor", "spacing"), [(1, 0.0), (2, 0.0), (4, 0.0), (1, 0.4), (2, 0.4)])
def test_white_stays_white_and_a_light_keeps_its_energy(factor: int, spacing: float) -> None:
    """Everything at one blur: coverage is 1 all over, so that the light of one pixel reappears whole around it."""
    network = untrained(GATED)
    session, inputs = session_of(coarser_model(network, factor, spacing)), pictures((64, 64))
    inputs["coc_px"] = torch.full_like(inputs["coc_px"], 8.0)
    white = blurred(session, inputs | {"rgb": torch.ones_like(inputs["rgb"])})
    np.testing.assert_allclose(white, 1.0, atol=1e-5)
    light = torch.zeros_like(inputs["rgb"])
    light[:, :, 31, 30] = 100.0
    np.testing.assert_allclose(blurred(session, inputs | {"rgb": light}).sum(axis=(2, 3)), 100.0, rtol=1e-3)


def test_the_coarse_gated_graph_stays_linear_in_radiance() -> None:
    network = untrained(GATED)
    session, inputs = session_of(coarser_model(network, 2)), pictures()
    other = inputs["rgb"].flip(3)
    apart = [blurred(session, inputs | {"rgb": each}) for each in (inputs["rgb"], other)]
    together = blurred(session, inputs | {"rgb": 3.0 * inputs["rgb"] + other})
    np.testing.assert_allclose(together, 3.0 * apart[0] + apart[1], atol=1e-3)


def test_bins_without_pixels_are_not_run_and_not_missed(tmp_path: Path) -> None:
    """At one circle of confusion at most two neighbouring bins are used, so most convolutions do not appear in the profile."""
    network = untrained(GATED)
    counts = []
    for name, inputs in (("all", pictures()), ("one", pictures() | {"coc_px": torch.full((1, 1, *SIZE), -9.3)})):
        session = session_of(coarser_model(network), tmp_path / name)
        assert np.abs(blurred(session, inputs) - twin(network, inputs)).max() < PARITY
        events = json.loads(Path(session.end_profiling()).read_text())
        counts.append(sum(each["name"].endswith("kernel_time") and each["args"].get("op_name") == "Conv" for each in events))
    assert counts[0] == len(groups_of(weights_of(network.tiles), [1] * len(network.tiles.kernels)))
    assert counts[1] <= 2


@pytest.mark.parametrize("form", ["demo", "unsigned", "field"])
def test_fewer_bins_give_back_the_network_that_the_others_were_drawn_between(form: str) -> None:
    """Bins of width 1 lie at every other knot of width 2, so the squares that the fit makes small can be 0."""
    changes = {name: value for name, value in FORMS[form].items() if name != "width"}
    coarse = untrained(replace(GATED, **changes, width=1))
    knots_px, fine = weights_of(coarse.tiles).knots_px, weights_of(_refined(coarse, changes).tiles)
    assert len(fine.knots_px) == 2 * len(knots_px) - 1
    model = gated_model(coarse, with_knots(fine, knots_px), [1] * len(coarse.tiles.kernels))
    assert np.abs(blurred(session_of(model), pictures()) - twin(coarse, pictures())).max() < PARITY


def test_fewer_bins_lose_nothing_where_all_count_the_same() -> None:
    """Kernels on lines between knots and equal weights: a pixel between two knots is spread by the same mixture either way."""
    coarse = untrained(replace(GATED, width=1))
    fine = _refined(coarse, {})
    with torch.no_grad():
        for parameter in fine.tiles.hide_out.parameters():
            parameter.zero_()
    model = gated_model(fine, with_knots(weights_of(fine.tiles), weights_of(coarse.tiles).knots_px), [1] * len(fine.tiles.kernels))
    assert np.abs(blurred(session_of(model), pictures()) - twin(fine, pictures())).max() < PARITY


@pytest.mark.parametrize("signed", [True, False])
def test_knots_thin_out_with_diameter_and_fill_their_groups(signed: bool) -> None:
    """1 px apart up to 1 / 0.2 = 5 px, as before, that is 4 of them; then at d 0.2 d apart, that is the sum of 5 / d over d = 6 to 49,
    11.0: 15 on a side, for which there are 16, the next multiple of 4."""
    every = np.sort(bins_px(25, 2, signed)[0])
    few = fewer_knots(every, 0.2, 4)
    far = few[few > every[np.abs(every).argmin()]]
    assert len(far) == 16
    assert len(few) == (2 if signed else 1) * len(far) + 1
    np.testing.assert_allclose(far[:3], [2.0, 3.0, 4.0])
    np.testing.assert_allclose(few[[0, -1]], every[[0, -1]])
    gaps = np.diff(far)
    assert (gaps[1:] > gaps[:-1] - 1e-5).all()
    assert (gaps <= np.maximum(1.0, 0.2 * far[1:]) + 1e-5).all()
    np.testing.assert_array_equal(fewer_knots(every, 0.0, 4), every)


def test_thinned_weights_keep_every_sum_and_plans_go_from_cheap_to_dear() -> None:
    weights = weights_of(untrained(GATED, 49.0).tiles)
    few = thinned(weights, 0.2)
    assert len(few.knots_px) < 0.4 * len(weights.knots_px)
    np.testing.assert_allclose([kernel.sum() for kernel in few.kernels], 1.0, atol=1e-9)
    assert reach_px(few, [1] * 25) == reach_px(weights, [1] * 25) == 25
    network = untrained(GATED, 25.0)
    whole, found = weights_of(network.tiles), plans(network)
    costs = [cost(thinned(whole, plan.spacing), plan.factors) for plan in found]
    assert costs == sorted(costs) and found[0].bins < found[-1].bins
    assert any(plan.bins == len(whole.knots_px) and set(plan.factors) == {1} for plan in found)


def test_groups_hold_every_bin_once_and_fill_their_channels() -> None:
    """24 bins on each side of the focus: 4 maps each, so four at once; those of each colour have 6 maps, eight at once."""
    for changes, at_once in (({}, 4), ({"kernels_per_colour": True}, 8)):
        weights = weights_of(untrained(replace(GATED, **changes), 25.0).tiles)
        parts = shared(weights, [1] * 6 + [2] * 7)
        assert weights.bins_at_once == at_once
        assert [each for bins, _ in parts for each in bins] == list(range(49))
        assert sorted({len(bins) for bins, _ in parts}) == [1, at_once]
        assert {factor for bins, factor in parts if 24 in bins} == {1}


def _two_cards() -> dict[str, torch.Tensor]:
    """In focus, with a near card at the border and a far one inside; 170 and 250 are no multiples of 4."""
    inputs = pictures((170, 250))
    coc_px = torch.zeros_like(inputs["coc_px"])
    coc_px[..., :17, 100:], coc_px[..., 40:57, 31:52] = -10.5, 8.7
    return inputs | {"coc_px": coc_px}


def _convolved_pixels(path: str) -> int:
    """Pixels that the convolutions of a profile gave, over all their channels, without the one around the focus, which is the largest."""
    events = [each for each in json.loads(Path(path).read_text()) if each["name"].endswith("kernel_time")]
    shapes = [each["args"]["output_type_shape"][0]["float"] for each in events if each["args"].get("op_name") == "Conv"]
    return sum(sorted(int(np.prod(shape)) for shape in shapes)[:-1])


@pytest.mark.parametrize("changes", [{}, {"field_bases": 2, "field_position": True}], ids=["demo", "field"])
def test_what_is_computed_in_windows_is_the_network(changes: dict) -> None:
    network = untrained(replace(GATED, **changes))
    got = blurred(session_of(coarser_model(network)), _two_cards())
    assert np.abs(got - twin(network, _two_cards())).max() < PARITY


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_windows_change_nothing_and_save_most(factor: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin has windows as large as the picture. The cards cover 7 % of it, and what they reach less than a quarter."""
    network, results, pixels = untrained(GATED), [], []
    for reach in (None, 1000):
        if reach is not None:
            monkeypatch.setattr(gated_groups, "reach_of", lambda *_: 1000)
        session = session_of(coarser_model(network, factor), tmp_path / str(reach))
        results.append(blurred(session, _two_cards()))
        pixels.append(_convolved_pixels(session.end_profiling()))
    np.testing.assert_allclose(results[0], results[1], atol=2e-5)
    assert pixels[0] < 0.25 * pixels[1]
