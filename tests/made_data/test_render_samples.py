"""The stochastic sampler: blur and motion of its samples, its mean, its sharp layers, its files.

Positions are checked against a pinhole projection written out here, light against areas and against the tracer of still scenes.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from datasets_scripts import render_samples as command
from datasets_scripts.render_samples import SamplesPlan, SamplesSet, in_a_row, render_samples
from datasets_scripts.scenes.moving_scenes import LENS, SCENES, Stage, checkerboard, make_scene
from datasets_scripts.tracers import thin_lens
from datasets_scripts.tracers.samples import SampleArrays, SampleTracer, gathered_lamps, lens_table, light_through, pack
from datasets_scripts.tracers.sobol import mirrored_sobol, owen_scrambled, reversed_bits, scramble_seed
from datasets_scripts.tracers.traced_scene import Mover, MovingScene, Quad, plain_texture
from mrbokeh.images.image_io import read_image, read_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import over
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.stacks.light_field_samples_file import read_samples
from mrbokeh.system.errors import InputError

W, H = 48, 32
STAGE = Stage(LENS, H / W)
DATA = Path(__file__).parents[1] / "data" / "samples"
GREY = plain_texture((0.5, 0.5, 0.5))
WHITE = plain_texture((1.0, 1.0, 1.0))


def tracer(*movers: Mover, seed: int = 0, threads: int = 0, lens=LENS, **light: object) -> SampleTracer:
    return SampleTracer(scene=MovingScene(movers, **light), lens=lens, width_px=W, height_px=H, seed=seed, threads=threads)  # type: ignore[arg-type]


def projected_px(points_m: np.ndarray) -> np.ndarray:
    """A pinhole in the middle of the lens."""
    return points_m[..., :2] / points_m[..., 2:] * LENS.focal_px(W) + (0.5 * W, 0.5 * H)


def at_half_time_px(s: SampleArrays) -> np.ndarray:
    """xy - coc/2 uv - motion (t - 1/2), from the stored numbers alone."""
    coc_px = LENS.coc_px(s.depth_m.astype(np.float64), W)
    return s.xy_px - 0.5 * coc_px[..., None] * s.lens_uv - s.motion_px * (s.time[..., None] - 0.5)


def placing_card(coc: float, motion: tuple[float, float], inwards_m: float = 0.0, tilt_rad: float = 0.0) -> Mover:
    """A card larger than the frame whose colour tells where on it a ray has arrived: red along, green down, 0 to 1."""
    texels = np.stack(np.meshgrid(*2 * [(np.arange(256) + 0.5) / 256.0]), axis=-1)
    texture = np.dstack([texels, np.zeros((256, 256))]).astype(np.float32)
    return Mover(STAGE.card((0.05, -0.03, coc), (2.5, 2.5), texture, 0.3, tilt_rad), STAGE.velocity_m(motion, coc, inwards_m))


def seen_at_half_time_px(card: Mover, rgb: np.ndarray) -> np.ndarray:
    """Projection of the place that the colour tells, with the card where it is in the middle of the exposure."""
    assert isinstance(card.body, Quad)
    corner, along, down = (np.asarray(each) for each in (card.body.corner_m, card.body.edge_u_m, card.body.edge_v_m))
    return projected_px(corner + rgb[..., :1] * along + rgb[..., 1:2] * down)


@pytest.mark.parametrize("coc", [-0.08, 0.0, 0.07])
def test_a_plane_that_moves_along_the_picture_is_reprojected_exactly(coc: float) -> None:
    """xy - coc/2 uv - motion (t - 1/2) is the pinhole projection, at t = 1/2, of the very place that was hit."""
    card = placing_card(coc, (0.06, -0.04))
    s = tracer(card, sun=0.0, ambient=1.0).samples(8)
    # Float32 texels and colours: 2e-7 of a card of 120 px.
    np.testing.assert_allclose(at_half_time_px(s), seen_at_half_time_px(card, s.rgb.astype(np.float64)), atol=2e-4)
    np.testing.assert_allclose(s.motion_px, np.broadcast_to((0.06 * W, -0.04 * W), s.motion_px.shape), rtol=1e-5)
    assert np.abs(s.motion_px * (s.time[..., None] - 0.5)).max() > 1.0


def test_so_is_one_that_slants_and_moves_in_depth() -> None:
    """The stored motion is the mean velocity between the sample's time and the middle, so that first order is no limit."""
    card = placing_card(0.03, (0.05, 0.03), inwards_m=-0.25, tilt_rad=0.6)
    s = tracer(card, sun=0.0, ambient=1.0).samples(8)
    np.testing.assert_allclose(at_half_time_px(s), seen_at_half_time_px(card, s.rgb.astype(np.float64)), atol=2e-4)
    assert np.ptp(s.depth_m) > 0.1


