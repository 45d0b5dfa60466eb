"""Focus pulls: keys in dioptres, real metadata of cameras, steps taken out within half a step."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.focus_pull import FocusPull, parse_focus_keys, quantisation_steps, read_focus_pull, smoothed_within_steps
from tests.support.refusals import refused


def venice(shared_data: Path) -> Path:
    path = shared_data / "lens" / "metadata" / "sony_venice_focus_pull.csv"
    if not path.is_file():
        pytest.skip("lens/metadata is not in the shared test data")
    return path


def restlessness(dioptres: np.ndarray) -> float:
    """RMS of the second differences."""
    return float(np.sqrt(np.mean(np.diff(dioptres, 2) ** 2)))


def test_keys_go_linearly_or_smoothly_in_dioptres_and_are_held() -> None:
    """1 D to 0.25 D over 30 frames: at frame 10 0.75 D."""
    pull = parse_focus_keys("10:1,40:4")
    assert pull.at(20) == pytest.approx(1.0 / 0.75) and pull.at(10) == 1.0 and pull.at(40) == 4.0
    assert pull.at(0) == 1.0 and pull.at(99) == 4.0
    assert pull.shifted(100).at(120) == pytest.approx(1.0 / 0.75)
    assert parse_focus_keys("0:2,10:inf").at(5) == 4.0 and parse_focus_keys("0:2,10:inf").at(10) == float("inf")
    # Of two keys smooth is 3 t^2 - 2 t^3; through a key in between it goes on without a stop, and stays between its keys.
    pull = parse_focus_keys("0:1,10:2", "smooth")
    assert 1.0 / pull.at(2.5) == pytest.approx(1.0 - 0.5 * (3 * 0.0625 - 2 * 0.015625))
    pull = parse_focus_keys("0:1,10:2,20:2.1,30:8", "smooth")
    dioptres = 1.0 / np.array([pull.at(frame) for frame in np.arange(0.0, 30.01, 0.25)])
    assert (np.diff(dioptres) <= 1e-12).all() and dioptres[40] == pytest.approx(0.5)
    assert abs(dioptres[41] - dioptres[40]) > 1e-4
    assert np.abs(np.diff(dioptres, 2)).max() < 0.01  # no kink: half of the largest speed a step would show as 0.01


def test_keys_that_are_none_are_refused() -> None:
    for text in ("", "1.2", "0:1.2,", "0:-1", "0:0", "0:x", "0:1:2", "0:1,0:2", "5:1,0:2"):
        with pytest.raises(InputError):
            parse_focus_keys(text)
    refused("easing must be", parse_focus_keys, "0:1", "bouncy")
    refused("must grow", FocusPull, np.array([1.0, 1.0]), np.array([1.0, 1.0]))


def test_venice_red_and_canon_write_feet_millimetres_and_bits(shared_data: Path) -> None:
    """The first row is 5.83 ft."""
    pull = read_focus_pull(venice(shared_data))
    assert len(pull.frames) == 588 and pull.at(0) == pytest.approx(5.83 * 0.3048)
    refused("from frame 0 to 587", pull.at, 588)
    # REDline: 410 and 420 mm. Canon: 3F000000 is 0.5.
    folder = venice(shared_data).parent
    red, canon = read_focus_pull(folder / "red_frames.csv"), read_focus_pull(folder / "canon_frames.csv")
    assert (red.at(0), red.at(1)) == (pytest.approx(0.41), pytest.approx(0.42))
    assert canon.at(0) == pytest.approx(0.5)


def test_plain_tables_name_their_unit(tmp_path: Path) -> None:
    """Frame 12 tells nothing: it is bridged in dioptres, from 1 D to 0.5 D."""
    path = tmp_path / "focus.csv"
    path.write_text("frame,Focus (cm),f_number\n10,100,2\n12,,4\n14,200,8\n")
    pull = read_focus_pull(path)
    assert pull.at(12) == pytest.approx(1.0 / 0.75)


@pytest.mark.parametrize(("text", "says"), [
    ("frame,distance\n0,1\n", "with its unit"), ("focus_distance_m\n\n", "holds no row"),
    ("frame,focus_distance_m\n0,\n1,\n", "none of its 2 rows"),
    ("frame,focus_distance_m\n0,near\n", "row 1: its focus distance is not a number"),
])  # fmt: skip
def test_tables_without_focus_are_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    refused(says, read_focus_pull, tmp_path / "a.csv")


@pytest.mark.parametrize(("amplitude", "period", "share"), [(0.25, 240, 0.5), (0.1, 240, 0.3), (0.4, 120, 0.4), (0.05, 480, 0.9)])
def test_rounded_pulls_come_back_nearer_to_the_truth_and_without_lag(amplitude: float, period: float, share: float) -> None:
    """Smooth pulls rounded to 0.02 D. In the last one a step lasts up to 60 frames, of which half a step's error must remain.

    A lag would leave the speed of the pull times the lag: forwards and backwards would differ.
    """
    frames = np.arange(240.0)
    true = 0.6 + amplitude * np.sin(2 * np.pi * frames / period)
    rounded = np.round(true / 0.02) * 0.02
    np.testing.assert_allclose(quantisation_steps(rounded), 0.02, rtol=1e-9)
    smooth = smoothed_within_steps(rounded)
    assert np.abs(smooth - rounded).max() <= 0.01 + 1e-12
    assert np.sqrt(np.mean((smooth - true) ** 2)) < share * np.sqrt(np.mean((rounded - true) ** 2))
    assert restlessness(smooth) < 0.1 * restlessness(rounded)
    np.testing.assert_allclose(smoothed_within_steps(rounded[::-1])[::-1], smooth, atol=1e-12)


def test_what_is_not_rounded_hardly_moves() -> None:
    """All digits, never twice the same value: the distance to the next frame passes for a step, but a smooth pull is smooth already.
    A constant has no step."""
    true = 0.6 + 0.25 * np.sin(np.arange(100.0) / 20.0)
    moved = smoothed_within_steps(true) - true
    assert np.sqrt(np.mean(moved**2)) < 0.1 * np.sqrt(np.mean(np.diff(true) ** 2))
    np.testing.assert_array_equal(smoothed_within_steps(np.full(5, 0.7)), np.full(5, 0.7))


def test_the_real_pull_is_smoothed_within_half_its_steps(shared_data: Path) -> None:
    """Steps of 0.5 to 1.5 thousandths of a dioptre. Where the ring rests or creeps (15 frames below 3 steps each) the restlessness
    falls to 0.54: the camera also writes late and then catches up, which is no rounding. Nothing moves by more than half a step."""
    pull = read_focus_pull(venice(shared_data))
    smooth = pull.smoothed()
    steps = quantisation_steps(pull.dioptres)
    assert 4e-4 < np.median(steps) < 2e-3
    assert (np.abs(smooth.dioptres - pull.dioptres) <= 0.5 * steps + 1e-12).all()
    creeping = np.convolve(np.abs(np.diff(pull.dioptres, prepend=pull.dioptres[0])) < 3.0 * steps, np.ones(15), "same") >= 15
    assert creeping.mean() > 0.15
    before, after = (np.sqrt(np.mean(np.diff(each.dioptres, 2)[creeping[1:-1]] ** 2)) for each in (pull, smooth))
    assert after < 0.6 * before
