"""The bench of real stacks on stacks that are made here: what it finds, where it lays a peer's picture, how it ranks and judges."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.report.picture_sharpness import SharpestSlices, block_detail
from capture.stacks.slice_looks import BLOCK_PX
from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from tests.bench.fusion_measures import FusionScores
from tests.bench.process_cost import attempted
from tests.bench.real_crops import worst_places, write_crops
from tests.bench.real_page import Bench, bars, flat_met, lost_met, write_bench_page
from tests.bench.real_pairs import OURS, ranked
from tests.bench.real_peers import features_of_slices, on_slices, slices_from_picture
from tests.bench.real_result import LeaveOneOut, Shown, StackResult
from tests.bench.real_sets import find_stacks, missing_sets
from tests.bench.real_stack import Figures, covered_blocks, measured_where

SIDE_PX = 14 * BLOCK_PX


def blobs(seed: int = 1) -> np.ndarray:
    """Linear Rec.709 that SIFT finds points in."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((SIDE_PX, SIDE_PX, 3)).astype(np.float32), (0, 0), 2.0)
    return srgb_to_linear(np.clip(0.5 + 4.0 * (noise - 0.5), 0.0, 1.0))


def write(path: Path, rgb: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.rint(255.0 * linear_to_srgb(rgb)).astype(np.uint8)[..., ::-1])
    return path


def test_stacks_are_found_in_the_layout_of_the_sets(tmp_path: Path) -> None:
    names = [f"lytro_stacks/{stack}__refocus_0{k}.jpg" for stack in (2, 10) for k in range(3)]
    names += ["balls/00.jpg", "balls/01.jpg", "balls/02.jpg", "pixel6_desk/image_1_0.50.jpg", "pixel6_desk/image_2_2.00.jpg"]
    names += ["depth_focal_stack/Data/0.png", "depth_focal_stack/Data/1.png", "depth_focal_stack/All_in_Focus/afocus.png"]
    names += ["lytro_pairs/lytro_01/lytro_01_A.jpg", "lytro_pairs/lytro_01/lytro_01_B.jpg", "lytro_pairs_fused/lytro_01_CNN.jpg"]
    names += ["pcb/1.jpg", "pcb/2.jpg", "pcb/10.jpg", "pcb/reference_fused.jpg", "photographs/a.jpg", "photographs/b.jpg", "alone/1.jpg"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "balls" / "focus_distance.txt").write_text("8.0\n4.0\n2.0\n")
    found = {stack.name: stack for stack in find_stacks(tmp_path)}
    expected = {"balls", "depth_focal_stack", "lytro_pairs/lytro_01", "lytro_stacks/2", "lytro_stacks/10", "pcb", "pixel6_desk"}
    assert set(found) == expected
    assert [path.name for path in found["pcb"].photographs] == ["1.jpg", "2.jpg", "10.jpg"]
    assert [len(found[name].photographs) for name in ("lytro_stacks/10", "depth_focal_stack")] == [3, 2]
    assert found["balls"].stated_dioptres == (0.125, 0.25, 0.5) and found["pixel6_desk"].stated_dioptres == (2.0, 0.5)
    assert [name for name, stack in found.items() if stack.is_pair] == ["lytro_pairs/lytro_01"]
    assert {"few_slices", "fusion_values"} <= set(missing_sets(tmp_path)) and "balls" not in missing_sets(tmp_path)
    before = found["pcb"].digest
    (tmp_path / "pcb" / "2.jpg").write_bytes(b"another photograph")
    assert {stack.name: stack for stack in find_stacks(tmp_path)}["pcb"].digest != before


def test_a_program_that_fails_says_how_and_one_that_hangs_is_ended() -> None:
    failed = attempted(["bash", "-c", "echo first >&2; echo why; exit 3"])
    assert failed.exit_code == 3 and failed.last_line == "why" and failed.cpu_s < 1.0
    assert attempted(["bash", "-c", "kill -11 $$"]).exit_code == 128 + 11
    hung = attempted(["bash", "-c", "sleep 60"], timeout_s=0.5)
    assert hung.exit_code == 124 and "no end after" in hung.last_line


