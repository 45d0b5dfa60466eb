"""Made RAW stacks: the round trip through DNG and LibRaw, the sensor's noise, and the shipped stack against its truth."""

import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

from datasets_scripts.made_sets.simulated_camera import (
    CFA_PATTERNS,
    SensorModel,
    ShotMetadata,
    write_dng,
)
from datasets_scripts.make_raw_stack import StackPlan, _jobs, make_raw_stack, truth_document
from datasets_scripts.scenes.desk import desk_camera, desk_scene
from datasets_scripts.scenes.stack_scenes import BOARD, BOARD_DICTIONARY, BOARD_MARKER_M, BOARD_SQUARE_M, BOARD_SQUARES, board_texture
from datasets_scripts.tracers.thin_lens import trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import Scene, emissive_quad
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.camera import camera_from_json
from mrbokeh.optics.lens import Lens, film_plane_m, lens_distance_m
from tests.support.refusals import refused

SHIPPED = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "raw_stack"
LENS = Lens(35.0, 2.8, 0.7, 23.5)
NOISE_FREE = {"full_well_electrons": 0.0, "read_noise_electrons": 0.0}


def random_rgb(seed: int = 0, height: int = 48, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def raw_of(path: Path):
    rawpy = pytest.importorskip("rawpy", reason="rawpy comes with the extra 'capture'")
    return rawpy.imread(str(path))


def linear_rec709(path: Path, rec709_from_balanced: np.ndarray) -> np.ndarray:
    """(H, W, 3) as a RAW reader should get it: white balanced, unclipped, 1.0 = raw white of green, no automatic brightness."""
    import rawpy

    with raw_of(path) as raw:
        red, green, blue = raw.camera_whitebalance[:3]
        rgb = raw.postprocess(
            user_wb=[red, green, blue, green], output_color=rawpy.ColorSpace.raw, gamma=(1, 1), output_bps=16, no_auto_bright=True,
            adjust_maximum_thr=0.0, highlight_mode=rawpy.HighlightMode.Ignore, user_flip=0, demosaic_algorithm=rawpy.DemosaicAlgorithm.AAHD,
        )  # fmt: skip
        balanced = rgb.astype(np.float32) / 65535.0 * (max(red, green, blue) / green)
    return balanced @ rec709_from_balanced.T.astype(np.float32)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2)))


@pytest.fixture(scope="module")
def desk() -> Scene:
    """The scene of the shipped stack; its soft light takes seconds to bake."""
    return desk_scene(1)


@pytest.mark.parametrize("pattern", CFA_PATTERNS)
def test_libraw_reads_back_every_bit(tmp_path: Path, pattern: str) -> None:
    sensor = SensorModel(pattern=pattern)
    mosaic = sensor.photograph(random_rgb(), np.random.default_rng(1))
    write_dng(tmp_path / "a.dng", mosaic, sensor, ShotMetadata(LENS))
    with raw_of(tmp_path / "a.dng") as raw:
        np.testing.assert_array_equal(raw.raw_image_visible, mosaic)
        colours = np.frombuffer(raw.color_desc, np.uint8)[raw.raw_colors_visible]
        np.testing.assert_array_equal(colours, np.frombuffer(b"RGB", np.uint8)[sensor.cfa_colours(*mosaic.shape)])
    assert [path.name for path in tmp_path.iterdir()] == ["a.dng"]


