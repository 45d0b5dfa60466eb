"""Sets computed from pictures with depth: pairs, samples as `transfer` makes them, the same bytes from any number of workers."""

import json
import shutil
import tarfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from mrbokeh.commands.dataset import app
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.layer import opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import lens_and_renderer
from mrbokeh.shots.synthesis import MADE, sources_in
from mrbokeh.stacks.focal_stack import find_focal_stacks
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by

SIZE = (24, 40)
NAMES = ("apple", "pear", "plum")


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three noisy pictures of a ramp from 1 m to 4 m with a card at 0.8 m."""
    folder = tmp_path_factory.mktemp("rgbd")
    for seed, name in enumerate(NAMES):
        rng = np.random.default_rng(seed)
        depth_m = np.broadcast_to(np.linspace(4.0, 1.0, SIZE[0], dtype=np.float32)[:, None], SIZE).copy()
        depth_m[8:16, 10:20] = 0.8
        write_image(folder / f"{name}_rgb.exr", rng.uniform(0.1, 0.9, (*SIZE, 3)).astype(np.float32), half=False)
        write_exr(folder / f"{name}_depth.exr", ExrPart({"Z": depth_m}))
    return folder


def synthesize(rgbd: Path, out: Path, *options: object) -> str:
    return printed_by(app, "synthesize", rgbd, "--out", out, "--slices", 3, "--workers", 1, *options)


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def made(rgbd: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "set"
    assert "3 samples" in synthesize(rgbd, out)
    return out


def test_samples_are_focal_stacks_blurred_as_the_renderer_does(rgbd: Path, made: Path) -> None:
    """Slices are half floats: 2^-11 of their value. Focus is even in dioptres over the depth but its outermost 2 %."""
    stacks = find_focal_stacks(made)
    assert [stack.folder.name for stack in stacks] == list(NAMES)
    stack = stacks[1]
    assert stack.metadata[MADE]["photograph"] == "pear_rgb.exr"
    depth_m = read_exr(rgbd / "pear_depth.exr")[0].channels["Z"]
    far, near = np.percentile(1.0 / depth_m, [2.0, 98.0])
    np.testing.assert_allclose([1.0 / (each or 0.0) for each in stack.focus_distances_m], np.linspace(near, far, 3), rtol=1e-6)
    _, renderer = lens_and_renderer(None, None, threads=1)
    sharp = opaque(read_image(rgbd / "pear_rgb.exr"), depth_m)
    for index, distance_m in enumerate(stack.focus_distances_m):
        lens = Lens.default().focused_at(float(distance_m or 0.0))
        np.testing.assert_allclose(stack.slice_rgb(index), renderer.render([sharp], lens).rgb, rtol=2.0**-10, atol=1e-4)
        coc_px = read_exr(stack.folder / "coc" / f"{index:02d}.exr")[0].channels["coc_px"]
        np.testing.assert_allclose(coc_px, lens.coc_px(depth_m, SIZE[1]), rtol=2.0**-10, atol=1e-4)


def test_what_was_lost_is_made_again_alike_and_the_rest_stays(rgbd: Path, made: Path) -> None:
    before, kept = files_of(made), (made / "apple" / "stack.json").stat().st_mtime_ns
    shutil.rmtree(made / "plum")
    synthesize(rgbd, made)
    assert files_of(made) == before
    assert (made / "apple" / "stack.json").stat().st_mtime_ns == kept


def test_two_workers_make_the_same_shards(rgbd: Path, tmp_path: Path) -> None:
    """A shard holds the samples' files under their keys, without times of their making."""
    for name, workers in (("one", 1), ("two", 2)):
        synthesize(rgbd, tmp_path / name, "--format", "webdataset", "--workers", workers)
    shard = tmp_path / "one" / "000000.tar"
    assert shard.read_bytes() == (tmp_path / "two" / "000000.tar").read_bytes()
    with tarfile.open(shard) as tar:
        names = tar.getnames()
        assert {name.split(".")[0] for name in names} == set(NAMES)
        assert "pear.json" in names and "pear.coc_02.exr" in names and "pear.all_in_focus.exr" in names
        assert len([name for name in names if name.startswith("pear.slice_")]) == 3
        assert {entry.mtime for entry in tar} == {0}


def test_hdf5_holds_the_same_numbers(rgbd: Path, made: Path, tmp_path: Path) -> None:
    synthesize(rgbd, tmp_path / "set", "--format", "hdf5")
    stack = find_focal_stacks(made)[0]
    with h5py.File(tmp_path / "set" / "apple.h5") as file:
        np.testing.assert_array_equal(file["slices"][2], stack.slice_rgb(2).astype(np.float16))
        np.testing.assert_array_equal(file["depth_m"][:], stack.depth_m())
        assert file["coc_px"].shape == (3, *SIZE) and file["valid"][:].all()
        assert json.loads(file.attrs["stack"])["slices"][0]["focus_distance_m"] == stack.focus_distances_m[0]


