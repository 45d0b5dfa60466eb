"""The three ways to the scale, each on synthetic views whose metres are known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.poses.cauchy_loss import squared_under_cauchy, squared_under_cauchy_slope
from capture.poses.colmap_job import ColmapJob, ColmapPicture, job_to_json
from capture.poses.sparse_model import SparseModel, SparseView, read_sparse_model, write_sparse_model
from capture.scale.answer import ScaleAnswer, ScaleResult, distance_scale, parse_distance, read_scale, write_scale
from capture.scale.board import (
    POSES_SIGMA,
    POSES_SIGMA_WITH_DISTORTION,
    BoardDetections,
    BoardSearch,
    board_from_options,
    detect_board,
    scale_of_detections,
    triangulate,
    umeyama,
)
from capture.scale.focus import FocusSample, focus_scale, sharpness_curves, sharpness_peaks, stated_sigma_dioptre
from capture.scale.focus_calibration import FocusFit, StackFocus
from capture.scale.metric_scale import ScaledScene, ScaleRequest, _answers, numbered, offset_of, scale_lines, scale_scene, view_pictures
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, read_board
from tests.support.refusals import refused

METRES_PER_UNIT = 0.2
BOARD = CharucoBoard((CharucoGrid((8, 6), 30.0, 22.0),))


def ring_of_views(count: int = 5) -> tuple[SparseView, ...]:
    """Views 1 m before the origin (5 units), 20 degrees apart, that look at it, with some distortion."""
    views = []
    for index in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("yx", [20 * (index - count // 2), 12 * (index % 2)], degrees=True).as_matrix()
        pose[2, 3] = 1.0 / METRES_PER_UNIT
        views.append(SparseView(f"view_{index}", Camera(800, 600, (900.0, 900.0), (400.0, 300.0), pose), (-0.05, 0.01)))
    return tuple(views)


def model_of(views: tuple[SparseView, ...]) -> SparseModel:
    return SparseModel(views, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), np.int64), np.zeros((0, 2)))


MODEL = model_of(ring_of_views())


def board_points() -> np.ndarray:
    """The board about the origin, oblique, in model units."""
    turn = Rotation.from_euler("x", 35, degrees=True).as_matrix()
    return (BOARD.corners_m - BOARD.corners_m.mean(axis=0)) @ turn.T / METRES_PER_UNIT


def detections(noise_px: float, wrong: int = 0) -> BoardDetections:
    rng = np.random.default_rng(3)
    views = np.repeat(np.arange(5), 35)
    corners = np.tile(np.arange(35), 5)
    xy_px = np.concatenate([view.project(board_points())[0] for view in MODEL.views]) + rng.normal(0, noise_px, (175, 2))
    xy_px[:wrong] += 12.0
    return BoardDetections(views, corners, xy_px)


def test_similarities_and_rays_are_solved_exactly() -> None:
    points = np.random.default_rng(0).normal(size=(9, 3))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    found = umeyama(points, 3.5 * points @ turn.T + [1.0, -2.0, 0.5])
    assert found.scale == pytest.approx(3.5, rel=1e-12)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(found(points), 3.5 * points @ turn.T + [1.0, -2.0, 0.5], atol=1e-12)
    point = np.array([0.3, -0.2, 0.4])
    seen = np.array([view.project(point)[0] for view in MODEL.views])
    np.testing.assert_allclose(triangulate(MODEL.views, seen), point, atol=1e-9)
    values = np.array([-2.0, 0.0, 0.5, 3.0])
    np.testing.assert_allclose(np.log1p(squared_under_cauchy(values) ** 2), values**2)
    numeric = (squared_under_cauchy(values + 1e-6) - squared_under_cauchy(values - 1e-6)) / 2e-6
    np.testing.assert_allclose(squared_under_cauchy_slope(values), numeric, rtol=1e-5)


def test_a_board_gives_the_scale_and_how_sure_it_is() -> None:
    answer = scale_of_detections(MODEL, BOARD, detections(0.0))
    assert answer.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-7)
    assert answer.facts["residual_mm"] < 1e-6 and answer.facts["detections"] == 175
    assert set(answer.outlines_px) == {view.name for view in MODEL.views}
    corner_seen = {view: detections(0.0).xy_px[(detections(0.0).views == view) & (detections(0.0).corners == 0)][0] for view in (0, 1)}
    for view, inner in corner_seen.items():
        outline = np.array(answer.outlines_px[MODEL.views[view].name], np.float32)
        assert cv2.pointPolygonTest(outline, tuple(map(float, inner)), measureDist=True) > 0.0, "an inner corner lies within"
    # 0.2 px on 900 px at 1 m are 0.22 mm; 175 sightings of a board 0.1 m about its middle leave some 0.02 %.
    answer = scale_of_detections(MODEL, BOARD, detections(0.2))
    error = abs(answer.metres_per_unit / METRES_PER_UNIT - 1.0)
    sigma = answer.facts["uncertainty_of_corners"]
    assert error < 4.0 * sigma and 5e-5 < sigma < 5e-4
    assert answer.uncertainty == pytest.approx(np.hypot(sigma, POSES_SIGMA_WITH_DISTORTION))
    assert answer.facts["residual_px"] == pytest.approx(0.2 * np.sqrt(2), rel=0.15)


def test_wrong_and_half_covered_corners_do_not_pull_the_board() -> None:
    answer = scale_of_detections(MODEL, BOARD, detections(0.1, wrong=6))
    assert answer.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=5e-4)
    assert answer.facts["detections"] == 169
    # One corner a pixel off in every view, as where a card lies over it, beside corners known to 0.05 px.
    seen = detections(0.05)
    seen.xy_px[seen.corners == 31] += (0.6, -0.8)
    answer = scale_of_detections(MODEL, BOARD, seen)
    assert answer.facts["detections"] == 170
    assert answer.facts["residual_px"] == pytest.approx(0.05 * np.sqrt(2), rel=0.15)
    clean = scale_of_detections(MODEL, BOARD, detections(0.05))
    assert answer.metres_per_unit == pytest.approx(clean.metres_per_unit, rel=3e-5)
    straight = model_of(tuple(replace(view, distortion=(0.0, 0.0)) for view in MODEL.views))
    xy_px = np.concatenate([view.project(board_points())[0] for view in straight.views])
    answer = scale_of_detections(straight, BOARD, replace(detections(0.0), xy_px=xy_px))
    assert answer.uncertainty == pytest.approx(POSES_SIGMA) and answer.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-7)


@pytest.mark.parametrize("legacy", [False, True])
def test_corners_are_found_where_they_are_printed(legacy: bool) -> None:
    """32 texels a square and a margin of 40: inner corner (i, j) lies at 40 + 32 (i, j), counted from the picture's corner."""
    printed = replace(BOARD, legacy=legacy).opencv_board(0).generateImage((32 * 8, 32 * 6), marginSize=0)
    picture = np.full((32 * 6 + 80, 32 * 8 + 80, 3), 255, np.uint8)
    picture[40:-40, 40:-40] = printed[..., None]
    found = BoardSearch(BOARD).corners(picture)
    assert len(found) == 35
    np.testing.assert_allclose(found.xy_px, 40.0 + 32.0 * BOARD.corners_m[found.ids, :2] / 0.03, atol=0.03)


