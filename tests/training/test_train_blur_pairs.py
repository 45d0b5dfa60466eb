"""Networks learn from blur pairs: registered and in even light, without metres, of several sizes where there are no tiles."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair, blurred_by_disc
from mrbokeh.system.errors import InputError
from tests.lens_measuring.test_blur_pairs import DIAMETER_PX, SIZE, pair
from tests.support.blur_pair_files import write_blur_pair
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.training.test_train import DEMO_LIKE, make_stack
from training.cli import app
from training.data.pairs import read_pair
from training.data.training_data import focal_stacks, training_data
from training.evaluation.methods import blur_of
from training.fitting import train
from training.fitting.run_folder import read_facts
from training.networks.network_settings import NetworkSettings


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring-shaped opening, once as it is and once at three quarters of its size."""
    folder = tmp_path_factory.mktemp("scenes")
    whole = pair(folder / "wall")
    write_blur_pair(whole)
    size = (SIZE[1] * 3 // 4, SIZE[0] * 3 // 4)
    sharp, blurred = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (whole.sharp, whole.blurred))
    coc_px = 0.75 * cv2.resize(whole.coc_px, size, interpolation=cv2.INTER_NEAREST)
    write_blur_pair(BlurPair(folder / "smaller", sharp, blurred, coc_px))
    return folder


def test_pixels_count_whose_light_is_all_known(scenes: Path) -> None:
    """Not those within 1.1 radii (6.6 px) of the frame, nor of the corner whose diameters are unknown; a part is that of the whole."""
    (_, whole) = training_data([scenes]).stacks
    read = read_pair(whole, 0)
    assert read.frame_px == SIZE and read.weight[40:-8, 50:-8].all()
    assert not read.weight[:7].any() and not read.weight[:, -7:].any() and not read.weight[:30, :35].any()
    np.testing.assert_array_equal(read_pair(whole, 0, rows=slice(20, 60)).target, read.target[20:60])


def test_the_command_learns_the_opening_from_pairs(scenes: Path, tmp_path: Path) -> None:
    """After 12 steps it is 1 dB nearer to the photograph than a disc; pairs are held out by name; the lens is guessed."""
    words = (
        "--preset",
        "demo",
        "--epochs",
        "40",
        "--threads",
        "1",
        "--set",
        "sheets=false",
        "--set",
        "crop_px=0",
        "--set",
        "validate_every_s=0",
    )
    said = printed_by(app, "fit", scenes, "--out", tmp_path / "run", "--held-out", "smaller", *words)
    facts = read_facts(tmp_path / "run")
    assert "held-out slices" in said and "(without any blur " in said and facts.held_out == (f"{scenes.name}/smaller",)
    assert facts.lens_guessed and facts.largest_coc_px == pytest.approx(DIAMETER_PX, rel=1e-3)
    seen = read_pair(training_data([scenes]).stacks[1], 0)
    errors = [blur_of(tmp_path / "run")[0](seen), blurred_by_disc(seen.all_in_focus, seen.coc_px)]
    network, disc = (float(((each - seen.target)[seen.weight > 0] ** 2).mean()) for each in errors)
    assert network < 0.8 * disc


def test_what_pairs_cannot_serve_is_refused(scenes: Path, tmp_path: Path) -> None:
    """Tiles need one size; stacks state a lens, which pairs do not; an evaluation moves the focus in metres."""
    tiled = dataclasses.replace(DEMO_LIKE, network=NetworkSettings(tile_px=32, overlap_px=8), test_fraction=0.0)
    with pytest.raises(InputError, match="one size of picture"):
        train.fit(training_data([scenes]), tmp_path / "run", tiled)
    make_stack(tmp_path / "scene" / "view", seed=1)
    with pytest.raises(InputError, match="got both"):
        training_data([scenes, tmp_path / "scene"])
    with pytest.raises(InputError, match="got the blur pair"):
        focal_stacks(training_data([scenes]).stacks)
    refused("names of stacks among", training_data([scenes]).split, ["floor"], 0.2, 0)
