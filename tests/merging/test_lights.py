"""Point lights that saturate: measured on their discs, drawn anew; a traced dark card with lights and shot noise."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from capture.merging.depth_from_focus import focus_map
from capture.merging.focus_volume import focus_volume
from capture.merging.lights import Extremes, Lights, find_lights, no_lights, spread_light
from capture.merging.registration.alignment import register_stack
from capture.merging.registration.plane_transforms import warp
from capture.merging.restored_lights import Discs, measured_discs, opening_kernel, restored_lights, with_restored_lights
from capture.merging.second_pass import SliceOptics, all_in_focus_from_depth
from datasets_scripts.tracers.thin_lens import camera_for_lens, trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import DiscLight, Quad, Scene, emissive_quad
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from tests.support.blended_slices import all_in_focus

SIZE = (64, 256)
AT_PX = np.array([40.3, 30.6])
FLUX = np.array([20.0, 15.0, 10.0])
RADIUS_PX = 1.0
SHARP_SLICE = 4
STEP_PX = 2.0
FULL = 1.0
SUBPIXELS = 16


def drawn_disc(radius_px: float) -> np.ndarray:
    """A disc of flux 1 at AT_PX, by counting subpixels."""
    y, x = (np.mgrid[: SIZE[0] * SUBPIXELS, : SIZE[1] * SUBPIXELS] + 0.5) / SUBPIXELS
    inside = (x - AT_PX[0]) ** 2 + (y - AT_PX[1]) ** 2 <= radius_px**2
    counted = inside.reshape(SIZE[0], SUBPIXELS, SIZE[1], SUBPIXELS).sum(axis=(1, 3))
    return (counted / counted.sum()).astype(np.float32)


@pytest.fixture(scope="module")
def photographs() -> list[np.ndarray]:
    """Seven slices of one light before a wall of 0.05; its blur has the diameter 2 px per slice from slice 4; full at 1."""
    slices = []
    for index in range(7):
        radius_px = float(np.hypot(RADIUS_PX, 0.5 * STEP_PX * (index - SHARP_SLICE)))
        slices.append(np.minimum(0.05 + drawn_disc(radius_px)[..., None] * FLUX, FULL).astype(np.float32))
    return slices


@pytest.fixture(scope="module")
def lights(photographs: list[np.ndarray]) -> Lights:
    return find_lights(lambda: photographs)


def test_a_pass_that_was_made_already_need_not_be_made_again(photographs: list[np.ndarray], lights: Lights) -> None:
    extremes = Extremes()
    assert sum(1 for _ in extremes.watching(photographs)) == 7
    again = find_lights(lambda: photographs, extremes)
    np.testing.assert_array_equal(again.zone, lights.zone)
    np.testing.assert_array_equal(again.core, lights.core)
    assert lights.core[30, 40] and lights.sharpest.tolist() == [SHARP_SLICE]


@pytest.fixture(scope="module")
def discs(photographs: list[np.ndarray], lights: Lights) -> Discs:
    return measured_discs(np.stack(photographs), lights.zone == 1, AT_PX, lights.areas_px[:, 0])


def test_discs_tell_flux_and_place(discs: Discs) -> None:
    use = discs.believable
    # 20 over discs of 4.1 and 3.2 px radius is 0.4 and 0.6; from slice 2 on, at 2.2 px, it is 1.3 and full.
    assert use.tolist() == [True, True, False, False, False, False, False]
    np.testing.assert_allclose(discs.xy_px[use].mean(axis=0), AT_PX, atol=0.03)
    np.testing.assert_allclose(discs.flux[use], np.broadcast_to(FLUX, (2, 3)), rtol=0.01)
    # A disc of radius r has the variance r^2 / 4 per axis, a pixel 1 / 12.
    radius_px = np.hypot(RADIUS_PX, 0.5 * STEP_PX * (np.flatnonzero(use) - SHARP_SLICE))
    np.testing.assert_allclose(discs.variance_px2[use], radius_px**2 / 4 + 1 / 12, rtol=0.03)


def test_a_light_that_lost_its_flux_is_drawn_anew(photographs: list[np.ndarray]) -> None:
    """What the sharp slice holds is a few full pixels; flux and place of the discs make a disc of the right size of them."""
    merged = photographs[SHARP_SLICE]
    _, found = restored_lights(lambda: photographs, merged)
    restored = with_restored_lights(merged, found)
    expected = 0.05 + drawn_disc(RADIUS_PX)[..., None] * FLUX
    np.testing.assert_allclose((restored - 0.05).sum(axis=(0, 1)), FLUX, rtol=0.03)
    np.testing.assert_allclose(restored[29:32, 39:42].max(), expected.max(), rtol=0.1)
    assert found[0].supported == pytest.approx(np.max(FLUX) + 0.75, rel=0.03), "all of the flux in one pixel, beside what else is there"
    assert restored.max() < found[0].supported
    far = np.hypot(*(np.mgrid[: SIZE[0], : SIZE[1]] + 0.5 - AT_PX[::-1, None, None])) > 8
    np.testing.assert_array_equal(restored[far], merged[far])


def test_a_light_behind_a_mirror_lens_is_drawn_anew_once_its_opening_is_known() -> None:
    """Half of the diameter is stopped: points blur to rings, and no disc explains them. In focus the light lacks a sixth of its flux."""
    opening, light = Aperture.disc().obstructed(0.5), drawn_disc(2.2)[..., None] * (1.3 * np.pi * 2.2**2)
    slices = []
    for index in range(9):
        kernel = opening.rasterize(1.6 * abs(index - SHARP_SLICE)).kernel
        slices.append(np.minimum(0.05 + cv2.filter2D(light, -1, kernel)[..., None] * np.ones(3, np.float32), FULL).astype(np.float32))
    whole = 3 * light.sum()
    merged = slices[SHARP_SLICE]
    assert (merged - 0.05).sum() < 0.9 * whole
    as_discs, as_rings = (
        with_restored_lights(merged, restored_lights(lambda: slices, merged, opening=each)[1]) for each in (None, opening)
    )
    np.testing.assert_array_equal(as_discs, merged)
    assert (as_rings - 0.05).sum() == pytest.approx(whole, rel=0.03)


@pytest.mark.parametrize(("radiance", "largest_grown"), [(20.0, 1.5), (1.0, np.inf)], ids=["sun glint", "white print"])
def test_a_glint_full_in_all_slices_has_no_say_where_blur_spreads_it_but_white_print_has(radiance: float, largest_grown: float) -> None:
    """A disc of radius 8 px blurred by 0 to 6 px: 20 times full it is full to a radius of 8 to 14, just full it loses its rim to blur."""
    y, x = np.mgrid[:64, :512]
    kernels = [cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2).astype(np.float32) for radius in range(7)]
    disc = np.where(np.hypot(x - 250, y - 32) < 8.0, np.float32(radiance), np.float32(0.02))
    blurred = np.minimum([cv2.filter2D(disc, -1, kernel / kernel.sum()) for kernel in kernels], FULL)
    spread = spread_light((255.0 * np.sqrt(blurred)).astype(np.uint8))
    for index, each in enumerate(spread):
        assert each.any() == (((8.0 + index) / 8.0) ** 2 > largest_grown)
        assert not each[:, :220].any() and each[32, 250] == each.any()


@pytest.mark.parametrize("radius_px", [4.3, 17.0])
@pytest.mark.parametrize("opening", [Aperture.disc().obstructed(0.5), Aperture.blades(6)], ids=["ring", "hexagon"])
def test_an_opening_drawn_by_opencv_is_the_exact_one(opening: Aperture, radius_px: float) -> None:
    drawn, exact = opening_kernel(opening, radius_px), opening.rasterize(2.0 * radius_px).kernel
    reach = max(len(drawn), len(exact)) // 2
    drawn, exact = (np.pad(each, reach - len(each) // 2) for each in (drawn, exact))
    # Corners lie on a grid of a sixteenth of a pixel, and OpenCV fills the line of the outline too.
    assert np.abs(drawn - exact).max() < exact.max() / 8 and np.abs(drawn - exact).sum() < 0.03


@pytest.mark.parametrize("cat_eye", [1.0, 0.6])
def test_an_elongated_light_keeps_its_shape_also_behind_a_lens_of_cat_eyes(cat_eye: float) -> None:
    """Half axes of 2 and 1.2 px along 115 degrees; discs whose short half axis is `cat_eye` of the long one, along another direction."""
    light, flux = _filled_ellipse(2.0, 1.2, 2.0), 2.4 * FLUX
    slices = []
    for index in range(12):
        radius_px = abs(index - 5.0)
        disc = _filled_ellipse(radius_px, cat_eye * radius_px, 1.2) if radius_px else None
        spread = light if disc is None else cv2.filter2D(light, -1, disc[1:, 1:], borderType=cv2.BORDER_CONSTANT)
        slices.append(np.minimum(0.05 + _on_pixels(spread)[..., None] * flux, FULL).astype(np.float32))
    _, found = restored_lights(lambda: slices, slices[5])
    drawn = (with_restored_lights(slices[5], found) - 0.05).sum(axis=2)
    assert drawn.sum() == pytest.approx(flux.sum(), rel=0.03)
    # A filled ellipse has a quarter of its squared half axes as variances, and pixels add 1 / 12.
    variances = np.linalg.eigvalsh(np.cov(np.indices(drawn.shape).reshape(2, -1), aweights=np.maximum(drawn, 0.0).ravel()))
    np.testing.assert_allclose(np.sqrt(variances - 1 / 12), [0.6, 1.0], atol=0.1, err_msg="a round dot of this area has 0.77 twice")


def _filled_ellipse(long_px: float, short_px: float, angle_rad: float) -> np.ndarray:
    """An ellipse of flux 1 about the middle of 64 x 64 pixels, by 8 x 8 points each."""
    y, x = (np.mgrid[: 64 * 8, : 64 * 8] + 0.5) / 8 - 32
    along, across = np.cos(angle_rad) * x + np.sin(angle_rad) * y, np.cos(angle_rad) * y - np.sin(angle_rad) * x
    inside = ((along / long_px) ** 2 + (across / short_px) ** 2 <= 1).astype(np.float32)
    return inside / inside.sum()


def _on_pixels(points: np.ndarray) -> np.ndarray:
    """The same on pixels, in a wider picture: a light's reach is a share of the width."""
    return np.pad(points.reshape(64, 8, 64, 8).sum(axis=(1, 3)), ((0, 0), (96, 96)))