def test_boards_come_from_options_and_files_and_intervals_from_slices(tmp_path: Path) -> None:
    path = tmp_path / "board.toml"
    path.write_text('squares = [8, 6]\nsquare_mm = 30.0\nmarker_mm = 22.0\ndictionary = "DICT_5X5_100"\n')
    assert read_board(path) == board_from_options(str(path), None, None, "DICT_4X4_50")
    assert board_from_options("8x6", 30.0, 22.0, "DICT_4X4_50") == BOARD
    told = Slice("0.exr", 1.0, metadata={"focus": {"lens_interval_dioptre": [0.97, 1.03]}})
    stack = FocalStack(tmp_path, (told, Slice("1.exr", 2.0), Slice("2.exr", 3.0, metadata={"focus": None})))
    np.testing.assert_allclose(stated_sigma_dioptre(stack), [0.06 / np.sqrt(12.0), 0.0, 0.0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: board_from_options("8", 30.0, 22.0, "DICT_4X4_50"), "COLUMNSxROWS"),
        (lambda: board_from_options("8x6", 30.0, None, "DICT_4X4_50"), "--marker"),
        (lambda: board_from_options("8x6", 30.0, 31.0, "DICT_4X4_50"), "marker < square"),
        (lambda: board_from_options("8x6", 30.0, 22.0, "DICT_9X9"), "dictionary of cv2"),
        (lambda: board_from_options("2x6", 30.0, 22.0, "DICT_4X4_50"), "at least 3x3"),
        (lambda: read_board(Path("nowhere.toml")), "no such file"),
        (lambda: parse_distance("a,b"), "VIEW_A,VIEW_B,METRES"),
        (lambda: distance_scale(MODEL, "view_0", "view_9", 1.0), "view_9"),
        (lambda: distance_scale(MODEL, "view_0", "view_0", 1.0), "two different"),
        (lambda: distance_scale(MODEL, "view_0", "view_1", -1.0), "positive"),
        (lambda: focus_scale([sample(np.full(12, np.nan))]), "found 0 in 1 stacks"),
        (
            lambda: scale_of_detections(MODEL, BOARD, detect_board(BOARD, iter([np.zeros((60, 80, 3), np.uint8)] * 5))),
            r"8x6 squares \(DICT_4X4_50\) in 5 views and found 0 corners",
        ),
    ],
)
def test_mistakes_are_named(make: Callable[[], object], message: str) -> None:
    refused(message, make)


