"""Evaluation: where the telling pixels lie, what each measure sees, and that tables hold what was computed."""

import csv
import dataclasses
import shutil
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.optics.psf_bank_file import write_bank
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.stacks.focal_stack import write_focal_stack
from tests.support.card_stack import CARD_M, CARD_PX, LENS, SIZE, WALL_M, make_card_scene, make_card_stack
from tests.support.command_line import printed_by
from tests.support.made_networks import jittered
from tests.support.refusals import refused
from tests.training.test_train import DEMO_LIKE
from training.cli import app
from training.data.dataset import PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.stacks import Seen
from training.data.training_data import training_data
from training.evaluation.comparison import Extras, Unseen, compare, focus_pull, is_fine, peak_memory_mib, scored, unseen_of
from training.evaluation.methods import (
    GATHERED,
    NETWORK,
    NO_BLUR,
    REFERENCE,
    SCATTERED,
    Method,
    blur_of,
    lens_methods,
    network_names,
    plain_methods,
    renderer_method,
    renderer_methods,
)
from training.evaluation.report import HEADINGS, table_rows
from training.evaluation.scores import MEASURES, OnnxPerceptualDistance, Score, SliceScorer, mean_known
from training.evaluation.unseen_slice import UnseenSlice, edge_band, highlight_discs, sharp_side, unseen_slice
from training.fitting import train
from training.fitting.run_folder import load_run, save_network

ON_THE_CARD, ON_THE_WALL = 0, 2


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_card_scene(tmp_path_factory.mktemp("evaluation") / "card")


