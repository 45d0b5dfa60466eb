"""Training on a tiny stack made here: it learns, it stops and goes on, it keeps viewpoints apart."""

import dataclasses
import itertools
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from mrbokeh.images.image_io import write_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from tests.support.command_line import mrbokeh, printed_by
from tests.support.refusals import refused
from tests.support.scattered_pictures import scatter_reference
from training.cli import app
from training.data.batches import draw_batch
from training.data.dataset import PairSet, read_pair
from training.data.pairs import Counting
from training.data.training_data import gather_facts, training_data
from training.evaluation.comparison import Extras, compare, unseen_of
from training.evaluation.methods import (
    NETWORK,
    NO_BLUR,
    blur_of,
    gaussian_gather,
    gaussian_scatter,
    network_method,
    plain_methods,
    sigma_per_coc,
)
from training.fitting import train
from training.fitting.checkpoint import Learner
from training.fitting.objective import learning_rate_factor
from training.fitting.run import Run
from training.fitting.run_folder import load_run
from training.fitting.settings import TrainSettings, demo_settings
from training.networks.network_settings import NetworkSettings

SIZE = (48, 72)
LENS = Lens(35.0, 2.8, 1.0, 3.5, Aperture.blades(6, 0.2))
FOCUS_M = (0.5, 0.6, 0.8)
DEMO_LIKE = dataclasses.replace(demo_settings(), minutes=None, epochs=30, crop_px=0, threads=1, validate_every_s=0.0)
DEMO_WORDS = ["--preset", "demo", "--threads", "1", "--held-out", "view_2"]
PUBLISHED = TrainSettings(network=NetworkSettings(tile_px=32, overlap_px=8), epochs=4, threads=1, validate_every_s=0.0)


