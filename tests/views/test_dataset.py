"""The data set: what the manifest says is what lies there, split by viewpoint, resumed and verified."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.commands.dataset import dataset_command
from capture.dataset.stack_writer import RadianceHistogram, StackWriting, coc_maps, largest_coc_px
from capture.dataset.writer import DatasetPlan, split_by_viewpoint, verify, write_dataset
from capture.report.exclusion import write_exclusions
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import read_focal_stack_dataset
from tests.support.command_line import printed_by
from tests.support.refusals import refused

SIZE = (24, 32)
LENS = Lens(50.0, 1.4, 1.0, 36.0)
FOCUS_M = (0.8, 1.0, 1.5)
PLAN = DatasetPlan("CC0, nobody")


def small_stack(folder: Path, seed: int = 0, brightest: float = 2.5) -> FocalStack:
    """Three slices of noise in [0, 1) with one pixel of `brightest`; depth from 0.7 to 2 m; masks that exclude a fifth of it."""
    rng = np.random.default_rng(seed)
    pictures = [rng.random((*SIZE, 3)).astype(np.float32) for _ in range(4)]
    pictures[1][3, 4] = brightest
    for index in range(3):
        write_camera_rgb(folder / f"registered/{index:02d}.exr", pictures[index], None)
    depth_m = np.tile(np.linspace(0.7, 2.0, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    write_merged(folder, pictures[3], np.ones(SIZE, np.float32), np.ones(SIZE, np.float32), depth_m)
    slices = tuple(Slice(f"registered/{index:02d}.exr", focus) for index, focus in enumerate(FOCUS_M))
    stack = FocalStack(folder, slices, LENS, None, 0, registered=True, merged=True)
    write_focal_stack(stack)
    masks = {name: np.zeros(SIZE, bool) for name in ("moving", "saturated", "border", "low_confidence", "board")}
    masks["moving"][:, :4], masks["border"][:, 2:8] = True, True
    write_exclusions(stack, masks)
    return stack


@pytest.fixture
def scenes(tmp_path: Path) -> list[Path]:
    """Two scenes, five viewpoints."""
    for index in range(5):
        small_stack(tmp_path / ("a" if index < 3 else "b") / f"view_{index}", index)
    return [tmp_path / "a", tmp_path / "b"]


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    """inode and content of every file."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): (path.stat().st_ino, path.read_bytes()) for path in files}


