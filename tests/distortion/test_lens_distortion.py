"""Distortion models: closed forms, OpenCV, COLMAP and lensfun as judges, the inverse, and files."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.distortion import LensDistortion
from mrbokeh.distortion.distortion import StMap, colmap_distortion, distortion_from_json, read_st_map
from mrbokeh.distortion.radial import IN_LENGTHS, PARAMETERS
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.optics.camera import Camera
from tests.support.refusals import refused

CAMERA = Camera(320, 214, (270.0, 265.0), (158.3, 109.6))
OPENCV = {"k1": -0.21, "k2": 0.06, "p1": 1.5e-3, "p2": -0.8e-3, "k3": 0.01, "k4": 0.03, "k5": -0.01, "k6": 0.002}
MODELS = {
    "barrel": LensDistortion.of("opencv", k1=-0.25, k2=0.08), "pincushion": LensDistortion.of("opencv", k1=0.15, k2=0.02),
    "rational": LensDistortion.of("opencv", **OPENCV), "fisheye": LensDistortion.of("fisheye", k1=0.02, k2=-0.004, k3=0.001),
    "ptlens": LensDistortion.of("ptlens", a=0.012, b=-0.035, c=0.01), "poly3": LensDistortion.of("poly3", k1=-0.03),
    "poly5": LensDistortion.of("poly5", k1=-0.04, k2=0.01),
}  # fmt: skip


def json_of(distortion: LensDistortion) -> dict[str, object]:
    """Return the document of a model, values that are 0 left out."""
    named = zip(PARAMETERS[distortion.model], distortion.values, strict=True)
    unit = {"unit_half_diagonals": distortion.unit_half_diagonals} if distortion.model in IN_LENGTHS else {}
    return {"model": distortion.model, **{name: value for name, value in named if value}, **unit}


def some_px(camera: Camera = CAMERA, count: int = 400) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.0, 1.0, (count, 2)) * (camera.width_px, camera.height_px)


@pytest.mark.parametrize(
    ("distortion", "at_half"),
    [
        (LensDistortion.of("ptlens", a=0.1, b=-0.2, c=0.04), 0.5 * (0.1 / 8 - 0.2 / 4 + 0.04 / 2 + 1.06)),
        (LensDistortion.of("poly3", k1=0.08), 0.5 * (0.92 + 0.02)),
        (LensDistortion.of("poly5", k1=0.08, k2=0.16), 0.5 * (1 + 0.02 + 0.01)),
    ],
)
def test_values_in_half_the_shorter_side(distortion: LensDistortion, at_half: float) -> None:
    """Hugin's unit: half of 200 px in a 3:2 frame, whatever the focal lengths are."""
    camera = Camera(300, 200, (500.0, 400.0), (150.0, 100.0))
    np.testing.assert_allclose(distortion.distorted_px(np.array([[150.0, 150.0]]), camera), [[150.0, 100.0 + 100.0 * at_half]], atol=1e-12)


