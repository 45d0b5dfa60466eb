"""Adapters of public sets, on tiny made-up folders of each layout: how much blurs, what is in focus, clipped or missing."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_scripts.public_datasets import KINDS, Conversion, DepthMaps, convert, crop_of, main, sharpest_depth_m
from datasets_scripts.public_sets.adapters import f_number_of
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset, read_focal_stack_dataset
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.scattered_pictures import scatter_reference
from training.data.dataset import read_pair
from training.data.training_data import training_data

WIDTH, HEIGHT = 96, 64
NEAR_M, FAR_M = 1.0, 4.0


def texture(seed: int = 0) -> np.ndarray:
    """Grey blocks of 2 px: JPEG halves the resolution of colour, but keeps that of grey."""
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.05, 0.7, (HEIGHT // 2, WIDTH // 2)).astype(np.float32)
    return np.repeat(grey.repeat(2, 0).repeat(2, 1)[..., None], 3, axis=2)


def depth_m() -> np.ndarray:
    """Near on the left, far on the right."""
    return np.where(np.arange(WIDTH) < WIDTH // 2, NEAR_M, FAR_M)[None].repeat(HEIGHT, 0).astype(np.float32)


def blurred(sharp: np.ndarray, lens: Lens) -> np.ndarray:
    return scatter_reference(sharp, lens.coc_px(depth_m(), WIDTH).astype(np.float32), lens.aperture)


def disparity_map(path: Path) -> None:
    """White is near."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.repeat((depth_m() == NEAR_M)[..., None], 3, 2).astype(np.float32), "linear")


def converted(kind: str, source: Path, out: Path, maps: DepthMaps | None = None, **changes: object) -> FocalStackDataset:
    chosen = KINDS[kind]
    conversion = Conversion(kind, chosen.lens, chosen.licence, maps or DepthMaps())
    return convert(chosen.stacks(source), out, replace(conversion, **changes))


def ebb_folder(source: Path, depths: Path) -> np.ndarray:
    """One pair, focused on the far half by a 50 mm f/1.8 before 22.3 mm; a window of white in the sharp picture."""
    sharp = texture()
    sharp[:4, :4] = 1.0
    for folder in ("original", "bokeh"):
        (source / "train" / folder).mkdir(parents=True)
    lens = Lens(50.0, 1.8, FAR_M, 22.3)
    write_image(source / "train" / "original" / "7.jpg", sharp)
    write_image(source / "train" / "bokeh" / "7.jpg", blurred(sharp, lens))
    disparity_map(depths / "7.png")
    return sharp


def test_ebb_becomes_a_set_that_training_reads(tmp_path: Path) -> None:
    """The lens is the paper's; the focus is found on the far half, where the wide picture kept its detail."""
    sharp = ebb_folder(tmp_path / "ebb", tmp_path / "maps")
    dataset = converted("ebb", tmp_path / "ebb", tmp_path / "out", DepthMaps(tmp_path / "maps", NEAR_M, FAR_M))
    stack = read_focal_stack(tmp_path / "out" / "ebb" / "7")
    assert stack.slices[0].focus_distance_m == pytest.approx(FAR_M, rel=1e-3)
    expected = Lens(50.0, 1.8, FAR_M, 22.3).coc_px(depth_m(), WIDTH)
    assert stack.coc_px(0, stack.depth_m()) == pytest.approx(expected, rel=1e-4, abs=1e-3)
    # JPEG of quality 95 rounds to about 1 % of the range.
    assert np.abs(stack.all_in_focus() - sharp).mean() < 0.01
    assert stack.exclusions()["saturated"][:4, :4].all() and stack.exclusions()["saturated"].mean() < 0.05
    assert dataset.largest_coc_px == pytest.approx(abs(expected).max(), rel=1e-4)
    assert stack.metadata["clipped"] is True and "ask the authors" in dataset.licence
    pairs = training_data([tmp_path / "out"])
    assert read_pair(pairs.stacks[0], 0).target.shape == (HEIGHT, WIDTH, 3)


def test_8_bit_is_linearised_as_srgb(tmp_path: Path) -> None:
    """Code 188 is 0.5029 linear (IEC 61966-2-1: ((188/255 + 0.055) / 1.055)^2.4)."""
    for folder in ("original", "bokeh"):
        (tmp_path / "ebb" / folder).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "ebb" / folder / "1.png"), np.full((HEIGHT, WIDTH, 3), 188, np.uint8))
    disparity_map(tmp_path / "maps" / "1.png")
    converted("ebb", tmp_path / "ebb", tmp_path / "out", DepthMaps(tmp_path / "maps", NEAR_M, FAR_M), focus_m=2.0)
    stack = read_focal_stack(tmp_path / "out" / "ebb" / "1")
    assert stack.all_in_focus() == pytest.approx(0.5029, abs=1e-4)
    assert not stack.exclusions()["saturated"].any()
    assert stack.slices[0].focus_distance_m == 2.0


