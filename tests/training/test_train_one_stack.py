"""One stack trains: slices held out inside it, budgets of time that make enough steps, and bars that count what is done."""

import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from capture.dataset.writer import slices_of_a_single_stack
from mrbokeh.images.image_io import write_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.renderers.onnx_network import facts_from_json
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import slices_to_hold_out
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.scattered_pictures import scatter_reference
from tests.training.test_train import DEMO_LIKE, LENS
from training.cli import app
from training.data.dataset import PairSet
from training.data.stacks import Seen, stack_name
from training.data.training_data import training_data
from training.evaluation.comparison import unseen_of
from training.evaluation.methods import blur_of
from training.export.onnx_export import network_facts_of
from training.fitting import record, train
from training.fitting.run import LEAST_STEPS, Run, is_rate_known, steps_within, too_few_words
from training.fitting.run_folder import load_run, read_facts

SIZE = (40, 56)
SHORT = dataclasses.replace(DEMO_LIKE, epochs=2, sheets=False)


def bare_stack(slices: int, reference: int, backwards: bool = False) -> FocalStack:
    """Focus distances alone, evenly in dioptres, the farthest first or last."""
    focus_m = [1.0 / dioptres for dioptres in np.linspace(1.0, 3.0, slices)][:: -1 if backwards else 1]
    return FocalStack(Path("view"), tuple(Slice(f"{index}.exr", float(each)) for index, each in enumerate(focus_m)), reference=reference)