def opencv_matrix(camera: Camera) -> np.ndarray:
    """OpenCV counts from the centre of the first pixel, which is (0.5, 0.5) here."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("name", "judge"), [("rational", cv2.projectPoints), ("fisheye", cv2.fisheye.projectPoints)])
def test_opencv_projects_alike(name: str, judge: Callable) -> None:
    xy_px, zero, values = some_px(), np.zeros((3, 1)), np.array(MODELS[name].values)
    points_m = CAMERA.unproject(xy_px, np.full(len(xy_px), 2.0))
    projected, _ = judge(points_m[:, None], zero, zero, opencv_matrix(CAMERA), values)
    np.testing.assert_allclose(MODELS[name].distorted_px(xy_px, CAMERA), projected[:, 0] + 0.5, atol=1e-9)


def test_opencv_undistorts_alike() -> None:
    """Its map holds, for every undistorted pixel, where in the plate it is read. float32: 320 px to 3e-5."""
    matrix, size = opencv_matrix(CAMERA), (CAMERA.width_px, CAMERA.height_px)
    x, y = cv2.initUndistortRectifyMap(matrix, np.array(list(OPENCV.values())), None, matrix, size, cv2.CV_32FC1)
    found = MODELS["rational"].distorted_px(CAMERA.pixel_centres_px(), CAMERA)
    np.testing.assert_allclose(found, np.stack([x, y], axis=-1) + 0.5, atol=5e-5)


@pytest.mark.parametrize(("model", "values"), [
    ("SIMPLE_PINHOLE", (270.0, 158.3, 109.6)), ("PINHOLE", (270.0, 265.0, 158.3, 109.6)),
    ("SIMPLE_RADIAL", (270.0, 158.3, 109.6, -0.1)), ("RADIAL", (270.0, 158.3, 109.6, -0.1, 0.03)),
    ("OPENCV", (270.0, 265.0, 158.3, 109.6, -0.1, 0.03, 1e-3, -2e-3)),
    ("FULL_OPENCV", (270.0, 265.0, 158.3, 109.6, *OPENCV.values())),
    ("OPENCV_FISHEYE", (270.0, 265.0, 158.3, 109.6, 0.02, -0.004, 0.001, 2e-4)),
    ("SIMPLE_RADIAL_FISHEYE", (270.0, 158.3, 109.6, 0.02)), ("RADIAL_FISHEYE", (270.0, 158.3, 109.6, 0.02, -0.004)),
])  # fmt: skip
def test_colmap_projects_alike(model: str, values: tuple[float, ...]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=320, height=214, params=list(values))
    focal_px, principal_px, distortion = colmap_distortion(model, values)
    camera = Camera(320, 214, focal_px, principal_px)
    xy_px = some_px()
    points_m = camera.unproject(xy_px, np.full(len(xy_px), 3.0))
    np.testing.assert_allclose(distortion.distorted_px(xy_px, camera), theirs.img_from_cam(points_m), atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_the_inverse_is_exact(name: str) -> None:
    """Residual of the solved equation, in pixels, also 10 % beyond the frame."""
    xy_px = (some_px() - 150.0) * 1.1 + 150.0
    undistorted = MODELS[name].undistorted_px(xy_px, CAMERA)
    assert np.isfinite(undistorted).all()
    np.testing.assert_allclose(MODELS[name].distorted_px(undistorted, CAMERA), xy_px, atol=3e-8)
    assert np.abs(undistorted - xy_px).max() > 1.0


def test_nothing_is_seen_beyond_the_fold_and_nothing_bends_nothing() -> None:
    """r (1 - r^2 / 3) grows up to r = 1, where it is 2/3: points beyond come from nowhere and go nowhere."""
    camera, distortion = Camera(100, 100, (1.0, 1.0), (0.0, 0.0)), LensDistortion.of("opencv", k1=-1.0 / 3.0)
    seen = np.array([[0.66, 0.0], [0.0, -0.66]])
    np.testing.assert_allclose(distortion.distorted_px(distortion.undistorted_px(seen, camera), camera), seen, atol=1e-9)
    assert np.isnan(distortion.undistorted_px(np.array([[0.67, 0.0]]), camera)).all()
    assert np.isnan(distortion.distorted_px(np.array([[1.01, 0.0]]), camera)).all()
    xy_px = some_px()
    for none in (LensDistortion(), LensDistortion.of("opencv"), LensDistortion.of("poly3")):
        assert none.is_none
        np.testing.assert_array_equal(none.distorted_px(xy_px, CAMERA), xy_px)
        np.testing.assert_array_equal(none.undistorted_px(xy_px, CAMERA), xy_px)
    assert not LensDistortion.of("fisheye").is_none


@pytest.mark.parametrize("name", MODELS)
def test_json_keeps_a_model_that_is_bent_alike_where_a_plate_is_resized(name: str) -> None:
    half = MODELS[name].distorted_px(some_px() / 2, CAMERA.resized(160, 107))
    np.testing.assert_allclose(2 * half, MODELS[name].distorted_px(some_px(), CAMERA), atol=1e-9)
    assert distortion_from_json(json.loads(json.dumps(json_of(MODELS[name])))) == MODELS[name]


def test_json_takes_names_of_colmap_and_st_maps_by_their_file(tmp_path: Path) -> None:
    assert distortion_from_json({"model": "RADIAL", "values": [-0.1, 0.02]}) == LensDistortion.of("opencv", k1=-0.1, k2=0.02)
    assert distortion_from_json({"model": "OPENCV_FISHEYE", "values": [0.1, 0.0, 0.0, 0.0]}) == LensDistortion.of("fisheye", k1=0.1)
    assert distortion_from_json({"model": "none"}).is_none
    assert distortion_from_json({"k1": -0.1, "p1": 0.01}) == LensDistortion.of("opencv", k1=-0.1, p1=0.01)
    uv = st_map_of(MODELS["barrel"], "distort")
    write_exr(tmp_path / "st.exr", ExrPart({"u": uv[..., 0], "v": uv[..., 1]}))
    read = distortion_from_json({"model": "st_map", "path": "st.exr"}, folder=tmp_path)
    assert read.st_map is not None
    assert (read.model, read.st_map.path, read.st_map.kind) == ("st_map", str(tmp_path / "st.exr"), "distort")


@pytest.mark.parametrize(
    "document",
    [{}, {"model": "opencv", "k9": 1.0}, {"model": "spline"}, {"model": "opencv", "k1": "x"}, {"model": "RADIAL", "values": [1.0]}],
)
def test_json_that_is_no_distortion(document: dict[str, object]) -> None:
    refused(r"camera\.json", distortion_from_json, document, "camera.json")


def st_map_of(distortion: LensDistortion, kind: str) -> np.ndarray:
    """(h, w, 2) as Nuke writes it: u to the right, v from the bottom up, at pixel centres."""
    centres = CAMERA.pixel_centres_px()
    read_px = distortion.undistorted_px(centres, CAMERA) if kind == "distort" else distortion.distorted_px(centres, CAMERA)
    return np.stack([read_px[..., 0] / CAMERA.width_px, 1.0 - read_px[..., 1] / CAMERA.height_px], axis=-1).astype(np.float32)


@pytest.mark.parametrize("kind", ["distort", "undistort"])
@pytest.mark.parametrize("name", ["barrel", "pincushion", "rational"])
def test_an_st_map_does_what_its_model_does(kind: str, name: str, tmp_path: Path) -> None:
    """Bilinear between samples: a map bent by f'' = 4e-3 px per px^2 (6 k1 r / f) misses by f''/8 an axis."""
    uv = st_map_of(MODELS[name], kind)
    write_exr(tmp_path / "st.exr", ExrPart({"R": uv[..., 0], "G": uv[..., 1], "B": np.zeros_like(uv[..., 0])}))
    distortion = LensDistortion.from_st_map(read_st_map(tmp_path / "st.exr", kind))
    expected = MODELS[name].undistorted_px(some_px(), CAMERA)
    undistorted = distortion.undistorted_px(some_px(), CAMERA)
    known = np.isfinite(undistorted).all(axis=-1)
    assert known.mean() > (0.999 if kind == "distort" or name == "pincushion" else 0.85)
    np.testing.assert_allclose(undistorted[known], expected[known], atol=6e-3)
    np.testing.assert_allclose(distortion.distorted_px(undistorted[known], CAMERA), some_px()[known], atol=1e-5)


def test_v_of_an_st_map_runs_upwards() -> None:
    """The identity, written by the convention: the lower left pixel's centre reads (0.5 / w, 0.5 / h)."""
    u, v = np.meshgrid((np.arange(320) + 0.5) / 320, 1.0 - (np.arange(214) + 0.5) / 214)
    assert (u[-1, 0], v[-1, 0]) == pytest.approx((0.5 / 320, 0.5 / 214))
    distortion = LensDistortion.from_st_map(StMap(np.stack([u, v], axis=-1)))
    np.testing.assert_allclose(distortion.undistorted_px(some_px(), CAMERA), some_px(), atol=1e-9)
    lower = LensDistortion.from_st_map(StMap(np.stack([u, v - 10.0 / 214], axis=-1)))
    np.testing.assert_allclose(lower.undistorted_px(some_px(), CAMERA), some_px() + np.array([0.0, 10.0]), atol=1e-9)


def test_what_is_no_distortion_is_refused(tmp_path: Path) -> None:
    uv = np.zeros((4, 1024), np.float16)
    write_exr(tmp_path / "half.exr", ExrPart({"R": uv, "G": uv, "B": uv}))
    refused("half floats", read_st_map, tmp_path / "half.exr")
    write_exr(tmp_path / "grey.exr", ExrPart({"Y": np.zeros((4, 4), np.float32)}))
    refused("u in red", read_st_map, tmp_path / "grey.exr")
    refused("distort or undistort", StMap, np.zeros((4, 4, 2)), "redistort")
    for make, of, said in (
        (LensDistortion, ("opencv", (0.1,)), "needs 8 finite values"),
        (LensDistortion, ("division",), "out of none, opencv"),
        (colmap_distortion, ("FOV", (1.0,)), "COLMAP's camera models"),
        (colmap_distortion, ("RADIAL", (1.0, 2.0, 3.0, 4.0)), "has 5 parameters, got 4"),
    ):
        refused(said, make, *of)