def test_pairs_without_depth_say_what_to_do(tmp_path: Path) -> None:
    ebb_folder(tmp_path / "ebb", tmp_path / "maps")
    for maps, said in (
        (None, r"without depth.*--depth"),
        (DepthMaps(tmp_path / "maps"), "--near-m and --far-m"),
        (DepthMaps(tmp_path), r"7\.exr"),
    ):
        refused(said, converted, "ebb", tmp_path / "ebb", tmp_path / "out", maps)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_of_something_else_is_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    refused("does not look like", KINDS[kind].stacks, tmp_path)


def test_dpdd_pairs_by_order_and_wants_a_lens(tmp_path: Path) -> None:
    for name in (
        "train_c/source/1P0A01",
        "train_c/source/1P0A03",
        "train_c/target/1P0A02",
        "train_c/target/1P0A04",
        "test_c/source/a",
        "test_c/target/b",
    ):
        (tmp_path / "dpdd" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "dpdd" / f"{name}.png", texture())
    stacks = KINDS["dpdd"].stacks(tmp_path / "dpdd")
    found = [(each.key, each.slices[0].path.stem, each.part) for each in stacks]
    assert found == [("1P0A02", "1P0A01", "train"), ("1P0A04", "1P0A03", "train"), ("b", "a", "test")]
    for each in stacks:
        disparity_map(tmp_path / "maps" / f"{each.key}.png")
    maps = DepthMaps(tmp_path / "maps", NEAR_M, FAR_M)
    refused("--focal-length-mm", converted, "dpdd", tmp_path / "dpdd", tmp_path / "out", maps)
    lens = replace(KINDS["dpdd"].lens, focal_length_mm=50.0)
    dataset = converted("dpdd", tmp_path / "dpdd", tmp_path / "out", maps, lens=lens, focus_m=2.0)
    assert [each.part for each in dataset.stacks] == ["train", "train", "test"]
    (tmp_path / "dpdd" / "train_c" / "source" / "1P0A05.png").write_bytes(b"")
    refused("as many pictures", KINDS["dpdd"].stacks, tmp_path / "dpdd")


def test_f_numbers_stand_at_the_end_of_names(tmp_path: Path) -> None:
    names = {"f2.8.jpg": 2.8, "12_f22.JPG": 22.0, "scene-f_16.png": 16.0, "leaf2.jpg": None, "f2_b.jpg": None}
    assert {name: f_number_of(Path(name)) for name in names} == names
    for number in (2.0, 8.0, 22.0):
        (tmp_path / "test" / "cup").mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "test" / "cup" / f"f{number:g}.png", texture())
    (stack,) = KINDS["aperture"].stacks(tmp_path)
    assert stack.sharp.name == "f22.png" and [each.f_number for each in stack.slices] == [2.0, 8.0] and stack.part == "test"