def test_motion_is_the_derivative_of_the_projection() -> None:
    """Samples near t = 1/2 against a central difference of the projection of the points hit."""
    card = placing_card(0.03, (0.05, 0.03), inwards_m=-0.25, tilt_rad=0.6)
    s = tracer(card, sun=0.0, ambient=1.0).samples(64)
    near = np.abs(s.time - 0.5) < 0.01
    assert isinstance(card.body, Quad)
    rgb = s.rgb[near].astype(np.float64)
    point_m = np.asarray(card.body.corner_m) + rgb[:, :1] * card.body.edge_u_m + rgb[:, 1:2] * card.body.edge_v_m
    step_m = 1e-4 * np.asarray(card.velocity_m)
    derivative_px = (projected_px(point_m + step_m) - projected_px(point_m - step_m)) / 2e-4
    # Within 0.01 of the middle the mean differs from the derivative by 0.01 V_z / Z = 0.1 % at most.
    np.testing.assert_allclose(s.motion_px[near], derivative_px, rtol=2e-3, atol=1e-3)
    assert near.sum() > 500


def test_depth_is_along_the_axis_at_the_time_of_the_sample() -> None:
    card = Mover(STAGE.card((0.0, 0.0, 0.02), (2.5, 2.5), GREY), (0.0, 0.0, 0.4))
    s = tracer(card).samples(4)
    np.testing.assert_allclose(s.depth_m, STAGE.depth_m(0.02) + 0.4 * (s.time - 0.5), rtol=1e-6)


@pytest.mark.parametrize("coc", [-0.1, 0.08])
def test_a_point_spreads_over_the_circle_of_confusion(coc: float) -> None:
    """A tiny lamp: every ray that meets it has xy = x0 + coc/2 uv, on either side of the focus, and they fill a disc of |coc| px."""
    lamp = STAGE.lamp((0.1, 0.1, coc), 0.02, (1.0, 1.0, 1.0))
    s = tracer(Mover(lamp)).samples(1024)
    hit = np.isfinite(s.depth_m)
    coc_px = float(LENS.coc_px(lamp.centre_m[2], W))
    assert coc_px == pytest.approx(coc * W, rel=1e-9)
    x0_px = projected_px(np.array(lamp.centre_m))
    radius_px = 0.02 * 0.5 * W
    off_px = np.linalg.norm(s.xy_px[hit] - x0_px - 0.5 * coc_px * s.lens_uv[hit], axis=1)
    assert hit.sum() > 300 and off_px.max() < radius_px * 1.001
    away_px = np.linalg.norm(s.xy_px[hit] - x0_px, axis=1)
    # Uniform over a disc of radius R: the mean squared distance is R^2 / 2, with a standard error of R^2 / sqrt(12 n).
    mean, expected = np.mean(away_px**2), (0.25 * coc_px**2 + radius_px**2) / 2.0
    assert mean == pytest.approx(expected, abs=4.0 * expected / np.sqrt(3.0 * hit.sum()))


def test_motion_displaces_what_is_in_focus() -> None:
    """A small ball in focus: rays find it where it is at their time."""
    ball = STAGE.ball((0.0, 0.0, 0.0), 0.02, GREY)
    s = tracer(Mover(ball, STAGE.velocity_m((0.4, 0.2), 0.0))).samples(512)
    hit = np.isfinite(s.depth_m)
    at_px = np.array([0.5 * W, 0.5 * H]) + np.array([0.4, 0.2]) * W * (s.time[hit][:, None] - 0.5)
    assert hit.sum() > 300
    assert np.linalg.norm(s.xy_px[hit] - at_px, axis=1).max() < 0.02 * 0.5 * W * 1.05
    assert np.ptp(s.xy_px[hit][:, 0]) > 0.35 * W