def test_memory_is_that_of_the_program() -> None:
    # 200 MB of ones (190.7 MiB) are touched by the started program, and none by a plain one. At their start both take 8 to 11 MiB, some of
    # which is free again when the ones are made.
    large, plain = (attempted(["python3", "-c", code]).memory_mb for code in ("x = b'1' * 200_000_000", "pass"))
    assert 180.0 < large - plain < 215.0


def test_a_peers_picture_is_laid_on_the_slices(tmp_path: Path) -> None:
    """A picture enlarged by 2 %, turned by 0.5 degrees and moved by (5, -3) px is laid back to a tenth of a pixel."""
    slices_from_world = cv2.getRotationMatrix2D((SIDE_PX / 2, SIDE_PX / 2), 0.5, 1.02)
    slices_from_world[:, 2] += np.array([5.0, -3.0])
    world = blobs()
    moved = np.clip(cv2.warpAffine(world, slices_from_world, (SIDE_PX, SIDE_PX), flags=cv2.INTER_CUBIC), 0.0, 1.0)
    features = features_of_slices([moved, moved], 2)
    affine = slices_from_picture(features_of_slices([world], 1)[0], features)
    assert affine is not None
    corners = np.array([[30, 30, 1], [30, SIDE_PX - 30, 1], [SIDE_PX - 30, 30, 1], [SIDE_PX - 30, SIDE_PX - 30, 1]]).T
    assert np.abs(affine @ corners - slices_from_world @ corners).max() < 0.1
    laid = on_slices(write(tmp_path / "peer.png", world), features, (SIDE_PX, SIDE_PX))
    assert laid is not None
    inner = (slice(30, -30), slice(30, -30))
    assert np.abs(linear_to_srgb(laid[0]) - linear_to_srgb(moved))[inner].mean() < 0.01
    assert not laid[1][SIDE_PX // 2, 0] and laid[1][inner].all()  # it was moved right by 5 px


def test_nothing_is_laid_where_nothing_matches(tmp_path: Path) -> None:
    features = features_of_slices([blobs(1)], 1)
    assert on_slices(write(tmp_path / "peer.png", blobs(2)), features, (SIDE_PX, SIDE_PX)) is None


def test_a_peer_has_not_lost_what_it_left_out() -> None:
    """Half of a picture blurred: half of its textured blocks are lost, and none where the blurred half is not covered."""
    sharp = blobs()
    half = np.arange(SIDE_PX) < SIDE_PX // 2
    picture = np.where(half[:, None], cv2.GaussianBlur(sharp, (0, 0), 8.0), sharp)
    sharpest = SharpestSlices.of([sharp])
    measured = sharpest.measure(picture)
    assert measured.lost == pytest.approx(0.5, abs=0.1)
    covered = np.broadcast_to(~half, (SIDE_PX, SIDE_PX))
    assert covered_blocks(covered).shape == block_detail(sharp).shape
    assert measured_where(sharpest, measured, covered_blocks(covered))[0] == 0.0
    assert measured_where(sharpest, measured, covered_blocks(np.ones_like(covered)))[0] == measured.lost


def test_crops_show_the_worst_places(tmp_path: Path) -> None:
    sharp = blobs()
    picture = sharp.copy()
    hole = (slice(4 * BLOCK_PX, 5 * BLOCK_PX), slice(8 * BLOCK_PX, 9 * BLOCK_PX))
    picture[hole] = 0.2
    picture[198:203, 58:63] = 8.0
    picture[200, 60] = 9.0
    nothing = SharpestSlices.of([np.full_like(sharp, 0.2), sharp], [None, np.zeros(sharp.shape[:2], bool)])
    assert (nothing.index == 0).all(), "what stands where a slice has no data is not sharp"
    sharpest = SharpestSlices.of([np.full_like(sharp, 0.2), sharp])
    measured = sharpest.measure(picture)
    places = worst_places(sharpest, measured, picture, top_bar=1.5)
    kinds = [place.said.split()[0].strip(",") for place in places]
    assert kinds[0] == "keeps" and kinds[-1] == "largest" and "flat" in kinds
    # Whether the hole was among the textured half is the picture's affair; the largest value is where it was put.
    assert (places[-1].x, places[-1].y) == (60, 200)
    crops = write_crops(tmp_path, "stack_0", places[-1], lambda index: (np.full_like(sharp, 0.2), sharp)[index], {OURS: picture})
    assert [crop.name for crop in crops] == ["sharpest slice (1)", OURS]
    beside, shown = (np.asarray(cv2.imread(str(tmp_path / crop.file))) for crop in crops)
    assert shown.shape == (7 * BLOCK_PX, 7 * BLOCK_PX, 3)
    # The light is 9 times white beside blobs; the crop begins at x = 0 and y = 200 - 84.
    assert shown[84, 60].min() > 240 and int(shown[84, 60].min()) > int(beside[84, 60].min())


def test_ranks_count_from_one_and_equal_values_share_theirs() -> None:
    scores = {
        "one": {OURS: FusionScores(0.9, 0.8, 0.5, 0.5), "x": FusionScores(0.8, 0.8, 0.6, 0.1), "y": FusionScores(0.7, 0.7, 0.7, 0.2)},
        "two": {OURS: FusionScores(0.1, 0.9, 0.5, 0.5), "x": FusionScores(0.2, 0.8, 0.6, 0.1), "y": FusionScores(0.3, 0.7, 0.7, 0.2)},
    }
    found = ranked(scores)
    assert found.ranks[0, found.methods.index(OURS)].tolist() == [1.0, 1.5, 3.0, 1.0]
    assert found.ranks[1, found.methods.index(OURS)].tolist() == [3.0, 1.0, 3.0, 1.0]
    assert found.mean_rank() == pytest.approx((1 + 1.5 + 3 + 1 + 3 + 1 + 3 + 1) / 8)
    # Means over the pairs: 0.5, 0.5, 0.5 by the first measure; 0.85, 0.8, 0.7 by the second.
    np.testing.assert_allclose(found.rank_of_means()[:2], [2.0, 1.0])


def result(lost: float, flat: float, top: float = 1.0, failure: str = "", **peers: tuple[float, float]) -> StackResult:
    figures = {OURS: Figures(lost, flat, top, 10.0, 500.0)} | {name: Figures(*each, 1.0, 5.0, 100.0) for name, each in peers.items()}
    return StackResult("lytro_stacks/1", 5, failure, {"process": (2.0, 400.0, 0)}, (100, 100), figures)


def test_bars_look_at_the_peers() -> None:
    assert lost_met(result(0.002, 1.0)) and not lost_met(result(0.0021, 1.0))
    assert not lost_met(result(0.002, 1.0, FocusWeave=(0.0, 1.0), enfuse=(0.01, 1.0)))
    assert flat_met(result(0.0, 1.1)) and not flat_met(result(0.0, 1.2, FocusWeave=(0.0, 1.0)))
    assert flat_met(result(0.0, 2.0, FocusWeave=(0.0, 2.1), enfuse=(0.0, 2.3))) and not flat_met(result(0.0, 2.2, FocusWeave=(0.0, 2.1)))
    assert lost_met(StackResult("a", 2, "exit 2", {})) is None


def test_the_page_counts_crashes_and_holds_its_pictures(tmp_path: Path) -> None:
    picture = blobs()
    sharpest = SharpestSlices.of([picture])
    place = worst_places(sharpest, sharpest.measure(picture), picture, 1.5)[0]
    shown = Shown(place, write_crops(tmp_path, "s", place, lambda _: picture, {OURS: picture}))
    good = result(0.0, 1.0, FocusWeave=(0.0, 1.0))
    good = StackResult(**vars(good) | {"shown": [shown], "refocus": LeaveOneOut(34.0, 35.0, 30.0)})
    bad = StackResult("few_slices/bench", 2, "capture merge: exit 2: error: <two slices>", {})
    bench = Bench([good, bad], ["FocusWeave"], ["a machine"], tmp_path)
    found = {bar.name: bar for bar in bars(bench)}
    assert found["every stack and pair runs"].found == "1 of 2 failed"
    assert found["a Lytro slice left out, rendered"].met and not found["a Lytro slice left out, with residuals"].met
    write_bench_page(tmp_path / "page.html", bench)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 2 and 'src="http' not in page
    assert "error: &lt;two slices&gt;" in page and "2.00 times the CPU seconds of FocusWeave" in page
