"""Traced focal stacks: discs of lights against the lens file, the stop that changes over the frame, the data set and its noise."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets_scripts.bokeh_stacks import StackView, main, make_bokeh_stacks, make_pull
from datasets_scripts.made_sets.bokeh_plan import SHAPES, SIZES, StackSize, StacksPlan, bokeh_shape
from datasets_scripts.scenes.bokeh_scenes import KINDS, bokeh_scene
from datasets_scripts.tracers.pupil import FieldStop, OpenShares
from datasets_scripts.tracers.traced_scene import plain_texture
from datasets_scripts.tracers.truth import Opening
from datasets_scripts.tracers.truth_layer import make_tracer
from datasets_scripts.tracers.truth_scene import Lamp, PackedScene, TruthScene, pack, quad
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import net_area
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.focal_stack_dataset import file_troubles, read_focal_stack_dataset
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.scalar_truth_tracer import ScalarTracer, require_mitsuba
from training.data.dataset import PairSet, read_pair
from training.data.training_data import training_data

NEAR_FOCUS_M, FAR_FOCUS_M = 0.9, 6.5
# Left, middle, right and a corner of the frame, as places of pixels.
PLACES = {"left": (24, 56), "middle": (96, 56), "right": (168, 60), "corner": (160, 20)}
TINY = StackSize(scenes=("garlands_1", "checkers_1"), views=2, focuses=2, width_px=32, height_px=20, f_number=1.1, samples=4, lamp_rays=512)


def polygon_share(aperture: Aperture) -> float:
    """Area of a plain aperture over that of the unit disc."""
    return net_area((aperture.outlines, aperture.weights)) / np.pi


@pytest.fixture(autouse=True)
def _mitsuba() -> None:
    require_mitsuba()


def one_light(camera: Camera, at_px: tuple[float, float], depth_m: float) -> PackedScene:
    """A point of light before a black wall, with its image at that place."""
    x_m, y_m = (np.asarray(at_px) - camera.principal_px) * depth_m / camera.focal_px
    wall = quad((-900.0, -900.0, 900.0), (1800.0, 0.0, 0.0), (0.0, 1800.0, 0.0), plain_texture((0.0, 0.0, 0.0)))
    return pack(TruthScene("open", (wall,), (Lamp((float(x_m), float(y_m), depth_m), 1e-5, (1e6, 1e6, 1e6)),)), camera)


def disc_and_psf(shape: str, place: str, depth_m: float, focus_m: float) -> tuple[np.ndarray, np.ndarray, float]:
    """(what is traced, what the aperture rasterizes at the diameter of Lens.coc_px, that diameter), both with the sum 1."""
    plan = StacksPlan(shape)
    camera, (column, row) = plan.camera("none", 0), PLACES[place]
    at_px = (column + 0.5, row + 0.5)
    picture = make_tracer(one_light(camera, at_px, depth_m), camera).lamp_light(plan.traced_opening(focus_m), 1 << 17)[..., 1].astype(float)
    diameter_px = float(plan.lens(focus_m).coc_px(depth_m, camera.width_px))
    half_diagonal = 0.5 * np.hypot(camera.width_px, camera.height_px)
    field_xy = (float((at_px[0] - 0.5 * camera.width_px) / half_diagonal), float((at_px[1] - 0.5 * camera.height_px) / half_diagonal))
    kernel = plan.opening.seen(1 if diameter_px > 0 else -1, field_xy).rasterize(diameter_px).kernel
    expected, reach = np.zeros_like(picture), kernel.shape[0] // 2
    expected[row - reach : row + reach + 1, column - reach : column + reach + 1] = kernel
    return picture / picture.sum(), expected, diameter_px


def moments(plane: np.ndarray) -> np.ndarray:
    """(mean x, mean y, variance of x, of y) in pixels."""
    y, x = np.mgrid[: plane.shape[0], : plane.shape[1]] + 0.5
    mean = np.array([(plane * x).sum(), (plane * y).sum()])
    return np.array([*mean, (plane * (x - mean[0]) ** 2).sum(), (plane * (y - mean[1]) ** 2).sum()])


def require_likeness(shape: str, place: str, depth_m: float, focus_m: float) -> None:
    picture, expected, _ = disc_and_psf(shape, place, depth_m, focus_m)
    # 2^17 rays in about 100 pixels: 0.1 % of noise; polygons of 64 sides stray from circles by 0.1 % of the radius.
    assert np.corrcoef(picture.ravel(), expected.ravel())[0, 1] > 0.999
    assert np.abs(picture - expected).sum() < 0.02
    assert moments(picture) == pytest.approx(moments(expected), abs=0.05)


# --- Discs of lights ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["left", "right"])
def test_the_ring_changes_over_the_frame_as_its_stop_says(place: str) -> None:
    require_likeness("ring", place, 4.0, NEAR_FOCUS_M)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("depth_m", "focus_m"), [(4.0, NEAR_FOCUS_M), (0.95, FAR_FOCUS_M)])
def test_discs_are_what_the_lens_file_says(shape: str, place: str, depth_m: float, focus_m: float) -> None:
    """Discs lie behind the focus and in front of it, where openings are mirrored."""
    require_likeness(shape, place, depth_m, focus_m)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["heart", "ring"])
def test_discs_in_front_are_mirrored(shape: str) -> None:
    """The test above can fail: the opening unmirrored is far from what is traced, on the right of the frame too."""
    picture, expected, _ = disc_and_psf(shape, "right", 0.95, FAR_FOCUS_M)
    column, row = PLACES["right"]
    window = (slice(row - 8, row + 9), slice(column - 8, column + 9))
    assert np.abs(picture[window] - expected[window][::-1, ::-1]).sum() > 0.2


def test_the_ring_is_thick_left_thin_in_the_middle_and_open_right() -> None:
    """Shares of the disc from pi r^2 by hand: 1 - 0.5^2 at the left edge, 1 - 0.8^2 in the middle; right, the ring is one open piece."""
    stop, disc = FieldStop(), Aperture.disc()
    left, middle, right = (stop.seen(disc, (x, 0.0)) for x in (-0.87, 0.0, 0.87))
    assert polygon_share(left) == pytest.approx(0.75, abs=1e-3)
    assert polygon_share(middle) == pytest.approx(0.36, abs=1e-3)
    assert [sum(weight < 0 for weight in each.weights) for each in (left, middle, right)] == [1, 1, 0]
    refused("radii between 0 and 1", FieldStop, radius=1.2)
    refused("round openings", Opening, Aperture.heart(), 0.05, 1.0, FieldStop())


def test_open_shares_are_areas() -> None:
    """Spans on lines against polygons cut by Shapely, and the table against both; a weight is 1 over the share."""
    stop, round_opening = FieldStop(), replace(Aperture.disc(), cat_eye=0.35)
    shares = OpenShares(stop, 0.35)
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2)) * [0.87, 0.5]
    polygons = [polygon_share(stop.seen(round_opening, (float(x), float(y)))) for x, y in places]
    assert [shares.exactly(float(x), float(y)) for x, y in places] == pytest.approx(polygons, abs=2e-3)
    assert shares.at(*places.T) == pytest.approx(polygons, abs=3e-3)


def test_both_ways_of_tracing_agree_about_the_stop() -> None:
    """The same scrambled numbers: they differ by float32 alone, which lets single rays of 32 pass on another side of an edge."""
    plan = StacksPlan("ring", replace(TINY, width_px=24, height_px=16))
    camera = plan.camera("checkers_1", 1)
    packed = pack(bokeh_scene("checkers_1"), camera)
    packed = replace(packed, lamps=packed.lamps[:6], lamp_centres_m=packed.lamp_centres_m[:6])
    opening = plan.traced_opening(NEAR_FOCUS_M)
    fast, slow = make_tracer(packed, camera), ScalarTracer(packed, camera)
    one, other = fast.traced(opening, 8), slow.traced(opening, 8)
    assert np.median(np.abs(one.rgb - other.rgb)) < 1e-5
    assert one.open_share.mean() == pytest.approx(other.open_share.mean(), abs=0.003)
    assert fast.lamp_light(opening, 2048).sum() == pytest.approx(slow.lamp_light(opening, 2048).sum(), rel=0.01)


# --- Plan and scenes ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_a_fifth_is_for_testing_by_scene_and_by_viewpoint(size: str) -> None:
    """Full, as in the paper: 15 x 15 stacks, 45 to test on: two whole scenes are 30, the other 15 are last views of the other 13."""
    plan = StacksPlan("round", SIZES[size])
    parts = plan.parts()
    tested = Counter(name.split("/")[0] for name, part in parts.items() if part == "test")
    assert sum(tested.values()) == round(0.2 * len(parts))
    whole = [scene for scene, count in tested.items() if count == plan.size.views]
    assert len(whole) == (1 if size == "small" else 2)
    assert all(parts[f"{scene}/view_00"] == "train" for scene in plan.size.scenes if scene not in whole)
    if size != "small":
        assert (len(parts), len(plan.focus_distances_m)) == (225, 10)
        assert sorted(count for scene, count in tested.items() if scene not in whole) == [1] * 11 + [2] * 2


def test_slices_to_train_on_have_fewer_rays_with_the_same_mean(tmp_path: Path) -> None:
    """A quarter of the rays: about twice the noise of Monte Carlo, or more as the points are even, and no light lost."""
    size = replace(TINY, width_px=48, height_px=28, samples=256, lamp_rays=1 << 14)
    all_rays, fewer = StacksPlan("round", size), StacksPlan("round", replace(size, fewer_in_training=4))
    assert fewer.rays("checkers_1/view_00") == all_rays.rays("checkers_1/view_00") == (256, 1 << 14)  # the scene that is tested on
    assert fewer.rays("garlands_1/view_00") == (64, 1 << 12)
    opening = fewer.traced_opening(1.5)
    pictures = [StackView(tmp_path, plan, "garlands_1", 0).defocused(opening) for plan in (all_rays, fewer)]
    assert 5.0 < pictures[0][1] - pictures[1][1] < 14.0
    assert np.mean(pictures[1][0]) == pytest.approx(np.mean(pictures[0][0]), rel=0.01)


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.slow) if kind != "leaves" else kind for kind in KINDS])
def test_scenes_have_lights_at_many_depths_are_always_the_same_and_differ_by_number(kind: str) -> None:
    scene = bokeh_scene(f"{kind}_1")
    depths_m = np.array([lamp.centre_m[2] for lamp in scene.lamps])
    assert len(depths_m) > 30 and 1 / depths_m.min() - 1 / depths_m.max() > 0.6
    assert len(scene.bodies) > 5
    assert scene.lamps == bokeh_scene(f"{kind}_1").lamps != bokeh_scene(f"{kind}_2").lamps


def test_unknown_names_are_refused() -> None:
    for name in ("castle_1", "fence", "fence_x"):
        refused("scene such as", bokeh_scene, name)
    refused("shape out of", bokeh_shape, "square")
    refused("a set needs", replace, TINY, views=0)


# --- The data set ---------------------------------------------------------------------------------------------------------------------


def test_a_set_is_written_resumed_and_trained_on(tmp_path: Path) -> None:
    plan = StacksPlan("ring", TINY)
    out = tmp_path / "set"
    assert make_bokeh_stacks(out, plan, ("garlands_1",)) is None
    made = {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")}
    lost = out / "garlands_1" / "view_01" / "slice_01.exr"
    lost.unlink()
    dataset = make_bokeh_stacks(out, plan, workers=2)
    assert dataset is not None and lost.is_file()
    assert all(path.stat().st_mtime_ns == before for path, before in made.items() if path != lost)
    read = read_focal_stack_dataset(out)
    assert [(each.name, each.part) for each in read.stacks] == list(plan.parts().items())
    assert read.largest_coc_px == dataset.largest_coc_px > 1.0
    assert not [trouble for record in read.stacks for trouble in file_troubles(read, record)]
    assert len(read.metadata["noise_floor_db"]["by_stack"]["garlands_1/view_00"]) == 2
    assert "CC0" in read.licence and (out / "LICENCE.txt").is_file()
    assert read_lens(out / "lens.json").aperture.cat_eye == 0.35
    refused("other settings", make_bokeh_stacks, out, replace(plan, seed=2))
    require_trainable(out)


def require_trainable(out: Path) -> None:
    """`mrbokeh train fit` takes it; the circle of confusion of a pair is that of the lens at the depth of each pixel."""
    data = training_data([out])
    split = data.split([], 0.2, 0)
    train, test = split.train, split.test
    assert len(train) == 2 and len(test) == 2
    facts = data.facts(PairSet(train))
    assert (facts.width_px, facts.height_px) == (TINY.width_px, TINY.height_px)
    pair, stack = read_pair(train[0], 1), train[0]
    assert pair.coc_px == pytest.approx(stack.lens_of(1).coc_px(stack.depth_m(), TINY.width_px), rel=1e-5)
    assert pair.weight.all() and np.isfinite(pair.target).all()


def test_a_pull_is_one_test_view_in_even_steps(tmp_path: Path) -> None:
    plan = StacksPlan("round", replace(TINY, focuses=4))
    folder = make_pull(tmp_path / "pull", plan, 3)
    stack = read_focal_stack(folder)
    assert plan.parts()[f"{folder.parent.name}/{folder.name}"] == "test"
    assert np.ptp(np.diff(1.0 / np.array(stack.focus_distances_m))) < 1e-9
    assert [stack.focus_distances_m[0], stack.focus_distances_m[-1]] == pytest.approx(plan.focus_distances_m[1:3])
    refused("at least 2 frames", make_pull, tmp_path / "pull", plan, 1)


@pytest.mark.slow
def test_the_noise_floor_is_the_distance_from_a_picture_without_noise(tmp_path: Path) -> None:
    """64 samples against 4096, whose own noise is some 15 dB lower."""
    size = replace(TINY, width_px=96, height_px=56, samples=64, lamp_rays=1 << 14)
    noisy = StackView(tmp_path, StacksPlan("round", size), "checkers_1", 0)
    clean = StackView(tmp_path, StacksPlan("round", replace(size, samples=4096, lamp_rays=1 << 19), seed=9), "checkers_1", 0)
    opening = StacksPlan("round", size).traced_opening(NEAR_FOCUS_M)
    picture, floor_db = noisy.defocused(opening)
    assert psnr(picture, clean.defocused(opening)[0]) == pytest.approx(floor_db, abs=1.0)


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    cases = {
        "a size out of": [str(tmp_path / "a"), "--shape", "round", "--size", "huge"],
        "a shape out of": [str(tmp_path / "a"), "--shape", "square"],
        "scenes out of": [str(tmp_path / "a"), "--shape", "round", "--scenes", "castle_1"],
        "something else": [str(tmp_path / "other"), "--shape", "round"],
    }
    for sentence, arguments in cases.items():
        assert sentence in printed_by(main, *arguments, exit_code=2)