@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.15, 0.08)])
@pytest.mark.parametrize("coc", [-0.2, -0.02, 0.0, 0.14])
def test_a_lamp_keeps_its_energy_however_blurred_and_moved(coc: float, motion: tuple[float, float]) -> None:
    """Sum over the picture = radiance x pi (r f_px / z)^2, whether its light is gathered or followed."""
    lamp = Mover(STAGE.lamp((0.0, 0.0, coc), 0.02, (10.0, 10.0, 10.0)), STAGE.velocity_m(motion, coc))
    expected = 10.0 * np.pi * (0.02 * 0.5 * W) ** 2
    # Pixels at the rim of a gathered disc know their share from 256 points: a few 1e-4 of the whole.
    assert tracer(lamp).mean(1024)[..., 0].sum() == pytest.approx(expected, rel=0.005)


@pytest.mark.slow
def test_lamps_found_by_rays_gathered_and_followed_give_one_picture() -> None:
    """Three ways to one integral, half hidden by a card in front: rays through the lens (the samples themselves) are the plain one."""
    movers = [Mover(STAGE.card((-0.4, 0.0, -0.05), (0.4, 0.9), GREY))]
    for x, y, coc, motion in ((0.0, -0.25, 0.14, 0.0), (0.1, 0.3, 0.004, 0.15), (0.55, 0.1, -0.14, 0.05)):
        movers.append(Mover(STAGE.lamp((x, y, coc), 0.04, (4.0, 4.0, 4.0)), STAGE.velocity_m((motion, 0.0), coc)))
    both = tracer(*movers)
    packed, view = both._packed(), both._view
    assert gathered_lamps(packed, view, light_through(LENS.aperture)).tolist() == [False, True, False, True]
    by_rays, by_lamps = both.samples(4096).rgb.mean(axis=2)[..., 0], both.mean(4096)[..., 0]
    # A pixel that sees a lamp of radiance 4 with a share q is off by 4 sqrt(q (1 - q) / 4096) <= 0.031 as a standard deviation.
    assert np.abs(by_rays - by_lamps).max() < 0.12
    assert by_rays.sum() == pytest.approx(by_lamps.sum(), rel=0.003)


@pytest.mark.slow
def test_still_scenes_look_as_the_tracer_of_still_scenes_renders_them() -> None:
    """Another implementation of the same lens, with other samples: the picture agrees, the one through the turned triangle does not."""
    movers = (
        Mover(STAGE.card((-0.3, 0.0, -0.12), (0.3, 0.4), checkerboard(4, (0.1, 0.2, 0.3), (0.9, 0.7, 0.5)), 0.4, 0.3)),
        Mover(STAGE.ball((0.4, 0.1, 0.0), 0.35, checkerboard(8, (0.7, 0.1, 0.1), (0.2, 0.6, 0.9)), (2.0, 1.0))),
        STAGE.backdrop(0.12, checkerboard(6, (0.1, 0.1, 0.1), (0.9, 0.9, 0.9))),
    )
    lens, turned = (replace(LENS, aperture=Aperture.blades(3, rotation_rad=0.2 + turn)) for turn in (0.0, np.pi))
    camera = thin_lens.camera_for_lens(Camera(W, H, (1.0, 1.0), (0.5 * W, 0.5 * H)), lens)
    still = thin_lens.trace(MovingScene(movers).at(0.5), camera, lens, 1024)
    # Random rays would leave about 0.4 / sqrt(1024) in two such pictures: 35 dB.
    assert psnr(tracer(*movers, lens=lens).mean(1024), still) > 45.0
    assert psnr(tracer(*movers, lens=turned).mean(1024), still) < 35.0


def test_the_mean_of_samples_converges_to_the_reference() -> None:
    """The error falls at least as 1 / sqrt(spp): a factor 8 from 4 to 256 samples, and each step of 4 by more than 1.8."""
    plan = SamplesPlan("fence", 3, W, H)
    both = plan.tracer(make_scene("fence", 3, LENS, H / W))
    reference = both.mean(8192)
    errors = [np.sqrt(np.mean((both.samples(spp).rgb.mean(axis=2) - reference) ** 2)) for spp in (4, 16, 64, 256)]
    assert errors[0] / errors[-1] > 8.0
    assert all(before > 1.8 * after for before, after in pairwise(errors))


