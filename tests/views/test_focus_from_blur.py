"""Focus solved from the blur of a board, on pictures through a thin lens whose focus is known (tests/support/thin_lens_board)."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid
from tests.support.thin_lens_board import DARK, LIGHT, Shot, camera_over, display_bgr, photograph
from viewfinder.focus.board_focus import BlurOfBoardFocus, BlurSettings, FocusEvidence, focus_candidates, settled
from viewfinder.focus.edge_blur import EdgeBlurs, board_edges, edge_blurs, edge_rise
from viewfinder.frames import CameraFrame, LensState
from viewfinder.tracking.tracker import TrackedPose

BOARD = CharucoBoard((CharucoGrid((6, 4), 30.0, 22.0),))
LENS = Lens(35.0, 2.8, 1.0, 23.5)
WIDTH_PX, HEIGHT_PX = 320, 214
DISTANCE_M = 0.45
"""Squares of 32 px, a rim of 4 px around the markers; 8.7 px of blur for each dioptre."""

RAYS = 48
NOISE = 0.004
SHARPEST_PX = 0.1
"""Nothing but drawing blurs: bilinear steps of a third of a pixel."""


def shot(dioptres: float, tilt_deg: float, distance_m: float = DISTANCE_M) -> tuple[np.ndarray, Camera, Lens]:
    """(linear picture, its camera with the pose over the board, its lens)."""
    lens = LENS.focused_at(1.0 / dioptres)
    camera = camera_over(BOARD, lens, WIDTH_PX, HEIGHT_PX, distance_m, tilt_deg)
    return photograph(BOARD, Shot(lens, camera, NOISE, np.random.default_rng(1)), RAYS), camera, lens


def slightly_off(camera: Camera) -> Camera:
    """The pose as a tracker knows it: 0.05 degrees and 0.3 px aside."""
    turn = cv2.Rodrigues(np.radians([0.05, -0.05, 0.05]))[0]
    pose = camera.camera_from_world.copy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:2, 3] += 0.3 * pose[2, 3] / camera.focal_px[0]
    return replace(camera, camera_from_world=pose)


def test_edges_lie_between_black_and_white_and_rise_as_a_disc() -> None:
    """In a sharp picture from above: half way over the white rim it is light, before it and on the border of the marker dark."""
    lens = Lens(35.0, 500.0, DISTANCE_M, 23.5)
    camera = camera_over(BOARD, lens, 640, 428, DISTANCE_M, 0.0)
    picture = photograph(BOARD, Shot(lens, camera), 1)
    edges = board_edges(BOARD)
    # Between 6x4 squares lie 5 * 4 + 6 * 3 edges; the rim is (30 - 22) / 2 mm, a cell of a 4x4 marker with its border 22 / 6 mm.
    assert len(edges.clear_m) == 38
    assert edges.clear_m == pytest.approx(0.004) and edges.border_m == pytest.approx(0.022 / 6)
    middles = (edges.starts_m + edges.ends_m) / 2
    for step_m, expected in ((0.002, LIGHT), (-0.002, DARK), (0.004 + 0.0018, DARK)):
        xy_px, _ = camera.project(middles + step_m * edges.to_white)
        seen = picture[xy_px[:, 1].astype(int), xy_px[:, 0].astype(int)]
        assert seen == pytest.approx(expected, abs=0.02)
    # Without the Gaussian the area of a circle up to a chord: 1/2 + (asin u + u sqrt(1 - u^2)) / pi, here at u of -1 to 1.
    u = np.linspace(-1.0, 1.0, 21)
    exact = 0.5 + (np.arcsin(u) + u * np.sqrt(1 - u**2)) / np.pi
    assert edge_rise(5.0 * u, 10.0, 0.2) == pytest.approx(exact, abs=3e-3)
    assert edge_rise(np.array([-9.0, 9.0]), 10.0, 0.2) == pytest.approx([0.0, 1.0], abs=1e-6)


@pytest.mark.parametrize("dioptres", [1.4, 1.5, 1.9, 2.2, 2.6, 2.9, 3.0])
def test_diameters_of_edges_and_focus_of_a_tilted_board(dioptres: float) -> None:
    """The board lies at 2.0 to 2.5 dioptres; nearer and farther focus, one frame, a pose as it is tracked.

    Each diameter is the circle of confusion of the thin lens at its edge's depth; below 2 px one edge says little, the mean still does.
    """
    picture, camera, lens = shot(dioptres, 35.0)
    blurs = edge_blurs(picture, slightly_off(camera), board_edges(BOARD), SHARPEST_PX)
    if dioptres in (1.5, 1.9, 2.9):
        true_px = np.abs(lens.coc_px(blurs.depth_m, WIDTH_PX))
        assert len(blurs) >= 20 and np.ptp(true_px) > 1.0
        assert np.mean(blurs.diameter_px - true_px) == pytest.approx(0.0, abs=0.1)
        assert np.sqrt(np.mean((blurs.diameter_px - true_px)[true_px > 2.0] ** 2)) < 0.35
    found = settled(focus_candidates(blurs, LENS, WIDTH_PX), FocusEvidence(blurs, (), LENS, WIDTH_PX))
    # 0.03 dioptres are a quarter of a pixel of blur.
    assert found is not None and found.dioptres == pytest.approx(dioptres, abs=0.03)
    assert 0.03 * lens.coc_px_per_dioptre(WIDTH_PX) < 0.3


def exact_blurs(dioptres: float, depths_m: np.ndarray) -> EdgeBlurs:
    diameters = np.abs(LENS.focused_at(1.0 / dioptres).coc_px(depths_m, WIDTH_PX))
    return EdgeBlurs(depths_m, diameters, np.full(len(depths_m), 0.1))


def test_sides_are_told_by_the_last_answer_or_a_moved_camera() -> None:
    """The board at 2 dioptres, the focus at 1.5: as blurred as with the focus nearer, at d with (d - 2) / (1 - f d) = 0.5 / (1 - 1.5 f).

    (The blur goes with the image distance f / (1 - f d).) f = 0.035 m: d = 2.4819.
    """
    blurs = exact_blurs(1.5, np.full(20, 0.5))
    candidates = focus_candidates(blurs, LENS, WIDTH_PX)
    assert sorted(each.dioptres for each in candidates) == pytest.approx([1.5, 2.4819], abs=2e-3)
    evidence = FocusEvidence(blurs, (), LENS, WIDTH_PX)
    assert settled(candidates, evidence) is None
    near = settled(candidates, replace(evidence, settled_dioptres=2.6))
    far = settled(candidates, replace(evidence, settled_dioptres=1.3))
    assert near is not None and far is not None
    assert (near.dioptres, far.dioptres) == (pytest.approx(2.4819, abs=2e-3), pytest.approx(1.5, abs=2e-3))
    # The camera was 5 cm nearer before, with the same focus: only the true answer explains both, whatever was believed.
    now, before = exact_blurs(1.5, np.full(20, 0.5)), exact_blurs(1.5, np.full(20, 0.45))
    evidence = FocusEvidence(now, [before], LENS, WIDTH_PX, settled_dioptres=2.6)
    found = settled(focus_candidates(now, LENS, WIDTH_PX), evidence)
    assert found is not None and found.dioptres == pytest.approx(1.5, abs=2e-3)


def test_wrong_edges_are_outvoted_and_too_few_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    depths_m = rng.uniform(0.4, 0.6, 60)
    blurs = exact_blurs(1.5, depths_m)
    wrong = np.where(rng.random(60) < 0.3, rng.uniform(0.0, 15.0, 60), blurs.diameter_px + rng.normal(0.0, 0.1, 60))
    found = focus_candidates(replace(blurs, diameter_px=wrong), LENS, WIDTH_PX)[0]
    assert found.dioptres == pytest.approx(1.5, abs=0.01)
    camera = camera_over(BOARD, LENS, WIDTH_PX, HEIGHT_PX, DISTANCE_M, 0.0)
    grey = np.full((HEIGHT_PX, WIDTH_PX), 0.3, np.float32)
    assert len(edge_blurs(grey, camera, board_edges(BOARD))) == 0
    away = camera.camera_from_world.copy()
    away[:3, 3] = (0.0, 0.0, -1.0)
    assert len(edge_blurs(grey, replace(camera, camera_from_world=away), board_edges(BOARD))) == 0
    assert focus_candidates(exact_blurs(1.5, np.full(5, 0.5)), LENS, WIDTH_PX) == ()


def test_focus_on_the_board_and_through_a_softer_camera() -> None:
    picture, camera, _ = shot(1.0 / DISTANCE_M, 0.0)
    blurs = edge_blurs(picture, camera, board_edges(BOARD), SHARPEST_PX)
    found = settled(focus_candidates(blurs, LENS, WIDTH_PX), FocusEvidence(blurs, (), LENS, WIDTH_PX))
    # Within a pixel of blur, 0.115 dioptres.
    assert found is not None and found.dioptres == pytest.approx(1.0 / DISTANCE_M, abs=0.06)
    # Behind a Gaussian of 0.7 px, as a low-pass filter on the sensor, of which `sharpest_px` tells.
    picture, camera, _ = shot(1.5, 35.0)
    sigma_px = float(np.hypot(0.7, SHARPEST_PX))
    blurs = edge_blurs(cv2.GaussianBlur(picture, (0, 0), 0.7), camera, board_edges(BOARD), sigma_px)
    assert focus_candidates(blurs, LENS, WIDTH_PX)[0].dioptres == pytest.approx(1.5, abs=0.04)


def test_source_with_its_thread() -> None:
    picture, camera, _ = shot(1.5, 35.0)
    intrinsics = replace(camera, camera_from_world=np.eye(4)).resized(2 * WIDTH_PX, 2 * HEIGHT_PX)
    source = BlurOfBoardFocus(BOARD, LENS, intrinsics, BlurSettings(sharpest_px=SHARPEST_PX, hold_s=2.0))
    try:
        frame = CameraFrame(display_bgr(picture), 10.0, 0)
        assert source.state(frame, None) == LensState()
        assert source.state(frame, TrackedPose(camera.camera_from_world, 0.1, 10.0)) == LensState()
        pose = TrackedPose(camera.camera_from_world, 1.0, 10.0)
        deadline = time.monotonic() + 10.0
        while (told := source.state(frame, pose).focus_distance_m) is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert told is not None and 1.0 / told == pytest.approx(1.5, abs=0.03)
        assert source.answer is not None and source.answer.sigma_dioptres < 0.03
        later = replace(frame, captured_s=12.5)
        assert source.state(later, None) == LensState()
    finally:
        source.close()
    assert not source._thread.is_alive()