def test_folders_of_pictures_and_of_depth_pair_by_name(tmp_path: Path) -> None:
    for name in ("rgb/a.png", "rgb/b.jpg", "depth/a.png", "depth/c.exr"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found, alone = sources_in(tmp_path)
    assert [(each.name, each.photo.name, each.depth and each.depth.parent.name) for each in found] == [("a", "a.png", "depth")]
    assert alone == ["b.jpg", "c.exr"]


def test_names_pair_by_their_last_word(tmp_path: Path) -> None:
    for name in ("my-photo_rgb.png", "my-photo_depth.exr", "a.b.png", "a.b-depth.exr", "alone.png"):
        (tmp_path / name).touch()
    found, alone = sources_in(tmp_path)
    assert [each.name for each in found] == ["a_b", "my-photo"]
    assert alone == ["alone.png"]
    for name in ("a_b.png", "a_b_depth.exr"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="called a_b"):
        sources_in(tmp_path)


def test_overwrite_takes_away_only_what_was_made(rgbd: Path, tmp_path: Path) -> None:
    synthesize(rgbd, tmp_path / "set")
    (tmp_path / "set" / "notes.txt").write_text("mine")
    with pytest.raises(InputError):
        synthesize(rgbd, tmp_path / "set", "--overwrite", "--focus", "0.8:x")
    assert len(find_focal_stacks(tmp_path / "set")) == 3
    synthesize(rgbd, tmp_path / "set", "--overwrite", "--focus", "0.8,1.5")
    assert {len(stack) for stack in find_focal_stacks(tmp_path / "set")} == {2}
    assert (tmp_path / "set" / "notes.txt").read_text() == "mine"


def test_a_set_within_its_pictures_is_refused(rgbd: Path, tmp_path: Path) -> None:
    shutil.copytree(rgbd, tmp_path / "set" / "rgbd")
    for source, out in ((tmp_path / "set" / "rgbd", tmp_path / "set"), (tmp_path / "set", tmp_path / "set" / "made")):
        shutil.copytree(rgbd, source, dirs_exist_ok=True)
        with pytest.raises(InputError, match="lie in one another"):
            synthesize(source, out)
    assert (tmp_path / "set" / "rgbd" / "pear_rgb.exr").is_file()


def test_a_shard_waits_for_a_picture_that_fails(rgbd: Path, tmp_path: Path) -> None:
    """And is made when that is mended; of other pictures than before it is not."""
    source, out = tmp_path / "rgbd", tmp_path / "set"
    shutil.copytree(rgbd, source)
    write_image(source / "fig_rgb.exr", np.ones((8, 8, 3), np.float32))
    write_exr(source / "fig_depth.exr", ExrPart({"Z": np.ones((8, 8), np.float32)}))  # the same everywhere: no range of focus
    with pytest.raises(InputError, match=r"the same everywhere|waits for fig"):
        synthesize(source, out, "--format", "webdataset")
    assert not list(out.glob("*.tar"))
    for left in source.glob("fig*"):
        left.unlink()
    assert "3 samples" in synthesize(source, out, "--format", "webdataset")
    shutil.copy(source / "pear_rgb.exr", source / "apricot_rgb.exr")
    shutil.copy(source / "pear_depth.exr", source / "apricot_depth.exr")
    with pytest.raises(InputError, match="other settings or pictures"):
        synthesize(source, out, "--format", "webdataset")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--slices", 4), "other settings"),
        (("--format", "zip"), "folders, webdataset, hdf5"),
        (("--focus", "0.8:x"), "expected different places"),
    ],
)
def test_what_cannot_be_is_told(rgbd: Path, made: Path, tmp_path: Path, options: tuple[object, ...], told: str) -> None:
    out = made if "--slices" in options else tmp_path / "set"
    with pytest.raises(InputError, match=told):
        synthesize(rgbd, out, *options)


def test_a_sample_that_fails_is_left_out_and_told(rgbd: Path, tmp_path: Path) -> None:
    shutil.copytree(rgbd, tmp_path / "rgbd")
    (tmp_path / "rgbd" / "pear_depth.exr").write_bytes(b"no EXR")
    assert "2 samples" in synthesize(tmp_path / "rgbd", tmp_path / "set")
    assert [stack.folder.name for stack in find_focal_stacks(tmp_path / "set")] == ["apple", "plum"]