def test_samples_of_a_pixel_are_stratified() -> None:
    """Every cell of 4 x 4 holds one of 16 points of a (0, 2)-sequence pair; every 16th of the exposure holds one in time."""
    s = tracer(STAGE.backdrop(0.05, GREY)).samples(16)
    cells = np.floor((s.xy_px % 1.0) * 4).astype(int)
    assert (np.sort(cells[..., 0] * 4 + cells[..., 1], axis=-1) == np.arange(16)).all()
    assert (np.sort(np.floor(s.time * 16).astype(int), axis=-1) == np.arange(16)).all()
    np.testing.assert_array_equal(np.floor(s.xy_px[..., 0]), np.broadcast_to(np.arange(W)[None, :, None], (H, W, 16)))


def test_random_numbers_are_those_of_their_plain_twin() -> None:
    """The moments of the samples, recomputed with the scrambles of truth_sampling."""
    s = tracer(STAGE.backdrop(0.05, GREY), seed=3).samples(8)
    with np.errstate(over="ignore"):
        pixels = np.arange(W * H, dtype=np.uint32)
        seeds = scramble_seed(pixels, np.uint32(3 * 64 + 4))[:, None]
        bits = owen_scrambled(reversed_bits(mirrored_sobol(8)[:, 4])[None], seeds, reversed_bits)
    np.testing.assert_array_equal(s.time.reshape(-1, 8), (bits / 2.0**32).astype(np.float32))


