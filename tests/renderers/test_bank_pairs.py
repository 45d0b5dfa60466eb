"""Training pairs rendered with a bank of kernels: blurred by it, read by the training code, resumed and refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets_scripts.bank_pairs import FARTHEST_M, NEAREST_M, PairsPlan, main, make_bank_pairs, random_layers
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.optics.psf_bank import Axis, PsfBank, physical_boxes
from mrbokeh.optics.psf_bank_file import write_bank
from mrbokeh.optics.psf_grid import NestedGrid
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import file_troubles, read_focal_stack_dataset
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from training.data.dataset import read_pair

PLAN = PairsPlan(scenes=2, focuses=2, width_px=64, height_px=40)


@pytest.fixture(scope="module", name="bank")
def fixture_bank() -> PsfBank:
    axis, counts = Axis("diameter_px", -10.0, 10.0, 1.5), (31,)
    middles = physical_boxes((axis,), NestedGrid(counts, nested=False)).mean(axis=2)[:, 0]
    ring = Aperture.ring(0.5)
    kernels = tuple(ring.rasterize(float(each)).kernel[..., None].astype(np.float32) for each in middles)
    return PsfBank("measured", (axis,), counts, kernels, nested=False)


def test_a_set_is_what_the_bank_makes_of_its_scenes_with_one_wall_and_depths_within_the_range(tmp_path: Path, bank: PsfBank) -> None:
    """Slices are nearer to the ring by its own aperture than to a disc; the largest blur is nearly the bank's; training reads it."""
    dataset = make_bank_pairs(bank, tmp_path / "set", PLAN)
    assert read_focal_stack_dataset(tmp_path / "set") == dataset
    assert [each.part for each in dataset.stacks] == ["train", "test"]
    assert 7.0 < dataset.largest_coc_px <= 10.0
    assert not [trouble for record in dataset.stacks for trouble in file_troubles(dataset, record)]
    stack = read_focal_stack(tmp_path / "set" / dataset.stacks[0].name)
    layers, lens = random_layers((40, 64), np.random.default_rng([PLAN.seed, 0])), stack.lens_of(0)
    ring, disc = (
        ScatterReference().render(layers, replace(lens, aperture=aperture)).rgb for aperture in (Aperture.ring(0.5), Aperture.disc())
    )
    seen = stack.slice_rgb(0)
    assert psnr(seen, ring, 1.0) > psnr(seen, disc, 1.0) + 6.0
    pair = read_pair(stack, 1)
    assert pair.target.shape == (40, 64, 3) and np.abs(pair.coc_px).max() <= 10.0
    for seed in range(4):
        layers = random_layers((40, 64), np.random.default_rng(seed))
        assert len(layers) >= 4 and (layers[-1].alpha == 1.0).all()
        for layer in layers:
            seen_m = layer.depth_m[layer.alpha > 0]
            assert (seen_m >= np.float32(NEAREST_M)).all() and (seen_m <= np.float32(FARTHEST_M)).all()
            assert set(np.unique(layer.alpha)) <= {0.0, 1.0}


def test_an_interrupted_set_goes_on_and_another_is_refused(tmp_path: Path, bank: PsfBank) -> None:
    first = make_bank_pairs(bank, tmp_path / "set", PLAN)
    kept, lost = (tmp_path / "set" / name for name in PLAN.names)
    before, missing = (kept / "slice_00.exr").stat().st_mtime_ns, lost / "slice_00.exr"
    content = missing.read_bytes()
    (lost / "stack.json").unlink()
    missing.unlink()
    assert make_bank_pairs(bank, tmp_path / "set", PLAN) == first
    assert (kept / "slice_00.exr").stat().st_mtime_ns == before and missing.read_bytes() == content
    with pytest.raises(InputError, match="other settings"):
        make_bank_pairs(bank, tmp_path / "set", PairsPlan(seed=2))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match="something else"):
        make_bank_pairs(bank, tmp_path / "other", PLAN)


def test_the_command_says_what_it_made_or_what_is_wrong(tmp_path: Path, bank: PsfBank) -> None:
    write_bank(tmp_path / "bank", bank)
    words = ["--out", tmp_path / "set", "--scenes", 1, "--focuses", 1, "--width", 32, "--height", 24]
    assert "1 stacks" in printed_by(main, tmp_path / "bank", *words)
    assert read_lens(tmp_path / "set" / "lens.json").focal_length_mm == 50.0
    assert "bank of PSFs" in printed_by(main, tmp_path / "none", *words, exit_code=2)
