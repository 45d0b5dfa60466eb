"""The fast graphs against their slow twins in PyTorch, and what they keep: light, linearity, the budget."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.made_networks import GATED, PARITY, PUBLISHED, SIZE, TOP, blurred, pictures, session_of, twin, untrained
from tests.support.refusals import refused
from training.commands.export import export_command
from training.export import fast_onnx
from training.export.fast_onnx import ASSUMED_PSNR_DB, export_fast_network, loss_db, made_up_sample, model_of, plans
from training.export.graph_builder import coarse_kernel, place_responses, tent
from training.export.onnx_export import network_facts_of, record_path
from training.export.published_graph import BlockPlan, PublishedGraph, separable_kernels
from training.fitting.run_folder import RunFacts, save_network, write_facts
from training.fitting.settings import TrainSettings, write_settings
from training.networks.network import BlurNetwork, TileGrid
from training.networks.network_settings import NetworkSettings


@pytest.mark.parametrize("padding", ["replicate", "reflect", "zeros"])
@pytest.mark.parametrize("tiled", [False, True], ids=["whole", "tiles"])
def test_the_published_graph_in_strips_is_the_network(padding: str, tiled: bool) -> None:
    network = untrained(replace(PUBLISHED, padding=padding), grid=TileGrid(*SIZE, 20, 8) if tiled else None)
    graph = PublishedGraph(network, [BlockPlan()] * 4)
    assert (graph.strips > 1) is not tiled  # 45 channels of 15 tiles nearly fill three blocks without strips
    assert np.abs(blurred(session_of(graph.model()), pictures()) - twin(network, pictures())).max() < PARITY


@pytest.mark.parametrize("tiled", [False, True], ids=["whole", "tiles"])
def test_separable_kernels_of_full_rank_are_the_network(tiled: bool) -> None:
    """Block n has kernels of 2n+1 px, whose rank is at most that."""
    network = untrained(PUBLISHED, grid=TileGrid(*SIZE, 20, 8) if tiled else None)
    model = PublishedGraph(network, [BlockPlan(rank=2 * n + 1) for n in range(1, 5)]).model()
    assert np.abs(blurred(session_of(model), pictures()) - twin(network, pictures())).max() < PARITY


def test_separable_kernels_keep_sums_and_miss_less_with_more_terms() -> None:
    disc = Aperture.disc(sides=64).rasterize(19.0).kernel
    errors = [separable_kernels(disc[None], rank).relative_error for rank in (1, 2, 4, 8)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.05
    short = separable_kernels(disc[None], 2)
    assert float(np.einsum("mry,mrx->", short.columns, short.rows)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("factor", [2, 4])
def test_coarse_taps_spread_like_the_kernel_and_keep_its_sum(factor: int) -> None:
    """A disc 41 px wide is 10 cells or more; what is missed lies at its rim, where a step meets pixels of 2 or 4."""
    disc = Aperture.disc(sides=64).rasterize(41.0).kernel.astype(np.float64)
    taps = coarse_kernel(disc, factor)
    assert taps.sum() == pytest.approx(disc.sum(), abs=1e-9)
    mean = place_responses(disc.shape[0] // 2, factor).mean(axis=0)
    seen = mean @ taps @ mean.T
    margin = (seen.shape[0] - disc.shape[0]) // 2
    assert np.linalg.norm(seen - np.pad(disc, margin)) < 0.05 * factor * np.linalg.norm(disc)
    assert tent(factor).sum() == pytest.approx(1.0)


@pytest.mark.slow
def test_the_budget_holds_for_pictures_it_was_not_chosen_on() -> None:
    """A loss of 0.2 dB for a network 42 dB from the truth is a difference of at most 42 + 13.3 dB: 10 lg(10^0.02 - 1) = -13.3."""
    largest_px = 21.0
    network = untrained(GATED, largest_px)
    facts = network_facts_of(network, GATED, _facts(largest_px))
    sample = made_up_sample(network, facts, (96, 160))
    plan = next(each for each in plans(network) if loss_db(session_of(model_of(network, each)), [sample]) <= 0.2)
    assert plan.factors[0] == 1
    assert max(plan.factors) > 1
    assert plan.bins < len(network.tiles.knots)
    inputs = pictures((96, 160), largest_px)
    error = np.clip(blurred(session_of(model_of(network, plan)), inputs), 0, 1) - np.clip(twin(network, inputs), 0, 1)
    assert -10.0 * np.log10(np.mean(error**2)) > ASSUMED_PSNR_DB + 13.3 - 3.0  # another picture: twice the error is granted


def _facts(largest_px: float = 5.0) -> RunFacts:
    return RunFacts(Lens(35.0, 2.8, 1.0, 23.5), 64, 48, largest_px, TOP, (), (), None)


@pytest.mark.slow
def test_the_file_is_an_ordinary_network_and_a_record_lies_beside_it(tmp_path: Path) -> None:
    settings = replace(GATED, width=1)
    network, path = untrained(settings, 5.0), tmp_path / "fast.onnx"
    done = export_fast_network(network, settings, _facts(), path)
    assert done.loss_db <= 0.2
    assert min(done.naive_ms, done.fast_ms) > 0.0
    loaded = OnnxNetwork(path)
    assert loaded.provider == "cpu" or "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    assert (loaded.facts.linear_in_radiance, loaded.facts.tiled, loaded.facts.largest_coc_px) == (True, False, 5.0)
    record = json.loads(record_path(path).read_text())
    assert record["fast"]
    assert record["loss_db"] == done.loss_db
    assert record["factors"] == list(done.plan.factors)


def test_what_keeps_no_budget_or_has_no_fast_graph_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no fast form of this network loses at most -1 dB"):
        export_fast_network(untrained(GATED, 5.0), GATED, _facts(), tmp_path / "fast.onnx", max_psnr_loss_db=-1.0)
    assert not any(tmp_path.iterdir())
    refused("without tiles", plans, untrained(GATED, grid=TileGrid(*SIZE, 20, 8)))
    refused("channel by channel", PublishedGraph, untrained(replace(PUBLISHED, mixing="colour", width=2)), [BlockPlan()] * 4)


def whole_graph(network: BlurNetwork, settings: NetworkSettings, facts: RunFacts, path: Path) -> None:
    fast_onnx.write_model(network, plans(network)[-1], network_facts_of(network, settings, facts), path)


def test_the_command_writes_a_fast_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared on a small picture with the graph of the last plan; the plain export has its own tests."""
    settings = TrainSettings(network=replace(PUBLISHED, blocks=2))
    run = tmp_path / "run"
    run.mkdir()
    write_settings(run, settings)
    write_facts(run, _facts())
    save_network(run, untrained(settings.network, 5.0))
    out = tmp_path / "fast.onnx"
    monkeypatch.setattr(fast_onnx, "TIMED_SIZE_PX", SIZE)
    monkeypatch.setattr(fast_onnx, "export_network", whole_graph)
    told = printed_by(export_command, run, "--out", out, "--fast", "--max-psnr-loss", 0.1)
    assert "times faster" in told and "of at most 0.1 dB" in told and out.is_file()