def test_discs_that_contradict_each_other_are_not_believed(photographs: list[np.ndarray], discs: Discs) -> None:
    confused = replace(discs, flux=discs.flux * np.linspace(0.1, 3, 7)[:, None])
    assert discs.believable.sum() == 2 and confused.believable.sum() < 2
    # A light that is brighter in every next slice is explained by no one picture: nothing is drawn.
    flickering = [0.05 + (each - 0.05) * np.float32(0.3 + 0.25 * index) for index, each in enumerate(photographs)]
    assert restored_lights(lambda: flickering, flickering[SHARP_SLICE])[1] == []


@dataclass(frozen=True)
class Card:
    """Slices in the geometry of the pinhole picture, that picture, its depth and optics."""

    slices: list[np.ndarray]
    truth: np.ndarray
    depth_m: np.ndarray
    optics: SliceOptics

    def merged(self) -> np.ndarray:
        return merged_of(self.slices)

    def psnr_db(self, picture: np.ndarray) -> float:
        """Return the PSNR on the card, where nothing nearer or farther shines in."""
        on_card = np.abs(self.depth_m - 1.2) < 0.01
        on_card[:, -8:] = on_card[:8] = on_card[-8:] = False
        return psnr(picture, self.truth, mask=on_card)


def merged_of(slices: list[np.ndarray]) -> np.ndarray:
    """Merge registered slices as `merge_stack` does."""
    volume = focus_volume(slices)
    merged = all_in_focus(slices, focus_map(volume, no_lights(volume.shape)).focus_index)
    return with_restored_lights(merged, restored_lights(lambda: slices, merged)[1])