def make_stack(folder: Path, seed: int, size: tuple[int, int] = SIZE, lens: Lens = LENS) -> FocalStack:
    """A textured wall, slanted from 0.5 m to 0.8 m, with three lights of radiance 20, photographed by the reference renderer.

    The wall has no depth edges, so that the reference renderer is exact up to its pixels.
    """
    rng = np.random.default_rng(seed)
    height, width = size
    coarse = np.kron(rng.random((height // 4, width // 4, 3)), np.ones((4, 4, 1)))
    rgb = (0.6 * coarse + 0.2 * rng.random((height, width, 3))).astype(np.float32)
    rgb[rng.integers(4, height - 4, 3), rng.integers(4, width - 4, 3)] = 20.0
    depth_m = np.broadcast_to(1.0 / np.linspace(1 / 0.5, 1 / 0.8, width), size).astype(np.float32)
    stack = FocalStack(folder, tuple(Slice(f"slice_{i}.exr", each) for i, each in enumerate(FOCUS_M)), lens, registered=True, merged=True)
    folder.mkdir(parents=True)
    write_merged(folder, rgb, np.zeros_like(depth_m), np.ones_like(depth_m), depth_m)
    for i in range(len(FOCUS_M)):
        write_image(folder / f"slice_{i}.exr", scatter_reference(rgb, stack.coc_px(i, depth_m), lens.aperture), half=False)
    write_focal_stack(stack)
    return stack


def make_wall(folder: Path) -> Path:
    """Three viewpoints of the wall."""
    for seed in range(3):
        make_stack(folder / f"view_{seed}", seed)
    return folder


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_wall(tmp_path_factory.mktemp("training") / "wall")


@pytest.fixture(scope="session")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "demo_like"
    train.fit(training_data([scene]), folder, DEMO_LIKE, ["view_2"])
    return folder


def test_facts_come_from_the_data_of_one_lens(scene: Path, tmp_path: Path) -> None:
    """The largest CoC is that of the wall's end farthest (in dioptres) from a focus: 0.5 m seen at a focus of 0.8 m, or 0.8 m at 0.5 m."""
    facts = gather_facts(PairSet(training_data([scene]).stacks))
    far_px, near_px = abs(LENS.focused_at(0.5).coc_px(0.8, SIZE[1])), abs(LENS.focused_at(0.8).coc_px(0.5, SIZE[1]))
    assert facts.largest_coc_px == pytest.approx(max(far_px, near_px), rel=1e-4)
    assert facts.radiance_scale == pytest.approx(20.0, rel=1e-3)
    assert (facts.height_px, facts.width_px) == SIZE
    other = dataclasses.replace(make_stack(tmp_path / "other", 3), lens=dataclasses.replace(LENS, f_number=4.0))
    write_focal_stack(other)
    refused("one network learns one lens", gather_facts, PairSet([*training_data([scene]).stacks, read_focal_stack(other.folder)]))
    # A pair of 48 x 72 px is 8 floats a pixel: 110 592 bytes; a cache smaller than that keeps only the last one.
    pairs = PairSet(training_data([scene]).stacks, cache_mib=0)
    for index in range(len(pairs)):
        assert pairs[index].bytes == 48 * 72 * 8 * 4
    assert len(pairs._cache) == 1


def test_the_network_learns_the_lens_and_a_finished_run_is_left_alone(scene: Path, run: Path, tmp_path: Path) -> None:
    """On a viewpoint it has not seen it beats no blur and both Gaussians by the 3 dB that the product promises."""
    blur, seen = blur_of(run)
    held_out = unseen_of(training_data([scene]).stacks, [seen])
    assert [stack.folder.name for stack in held_out.stacks] == ["view_2"] and not held_out.slices
    result = compare([network_method(NETWORK, blur), *plain_methods()], held_out, tmp_path, Extras(pull_frames=0, memory=False))
    assert result.gain_db(NETWORK, NO_BLUR) > 3.0
    assert result.gain_db(NETWORK, result.better_gaussian) > 3.0
    before = (run / "network.pt").read_bytes()
    assert train.fit(training_data([scene]), run, DEMO_LIKE, ["view_2"]).finished
    assert (run / "network.pt").read_bytes() == before
    refused("other settings \\(seed\\)", train.fit, training_data([scene]), run, dataclasses.replace(DEMO_LIKE, seed=1), ["view_2"])


def test_pictures_of_a_step_teach_together_what_they_teach_one_by_one(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, on the processor: joined by size, and kept where they are; only the recording of kernels needs a GPU."""
    few = dataclasses.replace(DEMO_LIKE, epochs=2, sheets=False)
    train.fit(training_data([scene]), tmp_path / "apart", few, ["view_2"])
    begin, sizes = Run.__init__, []

    def on_gpu(run: Run, *arguments: object, **named: object) -> None:
        begin(run, *arguments, **named)  # type: ignore[arg-type]
        run._on_gpu, run._kept = True, {}

    monkeypatch.setattr(Run, "__init__", on_gpu)
    monkeypatch.setattr(Learner, "record_steps", lambda _, batch: sizes.append(len(batch.rgb)))
    train.fit(training_data([scene]), tmp_path / "together", few, ["view_2"])
    assert sizes == [2]
    apart, together = (load_run(tmp_path / name)[0].state_dict() for name in ("apart", "together"))
    assert all(torch.allclose(apart[name], together[name], atol=1e-4) for name in apart)


def test_a_run_starts_from_another_one_and_learns_a_lens_of_its_family_sooner(run: Path, tmp_path: Path) -> None:
    """Of a blade less, seen in one stack: as many steps afresh are worse. It knows what the other one saw, and goes on without it."""
    lens = dataclasses.replace(LENS, aperture=Aperture.blades(5, 0.2))
    data = training_data([make_stack(tmp_path / "wall", 7, lens=lens).folder])
    few, base = dataclasses.replace(DEMO_LIKE, epochs=6, learning_rate=0.005), shutil.copytree(run, tmp_path / "base")
    tuned = train.fit(data, tmp_path / "tuned", few, start_from=base)
    afresh = train.fit(data, tmp_path / "afresh", dataclasses.replace(few, learning_rate=DEMO_LIKE.learning_rate))
    assert tuned.curve[-1].held_out_psnr_db > afresh.curve[-1].held_out_psnr_db + 1.0
    facts, before = load_run(tmp_path / "tuned")[2], load_run(run)[2]
    assert (facts.radiance_scale, facts.tuned_from) == (before.radiance_scale, "base")
    assert set(facts.trained_on) == {*before.trained_on, f"{tmp_path.name}/wall"}
    shutil.rmtree(base)
    assert train.fit(data, tmp_path / "tuned", few, start_from=base).step == tuned.step


def test_a_run_does_not_start_from_one_that_does_not_fit_it(scene: Path, run: Path, tmp_path: Path) -> None:
    near = training_data([make_stack(tmp_path / "near", 7, lens=dataclasses.replace(LENS, f_number=2.0)).folder])
    wall, out = training_data([scene]), tmp_path / "out"
    wider = dataclasses.replace(DEMO_LIKE, network=dataclasses.replace(DEMO_LIKE.network, width=3))
    refused("has learned blur of up to .* px: give smaller", train.fit, near, out, DEMO_LIKE, start_from=run)
    refused("another shape", train.fit, wall, out, wider, ["view_2"], start_from=run)
    refused("was trained on wall/view_0, which cannot be held out", train.fit, wall, out, DEMO_LIKE, ["view_0"], start_from=run)
    refused("is the run to start from", train.fit, wall, run, DEMO_LIKE, ["view_2"], True, start_from=run)
    assert not out.exists()
    told = mrbokeh("train", "fit", scene, "--tune", run, "--set", "radiance_scale=50", "--out", out)
    assert told.returncode == 2 and "--tune takes the network and its ranges" in told.stderr


@pytest.mark.slow
def test_the_published_form_learns_too(scene: Path, tmp_path: Path) -> None:
    """With tiles, over the reassembled picture, lights out of its range left out: it ends clearly nearer to the truth than the sharp
    picture is. (How far it comes with the published size of data is not for a test to show.)"""
    settings = dataclasses.replace(PUBLISHED, epochs=60, learning_rate=5e-3, radiance_scale=1.2, saturation=1.0)
    train.fit(training_data([scene]), tmp_path / "run", settings, ["view_2"])
    blur, seen = blur_of(tmp_path / "run")
    pairs = unseen_of(training_data([scene]).stacks, [seen]).pairs()
    assert load_run(tmp_path / "run")[0].grid is not None
    for pair in (pairs[0], pairs[2]):
        counted = pair.target.max(axis=2) < 1.0
        sharp = np.minimum(pair.all_in_focus, 1.0)
        found = blur(dataclasses.replace(pair, all_in_focus=sharp))
        assert psnr(found, pair.target, mask=counted) > psnr(sharp, pair.target, mask=counted) + 1.0


@pytest.mark.parametrize(
    "settings", [dataclasses.replace(DEMO_LIKE, epochs=4), pytest.param(PUBLISHED, marks=pytest.mark.slow)], ids=["gated", "published"]
)
def test_a_killed_run_goes_on_as_if_never_stopped(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: TrainSettings
) -> None:
    """Killed after a checkpoint and a few more steps, which are lost: the same weights, to the last bit."""
    settings = dataclasses.replace(settings, checkpoint_every_s=0.0)
    stacks = training_data([scene])
    train.fit(stacks, tmp_path / "whole", settings, ["view_2"])
    step, steps = Run._step, []

    def dying_step(run: Run, rate_factor: float) -> None:
        steps.append(1)
        if len(steps) == 4:
            run._save = lambda: None  # a kill leaves no time to save
        if len(steps) == 6:
            raise RuntimeError("killed")
        step(run, rate_factor)

    monkeypatch.setattr(Run, "_step", dying_step)
    with pytest.raises(RuntimeError, match="killed"):
        train.fit(stacks, tmp_path / "killed", settings, ["view_2"])
    assert not (tmp_path / "killed" / "network.pt").exists()
    monkeypatch.setattr(Run, "_step", step)
    train.fit(stacks, tmp_path / "killed", settings, ["view_2"])
    whole, resumed = (load_run(tmp_path / name)[0].state_dict() for name in ("whole", "killed"))
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_a_stopped_run_goes_on_to_the_last_bit(
    number: signal.Signals, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights, their average, the optimizer and both random states, of a run that was stopped and one that was not; depth is made
    worse at random, so that an order that changed would show."""
    step = Run._step

    def interrupted(run: Run, rate_factor: float) -> None:
        """Ctrl-C, or a batch system's SIGTERM, in the third step, which is still done."""
        if run.progress.step == 2:
            signal.raise_signal(number)
        step(run, rate_factor)

    arguments = ["fit", scene, *DEMO_WORDS, "--epochs", 4, "--set", "depth_noise=1", "--out"]
    printed_by(app, *arguments, tmp_path / "whole")
    monkeypatch.setattr(Run, "_step", interrupted)
    done = mrbokeh("train", *arguments, tmp_path / "run")
    assert done.returncode == 128 + number and "go on" in done.stderr
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["progress"]["step"] == 3
    page = (tmp_path / "run" / "index.html").read_text()
    assert "stopped, the same command goes on: 3 steps" in page and "refresh" not in page
    monkeypatch.setattr(Run, "_step", step)
    printed_by(app, *arguments, tmp_path / "run")
    whole, resumed = (torch.load(tmp_path / name / "checkpoint.pt", weights_only=True) for name in ("whole", "run"))
    assert resumed["batch_rng"] == whole["batch_rng"] and torch.equal(resumed["torch_rng"], whole["torch_rng"])
    for part in ("network", "average"):
        assert all(torch.equal(resumed["learner"][part][name], value) for name, value in whole["learner"][part].items())
    moments = zip(*(each["learner"]["optimizer"]["state"].values() for each in (resumed, whole)), strict=True)
    assert all(torch.equal(mine[name], value) for mine, plain in moments for name, value in plain.items())
    ends = [load_run(tmp_path / name)[0].state_dict() for name in ("whole", "run")]
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def test_a_time_budget_is_kept(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """0.02 minutes are 1.2 s, on a clock that goes 0.05 s ahead whenever it is looked at."""
    settings, clock = dataclasses.replace(DEMO_LIKE, epochs=None, minutes=0.02), itertools.count()
    monkeypatch.setattr(Run, "_now_s", lambda _: 0.05 * next(clock))
    progress = train.fit(training_data([scene]), tmp_path / "run", settings, ["view_2"], least_steps=1)
    assert 1.2 <= progress.elapsed_s < 2.7


def test_learning_rate_rises_then_falls_to_zero() -> None:
    assert learning_rate_factor(0.025, 0.05) == pytest.approx(0.5)
    assert learning_rate_factor(0.05, 0.05) == pytest.approx(1.0)
    assert learning_rate_factor(0.525, 0.05) == pytest.approx(0.5)
    assert learning_rate_factor(1.0, 0.05) == pytest.approx(0.0)


def test_viewpoints_are_held_out_whole(scene: Path) -> None:
    data = training_data([scene])
    split = data.split(["wall/view_1"], 0.2, 0)
    assert [each.folder.name for each in split.train] == ["view_0", "view_2"] and [each.folder.name for each in split.test] == ["view_1"]
    split = data.split([], 0.34, seed=5)
    assert len(split.train) == 2 and len(split.test) == 1 and not split.held_out_slices
    refused("names of stacks among", data.split, ["view_9"], 0.2, 0)
    refused("none is left", data.split, ["view_0", "view_1", "view_2"], 0.2, 0)


def test_weights_are_where_pixels_are_trusted_and_light_is_not_missing(tmp_path: Path, scene: Path) -> None:
    stack = make_stack(tmp_path / "view", 0)
    depth_m, confidence = stack.depth_m(), np.ones(SIZE, np.float32)
    confidence[:, :10] = 0.0
    write_merged(stack.folder, stack.all_in_focus(), np.zeros(SIZE, np.float32), confidence, depth_m)
    pair = read_pair(stack, 0, Counting(least_confidence=0.1, saturation=0.5))
    bright = pair.target.max(axis=2) >= 0.5
    assert (pair.weight[:, :10] == 0).all() and (pair.weight[bright] == 0).all()
    assert (pair.weight[:, 10:][~bright[:, 10:]] == 1).all()
    # Crops of 20 px with a halo of 4: only sides on the border of the picture count to their edge.
    pairs, rng = PairSet(training_data([scene]).stacks), np.random.default_rng(0)
    for _ in range(20):
        weight = draw_batch(pairs, 1, 20, 4, rng).weight[0, 0]
        assert weight.shape == (20, 20)
        rows, columns = weight.amax(dim=1), weight.amax(dim=0)
        assert all(line[:4].sum() in (0, 4) and line[4:16].sum() == 12 and line[16:].sum() in (0, 4) for line in (rows, columns))


def test_gaussian_baselines_keep_light_and_the_reference_beats_them(scene: Path) -> None:
    """A light of 100 blurred by 8 px everywhere keeps its energy; with no circle of confusion nothing changes."""
    rgb = np.zeros((41, 41, 3), np.float32)
    rgb[20, 20] = 100.0
    for gaussian in (gaussian_scatter, gaussian_gather):
        blurred = gaussian(rgb, np.full((41, 41), -8.0, np.float32))
        assert blurred.sum() == pytest.approx(300.0, rel=1e-3)
        assert np.array_equal(gaussian(rgb, np.zeros((41, 41), np.float32)), rgb)
        offsets = np.arange(41) - 20
        assert (blurred[..., 0].sum(axis=0) @ offsets**2) / 100.0 == pytest.approx(2.0**2, rel=0.02)
    # Per axis: a disc of diameter d has variance d^2/16; a regular hexagon of circumradius R has 5 R^2/24.
    assert sigma_per_coc(Aperture.disc()) == pytest.approx(0.25, rel=2e-3)
    assert sigma_per_coc(Aperture.blades(6)) == pytest.approx(np.sqrt(5 / 24) / 2, rel=2e-3)
    pairs = PairSet(training_data([scene]).stacks)
    pair = pairs[0]
    assert psnr(scatter_reference(pair.all_in_focus, pair.coc_px, LENS.aperture), pair.target) > 60.0