@pytest.mark.parametrize(("bits", "half_step"), [(12, 1.3011e-4), (14, 3.2520e-5), (16, 8.1297e-6)])
def test_the_linear_mosaic_comes_back_within_half_a_quantisation_step(tmp_path: Path, bits: int, half_step: float) -> None:
    """half_step = 0.5 / (white - black) with black 1008/16384 of the range: 252, 1008, 4032 and white 4095, 16383, 65535."""
    sensor = SensorModel(bits=bits, black_level=1008 * 2**bits // 2**14, **NOISE_FREE)
    rgb = random_rgb()
    write_dng(tmp_path / "a.dng", sensor.photograph(rgb, np.random.default_rng(0)), sensor, ShotMetadata(LENS))
    with raw_of(tmp_path / "a.dng") as raw:
        black, white = raw.black_level_per_channel[0], raw.white_level
        read = (raw.raw_image_visible.astype(np.float64) - black) / (white - black)
    assert half_step == pytest.approx(0.5 / (white - black), rel=1e-3)
    assert np.abs(read - sensor.linear_mosaic(rgb)).max() <= half_step * (1.0 + 1e-3)


def test_metadata_comes_back(tmp_path: Path) -> None:
    pyexiv2 = pytest.importorskip("pyexiv2", reason="pyexiv2 comes with the extra 'capture'")
    sensor = SensorModel()
    shot = ShotMetadata(LENS, iso=200, taken_at=datetime(2025, 6, 1, 13, 14, 15))
    write_dng(tmp_path / "a.dng", sensor.photograph(random_rgb(), np.random.default_rng(0)), sensor, shot)
    with raw_of(tmp_path / "a.dng") as raw:
        assert (raw.black_level_per_channel, raw.white_level) == ([1008] * 4, 16383)
        np.testing.assert_allclose(raw.camera_whitebalance[:3], 1.0 / sensor.as_shot_neutral, rtol=3e-6)
        balanced_from_rec709 = np.diag(1.0 / sensor.as_shot_neutral) @ sensor.camera_from_rec709
        # color_matrix leads from balanced camera RGB to sRGB primaries; LibRaw's sRGB matrix has 6 digits.
        np.testing.assert_allclose(raw.color_matrix[:, :3], np.linalg.inv(balanced_from_rec709), atol=1e-5)
        assert (raw.other.focal_length, raw.other.iso_speed) == (35.0, 200.0)
        assert raw.other.aperture == pytest.approx(2.8, abs=1e-6)
        assert raw.other.shutter_speed == pytest.approx(1 / 60, rel=1e-6)
        assert raw.lens.model == shot.lens_model
    with pyexiv2.Image(str(tmp_path / "a.dng")) as image:
        exif = image.read_exif()
    assert exif["Exif.Photo.DateTimeOriginal"] == "2025:06:01 13:14:15"
    numerator, denominator = map(int, exif["Exif.Photo.SubjectDistance"].split("/"))
    # d_f + d_s = 0.7 + 0.0245 / 0.665 m.
    assert numerator / denominator == pytest.approx(0.7 + 0.035 * 0.7 / 0.665, abs=1e-5)
    numerator, denominator = map(int, exif["Exif.Photo.FocalPlaneXResolution"].split("/"))
    assert exif["Exif.Photo.FocalPlaneResolutionUnit"] == "3"
    assert 64 / (numerator / denominator) * 10.0 == pytest.approx(23.5, rel=1e-9)


@pytest.mark.parametrize("distance_m", [0.1, 0.62, 2.1, 30.0])
def test_film_plane_distance_is_the_focus_distance_plus_the_image_distance(distance_m: float) -> None:
    lens = LENS.focused_at(distance_m)
    from_film_plane_m = film_plane_m(lens)
    assert from_film_plane_m == pytest.approx(distance_m + 0.035 * distance_m / (distance_m - 0.035), rel=1e-12)
    assert lens_distance_m(from_film_plane_m, 35.0) == pytest.approx(distance_m, rel=1e-9)


def test_noise_has_the_stated_size() -> None:
    """Variance of a flat patch at share s of 60000 electrons: (s * 60000 + 3^2) / 60000^2 plus the rounding's 1/12 step^2."""
    sensor = SensorModel()
    patch = np.full((400, 400), 0.2, np.float32)
    step = 1.0 / (sensor.white_level - sensor.black_level)
    raw = (sensor.quantise(sensor.expose(patch, np.random.default_rng(0))) - float(sensor.black_level)) * step
    expected = (0.2 * 60000 + 9.0) / 60000**2 + step**2 / 12
    assert raw.var() == pytest.approx(expected, rel=0.015)
    assert raw.mean() == pytest.approx(0.2, abs=4 * np.sqrt(expected) / 400)


def test_light_beyond_the_full_well_is_clipped_at_white() -> None:
    sensor = SensorModel()
    raw = sensor.photograph(np.full((8, 8, 3), 50.0, np.float32), np.random.default_rng(0))
    # Read noise of 3 electrons is 0.8 steps: what is full reads white or a few steps less.
    assert raw.max() == sensor.white_level
    assert raw.min() >= sensor.white_level - 5


def test_a_flat_colour_comes_back_at_its_own_scale(tmp_path: Path) -> None:
    """The relation that truth.json states, nothing to demosaic: half a step of 14 bit (3.3e-5) times white balance and matrix (< 5)."""
    plan = StackPlan(sensor=SensorModel(**NOISE_FREE))
    colour = np.array([0.3, 0.2, 0.4], np.float32)
    mosaic = plan.sensor.photograph(np.tile(colour, (64, 64, 1)), np.random.default_rng(0))
    write_dng(tmp_path / "a.dng", mosaic, plan.sensor, ShotMetadata(LENS))
    rec709_from_balanced = np.array(truth_document(plan)["sensor"]["rec709_from_balanced_camera"])
    decoded = linear_rec709(tmp_path / "a.dng", rec709_from_balanced)
    np.testing.assert_allclose(decoded[8:-8, 8:-8], np.tile(colour, (48, 48, 1)), atol=1.6e-4)


@pytest.mark.slow
def test_a_traced_slice_survives_the_camera(tmp_path: Path, desk: Scene) -> None:
    """Decoded by LibRaw (AAHD) and taken to Rec.709, a slice without lamps equals what was traced but for demosaicing.

    AAHD reaches 43 dB on photographs; a picture of 192 px holds three times the detail per pixel, so 38 dB are asked for.
    """
    plan = StackPlan(width_px=192, height_px=128, sensor=SensorModel(**NOISE_FREE))
    lens = plan.lens_at(6)
    scene = replace(desk, lights=())
    traced = trace(scene, desk_camera(0, 192, 128, lens), lens, 64, footprint_px=plan.sensor.footprint_px)
    write_dng(tmp_path / "a.dng", plan.sensor.photograph(traced, np.random.default_rng(0)), plan.sensor, ShotMetadata(lens))
    decoded = linear_rec709(tmp_path / "a.dng", np.array(truth_document(plan)["sensor"]["rec709_from_balanced_camera"]))
    assert psnr_db(decoded[4:-4, 4:-4], traced[4:-4, 4:-4]) > 38.0


@pytest.mark.slow
def test_a_stack_is_resumed_and_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a plain wall instead of the still life, since what is in the picture does not matter here."""
    wall = emissive_quad((-1.0, -1.0, 1.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0), random_rgb())
    monkeypatch.setattr("datasets_scripts.scenes.stack_scenes.desk_scene", lambda _seed: Scene((wall,)))
    plan = StackPlan(viewpoints=1, slices=2, width_px=48, height_px=32, samples=8)
    assert make_raw_stack(tmp_path, plan) == 3
    path = tmp_path / "view_0" / "slice_01.dng"
    first, kept = path.read_bytes(), (tmp_path / "view_0" / "slice_00.dng").stat().st_mtime_ns
    path.unlink()
    assert make_raw_stack(tmp_path, plan) == 1
    assert path.read_bytes() == first, "the seed must decide every bit"
    assert (tmp_path / "view_0" / "slice_00.dng").stat().st_mtime_ns == kept
    other = StackPlan(viewpoints=1, slices=2, width_px=48, height_px=32, samples=8, seed=2)
    refused("--overwrite", make_raw_stack, tmp_path, other)
    assert path.read_bytes() == first
    assert make_raw_stack(tmp_path, other, overwrite=True) == 3
    assert path.read_bytes() != first


def test_jittered_slices_map_onto_the_reference_as_stated() -> None:
    """Points projected by the camera of a slice and then mapped land where the reference's camera sees them."""
    plan = StackPlan(2, 4, 96, 64, 1, 8, scene="lab", jitter_px=1.2, jitter_deg=0.03)
    points_m = np.random.default_rng(0).uniform([-0.3, -0.1, 0.7], [0.3, 0.2, 2.0], (30, 3))
    for index in range(plan.slices):
        matrix = plan.reference_from_slice(1, index)
        in_slice, _ = plan.camera_at(1, index).project(points_m)
        in_reference, _ = plan.reference_camera(1).project(points_m)
        np.testing.assert_allclose(in_slice @ matrix[:, :2].T + matrix[:, 2], in_reference, atol=1e-9)
    np.testing.assert_array_equal(plan.jitter_of(1, 0)[0], 0.0)
    shift_px, roll_rad = plan.jitter_of(1, 2)
    assert 0.0 < np.hypot(*shift_px) <= 1.2 and 0.0 < abs(roll_rad) <= np.deg2rad(0.03)


def test_views_beyond_the_stacks_have_truth_only() -> None:
    plan = StackPlan(3, 2, 48, 32, samples=8, stacks=1, scene="lab", jitter_px=1.0)
    paths = [str(path) for job in _jobs(Path("x"), plan, Scene) for path in job.paths]
    assert sum(path.endswith(".dng") for path in paths) == 2
    assert sum("truth" in path for path in paths) == 6
    views = truth_document(plan)["views"]
    assert [("reference_from_slice" in each) for each in views] == [True, False, False]


def test_an_unknown_scene_is_refused() -> None:
    refused("desk, lab", truth_document, StackPlan(scene="kitchen"))


def test_the_lab_board_is_as_large_as_stated() -> None:
    """8 x 6 squares of 30 mm: the quad's edges are 240 and 180 mm long, and OpenCV finds its corners in the print."""
    width_m, height_m = (np.linalg.norm(edge) for edge in (BOARD.right_m, BOARD.down_m))
    assert (width_m, height_m) == pytest.approx((0.24, 0.18), rel=1e-12)
    assert np.dot(BOARD.right_m, BOARD.down_m) == pytest.approx(0.0, abs=1e-12)
    printed = (board_texture()[..., 0] * 255).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD_DICTIONARY))
    board = cv2.aruco.CharucoBoard(BOARD_SQUARES, BOARD_SQUARE_M, BOARD_MARKER_M, dictionary)
    bordered = cv2.copyMakeBorder(printed, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=200)
    corners, _ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(bordered)
    assert len(corners) == 7 * 5