@pytest.fixture(scope="module")
def runs(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A trained network, and another one: its weights a little off."""
    first, second = (tmp_path_factory.mktemp("runs") / f"seed_{seed}" for seed in range(2))
    train.fit(training_data([scene]), first, dataclasses.replace(DEMO_LIKE, epochs=1), ["view_1"])
    shutil.copytree(first, second)
    save_network(second, jittered(load_run(first)[0], 0.01))
    return [first, second]


def slice_of(scene: Path, index: int) -> UnseenSlice:
    return unseen_slice(PairSet(training_data([scene]).stacks[:1], WHERE_TRUTH_IS_KNOWN, cache_mib=0), index)


def test_the_band_and_the_sharp_side_follow_the_blur(scene: Path) -> None:
    """Focused on the card, the wall's circle of confusion is LENS.coc_px; half of it, rounded up, on both sides of the card's edge."""
    seen = slice_of(scene, ON_THE_CARD)
    reach = int(np.ceil(LENS.focused_at(CARD_M).coc_px(WALL_M, SIZE[1]) / 2))
    band = np.flatnonzero(edge_band(seen)[SIZE[0] // 2])
    assert (band[0], band[-1]) == (CARD_PX - 1 - reach, CARD_PX + reach)
    assert not edge_band(dataclasses.replace(seen, depth_m=np.full(SIZE, CARD_M, np.float32))).any()
    card, wall = (sharp_side(slice_of(scene, index)) for index in (ON_THE_CARD, ON_THE_WALL))
    assert card[:, :CARD_PX].any() and not card[:, CARD_PX:].any()
    assert wall[:, CARD_PX:].any() and not wall[:, :CARD_PX].any()


def test_discs_of_lights_have_their_size(scene: Path) -> None:
    """One light of 20 in the middle of a blur of d px: about pi d^2 / 4 pixels, within d / 2 and a pixel; where it is sharp none."""
    seen = slice_of(scene, ON_THE_CARD)
    rgb, coc_px = np.zeros((*SIZE, 3), np.float32), np.full(SIZE, 12.0, np.float32)
    rgb[24, 36] = 20.0
    lit = dataclasses.replace(seen, pair=dataclasses.replace(seen.pair, all_in_focus=rgb, coc_px=coc_px))
    rows, columns = np.nonzero(highlight_discs(lit))
    assert np.hypot(rows - 24, columns - 36).max() <= 7.0
    assert len(rows) == pytest.approx(np.pi * 36.0, rel=0.1)
    assert not highlight_discs(dataclasses.replace(lit, pair=dataclasses.replace(lit.pair, coc_px=coc_px * 0))).any()
    assert not highlight_discs(dataclasses.replace(lit, pair=dataclasses.replace(lit.pair, all_in_focus=np.minimum(rgb, 1.0)))).any()


def test_every_failure_is_seen_by_its_measure_and_the_truth_has_none(scene: Path) -> None:
    seen = slice_of(scene, ON_THE_CARD)
    score = SliceScorer(seen).score("truth", seen.pair.target)
    assert (score.psnr_db, score.edge_psnr_db, score.energy_ratio) == (float("inf"), float("inf"), 1.0)
    assert (score.leak, score.highlight_error) == (0.0, 0.0) and score.ssim == pytest.approx(1.0)
    # Light of the wall over the sharp card is leak; lights cut off are a highlight error that PSNR hardly sees; both alone.
    seen = slice_of(scene, ON_THE_CARD)
    truth, scorer = seen.pair.target, SliceScorer(seen)
    clipped = scorer.score("clipped", np.minimum(truth, 0.5 * truth.max()))
    over_card = truth.copy()
    over_card[:, CARD_PX - 3 : CARD_PX] += 0.2
    leaking = scorer.score("leaking", over_card)
    assert clipped.highlight_error > 0.05 and clipped.leak == 0.0
    assert leaking.leak > 0.05 and leaking.highlight_error < 1e-6 + clipped.highlight_error / 5
    assert leaking.edge_psnr_db < leaking.psnr_db
    assert scorer.score("dark", truth * 0.5).energy_ratio == pytest.approx(0.5, rel=1e-5)


def test_gaussians_leak_and_renderers_do_not(scene: Path) -> None:
    """A scattered Gaussian throws the blurred wall over the sharp card. The scatter renderer made the truth."""
    result = scored([*plain_methods(), renderer_method("scatter")], Unseen(training_data([scene]).stacks[:1]), Extras(memory=False))
    on_card = {each.method: each for each in result.scores if each.slice_index == ON_THE_CARD}
    assert on_card[SCATTERED].leak > 0.005 > 1e-4 > on_card[REFERENCE].leak
    assert on_card[REFERENCE].psnr_db > 60.0
    assert result.rivals == (SCATTERED, GATHERED) and result.networks == ()


def test_renderers_get_the_blur_of_the_registered_slice(tmp_path: Path) -> None:
    """Registration enlarged the slice by 5 %, its blur with it; depth and lens together give just the pair's circles of confusion."""
    stack = make_card_stack(tmp_path / "view", 0)
    slices = tuple(dataclasses.replace(each, scale=1.05) for each in stack.slices)
    write_focal_stack(dataclasses.replace(stack, slices=slices))
    seen = slice_of(tmp_path, ON_THE_WALL)
    assert np.allclose(seen.lens.coc_px(seen.depth_m, SIZE[1]), seen.pair.coc_px, atol=1e-5)
    assert seen.pair.coc_px[0, 0] == pytest.approx(1.05 * LENS.focused_at(WALL_M).coc_px(CARD_M, SIZE[1]), rel=1e-5)
    assert seen.focused_at(CARD_M).pair.coc_px[0, 0] == pytest.approx(0.0, abs=1e-5)


def flickering(amplitude: float) -> Method:
    """The polygon renderer with a picture that is brighter and darker in turn."""
    calm, frames = renderer_method("polygon"), []

    def blur(seen: UnseenSlice) -> np.ndarray:
        frames.append(seen)
        return (calm.blur(seen) + np.float32(amplitude * (-1) ** len(frames))).astype(np.float32)

    return Method("flickering", blur, "renderer")


def test_a_network_that_flickers_scores_worse_and_a_fine_stack_is_its_own_pull(scene: Path, tmp_path: Path) -> None:
    """Between slices the truth is the polygon renderer itself; alternating by 0.02 scores 0.02, less what is clipped at 0 and 1."""
    pull = focus_pull(training_data([scene]).stacks[0], frames=5)
    focus_m = [frame.lens.focus_distance_m for frame in pull.frames]
    assert focus_m[0] == pytest.approx(0.55) and focus_m[-1] == pytest.approx(CARD_M)
    assert np.allclose(np.diff(1.0 / np.array(focus_m)), (1 / CARD_M - 1 / 0.55) / 4)
    methods = (renderer_method("polygon"), renderer_method("scatter"), flickering(0.02), flickering(0.05))
    calm, exact, less, more = (pull.flicker_of(each) for each in methods)
    assert calm == 0.0 and less == pytest.approx(0.02, rel=0.05) and more > less > exact
    # Steps of 1 px in the circle of confusion: 1 / coc_px_per_dioptre dioptres each.
    step = 1.0 / LENS.focused_at(CARD_M).coc_px_per_dioptre(SIZE[1])
    focus_m = tuple(float(1.0 / (1.0 / WALL_M + step * index)) for index in range(5))
    stack = make_card_stack(tmp_path / "view", 0, focus_m)
    pull = focus_pull(stack)
    assert is_fine(stack) and len(pull.frames) == 5 and pull.against == "its own slices"
    assert pull.flicker_of(renderer_method("scatter")) < 1e-5
    assert pull.flicker_of(plain_methods()[0]) > 1e-4
    assert not is_fine(dataclasses.replace(stack, slices=stack.slices[::2]))


def write_distance(path: Path, inputs: int = 2) -> Path:
    """Mean absolute difference of two pictures as a network, in the place of LPIPS."""
    size = [1, 3, "height", "width"]
    given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, size) for name in ("a", "b")[:inputs]]
    steps = (("Sub", ["a", "b" if inputs == 2 else "a"], "difference", {}), ("Abs", ["difference"], "absolute", {}))
    steps += (("ReduceMean", ["absolute"], "distance", {"keepdims": 1}),)
    nodes = [helper.make_node(name, inputs_of, [output], **options) for name, inputs_of, output, options in steps]
    graph = helper.make_graph(nodes, "distance", given, [helper.make_tensor_value_info("distance", TensorProto.FLOAT, [1, 1, 1, 1])])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return path


