"""`mrbokeh lens psf`, `export` and `show` as a user meets them: real files, builds that stopped half way, and mistakes."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.commands.lens import app
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.optics.psf_bank_file import cell_path, missing_cells, read_bank, read_head
from mrbokeh.psf_models.build import MODEL_NAMES, Combined, ModelOptions, build_bank, choose_model
from mrbokeh.psf_models.physical_lens import PhysicalLens
from mrbokeh.psf_models.simple_lens import SimpleLens
from mrbokeh.renderers.bank.kernel_files import build_spreadlets, spreadlets_beside
from mrbokeh.renderers.kernels.spreadlets import Sparsification, Spreadlet, sparsify
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh, printed_by

SMALL = ["--diameter", "12", "--counts", "4"]


run = partial(printed_by, app)


def picture_file(path: Path) -> Path:
    write_image(path, np.random.default_rng(0).random((9, 12, 3)).astype(np.float32))
    return path


def test_a_bank_of_the_disc_holds_the_disc(tmp_path: Path) -> None:
    """At the largest diameter of the last cell, 12 px, and below: every kernel lies between those of its cell's ends."""
    told = json.loads(mrbokeh("lens", "psf", "simple", "--out", tmp_path / "bank", *SMALL, "--json").stdout)
    assert told["figures"]["kernels"] == 4 and told["outputs"] == [str(tmp_path / "bank")]
    bank = read_bank(tmp_path / "bank")
    np.testing.assert_allclose(bank.boxes[:, 0], [[0, 0.75], [0.75, 3], [3, 6.75], [6.75, 12]])
    np.testing.assert_array_equal(bank.kernels[0], np.ones((1, 1, 1)))
    middle = len(bank.kernels[3]) // 2
    ends = [Aperture.disc().rasterize(diameter_px).kernel.max() for diameter_px in (12.0, 6.75)]
    assert ends[0] < bank.kernels[3][middle, middle, 0] < ends[1]


