"""Training on more than fits in memory: a few rows at a time, read ahead, the same whatever is read when."""

import pickle
import threading
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mrbokeh.images.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.optics.camera import field_positions
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused
from training.data.batches import Batch, Drawing, draw_batch, draw_share, network_inputs, stack_pairs
from training.data.dataset import PairSet, ReadAhead, Window, read_pair
from training.data.exr_rows import exr_size_px, read_rows
from training.data.pairs import Counting
from training.data.training_data import gather_facts

SIZE = (200, 330)
MATRIX = ((1.7, -0.6, -0.1), (-0.3, 1.6, -0.3), (0.05, -0.55, 1.5))
LENS = Lens(50.0, 1.4, 1.0, 36.0)
FOCUS_M = (0.8, 1.0, 1.5)
PAIR_BYTES = SIZE[0] * SIZE[1] * 8 * 4
MIB = 2**20


def write_stack(folder: Path, seed: int, lens: Lens = LENS) -> FocalStack:
    """Three slices of noise, masks in each, depth from 0.7 to 2 m."""
    rng = np.random.default_rng(seed)

    def picture() -> np.ndarray:
        return rng.random((*SIZE, 3)).astype(np.float32)

    for index in range(3):
        masks = {"saturated": rng.random(SIZE) < 0.1, "valid": rng.random(SIZE) < 0.9}
        write_camera_rgb(folder / f"registered/{index:02d}.exr", picture(), MATRIX, **masks)
    depth_m = np.tile(np.linspace(0.7, 2.0, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    write_merged(folder, picture(), np.ones(SIZE, np.float32), rng.random(SIZE, np.float32), depth_m, MATRIX)
    write_masks(folder / "exclusion.exr", {name: rng.random(SIZE) < 0.1 for name in ("moving", "board", "low_confidence", "saturated")})
    slices = tuple(Slice(f"registered/{index:02d}.exr", focus, scale=1.01) for index, focus in enumerate(FOCUS_M))
    stack = FocalStack(folder, slices, lens, None, 0, registered=True, merged=True, rec709_from_camera=MATRIX)
    write_focal_stack(stack)
    return stack


@pytest.fixture(scope="module")
def stacks(tmp_path_factory: pytest.TempPathFactory) -> list[FocalStack]:
    folder = tmp_path_factory.mktemp("stacks")
    return [write_stack(folder / f"view_{view}", view) for view in range(3)]


def same(first: Batch, second: Batch) -> bool:
    return all(torch.equal(part, second.parts()[name]) for name, part in first.parts().items())


@pytest.mark.parametrize("lens", [LENS, replace(LENS, tilt_rad=(0.01, 0.05), petzval_radius_mm=75.0)], ids=["flat", "tilted and curved"])
@pytest.mark.parametrize("rows", [slice(0, 1), slice(13, 101), slice(176, 200)])
def test_rows_are_those_of_the_whole_picture(stacks: list[FocalStack], lens: Lens, rows: slice) -> None:
    """Against the methods of the stack, which read whole files by OpenEXR: to the last bit."""
    stack = replace(stacks[0], lens=lens)
    pair = read_pair(stack, 1, Counting(one_sided=True), rows)
    masks, exclusions = stack.slice_masks(1), stack.exclusions()
    counted = masks.valid & (stack.depth_confidence() >= 0.1)
    counted &= ~(exclusions["moving"] | exclusions["board"] | exclusions["low_confidence"])
    np.testing.assert_array_equal(pair.target, stack.slice_rgb(1)[rows])
    np.testing.assert_array_equal(pair.all_in_focus, stack.all_in_focus()[rows])
    np.testing.assert_allclose(pair.coc_px, stack.coc_px(1, stack.depth_m())[rows], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(pair.saturated, masks.saturated[rows])
    np.testing.assert_array_equal(pair.weight, counted[rows])
    np.testing.assert_array_equal(read_pair(stack, 1, None, rows).weight, (counted & ~masks.saturated)[rows])


@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PIZ"])
def test_files_of_any_compression(tmp_path: Path, compression: str) -> None:
    """Half and float side by side, an odd size, noise (which ZIP stores as it is) and a flat part. PIZ is read whole and cut."""
    import OpenEXR

    rng = np.random.default_rng(0)
    noise = np.frombuffer(rng.bytes(53 * 41 * 4), np.uint32).reshape(53, 41)
    noise = (noise & 0x7F7FFFFF).view(np.float32).copy()
    flat = np.zeros((53, 41), np.float16)
    flat[20:] = 3.0
    attributes = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    write_exr(tmp_path / "a.exr", ExrPart({"noise": noise, "flat": flat}, attributes=attributes))
    assert exr_size_px(tmp_path / "a.exr") == (53, 41)
    whole = read_exr(tmp_path / "a.exr")[0].channels
    for rows in (slice(0, 53), slice(15, 17), slice(50, 53)):
        found = read_rows(tmp_path / "a.exr", rows, ["noise"], ["flat", "absent"])
        assert sorted(found) == ["flat", "noise"]
        for name, channel in found.items():
            assert channel.dtype == np.float32
            np.testing.assert_array_equal(channel, whole[name][rows].astype(np.float32))


def test_damaged_and_missing_files_say_so(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", ExrPart({"R": np.random.default_rng(0).random((64, 64)).astype(np.float32)}))
    refused(r"a.exr: expected the EXR channels \['Z'\]", read_rows, tmp_path / "a.exr", slice(0, 64), ["Z"])
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[: len(content) // 2])
    refused(r"a.exr cannot be read as EXR", read_rows, tmp_path / "a.exr", slice(0, 64), ["R"])
    (tmp_path / "b.exr").write_bytes(b"no picture")
    refused(r"b.exr cannot be read as EXR", exr_size_px, tmp_path / "b.exr")
    refused(r"expected an EXR file at .*c.exr", exr_size_px, tmp_path / "c.exr")


@pytest.mark.parametrize("whole", [True, False], ids=["whole pictures", "crops"])
def test_what_is_drawn_does_not_depend_on_memory(stacks: list[FocalStack], whole: bool) -> None:
    """A set that fits, one of which a third fits, one of which nothing fits."""
    crop_px, count, noise = (0, 4, 0.0) if whole else (40, 8, 1.0)
    drawn = []
    for cache_mib in (2048, 3 * PAIR_BYTES // MIB, 0):
        pairs, rng = PairSet(stacks, cache_mib=cache_mib), np.random.default_rng(7)
        drawn.append([draw_batch(pairs, 1, crop_px, 3, rng, depth_noise=noise, largest_coc_px=20.0) for _ in range(count)])
        pairs.close()
    assert PairSet(stacks).all_fit and not PairSet(stacks, cache_mib=6).all_fit
    assert all(same(*each) for other in drawn[1:] for each in zip(drawn[0], other, strict=True))
    assert not same(drawn[0][0], drawn[0][1])


def test_what_comes_next_is_read_ahead(stacks: list[FocalStack], monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first batch nothing is read by the thread that computes; it does not matter that two processes share the pictures."""
    readers: list[str] = []

    def noted(pairs: PairSet, window: Window, read=PairSet._read):  # type: ignore[no-untyped-def]
        readers.append(threading.current_thread().name)
        return read(pairs, window)

    monkeypatch.setattr(PairSet, "_read", noted)
    pairs, rng = PairSet(stacks, cache_mib=3), np.random.default_rng(0)
    assert not pairs.all_fit
    drawing = Drawing(pairs, 2, 40, 3)
    for _ in range(10):
        assert len(list(draw_share(drawing, rng, 1, 2))) == 2
    assert all(name.startswith("read-ahead") for name in readers)
    assert len(readers) <= 20 + 8 + 2, "what was read is what was drawn, and the next"
    pairs.close()


def test_what_is_drawn_depends_on_neither_processes_nor_interruptions(stacks: list[FocalStack]) -> None:
    """Two processes with two pictures each see what one with four sees."""
    pairs = PairSet(stacks)
    alone = list(draw_share(Drawing(pairs, 4, 40, 3), np.random.default_rng(3)))
    shares = [list(draw_share(Drawing(pairs, 2, 40, 3), np.random.default_rng(3), number, 2)) for number in range(2)]
    assert all(same(*each) for each in zip(alone, shares[0] + shares[1], strict=True))
    # From the state of the generator alone, with nothing in memory.
    rng, pairs = np.random.default_rng(1), PairSet(stacks, cache_mib=3)
    for _ in range(3):
        draw_batch(pairs, 1, 40, 3, rng)
    state = rng.bit_generator.state
    going_on = [draw_batch(pairs, 1, 40, 3, rng) for _ in range(4)]
    resumed = np.random.default_rng(99)
    resumed.bit_generator.state = state
    copied = pickle.loads(pickle.dumps(pairs))
    assert len(copied._cache) == 0
    assert all(same(each, draw_batch(copied, 1, 40, 3, resumed)) for each in going_on)
    pairs.close()
    copied.close()
    # Six crops, three from each of two windows, side by side at random.
    pairs = PairSet(stacks, cache_mib=3)
    crops = Drawing(pairs, 6, 40, 3, crops_per_picture=3).draw(np.random.default_rng(0))
    assert len(crops) == 6 and len({crop.window for crop in crops}) == 2
    assert len({crop.columns.start for crop in crops}) > 2


def test_memory_stays_within_the_limit(stacks: list[FocalStack]) -> None:
    """9 pairs of 2.1 MB, whole 19 MB, with a limit of 1 MiB: windows of 40 rows are 0.42 MB, so that two of them are held, and reading
    takes one more in passing for each reader and for the caller, besides the crops themselves (51 kB)."""
    pairs, rng = PairSet(stacks, cache_mib=1), np.random.default_rng(0)
    window_bytes = 40 * SIZE[1] * 8 * 4
    draw_batch(pairs, 1, 40, 3, rng)  # what is loaded once does not count
    tracemalloc.start()
    held = []
    for _ in range(20):
        draw_batch(pairs, 1, 40, 3, rng)
        held.append(pairs._cache.held_bytes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    pairs.close()
    assert max(held) <= MIB and max(held) > window_bytes
    assert peak < MIB + (1 + pairs._cache.readers) * 1.5 * window_bytes < 9 * PAIR_BYTES / 4


def test_looking_at_all_pictures_in_pieces_takes_little_memory_too(stacks: list[FocalStack], monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of 256 rows: here whole pictures of 2.1 MB, one at a time; the numbers are those of a set that fits."""
    streamed, whole = PairSet(stacks, cache_mib=3), PairSet(stacks)
    assert gather_facts(streamed) == gather_facts(whole)
    assert streamed._cache.held_bytes <= 3 * MIB < whole._cache.held_bytes == 9 * PAIR_BYTES
    streamed.close()
    monkeypatch.setattr("training.data.dataset._PIECE_ROWS", 64)
    pairs = PairSet(stacks, cache_mib=1)
    pieces = list(pairs.pieces(4))
    assert [len(each.coc_px) for each in pieces] == [64, 64, 64, 8]
    np.testing.assert_array_equal(np.concatenate([each.target for each in pieces]), pairs[4].target)
    np.testing.assert_array_equal(np.concatenate([each.place for each in pieces]), pairs[4].place)
    pairs.close()


def test_a_mistake_in_the_reading_thread_is_told(tmp_path: Path) -> None:
    """A file that goes missing while training: the sentence that names it, when its turn comes, however often one asks."""
    stack = write_stack(tmp_path / "view", 5)
    pairs, rng = PairSet([stack], cache_mib=1), np.random.default_rng(0)

    def draw_many() -> None:
        for _ in range(20):
            draw_batch(pairs, 1, 40, 3, rng)

    draw_batch(pairs, 1, 40, 3, rng)
    stack.depth_path.unlink()
    for _ in range(2):
        refused(r"expected an EXR file at .*depth.exr, but there is none", draw_many)
    pairs.close()


def test_what_is_expected_stays_and_the_oldest_goes(stacks: list[FocalStack]) -> None:
    """Three windows of 100 bytes fit into 300: a fourth one drives out what was used longest ago and is not expected."""
    pair, read = read_pair(stacks[0], 0, None, slice(0, 1)), []

    def reading(window: Window):  # type: ignore[no-untyped-def]
        read.append(window.index)
        return pair

    cache = ReadAhead(reading, 300)
    windows = [Window(index, 0, 1, 100) for index in range(5)]
    for index in (0, 1, 2, 0):
        cache.get(windows[index])
    assert read == [0, 1, 2] and cache.held_bytes == 300
    cache.expect([windows[1], windows[3]])
    cache.get(windows[3])
    cache.get(windows[1])
    cache.get(windows[0])
    assert read == [0, 1, 2, 3], "2 had to go"
    cache.expect([windows[0], windows[1], windows[3], windows[4]])
    assert cache.held_bytes == 300, "no room for the last one"
    cache.get(windows[4])
    assert read == [0, 1, 2, 3, 4] and cache.held_bytes == 300
    cache.close()
    assert cache.held_bytes == len(cache) == 0


def test_crops_know_their_place_lens_and_dioptres(stacks: list[FocalStack]) -> None:
    """The corner of a corner pixel lies half a diagonal from the middle (CONVENTIONS)."""
    pair = read_pair(stacks[0], 0)
    np.testing.assert_allclose(pair.place, field_positions(SIZE), atol=1e-6)
    part = pair.cut(slice(10, 60), slice(200, 330)).cut(slice(5, 9), slice(1, 4))
    np.testing.assert_allclose(part.place, field_positions(SIZE)[15:19, 201:204], atol=1e-6)
    half_px = 0.5 / (0.5 * np.hypot(*SIZE))
    assert np.hypot(*(pair.place[-1, -1] + half_px)) == pytest.approx(1.0, rel=1e-5)
    rgb, coc_px, place, lens = network_inputs(part)
    assert (rgb.shape, coc_px.shape, place.shape) == ((1, 3, 4, 3), (1, 1, 4, 3), (1, 2, 4, 3))
    assert lens.tolist() == [[pytest.approx(1.4), 50.0]]
    batch = stack_pairs([part, part])
    assert torch.equal(batch.place[1], place[0]) and torch.equal(batch.lens, lens.expand(2, -1)) and batch.saturated is None
    # 1 / depth, whatever registration enlarged.
    np.testing.assert_allclose(read_pair(stacks[1], 2).dioptres, 1.0 / read_focal_stack(stacks[1].folder).depth_m(), rtol=1e-4)


def test_several_lenses_where_the_network_is_told(stacks: list[FocalStack]) -> None:
    """1.4 and 2.8 at 50 mm, 4 at 85 mm: the ranges are those, the lens is the one in the middle; another sensor is refused."""
    lenses = (LENS, replace(LENS, f_number=2.8), replace(LENS, focal_length_mm=85.0, f_number=4.0))
    mixed = [replace(stack, lens=lens) for stack, lens in zip(stacks, lenses, strict=True)]
    refused("one network learns one lens", gather_facts, PairSet(mixed))
    facts = gather_facts(PairSet(mixed), several_lenses=True)
    assert (facts.f_numbers, facts.focal_lengths_mm) == ((1.4, 4.0), (50.0, 85.0))
    assert (facts.lens.f_number, facts.lens.focal_length_mm) == (2.8, 50.0)
    with pytest.raises(InputError, match="lenses on one sensor"):
        gather_facts(PairSet([mixed[0], replace(mixed[1], lens=replace(LENS, sensor_width_mm=24.0))]), several_lenses=True)
    assert gather_facts(PairSet(stacks)).f_numbers == (1.4, 1.4)