def test_a_distance_between_two_cameras() -> None:
    """Views 0 and 2 stand on a circle of 5 units, seen under a known angle: their chord is measured to be its length in metres."""
    units = float(np.linalg.norm(MODEL.views[0].centre - MODEL.views[2].centre))
    answer = distance_scale(MODEL, "view_0", "view_2", units * METRES_PER_UNIT)
    assert answer.metres_per_unit == pytest.approx(METRES_PER_UNIT)
    assert answer.uncertainty == pytest.approx(0.001 / (units * METRES_PER_UNIT))


FOCUS_DIOPTRES = np.linspace(1.6, 0.5, 12)


def sample(stated: np.ndarray, noise: float = 0.05, wrong: float = 0.0, sigma: np.ndarray | None = None) -> FocusSample:
    """Points between the first and last focus, whose log energy is a parabola about their true dioptre."""
    rng, points = np.random.default_rng(4), 800
    dioptre = rng.uniform(0.58, 1.52, points)
    seen = np.where(rng.random(points) < wrong, rng.uniform(0.58, 1.52, points), dioptre)
    curves = np.exp(8.0 - 30.0 * (FOCUS_DIOPTRES[:, None] - seen) ** 2 + rng.normal(0, noise, (12, points)))
    peaks = sharpness_peaks(curves)
    depth = 1.0 / dioptre[peaks.points] / METRES_PER_UNIT
    return FocusSample("view_0", peaks, np.zeros((len(peaks.points), 2)), depth, stated, np.zeros(12) if sigma is None else sigma)


def test_sharpness_peaks_at_the_focus_of_a_point() -> None:
    true = np.array([0.9, 1.2312])
    curves = np.exp(5.0 - 20.0 * (FOCUS_DIOPTRES[:, None] - true) ** 2)
    np.testing.assert_allclose(sharpness_peaks(curves).dioptres(FOCUS_DIOPTRES), true, atol=1e-9)
    nearer_than_all = np.exp(-20.0 * (FOCUS_DIOPTRES - 2.0) ** 2)
    without_texture = np.full(12, 0.3)
    peaks = sharpness_peaks(np.stack([nearer_than_all, without_texture, np.exp(-20.0 * (FOCUS_DIOPTRES - 1.0) ** 2)], axis=1))
    np.testing.assert_array_equal(peaks.points, [2])
    # Texture on the left is sharp in the first slice only, on the right in the second only.
    rng = np.random.default_rng(0)
    slices = np.full((2, 40, 80, 3), 0.5, np.float32)
    slices[0, :, :30] += rng.normal(0, 0.1, (40, 30, 1)).astype(np.float32)
    slices[1, :, 50:] += rng.normal(0, 0.1, (40, 30, 1)).astype(np.float32)
    curves = sharpness_curves(iter(slices), np.array([[12.5, 20.5], [66.5, 20.5]]))
    np.testing.assert_array_equal(np.argmax(curves, axis=0), [0, 1])