def test_perceptual_distance_sees_what_a_display_shows(tmp_path: Path) -> None:
    """White against linear 0.5: [-1, 1] is twice as wide as [0, 1], so 2 (1 - sRGB(0.5)); radiance above white looks like white."""
    distance = OnnxPerceptualDistance(write_distance(tmp_path / "distance.onnx"))
    grey, white = np.full((8, 9, 3), 0.5, np.float32), np.full((8, 9, 3), 7.0, np.float32)
    assert distance(white, grey) == pytest.approx(2.0 * (1.0 - float(linear_to_srgb(np.array([0.5]))[0])), rel=1e-5)
    assert distance(grey, grey) == 0.0
    refused("take two pictures", OnnxPerceptualDistance, write_distance(tmp_path / "one.onnx", inputs=1))
    refused("LPIPS as an", OnnxPerceptualDistance, tmp_path / "absent.onnx")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells how much memory was in use")
def test_peak_memory_counts_what_was_given_back() -> None:
    """64 MiB that live only within the work."""
    assert peak_memory_mib(lambda: np.ones(2**23).sum()) == pytest.approx(64.0, abs=4.0)


def test_renderers_with_a_measured_bank(scene: Path, tmp_path: Path) -> None:
    """A bank of the true opening, sampled per pixel of blur, is as good as the opening itself; networks and LRDM take none."""
    pairs = PairSet(training_data([scene]).stacks[:1], WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    seen = unseen_slice(pairs, 0)
    reach = float(np.abs(seen.pair.coc_px).max()) + 1.0
    axes, counts = (Axis("diameter_px", -reach, reach),), (2 * int(reach) + 1,)
    cells = physical_boxes(axes, NestedGrid(counts, nested=False)).mean(axis=2)[:, 0]
    kernels = tuple(seen.lens.aperture.rasterize(abs(float(size))).kernel[..., None].astype(np.float32) for size in cells)
    write_bank(tmp_path / "bank", PsfBank("measured", axes, counts, kernels, nested=False))
    (measured,) = lens_methods(["scatter", "lrdm"], tmp_path / "bank")
    assert (measured.name, measured.kind) == ("scatter, bank", "renderer")
    exact = renderer_method("scatter").blur(seen)
    assert psnr(measured.blur(seen), exact) > 45.0 > psnr(seen.pair.all_in_focus, exact)


def read_numbers(path: Path) -> list[Score]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [Score(row["stack"], int(row["slice_index"]), row["method"], **{name: float(row[name]) for name in MEASURES}) for row in rows]


@pytest.mark.slow
def test_many_networks_on_stacks_that_none_has_seen(scene: Path, runs: list[Path], tmp_path: Path) -> None:
    """The table's numbers are those computed here from the runs, and both come back from the CSV."""
    write_distance(tmp_path / "distance.onnx")
    arguments = ["evaluate", *runs, "--data", scene, "--out", tmp_path / "out", "--renderer", "polygon", "--pull", "3"]
    told = printed_by(app, *arguments, "--lpips", tmp_path / "distance.onnx")
    scores = read_numbers(tmp_path / "out" / "evaluation.csv")
    assert {each.stack for each in scores} == {"card/view_1"}
    assert {each.method for each in scores} == {"seed_0", "seed_1", NO_BLUR, SCATTERED, GATHERED, "polygon"}
    pairs = PairSet(training_data([scene]).stacks[1:], WHERE_TRUTH_IS_KNOWN)
    for run in runs:
        expected = [psnr(blur_of(run)[0](pairs[index]), pairs[index].target) for index in range(len(pairs))]
        assert [each.psnr_db for each in scores if each.method == run.name] == pytest.approx(expected, abs=1e-4)
        assert f"| {run.name} | {np.mean(expected):.2f} |" in (tmp_path / "out" / "evaluation.md").read_text()
        assert f"{run.name} over no blur" in told
    assert all(each.lpips >= 0 and each.seconds >= 0 for each in scores)
    assert {each.name for each in (tmp_path / "out").iterdir()} == {f"evaluation{end}" for end in (".md", ".csv", ".png", "_crops.png")}


@pytest.mark.slow
def test_one_network_with_its_data_behind_it(scene: Path, runs: list[Path]) -> None:
    """The short form; the network is called "network" and its results lie in its run. No weights of LPIPS: the table says so."""
    told = printed_by(app, "evaluate", runs[0], scene, "--renderer", "none", "--pull", "0")
    with (runs[0] / "evaluation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {NETWORK, NO_BLUR, SCATTERED, GATHERED}
    assert set(rows[0]) == {"stack", "slice_index", "method", *MEASURES}
    assert "network over no blur" in told and "no weights are shipped" in (runs[0] / "evaluation.md").read_text()


def test_what_evaluate_wants_and_names_of_networks(scene: Path, runs: list[Path]) -> None:
    refused("give --data", printed_by, app, "evaluate", runs[0])
    refused("give --out", printed_by, app, "evaluate", *runs, "--data", scene)
    refused("trained on every slice of these", unseen_of, training_data([scene]).stacks, [Seen(("card/view_0", "card/view_1"))])
    assert network_names([Path("runs/a")]) == [NETWORK]
    assert network_names([Path("runs/a"), Path("b.onnx")]) == ["a", "b"]
    assert network_names([Path("x/lens.onnx"), Path("y/lens.onnx")]) == ["x/lens.onnx", "y/lens.onnx"]
    refused("expected --renderer out of .* got gauss: give one of these", renderer_methods, ["gauss"])
    refused("got a.onnx: networks are named first", renderer_methods, ["a.onnx"])
    assert mean_known([1.0, float("nan"), 3.0]) == 2.0
    assert np.isnan(mean_known([float("nan")]))


def test_the_table_is_sorted_and_has_a_cell_for_everything(scene: Path, tmp_path: Path) -> None:
    result = compare(plain_methods(), Unseen(training_data([scene]).stacks[:1]), tmp_path, Extras(pull_frames=3))
    rows = table_rows(result)
    assert all(len(row) == len(HEADINGS) for row in rows)
    decibels = [float(row[1]) for row in rows]
    assert decibels == sorted(decibels, reverse=True)
    assert "the polygon renderer between card/view_0 slice" in (tmp_path / "evaluation.md").read_text()
