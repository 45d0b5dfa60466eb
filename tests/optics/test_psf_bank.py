"""Axes, banks and their folders: remapping, nearest kernels, what is refused, and files that come back as they were."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.figures.psf_bank_drawing import draw_bank, export_bank
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.psf_bank import Axis, PsfBank
from mrbokeh.optics.psf_bank_file import cell_path, read_bank, write_bank
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.system.errors import InputError

DIAMETER = Axis("diameter_px", 0.0, 32.0, 2.0)
ECCENTRICITY = Axis("eccentricity", 0.0, 1.0, 1.2)
INFINITE = Axis("depth_m", 0.5, np.inf, 1.5, in_dioptres=True)
SIGNED = Axis("diameter_px", -20.0, 20.0, 2.0)


def random_bank(channels: int = 3, light: float = 1.0, **changes: object) -> PsfBank:
    """A bank of noise, as a measured lens would fill it: every kernel another one, of sizes 1, 3, 5, ..."""
    rng = np.random.default_rng(3)
    axes, counts = (DIAMETER, ECCENTRICITY), (6, 4)
    kernels = [rng.random((2 * (i % 4) + 1, 2 * (i % 4) + 1, channels)) for i in range(len(NestedGrid(counts)))]
    kernels = [(light * kernel / kernel.sum(axis=(0, 1))).astype(np.float32) for kernel in kernels]
    values: dict = {"turns": "field", "near_side_turned": True, "settings": {"stack": "keyboard", "seed": 3}}
    return PsfBank("measured", axes, counts, tuple(kernels), **(values | changes))


@pytest.mark.parametrize("axis", [DIAMETER, ECCENTRICITY, INFINITE, SIGNED, Axis("depth_m", 1.0, 9.0)])
def test_remapping_goes_both_ways(axis: Axis) -> None:
    unit = np.linspace(0.0, 1.0, 41)
    there = axis.from_unit(unit)
    assert there[0] == axis.low and there[-1] == axis.high and (np.diff(there) > 0).all()
    np.testing.assert_allclose(axis.to_unit(there), unit, atol=1e-12)


def test_small_coordinates_are_sampled_more_finely_and_those_beyond_the_range_are_cut() -> None:
    """An exponent of 2 over 32 px: ten even steps end at 32 (i / 10)^2, the first is 0.32 px and the last 6.08 px wide."""
    np.testing.assert_allclose(np.diff(DIAMETER.from_unit(np.linspace(0, 1, 11)))[[0, -1]], [0.32, 6.08])
    widths = np.diff(SIGNED.from_unit(np.linspace(0, 1, 21)))
    assert widths.argmin() in (9, 10) and widths[0] == pytest.approx(widths[-1])
    np.testing.assert_array_equal(DIAMETER.to_unit(np.array([-8.0, 8.0, 99.0])), [0.5, 0.5, 1.0])
    np.testing.assert_allclose(SIGNED.to_unit(np.array([-99.0, -5.0, 0.0, 5.0])), [0.0, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(INFINITE.to_unit(np.array([0.1, np.inf])), [0.0, 1.0])
    assert INFINITE.between(1.0, np.inf, 0.5) == pytest.approx(2.0), "half way in dioptres"


@pytest.mark.parametrize(("values", "message"), [
    (("width", 0.0, 1.0), "expected an axis out of"), (("motion_px", 3.0, 3.0), "low before high"),
    (("depth_m", 1.0, np.inf), "finite"), (("motion_px", 0.0, 3.0, 0.0), "positive exponent"),
    (("depth_m", 0.0, 3.0, 1.0, True), "above 0 m"), (("motion_px", -3.0, 3.0), "only diameter_px may be negative"),
    (("diameter_px", -3.0, 4.0), "only diameter_px may be negative"),
])  # fmt: skip
def test_axes_that_make_no_sense(values: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Axis(*values)


def test_the_nearest_kernel_is_that_of_the_cell_and_is_turned_in_front_of_the_focus() -> None:
    bank = random_bank()
    np.testing.assert_array_equal(bank.nearest(bank.centres), np.arange(len(bank.kernels)))
    rng = np.random.default_rng(0)
    points = np.stack([32.0 * rng.random(200), rng.random(200)], axis=1)
    low, high = bank.boxes[bank.nearest(points), :, 0], bank.boxes[bank.nearest(points), :, 1]
    assert ((low <= points) & (points <= high)).all()
    behind, in_front = (bank.kernel_at(np.array([side * 20.0, 0.3])) for side in (1, -1))
    np.testing.assert_array_equal(in_front, behind[::-1, ::-1])
    still = [random_bank(near_side_turned=False).kernel_at(np.array([side * 20.0, 0.3])) for side in (1, -1)]
    np.testing.assert_array_equal(*still)


def test_absorbed_light_is_kept_track_of_and_shown_on_the_sheet() -> None:
    np.testing.assert_allclose(random_bank(light=0.6).throughput, 0.6, rtol=1e-5)
    with pytest.raises(InputError, match="must sum to 1"):
        random_bank(light=1.1)

    def titles(bank: PsfBank) -> str:
        return " ".join(axes.get_title() for axes in draw_bank(bank).axes)

    assert "each of which shares" in titles(random_bank()) and "width of the kernels" in titles(random_bank())
    assert "light that arrives" in titles(random_bank(light=0.5))
    row = PsfBank("m", (INFINITE,), (3,), (np.ones((1, 1, 1), np.float32),) * 3, nested=False)
    assert "width of the cells" in titles(row)
    assert len(draw_bank(row).axes) == 3 + 2, "each of three kernels once, and two graphs"


def test_faint_light_is_seen_beside_a_bright_middle() -> None:
    """Of a kernel whose middle is 10,000 times brighter the right half, the logarithm, shows a third of white where the left is black."""
    kernel = np.full((9, 9, 1), 1.0, np.float32)
    kernel[4, 4] = 1e4
    sheet = draw_bank(PsfBank("m", (INFINITE,), (1,), (kernel / kernel.sum(),), nested=False))
    shown = sheet.axes[0].images[0].get_array()[..., 1]
    assert shown[1, 1] < 0.01 and shown[1, -2] == pytest.approx(1.0 / 3.0, abs=1e-3) and shown[4, -5] == pytest.approx(1.0)


def test_what_is_not_a_bank() -> None:
    bank = random_bank()
    parts = {"model": "m", "axes": bank.axes, "counts": bank.counts, "kernels": bank.kernels}
    wrong = [
        ({"kernels": bank.kernels[:-1]}, "needs as many kernels"),
        ({"kernels": (bank.kernels[0][..., :1], *bank.kernels[1:])}, "all have 1 or all have 3"),
        ({"kernels": (np.ones((2, 2, 3), np.float32) / 4, *bank.kernels[1:])}, "odd K"),
        ({"kernels": (np.full((3, 3, 3), np.nan, np.float32), *bank.kernels[1:])}, "must sum to 1"),
        ({"axes": (DIAMETER, DIAMETER)}, "each axis of a bank must appear once"),
        ({"axes": (SIGNED, ECCENTRICITY)}, "regular grid"),
        ({"turns": "always"}, "turns by one of"),
    ]
    for change, message in wrong:
        with pytest.raises(InputError, match=message):
            PsfBank(**(parts | change))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_bank_comes_back_from_its_folder(tmp_path: Path, channels: int) -> None:
    bank = random_bank(channels)
    write_bank(tmp_path / "bank", bank)
    again = read_bank(tmp_path / "bank")
    same = ("model", "axes", "counts", "turns", "near_side_turned", "nested", "settings")
    assert all(getattr(again, name) == getattr(bank, name) for name in same)
    for kernel, expected in zip(again.kernels, bank.kernels, strict=True):
        np.testing.assert_array_equal(kernel, expected)


def test_a_single_axis_to_infinity_comes_back(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", PsfBank("m", (INFINITE,), (3,), (np.ones((1, 1, 1), np.float32),) * 3, nested=False))
    assert json.loads((tmp_path / "bank" / "bank.json").read_text())["axes"][0]["high"] is None
    assert read_bank(tmp_path / "bank").axes == (INFINITE,)


def test_existing_folders_are_kept(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", random_bank())
    (tmp_path / "bank" / "spreadlets.npz").write_bytes(b"of the old bank")
    (tmp_path / "bank" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="--overwrite"):
        write_bank(tmp_path / "bank", random_bank(1))
    write_bank(tmp_path / "bank", random_bank(1), overwrite=True)
    assert read_bank(tmp_path / "bank").channels == 1
    assert not (tmp_path / "bank" / "spreadlets.npz").exists() and (tmp_path / "bank" / "notes.txt").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "00000.npy").write_bytes(b"")
    with pytest.raises(InputError, match="not a bank"):
        write_bank(tmp_path / "mine", random_bank(), overwrite=True)


def test_damaged_banks_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "bank"
    with pytest.raises(InputError, match="no such file"):
        read_bank(folder)
    write_bank(folder, random_bank())
    whole = cell_path(folder, 2).read_bytes()
    for content, message in ((None, r"only 13 of its 14 kernels"), (whole[:-4], "not an array"), (b"", "not an array")):
        cell_path(folder, 2).unlink() if content is None else cell_path(folder, 2).write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_bank(folder)
    cell_path(folder, 2).write_bytes(whole)
    head = json.loads((folder / "bank.json").read_text())
    for change, message in (
        ({"version": 9}, "version 1"),
        ({"axes": [{"name": "x"}]}, "not the description"),
        ({"turns": "about"}, "turns by"),
    ):
        (folder / "bank.json").write_text(json.dumps(head | change))
        with pytest.raises(InputError, match=message):
            read_bank(folder)


def test_kernels_as_pictures_in_colour_and_grey(tmp_path: Path) -> None:
    """EXR keeps the numbers; PNG keeps them to a step of 16 bits of its largest; the index says where each belongs."""
    bank = random_bank()
    assert export_bank(bank, tmp_path / "exr", "exr") == len(bank.kernels)
    np.testing.assert_array_equal(read_image(tmp_path / "exr" / "00005.exr"), bank.kernels[5])
    export_bank(bank, tmp_path / "png", "png")
    with (tmp_path / "png" / "index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == [f"{cell:05d}.png" for cell in range(len(bank.kernels))]
    stored = cv2.imread(str(tmp_path / "png" / rows[7]["file"]), cv2.IMREAD_UNCHANGED)[..., ::-1]
    peak = float(rows[7]["peak"])
    assert stored.dtype == np.uint16 and stored.max() == 65535
    np.testing.assert_allclose(stored / 65535.0 * peak, bank.kernels[7], atol=0.51 * peak / 65535.0)
    assert [float(rows[7][name]) for name in ("eccentricity_low", "eccentricity", "eccentricity_high")] == pytest.approx(
        [bank.boxes[7, 1, 0], bank.centres[7, 1], bank.boxes[7, 1, 1]]
    )
    with pytest.raises(InputError, match="exists already"):
        export_bank(bank, tmp_path / "png", "png")
    bank = random_bank(1)
    export_bank(bank, tmp_path / "grey", "exr")
    np.testing.assert_array_equal(read_image(tmp_path / "grey" / "00003.exr"), np.repeat(bank.kernels[3], 3, axis=2))