def test_focus_distances_give_the_scale_with_wrong_points_and_an_offset() -> None:
    answer = focus_scale([sample(FOCUS_DIOPTRES)])
    assert answer.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-3)
    assert answer.facts["offset_m"] == 0.0, "an offset that is not told apart from 0 is 0"
    assert focus_scale([sample(FOCUS_DIOPTRES, wrong=0.33)]).metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=3e-3)
    # What is stated 45 mm too long, for it counts from the film plane: 4.5 % at 1 m, were it not for the offset.
    stated = 1.0 / (1.0 / FOCUS_DIOPTRES + 0.045)
    answer = focus_scale([sample(stated)])
    assert answer.facts["offset_m"] == pytest.approx(0.045, abs=0.004)
    assert answer.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=4e-3)
    assert answer.facts["metres_per_unit_without_offset"] / METRES_PER_UNIT > 1.03


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5, 0.75])
def test_coarse_distances_are_known_to_be_coarse(phase: float) -> None:
    """Nikon's d = 0.01 m * 10^(v / 40) has steps of 5.9 %, which the intervals of the stated distances tell."""
    coarse = 1.0 / (0.01 * 10 ** ((np.round(40 * np.log10(100.0 / FOCUS_DIOPTRES) + phase) - phase) / 40))
    sigma = 0.059 * FOCUS_DIOPTRES / np.sqrt(12.0)
    fine, answer = focus_scale([sample(FOCUS_DIOPTRES)]), focus_scale([sample(coarse, sigma=sigma)])
    error = abs(answer.metres_per_unit / METRES_PER_UNIT - 1.0)
    assert error < 0.02 and error < 2.0 * answer.uncertainty
    assert answer.uncertainty > 3.0 * fine.uncertainty


def test_the_board_counts_most_and_the_others_are_told(tmp_path: Path) -> None:
    write_sparse_model(tmp_path, MODEL)
    answers = [ScaleAnswer("focus", 0.21, 0.005), ScaleAnswer("board", 0.2, 0.0003)]
    result = ScaleResult.of(answers, {"distance": "none was given"})
    write_scale(tmp_path, result)
    assert read_sparse_model(tmp_path).metres_per_unit == 0.2
    read = read_scale(tmp_path)
    assert read.used.method == "board" and read.missing == {"distance": "none was given"}
    assert read.disagreement == pytest.approx({"focus": 0.05})
    assert read.contradictions == ("focus",), "5 % are more than 2 % and ten deviations"
    unsure = ScaleResult.of([replace(answers[0], uncertainty=0.03), answers[1]], {})
    assert unsure.contradictions == (), "5 % are less than two deviations"
    refused("board: none was given; focus: unknown", ScaleResult.of, [], {"focus": "unknown", "board": "none was given"})


def test_a_kept_scale_must_rest_on_what_is_asked_for(tmp_path: Path) -> None:
    """Found by a distance: neither with a board nor with another distance is it the one that is asked for; nothing is found anew."""
    result = ScaleResult.of([ScaleAnswer("distance", 0.2, 0.001, {"views": ["a", "b"], "metres": 0.5})], {})
    write_scale(tmp_path / "reconstruction", result)
    for request in (ScaleRequest(), ScaleRequest(distance=("a", "b", 0.5))):
        assert scale_scene(tmp_path, request).result.used.metres_per_unit == 0.2
    refused(r"scale\.json was found without a board: --overwrite finds", scale_scene, tmp_path, ScaleRequest(BOARD))
    for other in (("a", "b", 0.6), ("a", "c", 0.5)):
        refused(r"found without this --distance: --overwrite finds", scale_scene, tmp_path, ScaleRequest(distance=other))


def test_every_way_to_the_scale_is_told_with_what_it_rests_on() -> None:
    """5 % and 30 % above the board: the distance, known to 10 %, does not contradict it. 2 and 0.5 dioptres are 0.5 and 2 m."""
    answers = [
        ScaleAnswer("focus", 0.21, 0.005, {"points": 90, "stacks": 2, "offset_m": -0.03, "residual_dioptre": 0.0123}),
        ScaleAnswer("distance", 0.26, 0.1, {"views": ["a", "b"], "metres": 0.25}),
        ScaleAnswer("board", 0.2, 0.0003, {"detections": 5, "corners": 35, "residual_px": 0.123}),
    ]
    result = ScaleResult.of(answers, {"sonar": "none was given"})
    fit = FocusFit(np.array([2.0, 0.5]), np.array([4.0, 5.0]), np.array([0.01, 0.02]), np.array([60, 60]))
    nobody = FocalStack(Path("a"), ())
    assert list(scale_lines(ScaledScene(result, {"a": StackFocus(nobody, fit, 400)}, {"b": "too few points"}))) == [
        "board: 0.2 metres per unit +- 0.030 % (used; 5 sightings of 35 corners, residual 0.12 px)",
        "distance: 0.26 metres per unit +- 10.000 % (+30.00 % from the one used; 0.25 m between a and b, for a ruler of 1 mm)",
        "focus: 0.21 metres per unit +- 0.500 % (+5.00 % from the one used; 90 points of 2 stacks, offset of the lens -30 mm, "
        "residual 0.012 dioptres)",
        "sonar: no answer, for none was given",
        "warning: focus contradicts board: measure the print or the distance again, or check the focus distances",
        "a: focus from 0.500 to 2.000 m +- 0.0150 dioptres, blur 4.50 px per dioptre",
        "b: focus not calibrated (too few points)",
    ]
    assert offset_of(result) == -0.03 and offset_of(replace(result, answers=result.answers[:1])) == 0.0
    assert [numbered("lens.json", number) for number in range(3)] == ["lens.json", "lens_2.json", "lens_3.json"]


