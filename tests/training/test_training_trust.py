"""Trust in a training: what it says beforehand, how it ends when it goes wrong, its page, its card and its doctor."""

import dataclasses
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mrbokeh.images.image_metrics import psnr, ssim
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.system.messages import channel
from tests.support.command_line import mrbokeh, printed_by
from tests.support.drawn_curves import drawn_curves
from tests.support.refusals import refused
from tests.training.test_train import DEMO_LIKE, DEMO_WORDS, make_wall
from training.cli import app
from training.data.pairs import read_pair
from training.data.training_data import training_data
from training.evaluation.diagnosis import (
    Case,
    Look,
    Pictures,
    _better,
    _blur,
    _counted,
    _diverged,
    _falling,
    _lights,
    _overfitted,
    _rate,
    _steps,
    _tiles,
    diagnose,
)
from training.evaluation.methods import DISC, NETWORK, NO_BLUR, blur_of
from training.evaluation.run_data import RunData
from training.evaluation.scores import Evaluation, Score
from training.export import onnx_export
from training.export.onnx_export import network_facts_of, write_card
from training.fitting import run as run_module
from training.fitting import train
from training.fitting.checkpoint import FAR_ABOVE_STEPS, CurvePoint, Learner, Progress
from training.fitting.record import lower_rate
from training.fitting.run import plan_words
from training.fitting.run_folder import load_run, read_facts
from training.fitting.settings import TrainSettings, demo_settings

LEARNT = dataclasses.replace(DEMO_LIKE, epochs=20, validate_every_s=0.5)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_wall(tmp_path_factory.mktemp("trust") / "wall")


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trusted") / "run"
    with drawn_curves():
        train.fit(training_data([scene]), folder, LEARNT, ["view_2"])
    return folder


def are_numbers(path: Path) -> bool:
    learner = torch.load(path, weights_only=True)["learner"]
    return all(bool(torch.isfinite(each).all()) for name in ("network", "average") for each in learner[name].values())