def test_realbokeh_takes_blur_from_its_metadata(tmp_path: Path) -> None:
    """Two f-numbers of one focus: at f/4 the diameters are half of those at f/2; the zoom's focal length counts, not the stated one."""
    root, sharp = tmp_path / "real" / "train", texture()
    for name in ("in/5_f22", "gt/5/5_f2.0", "gt/5/5_f4.0"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(root / f"{name}.JPG", sharp)
    facts = {"id": 5, "source_image": "in/5_f22.JPG", "source_av": 22.0, "target_avs": [2.0, 4.0], "focal_length": 32}
    facts |= {"target_images": ["gt/5/5_f2.0.JPG", "gt/5/5_f4.0.JPG"], "focus_plane_distance": 0.8, "focus_plane_uncertainty": 0.01}
    (root / "metadata").mkdir()
    (root / "metadata" / "5.json").write_text(json.dumps(facts))
    write_exr(tmp_path / "maps" / "5.exr", ExrPart({"Z": depth_m()}))
    dataset = converted("realbokeh", tmp_path / "real", tmp_path / "out", DepthMaps(tmp_path / "maps"))
    stack = read_focal_stack(tmp_path / "out" / "realbokeh_train" / "5")
    for index, number in enumerate((2.0, 4.0)):
        assert stack.coc_px(index, depth_m()) == pytest.approx(Lens(32.0, number, 0.8, 36.0).coc_px(depth_m(), WIDTH), rel=1e-4)
    assert "NC" in dataset.licence
    del facts["focal_length"]
    (root / "metadata" / "5.json").write_text(json.dumps(facts))
    refused("focal_length", KINDS["realbokeh"].stacks, tmp_path / "real")


def blb_folder(scene: Path, suffix: str = ".exr") -> None:
    scene.mkdir(parents=True)
    focuses_m, blurs = [FAR_M, NEAR_M], [4.0, 8.0]
    info = {"focus_distances": focuses_m, "blur_parameters": blurs, "focal_length": 0.05, "sensor_width": 0.036, "f_stops": [2.0, 1.0]}
    (scene / "info.json").write_text(json.dumps(info))
    write_exr(scene / "depth.exr", ExrPart({name: depth_m() for name in "RGB"}))
    pictures = ["image", *(f"bokeh_{level:02d}_{index:02d}" for level in range(2) for index in range(2))]
    for name in pictures:
        write_image(scene / f"{name}{suffix}", texture())


def test_blb_blur_is_a_radius_per_disparity(tmp_path: Path) -> None:
    """BokehMe: radius = K |1/z - 1/focus|. With K 8 focused at 4 m, 1 m lies in front: a diameter of -2 * 8 * (1 - 1/4) = -12 px."""
    blb_folder(tmp_path / "blb" / "251")
    dataset = converted("blb", tmp_path / "blb", tmp_path / "out")
    assert [each.name for each in dataset.stacks] == ["251/level_00", "251/level_01"]
    assert all(each.part == "test" for each in read_focal_stack_dataset(tmp_path / "out").stacks)
    stack = read_focal_stack(tmp_path / "out" / "251" / "level_01")
    coc_px = stack.coc_px(0, stack.depth_m())
    assert coc_px[0, 0] == pytest.approx(-12.0, rel=1e-5) and coc_px[0, -1] == pytest.approx(0.0, abs=1e-5)
    assert stack.metadata["clipped"] is False
    assert stack.all_in_focus() == pytest.approx(texture(), abs=1e-3)


def test_blb_pictures_as_jpeg_are_linearised_by_their_own_power(tmp_path: Path) -> None:
    """The set's script stores x^(1/2.2): code 128 is (128/255)^2.2 = 0.2195; sRGB would say 0.2159."""
    blb_folder(tmp_path / "blb" / "251", ".png")
    cv2.imwrite(str(tmp_path / "blb" / "251" / "image.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    converted("blb", tmp_path / "blb", tmp_path / "out")
    assert read_focal_stack(tmp_path / "out" / "251" / "level_00").all_in_focus() == pytest.approx(0.2195, abs=1e-4)


def test_cropping_keeps_the_size_of_blur(tmp_path: Path) -> None:
    """Blur in pixels belongs to the whole picture's width, 96 px, whatever is cut out of it."""
    ebb_folder(tmp_path / "ebb", tmp_path / "maps")
    maps = DepthMaps(tmp_path / "maps", NEAR_M, FAR_M)
    converted("ebb", tmp_path / "ebb", tmp_path / "out", maps, crop_px=(64, 48), focus_m=2.0)
    stack = read_focal_stack(tmp_path / "out" / "ebb" / "7")
    expected = Lens(50.0, 1.8, 2.0, 22.3).coc_px(depth_m(), WIDTH)[8:56, 16:80]
    assert stack.coc_px(0, stack.depth_m()) == pytest.approx(expected, rel=1e-4)
    assert crop_of("64x48") == (64, 48) and crop_of("") is None
    refused("WIDTHxHEIGHT", crop_of, "64")
    refused("too small", converted, "ebb", tmp_path / "ebb", tmp_path / "other", maps, crop_px=(640, 48), focus_m=2.0)


@pytest.mark.parametrize("focus_m", [NEAR_M, FAR_M])
def test_the_focus_is_found_where_detail_is_kept(focus_m: float) -> None:
    sharp = texture()
    assert sharpest_depth_m(sharp, blurred(sharp, Lens(50.0, 2.0, focus_m, 22.3)), depth_m()) == pytest.approx(focus_m)
    flat = np.full_like(sharp, 0.5)
    refused("no detail", sharpest_depth_m, flat, flat, depth_m())


def test_the_command_converts_and_keeps_a_finished_set(tmp_path: Path) -> None:
    ebb_folder(tmp_path / "ebb", tmp_path / "maps")
    arguments = [tmp_path / "ebb", tmp_path / "out", "--depth", tmp_path / "maps", "--near-m", 1, "--far-m", 4]
    assert "1 stacks" in printed_by(main, "ebb", *arguments)
    assert "exists already" in printed_by(main, "ebb", *arguments, exit_code=2)
    printed_by(main, "nothing", *arguments, exit_code=2)