def traced_card(
    texture: np.ndarray, lamps: tuple[DiscLight, ...], full_well: float = 1e4, jitter_px: float = 0.0, samples: int = 64
) -> Card:
    """Trace a card at 1.2 m between a near (0.8 m) and a far (1.8 m) wall in 11 slices; shot noise, full at 1.

    full_well: electrons at 1. samples: rays a pixel. jitter_px: how far each slice is moved besides breathing, for registration to find.
    """
    width, height = 192, 128
    rng = np.random.default_rng(3)
    walls = (_wall(rng, 0.8, 0.02, 0.35), _wall(rng, 1.8, -1.5, 3.0))
    card = emissive_quad((-0.22, -0.2, 1.2), (0.24, 0.0, 0.0), (0.0, 0.4, 0.0), texture)
    scene = Scene((*walls, card), (), lamps)
    focus = np.linspace(1 / 0.8, 1 / 1.8, 11)
    lens = Lens(50.0, 1.0, float(1 / focus[0]), 23.5)
    base = Camera(width, height, (1.0, 1.0), (width / 2, height / 2), np.eye(4))
    truth, depth_m = trace_pinhole(scene, camera_for_lens(base, lens), 128, footprint_px=1.5)
    slices = []
    for index, dioptre in enumerate(focus):
        focused = lens.focused_at(float(1 / dioptre))
        camera = camera_for_lens(base, focused)
        if jitter_px and index:
            moved = rng.uniform(-jitter_px, jitter_px, 2)
            camera = replace(camera, principal_px=(width / 2 + moved[0], height / 2 + moved[1]))
        rgb = trace(scene, camera, focused, samples, seed=index, footprint_px=1.5)
        slices.append(np.minimum(rng.poisson(np.maximum(rgb, 0) * full_well) / full_well, 1.0).astype(np.float32))
    scales = [lens.focused_at(float(1 / dioptre)).image_distance_mm for dioptre in focus]
    registered = register_stack(lambda index: slices[index], len(slices), scales, lambda index: slices[index].max(axis=2) < 1.0)
    assert registered.reference == 0
    growth = [lens.focused_at(float(1 / dioptre)).coc_px_per_dioptre(width) for dioptre in focus]
    optics = SliceOptics.of_slices(focus.tolist(), growth)
    return Card([warp(*each) for each in zip(slices, registered.reference_from_slice, strict=True)], truth, depth_m, optics)


