"""The fast graphs against their slow twins in PyTorch, and what they keep: light, linearity, the budget."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import ModelProto
from typer.testing import CliRunner

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError
from mrbokeh.field_position import field_positions
from mrbokeh.lens import Lens
from mrbokeh.renderers.onnx_network import OnnxNetwork
from training.commands.export import export_command
from training.export_onnx import network_facts_of, record_path
from training.fast_export.coarse_kernels import coarse_kernel, seen_kernel, tent
from training.fast_export.export import export_fast_network
from training.fast_export.gated_graph import GatedGraph
from training.fast_export.gated_groups import groups_of
from training.fast_export.measured_loss import ASSUMED_PSNR_DB, loss_db, made_up_look
from training.fast_export.plans import model_of, plans
from training.fast_export.published_graph import BlockPlan, PublishedGraph
from training.fast_export.separable import separable_kernels
from training.network import BlurNetwork
from training.network_settings import NetworkSettings
from training.presets import demo_settings
from training.run_folder import RunFacts, save_network, write_facts
from training.settings import TrainSettings, write_settings
from training.tiling import TileGrid

LARGEST_PX, TOP = 11.0, 4.0
SIZE = (41, 58)
GATED = replace(demo_settings().network, hidden=8)
PUBLISHED = NetworkSettings(tile_px=0, overlap_px=0, blocks=4, initialisation="disc")
PARITY = 1e-4  # what the plain export is held to as well


def _network(settings: NetworkSettings, largest_px: float = LARGEST_PX, grid: TileGrid | None = None) -> BlurNetwork:
    """Not trained, but with weights that matter everywhere."""
    torch.manual_seed(1)
    network = BlurNetwork(settings, largest_px, TOP, grid, ((2.0, 8.0), (24.0, 70.0)) if settings.lens_inputs else None)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "hide" in name or "mixing" in name:
                parameter.normal_(0.0, 0.3)
    return network.eval()


def _inputs(size: tuple[int, int] = SIZE, largest_px: float = LARGEST_PX) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(3)
    rgb = rng.random((1, 3, *size), dtype=np.float32)
    rgb[:, :, 7::16, 5::16] = TOP
    coc_px = (
        np.linspace(-largest_px, largest_px, size[1], dtype=np.float32)[::-1] * np.linspace(0.4, 1.0, size[0], dtype=np.float32)[:, None]
    )
    place = field_positions(size).transpose(2, 0, 1)[None]
    arrays = {"rgb": rgb, "coc_px": coc_px[None, None], "place": place, "lens": np.array([[2.8, 35.0]], np.float32)}
    return {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in arrays.items()}


def _session(model: ModelProto, profile: Path | None = None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    if profile is not None:
        options.enable_profiling, options.profile_file_prefix = True, str(profile)
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def _run(session: onnxruntime.InferenceSession, inputs: dict[str, torch.Tensor]) -> np.ndarray:
    names = {each.name for each in session.get_inputs()}
    return session.run(["blurred"], {name: each.numpy() for name, each in inputs.items() if name in names})[0]


@torch.no_grad()
def _twin(network: BlurNetwork, inputs: dict[str, torch.Tensor]) -> np.ndarray:
    return network(**inputs).numpy()


def _gated_model(network: BlurNetwork, factor: int = 1) -> ModelProto:
    sizes = range(1, len(network.tiles.kernels) + 1)
    return GatedGraph(network, {n: factor if n > 2 else 1 for n in sizes}).model()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"width": 1, "signed_coc": False, "kernels_per_colour": True},
        {"field_bases": 3, "field_position": True},
        {"field_bases": 2, "field_position": True, "lens_inputs": True, "kernels_per_colour": True, "width": 1},
        {"activation": "tanh"},
    ],
    ids=["demo", "unsigned", "field", "field and lens", "tanh"],
)
def test_the_gated_graph_at_full_resolution_is_the_network(changes: dict) -> None:
    """Nothing is factorised, so that it agrees like a plain export; the size is odd and no multiple of anything."""
    network = _network(replace(GATED, **changes))
    got, expected = _run(_session(_gated_model(network)), _inputs()), _twin(network, _inputs())
    assert np.abs(got - expected).max() < PARITY


@pytest.mark.parametrize("padding", ["replicate", "reflect", "zeros"])
@pytest.mark.parametrize("tiled", [False, True], ids=["whole", "tiles"])
def test_the_published_graph_in_strips_is_the_network(padding: str, tiled: bool) -> None:
    network = _network(replace(PUBLISHED, padding=padding), grid=TileGrid(*SIZE, 20, 8) if tiled else None)
    graph = PublishedGraph(network, [BlockPlan()] * 4)
    assert (graph.strips > 1) is not tiled  # 45 channels of 15 tiles nearly fill three blocks without strips
    assert np.abs(_run(_session(graph.model()), _inputs()) - _twin(network, _inputs())).max() < PARITY


@pytest.mark.parametrize("tiled", [False, True], ids=["whole", "tiles"])
def test_separable_kernels_of_full_rank_are_the_network(tiled: bool) -> None:
    """Block n has kernels of 2n+1 px, whose rank is at most that."""
    network = _network(PUBLISHED, grid=TileGrid(*SIZE, 20, 8) if tiled else None)
    model = PublishedGraph(network, [BlockPlan(rank=2 * n + 1) for n in range(1, 5)]).model()
    assert np.abs(_run(_session(model), _inputs()) - _twin(network, _inputs())).max() < PARITY


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
    seen = seen_kernel(taps, factor, disc.shape[0] // 2)
    margin = (seen.shape[0] - disc.shape[0]) // 2
    assert np.linalg.norm(seen - np.pad(disc, margin)) < 0.05 * factor * np.linalg.norm(disc)
    assert tent(factor).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_white_stays_white_and_a_light_keeps_its_energy(factor: int) -> None:
    """Everything at one blur: coverage is 1 all over, so that the light of one pixel reappears whole around it."""
    network = _network(GATED)
    session, inputs = _session(_gated_model(network, factor)), _inputs((64, 64))
    inputs["coc_px"] = torch.full_like(inputs["coc_px"], 8.0)
    white = _run(session, inputs | {"rgb": torch.ones_like(inputs["rgb"])})
    np.testing.assert_allclose(white, 1.0, atol=1e-5)
    light = torch.zeros_like(inputs["rgb"])
    light[:, :, 31, 30] = 100.0
    np.testing.assert_allclose(_run(session, inputs | {"rgb": light}).sum(axis=(2, 3)), 100.0, rtol=1e-3)


def test_the_coarse_gated_graph_stays_linear_in_radiance() -> None:
    network = _network(GATED)
    session, inputs = _session(_gated_model(network, 2)), _inputs()
    other = inputs["rgb"].flip(3)
    apart = [_run(session, inputs | {"rgb": each}) for each in (inputs["rgb"], other)]
    together = _run(session, inputs | {"rgb": 3.0 * inputs["rgb"] + other})
    np.testing.assert_allclose(together, 3.0 * apart[0] + apart[1], atol=1e-3)


def test_bins_without_pixels_are_not_run_and_not_missed(tmp_path: Path) -> None:
    """At one circle of confusion at most two neighbouring bins are used, so most convolutions do not appear in the profile."""
    network = _network(GATED)
    counts = []
    for name, inputs in (("all", _inputs()), ("one", _inputs() | {"coc_px": torch.full((1, 1, *SIZE), -9.3)})):
        session = _session(_gated_model(network), tmp_path / name)
        assert np.abs(_run(session, inputs) - _twin(network, inputs)).max() < PARITY
        events = json.loads(Path(session.end_profiling()).read_text())
        counts.append(sum(each["name"].endswith("kernel_time") and each["args"].get("op_name") == "Conv" for each in events))
    assert counts[0] == len(groups_of(network.tiles, dict.fromkeys(range(1, len(network.tiles.kernels) + 1), 1)))
    assert counts[1] <= 2


def test_the_budget_holds_for_pictures_it_was_not_chosen_on() -> None:
    """A loss of 0.2 dB for a network 42 dB from the truth is a difference of at most 42 + 13.3 dB: 10 lg(10^0.02 - 1) = -13.3."""
    largest_px = 21.0
    network = _network(replace(GATED, width=1), largest_px)
    facts = network_facts_of(network, GATED, _facts(largest_px))
    look = made_up_look(network, facts, (96, 160))
    plan = next(each for each in plans(network) if loss_db(_session(model_of(network, each)), [look]) <= 0.2)
    assert plan.factors[0] == 1
    assert max(plan.factors) > 1
    inputs = _inputs((96, 160), largest_px)
    error = np.clip(_run(_session(model_of(network, plan)), inputs), 0, 1) - np.clip(_twin(network, inputs), 0, 1)
    assert -10.0 * np.log10(np.mean(error**2)) > ASSUMED_PSNR_DB + 13.3 - 3.0  # another picture: twice the error is granted


def _facts(largest_px: float = 5.0) -> RunFacts:
    return RunFacts(Lens(35.0, 2.8, 1.0, 23.5), 64, 48, largest_px, TOP, (), (), None)


def test_the_file_is_an_ordinary_network_and_a_record_lies_beside_it(tmp_path: Path) -> None:
    settings = replace(GATED, width=1)
    network, path = _network(settings, 5.0), tmp_path / "fast.onnx"
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


def test_nothing_is_written_where_no_plan_keeps_within_the_budget(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no fast form of this network loses at most -1 dB"):
        export_fast_network(_network(GATED, 5.0), GATED, _facts(), tmp_path / "fast.onnx", max_psnr_loss_db=-1.0)
    assert not any(tmp_path.iterdir())


def test_forms_that_have_no_fast_graph_are_said() -> None:
    with pytest.raises(InputError, match="without tiles"):
        next(plans(_network(GATED, grid=TileGrid(*SIZE, 20, 8))))
    with pytest.raises(InputError, match="channel by channel"):
        PublishedGraph(_network(replace(PUBLISHED, mixing="colour", width=2)), [BlockPlan()] * 4)


def test_the_command_writes_a_fast_network(tmp_path: Path) -> None:
    import typer

    app = typer.Typer()
    app.command()(export_command)
    settings = TrainSettings(network=replace(PUBLISHED, blocks=2))
    run = tmp_path / "run"
    run.mkdir()
    write_settings(run, settings)
    write_facts(run, _facts())
    save_network(run, _network(settings.network, 5.0))
    out = tmp_path / "fast.onnx"
    result = CliRunner().invoke(app, [str(run), "--out", str(out), "--fast", "--max-psnr-loss", "0.1"], catch_exceptions=False)
    assert result.exit_code == 0
    assert "times faster" in result.output
    assert "of at most 0.1 dB" in result.output
    assert out.is_file()
    with pytest.raises(InputError, match="add --fast"):
        CliRunner().invoke(app, [str(run), "--out", str(tmp_path / "x.onnx"), "--data", str(run)], catch_exceptions=False)