def test_a_loss_that_is_no_number_ends_with_one_sentence_and_the_last_good_checkpoint(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the sixth picture on (the third step of two) the loss is NaN; 0.002 is a tenth of the demo's learning rate."""
    loss, calls = run_module.loss, []

    def breaking(*arguments: object) -> torch.Tensor:
        calls.append(1)
        return loss(*arguments) * (math.nan if len(calls) > 5 else 1.0)  # type: ignore[arg-type]

    monkeypatch.setattr(run_module, "loss", breaking)
    done = mrbokeh("train", "fit", scene, *DEMO_WORDS, "--epochs", 4, "--set", "checkpoint_every_s=0", "--out", tmp_path / "run")
    assert (
        done.returncode == 2 and "after 2 steps" in done.stderr and "learning_rate=0.002" in done.stderr and "keeps the last" in done.stderr
    )
    assert are_numbers(tmp_path / "run" / "checkpoint.pt") and not (tmp_path / "run" / "network.pt").exists()
    calls += [1] * 5
    done = mrbokeh("train", "fit", scene, *DEMO_WORDS, "--epochs", 4, "--out", tmp_path / "first")
    assert done.returncode == 2 and "slices, all_in_focus.exr and depth.exr" in done.stderr


def test_weights_that_are_no_numbers_are_never_saved(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are spoilt in the last step, whose loss was still a number."""
    apply = Learner.apply

    def spoiling(learner: Learner, step: int) -> None:
        apply(learner, step)
        if step == 5:
            next(learner.network.parameters()).data.fill_(math.nan)

    monkeypatch.setattr(Learner, "apply", spoiling)
    settings = dataclasses.replace(DEMO_LIKE, epochs=2, checkpoint_every_s=0.0)
    refused("after 6 steps loss or weights are not numbers", train.fit, training_data([scene]), tmp_path / "run", settings, ["view_2"])
    assert are_numbers(tmp_path / "run" / "checkpoint.pt") and not (tmp_path / "run" / "network.pt").exists()


def test_a_loss_far_above_its_best_is_told_once(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    progress = Progress()
    for step in range(3 * FAR_ABOVE_STEPS):
        progress.took_step(0.2 if step == 0 else 1.0, 1)  # a dark picture first
    assert progress.steps_above == 0
    for _ in range(FAR_ABOVE_STEPS + 60):
        progress.took_step(2.0, 1)
    assert FAR_ABOVE_STEPS < progress.steps_above < FAR_ABOVE_STEPS + 60  # 35 steps until the smoothed loss is above 1.5
    monkeypatch.setattr(run_module, "FAR_ABOVE_STEPS", 2)
    before = Progress(step=50, best_loss=1e-12, smoothed_loss=1e-3)
    monkeypatch.setattr(run_module, "Progress", lambda: dataclasses.replace(before, curve=[]))
    train.fit(training_data([scene]), tmp_path / "run", dataclasses.replace(DEMO_LIKE, epochs=2, sheets=False), ["view_2"])
    (warning,) = [each for each in channel().warnings if "times its best" in each]
    assert "learning_rate=0.002" in warning
    channel().warnings.clear()


def test_the_plan_counts_steps_pictures_and_time() -> None:
    """150 steps of two pictures are 300, six for each of 50 slices; 600 steps of 0.5 s are five minutes."""
    minutes, epochs = demo_settings(2.0), dataclasses.replace(DEMO_LIKE, batch=1, validate_every_s=60.0)
    assert "about 150 steps of 0.8 s: 2 min; 300 crops, so that each of the 50 slices" in plan_words(150, 0.8, minutes, 50, 1)
    assert "about in 6.0 crops" in plan_words(150, 0.8, minutes, 50, 1)
    assert re.search(r"5 min, and the looks .* on top; 600 pictures, .* about 12 times", plan_words(600, 0.5, epochs, 50, 1))
    assert lower_rate(dataclasses.replace(minutes, learning_rate=6.0)) == "--set learning_rate=0.02"


def test_the_page_of_a_run_stands_alone(run: Path) -> None:
    """One strip for each of three held-out slices: sharp, the network at most six times, and the photograph."""
    page = (run / "index.html").read_text(encoding="utf-8")
    assert "finished: 60 steps" in page and page.count("<svg") == 1 and "preset demo" in page and "refresh" not in page
    assert page.count('class="strip"') == 3 and 3 * 3 <= page.count("<img") <= 3 * 8
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)


def test_the_card_measures_what_is_held_out_or_says_that_it_cannot(
    run: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Figures are the means of the three slices, computed here. The run stands for the exported file, which computes the same."""
    network, settings, facts = load_run(run)
    exported, blur = network_facts_of(network, settings.network, facts), blur_of(run)[0]
    monkeypatch.setattr(onnx_export, "blur_of", lambda _: (blur, None))
    write_card(run, tmp_path / "lens.onnx", exported, "fast, loses 0.1 dB")
    card = (tmp_path / "lens.md").read_text(encoding="utf-8")
    pairs = [read_pair(read_focal_stack(scene / "view_2"), index) for index in range(3)]
    decibels, similarities = zip(*((psnr(blur(each), each.target), ssim(blur(each), each.target)) for each in pairs), strict=True)
    assert f"this network: PSNR {np.mean(decibels):.2f} dB, SSIM {np.mean(similarities):.4f} (3 of 3 held-out slices" in card
    assert all(
        words in card for words in ("Held out: wall/view_2", "Focus: 0.5 to 0.8 m", "2.8 only", "any size", "60 steps", "ask whoever")
    )
    shutil.copytree(run, tmp_path / "run")
    document = json.loads((run / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps(document | {"roots": [str(tmp_path)], "licence": "CC0"}))
    assert "Form: fast, loses 0.1 dB" in card
    write_card(tmp_path / "run", tmp_path / "lens.onnx", exported, "plain")
    card = (tmp_path / "lens.md").read_text(encoding="utf-8")
    assert "dB while training" in card and "Focus: unknown" in card and "data: CC0" in card


def test_the_doctor_looks_at_everything_it_can(run: Path, scene: Path, tmp_path: Path) -> None:
    """A run of 60 steps on three slices of six stacks: few steps and slices, sound data. Then its blur is cut by half, and its
    pictures are gone."""
    whole = diagnose(run)
    assert not whole.unseen and len(whole.looked) == 12
    found = {" ".join(sentence.split()[:3]) for sentence in whole.found}
    assert {"Too few steps:", "Few held-out slices"} <= found and not {
        "The pictures are",
        "No lights to",
        "The learning rate",
        "It diverged: the",
    } & found
    shutil.copytree(run, tmp_path / "run")
    facts = json.loads((run / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps(facts | {"largest_coc_px": 0.5 * facts["largest_coc_px"]}))
    (tmp_path / "run" / "network.pt").unlink()
    said = printed_by(app, "doctor", tmp_path / "run")
    assert "blurred more than the network reaches" in said and "not looked at" in said
    (tmp_path / "run" / "run.json").write_text(json.dumps(facts | {"roots": []}))
    assert len(diagnose(tmp_path / "run").unseen) == 6 and not diagnose(run, training_data([scene]).stacks).unseen


def case(settings: TrainSettings, run: Path, losses: list[float], decibels: list[float]) -> Case:
    """A run of 1000 steps with these losses and looks, evenly spread."""
    steps = [1000 * (index + 1) // len(losses) for index in range(len(losses))]
    points = zip(steps, losses, decibels, strict=True)
    curve = [CurvePoint(step=step, elapsed_s=1.0, loss=loss, held_out_psnr_db=db, learning_rate=1e-3) for step, loss, db in points]
    progress = Progress(step=1000, pictures=4000, smoothed_loss=losses[-1], best_loss=min(losses), finished=True, curve=curve)
    return Case(folder=run, settings=settings, facts=read_facts(run), progress=progress, pictures=None)


def test_the_doctor_reads_curves(run: Path) -> None:
    """Each fault alone, and none in a curve that fell and stands."""
    demo, fallen, nan = demo_settings(), [4e-5, 2e-5, 1.6e-5, 1.55e-5, 1.5e-5], math.nan
    sound = case(demo, run, fallen, [28.0, 29.0, 29.2, 29.25, 29.25])
    assert not any(check(sound) for check in (_steps, _falling, _diverged, _overfitted, _rate, _tiles))
    assert "gained 1.1 dB" in _falling(case(demo, run, fallen, [24.0, 25.0, 26.0, 27.0, 27.1]))
    assert "the loss went from 2.00e-05 to 1.00e-05" in _falling(case(demo, run, [4e-5, 3e-5, 2e-5, 1.5e-5, 1e-5], [nan] * 5))
    assert "--set learning_rate=0.002" in _diverged(case(demo, run, [4e-5, 3e-5, 6e-5, 7e-5, 7e-5], [nan] * 5))
    assert "lost 1.00 dB" in (_overfitted(case(demo, run, fallen, [28.0, 29.0, 28.7, 28.2, 28.0])) or "")
    for rate, words in (
        (0.6, "too high: 0.6, 30 times that of the preset demo"),
        (1e-4, "too low: 0.0001, 1/100 of that of the preset better"),
    ):
        assert words in _rate(dataclasses.replace(sound, settings=dataclasses.replace(demo, learning_rate=rate)))
    tiled = dataclasses.replace(TrainSettings(), network=dataclasses.replace(TrainSettings().network, tile_px=16, overlap_px=4))
    assert "too small for the blur" in _tiles(dataclasses.replace(sound, settings=tiled))


def scores(network_db: float) -> Evaluation:
    """A network beside no blur at 22 dB and a disc at 27 dB, as on the traced stacks."""
    levels = {NETWORK: network_db, NO_BLUR: 22.0, DISC: 27.0}
    return Evaluation(
        scores=tuple(Score(stack="wall/a", slice_index=0, method=name, psnr_db=decibel, ssim=0.9) for name, decibel in levels.items()),
        networks=(NETWORK,),
        rivals=(),
        flicker={},
        peak_memory_mib={},
    )


def test_the_doctor_looks_at_pictures(run: Path) -> None:
    """Each fault of data and result alone; the network reaches 5 px with N = 2."""
    sound = case(demo_settings(), run, [4e-5, 2e-5, 1.6e-5, 1.55e-5, 1.5e-5], [28.0, 29.0, 29.2, 29.25, 29.25])
    data = RunData((), ())
    seen = Pictures(
        data=data, held_out=scores(29.0), train=scores(29.4), looks=(Look(3.0, 0.0, 15.0, 0.0),), left_out=0.1, by_depth=0.1, clipped=0.0
    )

    def told(check: Callable[[Case], str | None], settings: TrainSettings = sound.settings, **changed: object) -> str:
        pictures = dataclasses.replace(seen, **changed)  # type: ignore[arg-type]
        return check(dataclasses.replace(sound, settings=settings, pictures=pictures)) or ""

    assert not any(told(check) for check in (_overfitted, _blur, _lights, _counted, _better))
    small = dataclasses.replace(demo_settings(), network=dataclasses.replace(demo_settings().network, blocks=2))
    assert "up to 9.0 px, it reaches 5.0 px, and 20%" in told(_blur, small, looks=(Look(9.0, 0.2, 15.0, 0.0),))
    assert "clipped there: 0.4%" in told(_lights, looks=(Look(3.0, 0.0, 1.0, 0.004),))
    assert "and none is cut" in told(_lights, looks=(Look(3.0, 0.0, 0.8, 0.0),))
    left_out = dataclasses.replace(demo_settings(), sensor_white=None)
    assert "5.0% of the slices' pixels are saturated" in told(_lights, left_out, clipped=0.05) and not told(_lights, clipped=0.05)
    assert "70% of the pixels do not count, 60% because" in told(_counted, left_out=0.7, by_depth=0.6)
    assert "+4.0 dB over a disc of the right size on slices it learnt from, +2.0 dB on held-out" in told(_overfitted, train=scores(31.0))
    assert "no better than no blur" in told(_better, held_out=scores(22.5))
    assert "no better than a disc" in told(_better, held_out=scores(26.9))