def make_deep_stack(folder: Path, slices: int = 6) -> FocalStack:
    """A slanted wall with a few lights, photographed by the reference renderer at so many focus distances."""
    rng = np.random.default_rng(4)
    height, width = SIZE
    rgb = (0.2 + 0.6 * np.kron(rng.random((height // 4, width // 4, 3)), np.ones((4, 4, 1)))).astype(np.float32)
    rgb[rng.integers(4, height - 4, 3), rng.integers(4, width - 4, 3)] = 10.0
    depth_m = np.broadcast_to(1.0 / np.linspace(1 / 0.5, 1 / 0.8, width), SIZE).astype(np.float32)
    focus_m = [float(each) for each in 1.0 / np.linspace(1 / 0.5, 1 / 0.8, slices)]
    shots = tuple(Slice(f"slice_{index}.exr", each) for index, each in enumerate(focus_m))
    stack = FocalStack(folder, shots, LENS, reference=slices // 2, registered=True, merged=True)
    folder.mkdir(parents=True)
    write_merged(folder, rgb, np.zeros_like(depth_m), np.ones_like(depth_m), depth_m)
    for index in range(slices):
        write_image(folder / f"slice_{index}.exr", scatter_reference(rgb, stack.coc_px(index, depth_m), LENS.aperture), half=False)
    write_focal_stack(stack)
    return stack


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_deep_stack(tmp_path_factory.mktemp("one") / "wall" / "view").folder.parent


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("one_run") / "run"
    train.fit(training_data([scene]), folder, dataclasses.replace(SHORT, epochs=20))
    return folder


def test_held_out_slices_lie_inside_the_range_of_focus() -> None:
    """Neither end, for nothing else shows that blur; not the reference; from one to a quarter; never two neighbours."""
    for slices, backwards, reference in itertools.product(range(4, 20), (False, True), range(20)):
        stack = bare_stack(slices, min(reference, slices - 1), backwards)
        chosen = slices_to_hold_out(stack)
        assert chosen and len(chosen) <= slices / 4.0
        assert not {0, slices - 1, stack.reference} & set(chosen)
        assert all(after - before >= 2 for before, after in itertools.pairwise(chosen))


def test_few_slices_and_their_focus_decide_what_is_held_out() -> None:
    """Of five slices the middle one by focus, whichever number it has."""
    stack = bare_stack(5, 4)
    shuffled = dataclasses.replace(stack, slices=tuple(stack.slices[index] for index in (2, 0, 4, 1, 3)))
    assert slices_to_hold_out(stack) == (2,)
    assert slices_to_hold_out(shuffled) == (0,)
    # The middle of three is the only one that is no end, be it the reference.
    assert slices_to_hold_out(bare_stack(3, 1)) == (1,)
    assert slices_to_hold_out(bare_stack(2, 0)) == ()
    stack = bare_stack(6, 3)
    assert slices_of_a_single_stack({"scene/view": stack}) == {"scene/view": (2,)}
    assert slices_of_a_single_stack({"scene/view": stack}, test_share=0.0) == {}
    assert slices_of_a_single_stack({"scene/a": stack, "scene/b": stack}) == {}


@pytest.mark.slow
def test_training_does_not_look_at_held_out_slices(scene: Path, tmp_path: Path) -> None:
    """With the held-out slice white instead of what it was, training ends with the same weights, to the last bit."""
    (tmp_path / "other").mkdir()
    other = make_deep_stack(tmp_path / "other" / "wall" / "view")
    write_image(other.folder / "slice_2.exr", np.ones((*SIZE, 3), np.float32), half=False)
    settings = dataclasses.replace(SHORT, epochs=2)
    for name, folder in (("a", scene), ("b", other.folder.parent)):
        train.fit(training_data([folder]), tmp_path / name, settings)
    before, after = (load_run(tmp_path / name)[0].state_dict() for name in ("a", "b"))
    assert all((before[name] == after[name]).all() for name in before)
    split = training_data([scene]).split([], 0.2, 0)
    assert split.held_out_slices == (2,) and "not an unseen view" in split.words()
    assert [index for _, index in PairSet(split.train, slices=split.train_slices).keys] == [0, 1, 3, 4, 5]
    assert training_data([scene]).split([], 0.0, 0).held_out_slices == ()


@pytest.mark.slow
def test_what_was_held_out_is_recorded_and_what_any_network_saw_is_not_unseen(scene: Path, run: Path) -> None:
    facts = read_facts(run)
    assert (facts.trained_on, facts.held_out, facts.held_out_slices) == (("wall/view",), (), (2,))
    network, settings, _ = load_run(run)
    exported = network_facts_of(network, settings.network, facts)
    assert facts_from_json(exported.to_json(), "here").held_out_slices == (2,)
    unseen = unseen_of(training_data([scene]).stacks, [blur_of(run)[1]])
    assert [index for _, index in unseen.pairs().keys] == [2]
    stacks = training_data([scene]).stacks
    name = stack_name(stacks[0])
    unseen = unseen_of(stacks, [Seen((name,), (1, 3)), Seen((name,), (3, 4)), Seen(("elsewhere/view",))])
    assert unseen.slices == {name: [3]}
    assert not unseen_of(stacks, [Seen(("elsewhere/view",))]).slices
    refused("every slice of these stacks", unseen_of, stacks, [Seen((name,))])


@pytest.mark.slow
def test_evaluate_judges_a_network_of_one_stack_on_the_slices_held_out(scene: Path, run: Path, tmp_path: Path) -> None:
    """The network is nearer to the held-out slice than its neighbour in focus and than the sharp picture; the truth of this stack is the
    reference renderer's, whose score says that the pair is put together rightly."""
    told = printed_by(app, "evaluate", run, scene, "--renderer", "scatter", "--out", tmp_path)
    decibels = {line[:22].strip(): float(line[22:].split()[0]) for line in told.splitlines() if "SSIM" in line}
    assert "1 slices held out of one stack, not an unseen view" in told
    assert "held out of one stack, not an unseen view" in (tmp_path / "evaluation.md").read_text()
    assert decibels["network"] > max(decibels["nearest slice"], decibels["no blur"])
    assert decibels["scatter reference"] > 45.0
    stack = training_data([scene]).stacks[0]
    nearest = max(psnr(stack.slice_rgb(index), stack.slice_rgb(2)) for index in (1, 3))
    assert decibels["nearest slice"] <= nearest + 0.01


def test_the_rate_of_steps_is_told_and_what_to_change() -> None:
    """A first step of 3 s that reads the data, then 0.1 s each: 600 s make 1 + (600 - 3) / 0.1 steps."""
    ends_s = [3.0 + 0.1 * index for index in range(70)]
    assert steps_within(ends_s, 600.0) == pytest.approx(5971, abs=2)
    assert not is_rate_known(ends_s[:6], 600.0) and is_rate_known(ends_s, 600.0)
    assert not is_rate_known([], 60.0) and not is_rate_known([0.5], 60.0)
    assert is_rate_known([20.0], 60.0) and steps_within([20.0], 60.0) == 3
    assert is_rate_known([2.0, 40.0], 600.0)
    # Enough minutes for 200 steps of 2 s are 7, with a quarter of reserve 8.4.
    published = train.TrainSettings(epochs=None, minutes=1.0)
    words = too_few_words([2.0, 4.0, 6.0], published, 10, LEAST_STEPS)
    assert "about 30 steps of 2 s" in words and "--preset demo" in words and "--max-width" in words
    assert float(re.search(r"--minutes ([\d.]+)", words)[1]) == 9.0  # type: ignore[index]
    crops = dataclasses.replace(DEMO_LIKE, epochs=None, minutes=1.0, crop_px=256, batch=2)
    assert "--set crop_px=128 or --set batch=1" in too_few_words([2.0, 4.0], crops, 20, LEAST_STEPS)
    assert "crop_px" not in too_few_words([2.0, 4.0], crops, 40, LEAST_STEPS), "half a crop would have less inside than its rim"


def test_a_budget_without_time_for_200_steps_is_refused_and_nothing_changes(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps that take a minute on the run's own clock: two of them are enough to know. What a finished run left is still there, even with
    --overwrite, and where there was no folder there is none."""
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "settings.json").write_text("{}")
    (tmp_path / "old" / "network.pt").write_bytes(b"kept")
    arguments = ["fit", str(scene), "--preset", "demo", "--minutes", "10", "--threads", "1", "--overwrite", "--out"]
    for name in ("old", "new"):
        clock = itertools.count()
        monkeypatch.setattr(Run, "_now_s", lambda _, clock=clock: 60.0 * next(clock))
        refused(r"10 minutes make about 11 steps of 60 s.*give --minutes \d+", printed_by, app, *arguments, tmp_path / name)
    assert (tmp_path / "old" / "network.pt").read_bytes() == b"kept" and not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_bar_counts_what_is_done(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two epochs of five slices, one picture a step: 10 steps of 10, and one by one on the way.

    Of minutes the whole is what the rate so far makes of them.
    """
    bars: list[tuple[float, float]] = []
    told = Run._bar

    def noted(run: Run) -> dict[str, object]:
        bar = told(run)
        bars.append((bar["completed"], bar["total"]))
        return bar

    monkeypatch.setattr(Run, "_bar", noted)
    train.fit(training_data([scene]), tmp_path / "epochs", dataclasses.replace(SHORT, batch=1))
    assert bars == [(step, 10) for step in range(11)]
    bars.clear()
    clock = itertools.count()
    monkeypatch.setattr(Run, "_now_s", lambda _: 0.05 * next(clock))
    settings = dataclasses.replace(SHORT, epochs=None, minutes=0.01)
    progress = train.fit(training_data([scene]), tmp_path / "minutes", settings, least_steps=1)
    assert bars[-1] == (progress.step, progress.step) and all(done <= total <= 1.2 * progress.step for done, total in bars[2:])
    assert LEAST_STEPS == 200


def test_crops_are_wider_than_the_rim_that_does_not_count(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blur of 6 px leaves 3 px on each side of a crop without weight; of a crop of 8 px a sixteenth would be left, of 12 px a quarter."""
    seen = []
    learn = Run._learn_from
    monkeypatch.setattr(Run, "_learn_from", lambda run, batch: (seen.append(batch.weight), learn(run, batch))[1])
    train.fit(training_data([scene]), tmp_path / "run", dataclasses.replace(SHORT, epochs=1, crop_px=8))
    halo_px = int(np.ceil(read_facts(tmp_path / "run").largest_coc_px / 2.0))
    assert halo_px == 3
    assert all(weight.shape[2:] == (12, 12) and float(weight.mean()) >= 0.25 for weight in seen)


def test_looks_are_at_the_middle_of_large_pictures(monkeypatch: pytest.MonkeyPatch, scene: Path) -> None:
    """Of 40 x 56 px the middle 24 x 24 where that is the most, without the 3 px that get light from outside; a network that gives the
    sharp picture has the score of that part."""
    monkeypatch.setattr(record, "SIDE_PX", 24)
    stacks, shapes = training_data([scene]).stacks, []

    class Sharp(torch.nn.Module):
        def forward(self, rgb: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
            shapes.append(tuple(rgb.shape[2:]))
            return rgb

    slices = {stack_name(stacks[0]): (2,)}
    look = record.HeldOutSlices(stacks, slices).look(Sharp(), torch.device("cpu"))
    pair = PairSet(stacks, slices=slices)[0]
    halo_px = int(np.ceil(np.abs(pair.coc_px).max() / 2.0))
    inside = np.s_[8 + halo_px : 32 - halo_px, 16 + halo_px : 40 - halo_px]
    assert shapes == [(24, 24)]
    assert look.psnr_db == pytest.approx(psnr(pair.all_in_focus[inside], pair.target[inside]), abs=0.01)