def test_the_opening_of_a_lens_file_and_a_picture_become_banks(tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.json", Lens(50.0, 1.8, 2.0, 36.0, Aperture.heart()))
    run("psf", "simple", "--lens", tmp_path / "lens.json", "--out", tmp_path / "bank", *SMALL)
    bank = read_bank(tmp_path / "bank")
    expected = SimpleLens(Aperture.heart()).kernel(bank.boxes[3], 0, 0)
    np.testing.assert_allclose(bank.kernels[3], expected, atol=1e-7)
    assert bank.near_side_turned
    run("psf", "stylized", "--psf-picture", picture_file(tmp_path / "logo.png"), "--out", tmp_path / "logo", *SMALL)
    bank = read_bank(tmp_path / "logo")
    assert bank.channels == 3 and len(bank.kernels) == 4 and bank.near_side_turned


def test_combined_traced_by_rays(tmp_path: Path) -> None:
    run(
        "psf",
        "combined",
        "--out",
        tmp_path / "bank",
        "--diameter",
        8,
        "--longest-motion",
        6,
        "--counts",
        "3,3",
        "--rays",
        1 << 18,
        "--seed",
        4,
    )
    bank = read_bank(tmp_path / "bank")
    assert (bank.turns, bank.settings["rays"], bank.settings["seed"]) == ("motion", 1 << 18, 4)
    assert bank.axes[0].high == 8.0 and bank.axes[1].high == 6.0
    for box, kernel in zip(bank.boxes, bank.kernels, strict=True):
        assert np.abs(kernel - Combined().kernel(box, 0, 0)).sum() < 0.03


def test_the_same_bank_whatever_the_threads(tmp_path: Path) -> None:
    banks = [build_bank(Combined(9.0, 9.0, (5, 5)), tmp_path / str(threads), 4000, 1, threads=threads) for threads in (1, 3)]
    for one, other in zip(banks[0].kernels, banks[1].kernels, strict=True):
        np.testing.assert_array_equal(one, other)


class Interrupted(SimpleLens):
    """A simple lens whose owner stops it after two kernels."""

    asked = 0

    def kernel(self, *arguments: Any) -> np.ndarray:
        self.asked += 1
        if self.asked > 2:
            raise KeyboardInterrupt
        return super().kernel(*arguments)


def test_an_interrupted_build_goes_on(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        build_bank(Interrupted(diameter_px=12.0, counts=(6,)), tmp_path / "bank", threads=1)
    head = read_head(tmp_path / "bank")
    assert missing_cells(tmp_path / "bank", head) == [2, 3, 4, 5]
    with pytest.raises(InputError, match="only 2 of its 6 kernels are built"):
        read_bank(tmp_path / "bank")
    kept = cell_path(tmp_path / "bank", 1).stat().st_mtime_ns
    run("psf", "simple", "--out", tmp_path / "bank", "--diameter", 12, "--counts", 6)
    assert cell_path(tmp_path / "bank", 1).stat().st_mtime_ns == kept
    whole = build_bank(SimpleLens(diameter_px=12.0, counts=(6,)), tmp_path / "at once")
    for one, other in zip(read_bank(tmp_path / "bank").kernels, whole.kernels, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not list((tmp_path / "bank").rglob("*.part*"))


def test_a_part_of_another_bank_is_not_gone_on_with(tmp_path: Path) -> None:
    run("psf", "simple", "--out", tmp_path / "bank", *SMALL)
    cell_path(tmp_path / "bank", 2).unlink()
    for other in (["--diameter", 13, "--counts", 4], [*SMALL, "--rays", 1000]):
        with pytest.raises(InputError, match="exists already"):
            run("psf", "simple", "--out", tmp_path / "bank", *other)
    run("psf", "simple", "--out", tmp_path / "bank", "--diameter", 13, "--counts", 4, "--overwrite")
    assert read_bank(tmp_path / "bank").axes[0].high == 13.0
    with pytest.raises(InputError, match="exists already"):  # a finished one, too
        run("psf", "simple", "--out", tmp_path / "bank", "--diameter", 13, "--counts", 4)


def test_export_and_sheet(tmp_path: Path) -> None:
    run("psf", "combined", "--out", tmp_path / "bank", "--diameter", 8, "--longest-motion", 6, "--counts", "3,3")
    run("export", tmp_path / "bank", "--out", tmp_path / "kernels", "--format", "exr")
    bank = read_bank(tmp_path / "bank")
    assert sorted(path.suffix for path in (tmp_path / "kernels").iterdir()) == [".csv", *[".exr"] * len(bank.kernels)]
    np.testing.assert_array_equal(read_image(tmp_path / "kernels" / "00004.exr")[..., :1], bank.kernels[4])
    run("show", tmp_path / "bank", "--out", tmp_path / "sheet.png")
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[:2] == (8 * 150, 13 * 150)


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_every_model_can_be_made_by_name(name: str, tmp_path: Path) -> None:
    options = ModelOptions(image=picture_file(tmp_path / "logo.png")) if name == "stylized" else ModelOptions()
    model = choose_model(name, options)
    assert model.name == name and len(model.axes) == len(model.counts) and model.channels in (1, 3)


PAIR = "60 2 1.5 20\n-60 5 1 20\n0 5 0 12\n60 2 1.5 20\n-60 0 1 20\n"


def test_physical_lenses_and_media_are_what_their_options_say(tmp_path: Path) -> None:
    """Each option of the command line arrives as its namesake of the constructor: same settings, same kernels."""
    (tmp_path / "pair.dat").write_text(PAIR)
    options = ("--prescription", tmp_path / "pair.dat", "--focus", 3, "--f-number", 8, "--sensor-width", 24)
    depths = ("--near", 1, "--far", 20, "--image-width", 300, "--no-vignetting")
    run("psf", "physical", *options, *depths, "--counts", "3,3", "--rays", 1 << 12, "--out", tmp_path / "bank")
    bank = read_bank(tmp_path / "bank")
    model = PhysicalLens(
        tmp_path / "pair.dat", focus_distance_m=3.0, f_number=8.0, sensor_mm=(24.0, 16.0), image_width_px=300, nearest_m=1.0,
        farthest_m=20.0, vignetting=False, counts=(3, 3),
    )  # fmt: skip
    assert bank.axes == model.axes and bank.settings == model.settings | {"rays": 1 << 12, "seed": 0}
    assert bank.settings["f_number"] == 8.0 and bank.settings["mm_per_px"] == 0.08 and bank.axes[0].high == 20.0
    np.testing.assert_array_equal(bank.kernels[4], model.kernel(bank.boxes[4], 1 << 12, 4))
    made = choose_model("physical", ModelOptions(sensor_width_mm=24.0, sensor_height_mm=24.0, focus_distance_m=np.inf))
    assert made.settings["half_diagonal_mm"] == pytest.approx(12.0 * np.sqrt(2.0)) and made.settings["focus_distance_m"] == "inf"
    options = ("--density-per-m", 0.4, "--anisotropy", 0.5, "--focal-px", 60, "--far", 2, "--counts", 3)
    run("psf", "volume", *options, "--rays", 1000, "--out", tmp_path / "medium")
    bank = read_bank(tmp_path / "medium")
    assert [bank.settings[key] for key in ("density_per_m", "anisotropy", "focal_px")] == [0.4, 0.5, 60.0] and bank.axes[0].high == 2.0


def test_cells_in_proportion_or_the_papers_grid(tmp_path: Path) -> None:
    for name, option in (("ours", ("--cells", 30)), ("paper", ("--counts", "9,9"))):
        run("psf", "combined", "--diameter", 16, "--longest-motion", 16, *option, "--out", tmp_path / name)
    ours, paper = read_bank(tmp_path / "ours"), read_bank(tmp_path / "paper")
    assert 25 <= len(ours.kernels) <= 30 and ours.knee_px and len(paper.kernels) == 28 and paper.nested and paper.knee_px is None


def test_spreadlets_beside_a_bank(tmp_path: Path) -> None:
    """They are those of its kernels, one after the other, and what they are made with is what the command says."""
    run("psf", "simple", "--out", tmp_path / "bank", "--diameter", 60, "--counts", 3)
    said = run("spreadlets", tmp_path / "bank", "--points-per-px", 0.8, "--seed", 3)
    bank = read_bank(tmp_path / "bank")
    found = spreadlets_beside(tmp_path / "bank", bank.kernels)
    assert found is not None and f"{len(found.points)} points of 3 kernels" in said and not (tmp_path / "bank" / "spreadlets.part").exists()
    for cell, kernel in enumerate(bank.kernels):
        expected = sparsify(kernel, Sparsification(points_per_px=0.8, annealing_steps=0, seed=3))
        np.testing.assert_array_equal(found[cell].points, expected.points)
        np.testing.assert_array_equal(found[cell].values, expected.values)
    with pytest.raises(InputError, match="there already"):
        run("spreadlets", tmp_path / "bank", "--points-per-px", 0.8, "--seed", 3)
    run("spreadlets", tmp_path / "bank")
    other = spreadlets_beside(tmp_path / "bank", bank.kernels)
    assert other is not None and len(other.points) > len(found.points)


def test_spreadlets_of_a_bank_that_has_changed_are_noticed(tmp_path: Path) -> None:
    run("psf", "simple", "--out", tmp_path / "bank", *SMALL)
    assert spreadlets_beside(tmp_path / "bank", read_bank(tmp_path / "bank").kernels) is None
    run("spreadlets", tmp_path / "bank")
    kernel = read_bank(tmp_path / "bank").kernels[3]
    np.save(cell_path(tmp_path / "bank", 3), np.ascontiguousarray(kernel[:, ::-1] * np.float32(0.99)))
    with pytest.raises(InputError, match="of other kernels than the bank has now: run `mrbokeh lens spreadlets"):
        spreadlets_beside(tmp_path / "bank", read_bank(tmp_path / "bank").kernels)
    run("spreadlets", tmp_path / "bank")
    assert spreadlets_beside(tmp_path / "bank", read_bank(tmp_path / "bank").kernels) is not None
    run("psf", "simple", "--out", tmp_path / "bank", *SMALL, "--overwrite")
    assert not (tmp_path / "bank" / "spreadlets.npz").exists()


@pytest.mark.slow
def test_interrupted_spreadlets_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped at the third of four kernels, then a kernel changes: of the two that are there only the other one is kept."""
    run("psf", "simple", "--out", tmp_path / "bank", *SMALL)
    made: list[np.ndarray] = []

    def counted(kernel: np.ndarray, settings: Sparsification) -> Spreadlet:
        if len(made) == most:
            raise KeyboardInterrupt
        made.append(kernel)
        return sparsify(kernel, settings)

    monkeypatch.setattr("mrbokeh.renderers.bank.kernel_files.sparsify", counted)
    most = 2
    with pytest.raises(KeyboardInterrupt):
        build_spreadlets(tmp_path / "bank", Sparsification(), threads=1)
    parts = tmp_path / "bank" / "spreadlets.part"
    assert len(list(parts.iterdir())) == 2 and not (tmp_path / "bank" / "spreadlets.npz").exists()
    kernels = read_bank(tmp_path / "bank").kernels
    np.save(cell_path(tmp_path / "bank", 1), kernels[1] * np.float32(0.9))
    most = 9
    assert len(build_spreadlets(tmp_path / "bank", Sparsification(), threads=1)) == 4
    assert [len(kernel) for kernel in made[2:]] == [len(kernel) for kernel in kernels[1:]]


MISTAKES = {
    "an unknown model": (["psf", "blob"], "expected a model out of simple, combined, physical, volume, stylized"),
    "no picture": (["psf", "stylized"], "--psf-picture"),
    "an option of another model": (["psf", "combined", "--psf-picture", "a.png"], "--psf-picture does nothing"),
    "a motion for a model without": (["psf", "simple", "--longest-motion", "3"], "--longest-motion does nothing"),
    "no such lens": (["psf", "simple", "--lens", "none.json"], "none.json"),
    "no such picture": (["psf", "stylized", "--psf-picture", "none.png"], "none.png"),
    "counts in words": (["psf", "simple", "--counts", "many"], "--counts as whole numbers"),
    "too many counts": (["psf", "simple", "--counts", "3,3"], "have one count"),
    "a diameter below 0": (["psf", "simple", "--diameter", "-3"], "positive number"),
    "a focus for a model without": (["psf", "simple", "--focus", "3"], "--focus does nothing"),
    "vignetting of a thin lens": (["psf", "combined", "--no-vignetting"], "--no-vignetting does nothing"),
    "two grids": (["psf", "combined", "--cells", "9", "--counts", "3,3"], "either --counts"),
    "no cells": (["psf", "combined", "--cells", "0"], "at least one cell"),
    "too open": (["psf", "physical", "--f-number", "2"], "opens to f/4 only"),
    "too near a focus": (["psf", "physical", "--focus", "0.01"], "cannot focus at 0.01 m"),
    "no sensor": (["psf", "physical", "--sensor-width", "0"], "width and height in mm must be a positive"),
    "depths in the wrong order": (["psf", "physical", "--near", "9", "--far", "3"], "low before high"),
    "a depth in the lens": (["psf", "physical", "--near", "0.001"], "depths in front of the lens"),
    "no such prescription": (["psf", "physical", "--prescription", "none.dat"], "none.dat"),
    "less than no rays": (["psf", "simple", "--rays", "-1"], "number of rays"),
    "no bank": (["export", "none"], "expected a bank of PSFs"),
    "another format": (["export", "none", "--format", "jpg"], "exr or png"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_one_sentence_and_leave_nothing(mistake: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments, message = MISTAKES[mistake]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        run(*arguments, "--out", "out")
    assert list(tmp_path.iterdir()) == []