def test_slices_are_equally_spaced_in_dioptres() -> None:
    document = truth_document(StackPlan())
    dioptres = 1.0 / np.array(document["focus_distances_m"])
    np.testing.assert_allclose(np.diff(dioptres), (1 / 2.05 - 1 / 0.65) / 8, rtol=1e-9)
    # Half a step of blur at the nearest focus: 0.06567 D times 17.5 mm x 36.992 mm x 544 px / 23.5 mm = 14.986 px/D.
    assert document["largest_residual_coc_px"] == pytest.approx(0.06567 * 14.986, rel=1e-3)


def shipped_truth() -> dict:
    return json.loads((SHIPPED / "truth.json").read_text(encoding="utf-8"))


def assert_same_document(made, stored) -> None:
    """Equal, but for the last bits of numbers, in which processors differ."""
    if isinstance(stored, dict):
        assert made.keys() == stored.keys()
        for key in stored:
            assert_same_document(made[key], stored[key])
    elif isinstance(stored, list):
        assert len(made) == len(stored)
        for a, b in zip(made, stored, strict=True):
            assert_same_document(a, b)
    else:
        assert made == (pytest.approx(stored, rel=1e-12, abs=1e-15) if isinstance(stored, float) else stored)


def test_the_shipped_stack_is_the_one_this_program_makes() -> None:
    """Its truth.json says with which settings; the same settings must lead to the same document."""
    document = shipped_truth()
    plan = StackPlan(**document["plan"])
    assert plan.seed == 1, "the fixture `desk` is the scene of seed 1"
    assert_same_document(json.loads(json.dumps(truth_document(plan))), document)
    assert len(list(SHIPPED.glob("view_*/slice_*.dng"))) == plan.viewpoints * plan.slices
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) < 14e6