def lamps() -> tuple[DiscLight, ...]:
    places = [(-0.17, -0.12), (-0.1, -0.09), (-0.15, 0.0), (-0.06, 0.02), (-0.17, 0.11), (-0.09, 0.12)]
    return tuple(DiscLight((x, y, 1.198), 1.7e-3, (12.0, 10.0, 6.0)) for x, y in places)


@pytest.fixture(scope="module")
def card() -> Card:
    """Trace a dark card with six point lights."""
    return traced_card(_texture(np.random.default_rng(3), 0.02, 0.01), lamps())


@pytest.mark.slow
def test_the_dark_card_has_no_ghost_rings(card: Card) -> None:
    """The best focus-stacking tools leave 21 to 26 dB on such a card; 33 dB is what the project wants of it."""
    assert len(restored_lights(lambda: card.slices, card.slices[5])[0]) == 6
    first = card.merged()
    guided = all_in_focus_from_depth(lambda: card.slices, card.depth_m, card.optics, first)
    second = with_restored_lights(guided, restored_lights(lambda: card.slices, guided, guided=True)[1])
    best_single_db = max(card.psnr_db(each) for each in card.slices)
    assert best_single_db < 35.0, "even the slice that is focused on the card has lost the light in it"
    assert card.psnr_db(first) > 36.0
    assert card.psnr_db(second) > 36.0


@pytest.mark.slow
def test_lights_in_noisy_slices_of_a_shaky_camera_keep_their_shape() -> None:
    """35 dB is what the project wants with jitter of 1.2 px and shot noise of 2000 electrons."""
    shaky = traced_card(_texture(np.random.default_rng(3), 0.02, 0.01), lamps(), 2e3, 1.2)
    assert shaky.psnr_db(shaky.merged()) > 35.0


@pytest.mark.slow
def test_white_print_glints_and_black_text_stay_what_they_are() -> None:
    """Print at 0.97 of full, glints just above it and black text, no lamp among them: at least 35 dB, and no value above the slices'."""
    rng = np.random.default_rng(4)
    printed = _texture(rng, 0.2, 0.1)
    for row in range(12, 244, 26):
        for column in range(10, 240, 14):
            ink = 0.97 if (row // 26) % 2 else 0.01
            printed[row : row + rng.integers(6, 16), column : column + rng.integers(3, 9)] = ink
    for _ in range(40):
        row, column = rng.integers(8, 248, 2)
        printed[row : row + 2, column : column + 2] = 1.3
    shown = traced_card(printed, (), samples=256)
    merged = shown.merged()
    assert shown.psnr_db(merged) > 35.0
    assert merged.max() <= max(each.max() for each in shown.slices)


def _wall(rng: np.random.Generator, z_m: float, left_m: float, width_m: float) -> Quad:
    return emissive_quad((left_m, -1.0, z_m), (width_m, 0.0, 0.0), (0.0, 2.0, 0.0), _texture(rng, 0.35, 0.3), (2.0 * width_m, 4.0))


def _texture(rng: np.random.Generator, mean: float, contrast: float) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.uniform(-1, 1, (256, 256, 3)).astype(np.float32), (0, 0), 1.5)
    return np.maximum(mean + contrast * noise / np.abs(noise).max(), 0.001).astype(np.float32)
