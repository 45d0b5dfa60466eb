"""Training on a data set: its manifest decides what is held out, how radiance is mapped and how large the network is."""

import json
import math
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from capture.dataset.writer import DatasetPlan, write_dataset
from capture.report.exclusion import REASONS, write_exclusions
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import read_focal_stack_dataset
from mrbokeh.system.errors import InputError
from tests.support import traced_focal_stack
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.training.test_train import DEMO_LIKE
from training.cli import app
from training.data.dataset import PairSet
from training.data.training_data import common_lens, training_data
from training.export.onnx_export import export_run
from training.fitting import train
from training.fitting.run_folder import load_run, read_facts
from training.fitting.settings import TrainSettings, settings_to_json
from training.networks.network_settings import NetworkSettings

SIZE = (24, 32)
LENS = Lens(50.0, 1.4, 1.0, 36.0)
FOCUS_M = (0.8, 1.0, 1.5)
SCALE = 3.0
PLAN = DatasetPlan("CC0, nobody", test=("view_1",), radiance_scale=f"radiance {SCALE:g}")
FEW_STEPS = TrainSettings(network=NetworkSettings(tile_px=0, overlap_px=0), epochs=1, threads=1, validate_every_s=0.0)


def write_noise(folder: Path, seed: int, saturated: np.ndarray | None = None, full: float = 1.0) -> FocalStack:
    """Three slices of noise in [0, 1), `full` where saturated; depth from 0.7 to 2 m."""
    rng = np.random.default_rng(seed)
    pictures = [rng.random((*SIZE, 3)).astype(np.float32) for _ in range(4)]
    for index in range(3):
        if saturated is not None:
            pictures[index][saturated] = full
        write_camera_rgb(folder / f"registered/{index:02d}.exr", pictures[index], None, saturated=saturated)
    depth_m = np.tile(np.linspace(0.7, 2.0, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    write_merged(folder, pictures[3], np.ones(SIZE, np.float32), np.ones(SIZE, np.float32), depth_m)
    slices = tuple(Slice(f"registered/{index:02d}.exr", focus) for index, focus in enumerate(FOCUS_M))
    stack = FocalStack(folder, slices, LENS, None, 0, registered=True, merged=True)
    write_focal_stack(stack)
    write_exclusions(stack, {name: np.zeros(SIZE, bool) for name in REASONS})
    return stack


def write_small(folder: Path, held_out_seed: int = 1) -> Path:
    """Three viewpoints, of which view_1 is held out."""
    for view, seed in enumerate((0, held_out_seed, 2)):
        write_noise(folder / "scene" / f"view_{view}", seed)
    write_dataset([folder / "scene"], folder / "data", PLAN)
    return folder / "data"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small(tmp_path_factory.mktemp("small"))


def weights_after_training(data: Path, run: Path, settings: TrainSettings = FEW_STEPS) -> dict[str, torch.Tensor]:
    train.fit(training_data([data]), run, settings)
    return load_run(run)[0].state_dict()


@pytest.mark.slow
def test_scale_and_network_size_come_from_the_manifest(small: Path, tmp_path: Path) -> None:
    """Largest blur: 2 m in the slice focused at 0.8 m, 0.75 dioptres; N is the least with 2 N + 1 at least that wide.

    A scale of 3, which no picture of noise in [0, 1) would give, maps 3 to 2 * 3 / 3 - 1 = 1 and 0 to -1, here and in ONNX."""
    train.fit(training_data([small]), tmp_path / "run", FEW_STEPS)
    network, _, facts = load_run(tmp_path / "run")
    coc_px = LENS.focused_at(0.8).coc_px_per_dioptre(SIZE[1]) * (1 / 0.8 - 1 / 2.0)
    assert facts.largest_coc_px == pytest.approx(coc_px, rel=1e-5)
    assert len(network.tiles.blocks) == math.ceil((coc_px - 1) / 2) == read_focal_stack_dataset(small).network_blocks
    rgb = torch.tensor([0.0, 1.5, SCALE])[None, :, None, None].expand(1, 3, 2, 2)
    assert network.encode(rgb, torch.zeros(1, 1, 2, 2))[0, :3, 0, 0].tolist() == pytest.approx([-1.0, 0.0, 1.0])
    exported = export_run(tmp_path / "run", tmp_path / "lens.onnx").facts
    assert exported.radiance_scale == facts.radiance_scale == SCALE and exported.largest_coc_px == facts.largest_coc_px


def test_explicit_settings_go_before_the_manifest_and_data_do_not_change_on_the_way(small: Path, tmp_path: Path) -> None:
    train.fit(training_data([small]), tmp_path / "run", replace(FEW_STEPS, radiance_scale=5.0), ["scene/view_0"])
    facts = read_facts(tmp_path / "run")
    assert facts.radiance_scale == 5.0
    assert (facts.trained_on, facts.held_out) == (("scene/view_1", "scene/view_2"), ("scene/view_0",))
    with pytest.raises(InputError, match="other data \\(trained_on, held_out\\)"):
        train.fit(training_data([small]), tmp_path / "run", replace(FEW_STEPS, radiance_scale=5.0))
    assert read_facts(tmp_path / "run").held_out == ("scene/view_0",)


def test_held_out_views_are_never_trained_on(small: Path, tmp_path: Path) -> None:
    """Other pictures in the held-out viewpoint change nothing, to the last bit; other pictures elsewhere do."""
    weights = weights_after_training(small, tmp_path / "run")
    facts = read_facts(tmp_path / "run")
    assert (facts.trained_on, facts.held_out) == (("scene/view_0", "scene/view_2"), ("scene/view_1",))
    other = weights_after_training(write_small(tmp_path / "other", held_out_seed=7), tmp_path / "other_run")
    assert all(torch.equal(weights[name], other[name]) for name in weights)
    train.fit(training_data([small]), tmp_path / "swapped", FEW_STEPS, ["view_0"])
    assert not all(torch.equal(weights[name], each) for name, each in load_run(tmp_path / "swapped")[0].state_dict().items())


def test_saturated_targets_do_not_pull(tmp_path: Path) -> None:
    """What a full photosite says, 1 or 0.3, does not reach the weights."""
    saturated = np.random.default_rng(0).random(SIZE) < 0.2
    found = []
    for full in (1.0, 0.3):
        write_noise(tmp_path / f"{full:g}" / "scene" / "view_0", 0, saturated, full)
        write_dataset([tmp_path / f"{full:g}" / "scene"], tmp_path / f"{full:g}" / "data", replace(PLAN, test=(), test_share=0.0))
        found.append(weights_after_training(tmp_path / f"{full:g}" / "data", tmp_path / f"run_{full:g}"))
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


@pytest.mark.parametrize(
    ("break_it", "said"), [(Path.unlink, "is missing"), (lambda path: path.write_bytes(b"less"), "has 4 bytes, expected")]
)
def test_files_that_are_not_those_of_the_manifest_are_named(tmp_path: Path, break_it: Callable[[Path], object], said: str) -> None:
    data = write_small(tmp_path)
    break_it(data / "scene" / "view_1" / "registered" / "02.exr")
    refused(f"scene/view_1/registered/02.exr {said}.*capture dataset --out .*data --verify", training_data, [data])


def test_one_data_set_or_scenes_of_one_lens(small: Path) -> None:
    refused("write all scenes into one data set", training_data, [small, small.parent / "scene"])
    refused(r"belongs to the data set .* give .* itself", training_data, [small / "scene"])
    assert training_data([small.parent / "scene"]).dataset is None
    # Three slices whose blur was found 1, 1.02 and 0.95 times as fast as stated: f-numbers 1.4, 1.4 / 1.02 and 1.4 / 0.95.
    stack = read_focal_stack(small / "scene" / "view_0")
    stated = [LENS.focused_at(each).coc_px_per_dioptre(SIZE[1]) for each in FOCUS_M]
    measured = [
        replace(each, metadata={"px_per_dioptre": rate * factor, "px_per_dioptre_width_px": SIZE[1]})
        for each, rate, factor in zip(stack.slices, stated, (1.0, 1.02, 0.95), strict=True)
    ]
    assert common_lens([replace(stack, slices=tuple(measured))]).f_number == pytest.approx(1.4)
    refused("one network learns one lens", common_lens, [stack, replace(stack, lens=replace(LENS, f_number=2.0))])


def test_memory_does_not_grow_with_the_stacks(tmp_path: Path) -> None:
    """A pair is 32 bytes a pixel: 24 stacks of 3 slices are 24 * 3 * 24 * 32 * 32 = 1.77 MB; a pair, 24.6 kB, and what reading one takes
    in passing must do with a cache of nothing."""
    for view in range(24):
        write_noise(tmp_path / "scene" / f"view_{view:02d}", view)
    pairs = PairSet(training_data([tmp_path / "scene"]).stacks, cache_mib=0)
    pairs[0]  # what is loaded once does not count
    tracemalloc.start()
    for index in range(len(pairs)):
        pairs[index]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pairs) == 72 and len(pairs._cache) == 1
    assert peak < 0.4e6


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("traced")
    for view in range(2):
        stack = traced_focal_stack.write_stack(folder / "desk" / f"view_{view}", traced_focal_stack.traced(view))
        masks = {name: np.zeros((stack.camera.height_px, stack.camera.width_px), bool) for name in REASONS}
        masks["board"][:20] = True
        write_exclusions(stack, masks)
    write_dataset([folder / "desk"], folder / "data", replace(PLAN, radiance_scale="maximum"))
    return folder / "data"


@pytest.mark.slow
def test_the_commands_take_a_data_set(traced: Path, tmp_path: Path) -> None:
    """Ten epochs of six slices of view_0; on view_1, which the manifest holds out, the network beats no blur by 3 dB."""
    settings = tmp_path / "settings.json"
    settings.write_text(json.dumps(settings_to_json(replace(DEMO_LIKE, epochs=10))))
    run = tmp_path / "run"
    printed_by(app, "fit", traced, "--settings", settings, "--threads", 1, "--out", run)
    assert (read_facts(run).trained_on, read_facts(run).held_out) == (("desk/view_0",), ("desk/view_1",))
    told = printed_by(app, "evaluate", run, traced, "--no-reference")
    rows = (run / "evaluation.csv").read_text().splitlines()[1:]
    assert {tuple(row.split(",")[:2]) for row in rows} == {("desk/view_1", str(index)) for index in range(6)}
    assert float(told.split("over no blur ")[1].split(" dB")[0]) > 3.0