@pytest.mark.parametrize("name", list(SCENES))
def test_bodies_left_out_of_a_tile_are_not_to_be_seen_there(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fast path skips bodies whose bounds do not touch a tile; its slow twin tries every body everywhere."""
    from datasets_scripts.tracers import samples

    both = SampleTracer(make_scene(name, 5, LENS, H / W), LENS, W, H)
    fast, fast_mean = both.samples(4), both.mean(16)

    def everywhere(*args: object) -> object:
        packed = pack(*args)  # type: ignore[arg-type]
        return packed._replace(bounds_px=np.broadcast_to((-1e9, -1e9, 1e9, 1e9), packed.bounds_px.shape).copy())

    monkeypatch.setattr(samples, "pack", everywhere)
    slow = both.samples(4)
    for field in ("xy_px", "rgb", "depth_m", "motion_px"):
        np.testing.assert_array_equal(getattr(fast, field), getattr(slow, field))
    np.testing.assert_array_equal(fast_mean, both.mean(16))


def test_the_seed_decides_every_bit_whatever_the_threads() -> None:
    scene = make_scene("whirl", 2, LENS, H / W)
    one, three, other = (
        SampleTracer(scene=scene, lens=LENS, width_px=W, height_px=H, seed=seed, threads=threads)
        for seed, threads in ((7, 1), (7, 3), (8, 1))
    )
    first, again = one.samples(4), three.samples(4)
    for field in ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    np.testing.assert_array_equal(one.mean(32), three.mean(32))
    np.testing.assert_array_equal(one.sharp(16).rgb, three.sharp(16).rgb)
    assert (first.time != other.samples(4).time).mean() > 0.9


def test_scenes_look_alike_at_all_sizes() -> None:
    """Blur and motion are shares of the frame: the reference of twice the size, averaged, is that of the size (noise leaves 44 dB)."""
    large, small = (SampleTracer(make_scene("fence", 1, LENS, H / W), LENS, W * k, H * k).mean(256) for k in (2, 1))
    averaged = large.reshape(H, 2, W, 2, 3).mean(axis=(1, 3))
    assert psnr(averaged, small) > 40.0


def open_share(aperture: Aperture, points: np.ndarray) -> np.ndarray:
    from tests.scenes.card_tracer import transmission

    return transmission(aperture, points.astype(np.float64))


@pytest.mark.parametrize(
    "aperture",
    [
        Aperture.disc(),
        Aperture.blades(5, rotation_rad=0.3),
        Aperture.ring(0.6),
        Aperture.star(5, 0.4),
        Aperture.heart(),
        Aperture((0.9 * Aperture.disc().outlines[0], np.array([[0.0, -0.4], [0.5, 0.2], [-0.3, 0.5]])), (0.3, 0.7)),
    ],
    ids=["disc", "blades", "ring", "star", "heart", "two levels"],
)
def test_lens_points_are_drawn_in_proportion_to_what_the_aperture_passes(aperture: Aperture) -> None:
    """Histogram of the lens points of a picture against the transmission, integrated on a fine grid."""
    lens = replace(LENS, aperture=aperture)
    uv = tracer(STAGE.backdrop(0.05, GREY), lens=lens).samples(128).lens_uv.reshape(-1, 2)
    side = (np.arange(960) + 0.5) / 480.0 - 1.0
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * aperture.unit_radius
    passed = open_share(aperture, grid).reshape(12, 80, 12, 80).sum(axis=(1, 3))
    edges = np.linspace(-1.0, 1.0, 13) * aperture.unit_radius
    drawn = np.histogram2d(uv[:, 1], uv[:, 0], (edges, edges))[0]
    assert drawn.sum() >= len(uv) - 1
    # 196608 points: the standard error of a cell with the share q is below sqrt(q / 196608), at most 5e-4; bands and grid add 1e-4.
    np.testing.assert_allclose(drawn / len(uv), passed / passed.sum(), atol=1.5e-3)
    assert (open_share(aperture, uv) > 0).mean() > 0.998


def test_apertures_that_cannot_be_drawn_from_are_refused() -> None:
    negative = Aperture((Aperture.disc().outlines[0], 0.5 * Aperture.disc().outlines[0]), (1.0, -1.5))
    with pytest.raises(InputError, match="takes away more light"):
        lens_table(negative)
    with pytest.raises(InputError, match="changes over the frame"):
        tracer(lens=replace(LENS, aperture=replace(Aperture.disc(), cat_eye=0.5))).samples(1)
    with pytest.raises(InputError, match="flat focus"):
        tracer(lens=replace(LENS, tilt_rad=(0.1, 0.0)))


def test_the_sharp_layer_has_coverage_depth_and_motion_of_one_surface() -> None:
    """A moving card that ends in the middle of column 24 over nothing: half covered there, with its own depth and motion."""
    edge_m = 0.5 / W * 2.0 * STAGE.half_width_m(STAGE.depth_m(-0.05))
    size_m = 4.0 * STAGE.half_width_m(STAGE.depth_m(-0.05))
    quad = Quad((edge_m - size_m, -size_m, STAGE.depth_m(-0.05)), (size_m, 0.0, 0.0), (0.0, 2.0 * size_m, 0.0), WHITE)
    layer = tracer(Mover(quad, STAGE.velocity_m((0.1, 0.05), -0.05)), sun=0.0, ambient=0.8).sharp(64)
    alpha = np.where(np.arange(W) < W // 2, 1.0, np.where(np.arange(W) == W // 2, 0.5, 0.0))
    np.testing.assert_allclose(layer.alpha, np.broadcast_to(alpha, (H, W)), atol=1 / 64)
    np.testing.assert_allclose(layer.rgb[..., 0], 0.8 * layer.alpha, atol=1e-6)
    covered = layer.alpha > 0
    np.testing.assert_allclose(layer.depth_m[covered], STAGE.depth_m(-0.05), rtol=1e-6)
    assert np.isinf(layer.depth_m[~covered]).all()
    np.testing.assert_allclose(layer.extra["forward.u"][..., 0], 0.1 * W * layer.alpha, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(layer.extra["forward.v"][..., 0], -0.05 * W * layer.alpha, rtol=1e-5, atol=1e-6)


def test_the_layers_make_up_the_whole() -> None:
    scene = make_scene("fence", 1, LENS, H / W)
    whole, front, rest = (SampleTracer(part, LENS, W, H).sharp(64) for part in (scene, scene.part(True), scene.part(False)))
    together = over(front, rest)
    # At the fence's edges the two are correlated within a pixel, elsewhere they are the same rays.
    inner = (front.alpha == 0) | (front.alpha == 1)
    np.testing.assert_allclose(together.rgb[inner], whole.rgb[inner], atol=1e-6)
    np.testing.assert_array_equal(np.minimum(front.depth_m, rest.depth_m)[inner], whole.depth_m[inner])
    assert np.abs(together.rgb - whole.rgb).mean() < 0.01
    assert 0.1 < front.alpha.mean() < 0.7 and rest.alpha.min() == 1.0


@pytest.mark.parametrize("name", list(SCENES))
def test_every_scene_has_blur_on_both_sides_and_motion(name: str) -> None:
    s = SampleTracer(make_scene(name, 1, LENS, H / W), LENS, W, H).samples(4)
    coc_share = LENS.coc_px(s.depth_m.astype(np.float64), W) / W
    assert np.isfinite(s.depth_m).all()
    assert -0.13 < coc_share.min() < -0.02 and 0.05 < coc_share.max() < 0.13
    moves = np.linalg.norm(s.motion_px, axis=-1) / W
    assert 0.05 < moves.max() < 0.2 and (moves == 0).any()
    assert np.abs(coc_share).min() < 0.01


def test_files_are_made_once_and_resumed(tmp_path: Path) -> None:
    plan = SamplesPlan("fence", 1, W, H, spp=4, reference_spp=16, sharp_spp=16)
    assert render_samples(tmp_path, plan, measure=True) == 7
    folder = tmp_path / "fence_1"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert {path.name for path in before} == {
        "meta.json", "lens.json", "samples.npz", "all_in_focus.exr", "00.exr", "01.exr", "reference.exr", "noise.json",
    }  # fmt: skip
    assert render_samples(tmp_path, plan) == 0
    (folder / "samples.npz").unlink()
    (folder / "layers" / "01.exr").unlink()
    assert render_samples(tmp_path, plan, threads=1) == 2
    read = read_samples(folder / "samples.npz")
    expected = in_a_row(plan.tracer(SamplesSet(tmp_path, plan).scene).samples(4))
    for field in ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px"):
        np.testing.assert_array_equal(getattr(read, field), getattr(expected, field))
    assert (folder / "layers" / "01.exr").read_bytes() == before[folder / "layers" / "01.exr"]
    with pytest.raises(InputError, match="other settings"):
        render_samples(tmp_path, replace(plan, spp=8))
    assert render_samples(tmp_path, replace(plan, spp=8), overwrite=True) == 6
    assert not (folder / "noise.json").exists()


def test_mistakes_are_told_in_a_sentence(tmp_path: Path) -> None:
    for wrong in ({"scene": "fences"}, {"width_px": 8}, {"spp": 0}, {"seed": -1}, {"height_px": 4096}):
        with pytest.raises(InputError, match=r"expected|needs"):
            SamplesPlan(**({"scene": "fence"} | wrong))  # type: ignore[arg-type]
    import typer

    app = typer.Typer()
    app.command()(command.main)
    result = CliRunner().invoke(app, [str(tmp_path), "--scene", "sea"])
    assert result.exit_code == 2 and "expected a scene out of fence" in result.output


@pytest.mark.parametrize("name", ["fence_1", "whirl_1"])
def test_the_shipped_samples_are_what_the_sampler_makes(name: str) -> None:
    """Rounding may turn a ray at the edge of a body to the other side."""
    folder = DATA / name
    from mrbokeh.system.atomic_files import read_json

    meta = read_json(folder / "meta.json", "the description of a set of samples (meta.json)")
    plan = SamplesPlan(
        scene=meta["scene"],
        seed=meta["seed"],
        width_px=meta["width_px"],
        height_px=meta["height_px"],
        spp=meta["spp"],
        reference_spp=meta["reference_spp"],
        sharp_spp=meta["sharp_spp"],
    )
    files = SamplesSet(DATA, plan)
    assert meta == plan.document(files.scene)
    shipped, made = read_samples(folder / "samples.npz"), in_a_row(plan.tracer(files.scene).samples(plan.spp))
    np.testing.assert_array_equal(shipped.xy_px, made.xy_px)
    assert (np.abs(shipped.rgb - made.rgb).max(axis=1) < 1e-4).mean() > 0.999
    sharp = plan.tracer(files.scene).sharp(plan.sharp_spp)
    assert psnr(read_layer(folder / "all_in_focus.exr").rgb, sharp.rgb) > 50.0
    reference = read_image(folder / "reference.exr")
    assert psnr(plan.tracer(files.scene).mean(128), reference) > 36.0
    assert psnr(shipped.raw_picture(), reference) > 20.0
    assert read_lens(folder / "lens.json").coc_px(1.5, 96) == pytest.approx(plan.lens.coc_px(1.5, 96))