def test_a_distance_scales_plain_pictures_and_what_has_no_answer_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses lie in the folder itself. The first two views are turned by 20 and 12 degrees; 0.5 m between them."""
    write_sparse_model(tmp_path, MODEL)
    units = float(np.linalg.norm(MODEL.views[0].centre - MODEL.views[1].centre))
    refused("board: none was given .* distance: none was given .* focus: the scene has no merged", scale_scene, tmp_path, ScaleRequest())
    result = scale_scene(tmp_path, ScaleRequest(distance=("view_0", "view_1", 0.5))).result
    assert read_sparse_model(tmp_path).metres_per_unit == result.used.metres_per_unit == pytest.approx(0.5 / units)
    assert set(result.missing) == {"board", "focus"} and result.missing["board"] == "none was given (--board)"
    assert "no merged stacks" in result.missing["focus"]
    # Another run with a board, of which one view's picture is gone.
    job = ColmapJob(tuple(ColmapPicture(view.name, f"{view.name}.png", "", 0) for view in MODEL.views), (None,))
    write_json(tmp_path / "colmap_job.json", job_to_json(job))
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "view_0.png"), np.full((2, 3, 3), (3, 2, 1), np.uint8))
    pictures = view_pictures(MODEL, tmp_path)
    assert next(pictures)[0, 0].tolist() == [1, 2, 3], "red first"
    refused(r"cannot read .*view_1\.png: run `mrbokeh capture poses --overwrite`", next, pictures)
    both = ScaleRequest(BOARD, ("view_0", "view_1", 0.5), overwrite=True)
    monkeypatch.setattr("capture.scale.metric_scale.board_scale", lambda *_: ScaleAnswer("board", 0.2, 0.0003))
    assert [each.method for each in scale_scene(tmp_path, both).result.answers] == ["board", "distance"]


def test_stacks_of_unknown_focus_give_no_scale() -> None:
    nothing = sample(np.full(len(FOCUS_DIOPTRES), np.nan))
    result = _answers(MODEL, Path(), {"view_0": nothing}, ScaleRequest(distance=("view_0", "view_1", 0.5)))
    assert result.missing["focus"] == "the focus distances of the stacks are unknown"


def test_a_stack_without_focus_gets_its_camera_in_metres_and_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibration is refused, as for a stack with too few points; the camera of the view goes into stack.json all the same."""
    write_sparse_model(tmp_path / "reconstruction", MODEL)
    write_focal_stack(FocalStack(tmp_path / "view_1", (Slice("0.exr", 1.0), Slice("1.exr", 2.0)), registered=True, merged=True))
    write_focal_stack(FocalStack(tmp_path / "view_2", (Slice("0.exr", 1.0),), registered=True))

    def refuse(*_: object) -> None:
        raise InputError("too few points")

    monkeypatch.setattr("capture.scale.metric_scale.focus_sample", lambda *_: sample(np.full(len(FOCUS_DIOPTRES), np.nan)))
    monkeypatch.setattr("capture.scale.metric_scale.focus_start", refuse)
    scaled = scale_scene(tmp_path, ScaleRequest(distance=("view_0", "view_1", 0.5)))
    assert scaled.uncalibrated == {"view_1": "too few points"}, "view_2 is not merged"
    assert not scaled.calibrated and not scaled.calibrations and not (tmp_path / "lens_calibration.json").exists()
    camera = read_focal_stack(tmp_path / "view_1").camera
    assert camera is not None and camera.focal_px == (900.0, 900.0)
    assert camera.camera_from_world[2, 3] == pytest.approx(5.0 * scaled.result.used.metres_per_unit)