@pytest.mark.parametrize("view", [0, 1, 2])
@pytest.mark.slow
def test_the_shipped_truth_is_what_the_tracer_sees(view: int, desk: Scene) -> None:
    """Traced again with few rays: depth to the half float's 2^-11 except where the centre of a pixel grazes an edge."""
    document = shipped_truth()
    camera = camera_from_json(document["views"][view]["reference_camera"])
    rgb, depth_m = trace_pinhole(desk, camera, 32, footprint_px=document["sensor"]["footprint_px"])
    folder = SHIPPED / "truth" / f"view_{view}"
    stored_m = read_exr(folder / "depth.exr")[0].stacked(["Z"])[..., 0]
    assert np.mean(np.abs(stored_m / depth_m - 1.0) < 2.0**-11 + 1e-6) > 0.999
    assert psnr_db(read_image(folder / "all_in_focus.exr"), rgb) > 38.0


@pytest.mark.parametrize(("view", "index"), [(0, 1), (1, 3), (2, 5)])
@pytest.mark.slow
def test_the_shipped_slices_are_sharp_where_truth_json_says(view: int, index: int, desk: Scene) -> None:
    """Where a slice's blur is below 1 px it equals a pinhole's picture with that slice's focal length, noise and demosaicing included."""
    document = shipped_truth()
    plan = StackPlan(**document["plan"])
    lens = plan.lens_at(index)
    camera = replace(camera_from_json(document["views"][view]["reference_camera"]), focal_px=(document["focal_px"][index],) * 2)
    rgb, depth_m = trace_pinhole(desk, camera, 64, footprint_px=plan.sensor.footprint_px)
    path = SHIPPED / f"view_{view}" / f"slice_{index:02d}.dng"
    decoded = linear_rec709(path, np.array(document["sensor"]["rec709_from_balanced_camera"]))
    lamps = ndimage.maximum_filter(rgb.max(axis=2), 17) > 1.0
    coc_px = np.abs(lens.coc_px(depth_m, plan.width_px))
    sharp, blurred = (coc_px < 1.0) & ~lamps, (coc_px > 4.0) & ~lamps
    assert sharp.mean() > 0.04
    assert psnr_db(decoded[sharp], rgb[sharp]) > 38.0
    # The other way round: what should be blurred is, with at least twice the squared error.
    assert psnr_db(decoded[blurred], rgb[blurred]) < psnr_db(decoded[sharp], rgb[sharp]) - 3.0