def test_the_manifest_describes_the_files_and_gives_stacks_by_part(scenes: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    written = write_dataset(scenes, out, PLAN)
    dataset = read_focal_stack_dataset(out)
    assert dataset == written
    assert (out / "LICENCE.txt").read_text().strip() == dataset.licence == "CC0, nobody"
    assert [each.name for each in dataset.stacks] == ["a/view_0", "a/view_1", "a/view_2", "b/view_3", "b/view_4"]
    for record in dataset.stacks:
        assert sorted(record.files) == [
            "all_in_focus.exr", "depth.exr", "exclusion.exr", "registered/00.exr", "registered/01.exr", "registered/02.exr", "stack.json"
        ]  # fmt: skip
        for path, each in record.files.items():
            data = (out / record.name / path).read_bytes()
            assert (hashlib.sha256(data).hexdigest(), len(data)) == (each.sha256, each.bytes)
    assert not (out / "unfinished.json").exists()
    train, test = dataset.focal_stacks("train"), dataset.focal_stacks("test")
    assert (len(train), len(test)) == (4, 1), "80 to 20"
    assert not {each.folder for each in train} & {each.folder for each in test}
    assert train[0].slice_rgb(0).shape == (*SIZE, 3) and train[0].exclusions()["moving"].any()


def test_largest_blur_and_radiance_scale_count_what_is_not_excluded(tmp_path: Path, scenes: list[Path]) -> None:
    """Columns 0 to 7 are excluded, so depth begins at column 8: 0.7 + 8 * 1.3 / 31 = 1.0355 m, ends at 2 m.

    The largest diameter is that of 2 m in the slice focused at 0.8 m: k (1 / 0.8 - 1 / 2) with k of the lens; N = ceil((c - 1) / 2).
    """
    small_stack(tmp_path / "c" / "view_0")
    record = write_dataset([tmp_path / "c"], tmp_path / "one", replace(PLAN, test_share=0.0)).stacks[0]
    nearest = LENS.focused_at(0.8)
    expected_px = nearest.coc_px_per_dioptre(SIZE[1]) * (1 / 0.8 - 1 / 2.0)
    assert record.largest_coc_px == pytest.approx(expected_px, rel=1e-5)
    assert record.excluded_shares["any"] == 8 / 32 and record.excluded_shares["moving"] == 4 / 32 and record.excluded_shares["board"] == 0.0
    # The brightest pixel of all, 2.5 in every stack but 7 in one; half precision keeps both. With it, 7 maps to 2 * 7 / 7 - 1 = 1.
    small_stack(tmp_path / "b" / "view_3", 3, brightest=7.0)
    assert write_dataset(scenes, tmp_path / "out", PLAN).radiance_scale == 7.0
    share = write_dataset(scenes, tmp_path / "half", replace(PLAN, radiance_scale="0.5")).radiance_scale
    assert share == pytest.approx(0.5 ** (1 / 3), rel=0.02), "of the largest of three even channels: the median is the cube root of a half"
    assert write_dataset(scenes, tmp_path / "told", replace(PLAN, radiance_scale="radiance 12.5")).radiance_scale == 12.5
    refused("--radiance-scale must be", write_dataset, scenes, tmp_path / "wrong", replace(PLAN, radiance_scale="brightest"))


def test_the_histogram_against_all_numbers_at_once() -> None:
    """Its plain twin is NumPy's quantile; a step of the histogram is 0.54 %."""
    rgb = np.random.default_rng(0).lognormal(0.0, 2.0, (200, 300, 3)).astype(np.float32)
    counted = np.random.default_rng(1).random((200, 300)) < 0.7
    histogram = RadianceHistogram()
    for top in range(0, 200, 32):
        histogram.add(rgb[top : top + 32], counted[top : top + 32])
    peaks = rgb.max(axis=2)[counted]
    assert histogram.largest == peaks.max()
    for share in (0.5, 0.99, 0.999):
        assert histogram.quantile(share) == pytest.approx(np.quantile(peaks, share), rel=0.01)


def test_the_split_is_by_viewpoint_and_repeatable() -> None:
    names = [f"s/view_{index}" for index in range(20)]
    first = split_by_viewpoint(names)
    assert list(first.values()).count("test") == 4
    assert split_by_viewpoint(list(reversed(names))) == first, "whatever the order"
    assert split_by_viewpoint(names, seed=1) != first
    chosen = split_by_viewpoint(names, ("view_3", "s/view_7"))
    assert {name for name, part in chosen.items() if part == "test"} == {"s/view_3", "s/view_7"}
    assert split_by_viewpoint(["s/only"]) == {"s/only": "train"}
    refused("cannot test on view_99", split_by_viewpoint, names, ("view_99",))
    refused("none is left to train on", split_by_viewpoint, ["s/a"], ("a",))


def test_an_interrupted_run_goes_on_and_a_changed_source_is_written_again(
    scenes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It breaks in the third stack; the next run keeps the two that are whole, file by file."""
    from capture.dataset import writer

    whole, calls = writer.write_stack, []

    def breaks(stack: FocalStack, *rest: object) -> object:
        calls.append(stack.folder.name)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        return whole(stack, *rest)  # type: ignore[arg-type]

    out = tmp_path / "out"
    monkeypatch.setattr(writer, "write_stack", breaks)
    with pytest.raises(OSError, match="No space"):
        write_dataset(scenes, out, PLAN)
    assert (out / "unfinished.json").exists() and not (out / "dataset.json").exists()
    before = contents(out / "a" / "view_0")
    monkeypatch.setattr(writer, "write_stack", whole)
    dataset = write_dataset(scenes, out, PLAN)
    assert contents(out / "a" / "view_0") == before
    assert len(dataset.stacks) == 5 and not verify(dataset)
    small_stack(scenes[0] / "view_1", seed=77)
    refused("exists already", write_dataset, scenes, out, PLAN)
    dataset = write_dataset(scenes, out, PLAN, overwrite=True)
    assert contents(out / "a" / "view_0") == before
    assert (out / "a/view_1/registered/00.exr").read_bytes() == (scenes[0] / "view_1/registered/00.exr").read_bytes()
    assert not verify(dataset)
    _spoil(out)
    troubles = verify(dataset)
    assert len(troubles) == 3
    assert "a/view_0/depth.exr has another content" in troubles[0] and "b/view_4/registered/01.exr is missing" in troubles[2]


def test_files_are_links_or_copies(scenes: list[Path], tmp_path: Path) -> None:
    source = scenes[0] / "view_0" / "depth.exr"
    write_dataset(scenes, tmp_path / "linked", PLAN)
    write_dataset(scenes, tmp_path / "copied", replace(PLAN, writing=StackWriting(copy=True)))
    assert os.path.samefile(source, tmp_path / "linked/a/view_0/depth.exr")
    assert not os.path.samefile(source, tmp_path / "copied/a/view_0/depth.exr")
    small_stack(scenes[0] / "view_0", seed=5)
    assert not verify(read_focal_stack_dataset(tmp_path / "linked")), "merging again replaces files, it does not change them"


def _spoil(out: Path) -> None:
    data = bytearray((out / "a/view_0/depth.exr").read_bytes())
    data[-5] ^= 1
    (out / "a/view_0/depth.exr").unlink()
    (out / "a/view_0/depth.exr").write_bytes(data)
    (out / "b/view_4/registered/01.exr").unlink()
    (out / "b/view_3/stack.json").unlink()
    (out / "b/view_3/stack.json").write_text("{}")


def test_coc_maps_are_signed_and_half(tmp_path: Path) -> None:
    """Written maps against the lens itself: 1 / focus - 1 / depth times k, negative in front; a half holds 3 digits."""
    stack = small_stack(tmp_path / "a" / "view_0")
    write_dataset([tmp_path / "a"], tmp_path / "out", replace(PLAN, writing=StackWriting(with_coc=True)))
    for index, coc_px in enumerate(coc_maps(stack)):
        channel = read_exr(tmp_path / "out" / "a" / "view_0" / "coc" / f"{index:02d}.exr")[0].channels["coc_px"]
        assert channel.dtype == np.float16
        k = LENS.focused_at(FOCUS_M[index]).coc_px_per_dioptre(SIZE[1])
        expected = k * (1 / FOCUS_M[index] - 1 / stack.depth_m())
        np.testing.assert_allclose(channel, expected, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(coc_px, expected, rtol=1e-5, atol=1e-5)
    assert (channel < 0).any() and (channel > 0).any()
    assert largest_coc_px(stack, np.zeros(SIZE, bool)) == 0.0


def test_bad_input_gets_one_sentence(scenes: list[Path], tmp_path: Path) -> None:
    refused("needs a licence note", write_dataset, scenes, tmp_path / "out", DatasetPlan("  "))
    refused("two stacks are called a/view_0", write_dataset, [scenes[0], scenes[0]], tmp_path / "out", PLAN)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "diary.txt").write_text("dear")
    refused("holds something else", write_dataset, scenes, tmp_path / "mine", PLAN)
    (tmp_path / "newer").mkdir()
    (tmp_path / "newer" / "dataset.json").write_text(json.dumps({"format": "mrbokeh-focal-stack-dataset", "version": 99}))
    refused("version 99", read_focal_stack_dataset, tmp_path / "newer")
    write_focal_stack(FocalStack(tmp_path / "c" / "view_0", (Slice("a.exr", 1.0),)))
    refused("not registered and merged", write_dataset, [tmp_path / "c"], tmp_path / "out", PLAN)
    assert not (tmp_path / "out").exists(), "nothing is begun that cannot be finished"


def test_the_command_writes_and_verifies(scenes: list[Path], tmp_path: Path) -> None:
    (tmp_path / "licence.md").write_text("CC BY 4.0, Jane Doe\n")
    out = tmp_path / "out"
    told = printed_by(dataset_command, *scenes, "--out", out, "--licence", tmp_path / "licence.md", "--test", "view_2")
    assert "4 stacks to train on, 1 to test on" in told
    assert read_focal_stack_dataset(out).licence == "CC BY 4.0, Jane Doe\n"
    printed_by(dataset_command, "--out", out, "--verify")
    (out / "a/view_0/stack.json").unlink()
    printed_by(dataset_command, "--out", out, "--verify", exit_code=1)


@pytest.mark.slow
def test_memory_does_not_grow_with_slices(tmp_path: Path) -> None:
    """Stacks of 4 and 12 slices of 6 megapixels, each in a process of its own: peaks differ by less than one picture, 36 MB in half."""
    script = (
        "import resource, sys; from pathlib import Path; from tests.views.test_dataset import *\n"
        "write_dataset([Path(sys.argv[1])], Path(sys.argv[2]), PLAN)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)"
    )
    peaks = []
    for slices in (4, 12):
        stack = large_stack(tmp_path / f"s{slices}" / "view_0", slices, (2000, 3000))
        command = [sys.executable, "-c", script, str(stack.folder.parent), str(tmp_path / f"out{slices}")]
        peaks.append(int(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
    assert peaks[1] - peaks[0] < 36


def large_stack(folder: Path, slices: int, size: tuple[int, int]) -> FocalStack:
    """One noisy picture for all slices: what is measured is memory."""
    rgb = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    focus_m = 1.0 / np.linspace(1.3, 0.5, slices)
    listed = tuple(Slice(f"registered/{index:02d}.exr", float(focus)) for index, focus in enumerate(focus_m))
    for each in listed:
        write_camera_rgb(folder / each.path, rgb, None)
    depth_m = np.tile(np.linspace(0.7, 2.0, size[1], dtype=np.float32), (size[0], 1))
    write_merged(folder, rgb, np.ones(size, np.float32), np.ones(size, np.float32), depth_m)
    stack = FocalStack(folder, listed, LENS, registered=True, merged=True)
    write_focal_stack(stack)
    write_exclusions(stack, {name: np.zeros(size, bool) for name in ("moving", "saturated", "border", "low_confidence", "board")})
    return stack
