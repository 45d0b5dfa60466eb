"""The laws that every way of putting layers into a photograph keeps (mrbokeh.compositing.plate), and what each mode adds to them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mrbokeh.compositing.between import Between, Rerendered
from mrbokeh.compositing.choose import (
    DEFAULT_MODE,
    MODES,
    InDirtyRectangle,
    dirty_rectangle,
    insertion_of,
    without_what_touches_the_lens,
)
from mrbokeh.compositing.over import OverPhotograph, SmoothedMatte
from mrbokeh.compositing.plate import Inserted, Plate, plate_of
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

LENS = Lens(100.0, 1.0, 1.0, 36.0)  # 20 px of blur per dioptre at 64 px
WIDE = Lens(50.0, 1.4, 1.0, 36.0)
SIZE = (48, 64)
CARD = np.s_[12:36, 20:44]
RED = (0.8, 0.1, 0.1)


def card(
    depth_m: float, colour: tuple[float, float, float] = RED, size: tuple[int, int] = SIZE, where: tuple[slice, slice] = CARD
) -> Layer:
    alpha = np.zeros(size, np.float32)
    alpha[where] = 1.0
    return Layer(alpha[..., None] * np.array(colour, np.float32), alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def plate(scene_m: float | np.ndarray = 3.0, lens: Lens = LENS, size: tuple[int, int] = SIZE) -> Plate:
    """A noisy scene as the lens sees it, with all that a focal stack knows of it."""
    sharp = np.random.default_rng(0).uniform(0.0, 1.0, (*size, 3)).astype(np.float32)
    depth_m = np.broadcast_to(np.float32(scene_m), size).astype(np.float32)
    blurred = ScatterReference().render([opaque(sharp, depth_m)], lens).rgb
    return replace(plate_of(blurred, lens, depth_m), sharp_rgb=sharp)


def inserted(mode: str, layers: Sequence[Layer], photo: Plate, renderer: Renderer | None = None) -> Inserted:
    return insertion_of(mode).insert(photo, layers, renderer or ScatterReference())


each_mode = pytest.mark.parametrize("mode", MODES)


@each_mode
def test_no_layers_or_pixels_without_virtual_light_give_the_plate_bit_for_bit(mode: str) -> None:
    photo = plate()
    found = inserted(mode, [], photo)
    np.testing.assert_array_equal(found.rgb, photo.rgb)
    assert not found.virtual.alpha.any()
    picture = inserted(mode, [card(1.0)], plate()).rgb
    np.testing.assert_allclose(picture[16:32, 24:40], np.broadcast_to(np.float32(RED), (16, 16, 3)), atol=2e-4)
    refused("virtual layer is 10x10 px but the photograph is 64x48 px", inserted, mode, [card(1.0, size=(10, 10))], plate())


@each_mode
def test_colours_that_rec709_has_not_stay_as_they_are(mode: str) -> None:
    """Green of ACEScg is (-0.15, 0.38, 0.05) in Rec.709; in the middle of a card only it is seen, of a plate below 0 nothing."""
    green = (-0.15, 0.38, 0.05)
    picture = inserted(mode, [card(1.0, green)], plate()).rgb
    np.testing.assert_allclose(picture[16:32, 24:40], np.broadcast_to(np.float32(green), (16, 16, 3)), atol=2e-4)
    glass = card(1.0, green)
    glass = replace(glass, rgb=0.2 * glass.rgb, alpha=np.float32(0.2) * glass.alpha)
    lower = inserted(mode, [glass], plate()).rgb - inserted(mode, [replace(glass, rgb=np.zeros_like(glass.rgb))], plate()).rgb
    np.testing.assert_allclose(lower[16:32, 24:40], np.broadcast_to(np.float32(0.2) * np.float32(green), (16, 16, 3)), atol=1e-3)
    photo = plate()
    photo.rgb[..., 2] -= 0.4
    assert photo.sharp_rgb is not None
    photo.sharp_rgb[..., 2] -= 0.4
    picture = inserted(mode, [card(1.0)], photo).rgb
    np.testing.assert_allclose(picture[16:32, 24:40], np.broadcast_to(np.float32(RED), (16, 16, 3)), atol=2e-4)
    assert (picture[:, 60:] == photo.rgb[:, 60:]).all()


@each_mode
@pytest.mark.parametrize("renderer", [ScatterReference(), PolygonDifferences()], ids=["scatter", "polygon"])
def test_pixels_without_virtual_light_are_the_plates_bit_for_bit(mode: str, renderer: Renderer) -> None:
    photo = plate()
    found = inserted(mode, [card(1.3)], photo, renderer)
    untouched = found.virtual.alpha == 0
    assert 0.2 < untouched.mean() < 0.9
    np.testing.assert_array_equal(found.rgb[untouched], photo.rgb[untouched])


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "front"])
def test_a_layer_behind_everything_changes_nothing(mode: str) -> None:
    photo = plate(0.8)
    np.testing.assert_array_equal(inserted(mode, [card(2.0)], photo).rgb, photo.rgb)


@each_mode
def test_twice_the_light_gives_twice_the_picture_and_is_never_negative(mode: str) -> None:
    depth_m = np.full(SIZE, 3.0, np.float32)
    depth_m[:, :30] = 0.7
    photo, layer = plate(depth_m), card(1.3)
    assert photo.sharp_rgb is not None
    once = inserted(mode, [layer], photo).rgb
    brighter = replace(photo, rgb=2.0 * photo.rgb, sharp_rgb=2.0 * photo.sharp_rgb)
    np.testing.assert_allclose(inserted(mode, [replace(layer, rgb=2.0 * layer.rgb)], brighter).rgb, 2.0 * once, atol=2e-4)
    depth_m[:, :26], depth_m[:, 26:30] = 3.0, 0.7
    found = inserted(mode, [card(1.3)], plate(depth_m), PolygonDifferences())
    assert found.rgb.min() >= 0.0 and found.virtual.alpha.min() >= 0.0 and found.virtual.alpha.max() <= 1.0 + 1e-5


# The box: a part of the picture gives what the whole gives.


@each_mode
@pytest.mark.parametrize("focus_m", [1.0, 3.0])
def test_the_box_gives_what_the_whole_frame_gives(mode: str, focus_m: float) -> None:
    size = (120, 120)
    depth_m = np.full(size, 3.0, np.float32)
    depth_m[:, 58:61] = 0.8
    photo, layer = plate(depth_m, WIDE.focused_at(focus_m), size), card(1.3, size=size, where=np.s_[52:70, 50:74])
    boxed = MODES[mode]
    assert isinstance(boxed, InDirtyRectangle)
    whole, part = (each.insert(photo, [layer], ScatterReference()) for each in (boxed.insertion, boxed))
    box = dirty_rectangle(photo, [layer])
    assert (box.bottom - box.top) * (box.right - box.left) < 0.75 * size[0] * size[1]
    np.testing.assert_allclose(part.rgb, whole.rgb, atol=2e-5)
    np.testing.assert_allclose(part.virtual.alpha, whole.virtual.alpha, atol=2e-5)


@dataclass
class Recorder:
    """An insertion that writes down what it is given."""

    seen: list[tuple[Plate, Sequence[Layer]]] = field(default_factory=list)

    def insert(self, photo: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        self.seen.append((photo, layers))
        return OverPhotograph(by_depth=False).insert(photo, layers, renderer)


def test_circles_of_confusion_keep_their_size_in_the_box_and_near_things_go_on_beyond_the_frame() -> None:
    photo, recorder = plate(size=(100, 150)), Recorder()
    InDirtyRectangle(recorder).insert(photo, [card(1.3, size=(100, 150))], ScatterReference())
    part, _ = recorder.seen[0]
    width = part.rgb.shape[1]
    assert width < 120 and part.lens.coc_px(1.3, width) == pytest.approx(float(LENS.coc_px(1.3, 150)))
    assert part.lens.image_distance_mm == LENS.image_distance_mm
    # A near wall over the whole height hides as much at the border of the frame as in its middle; without the box it fades out.
    depth_m = np.full(SIZE, 3.0, np.float32)
    depth_m[:, :32] = 0.8
    everywhere = Layer(np.ones((*SIZE, 3), np.float32), np.ones(SIZE, np.float32), np.full(SIZE, 1.3, np.float32))
    photo = plate(depth_m, LENS.focused_at(1.3))
    share, bare = (each.insert(photo, [everywhere], ScatterReference()).virtual.alpha for each in (MODES["between"], Between()))
    assert 0.1 < share[24, 30] < 0.9
    np.testing.assert_allclose(share[0, 20:44], share[24, 20:44], atol=0.02)
    assert bare[0, 28] > share[0, 28] + 0.1


@pytest.mark.parametrize("lens", [replace(LENS, tilt_rad=(0.05, 0.0)), replace(LENS, aperture=replace(LENS.aperture, cat_eye=0.5))])
def test_a_lens_that_differs_over_the_frame_gets_the_whole_frame(lens: Lens) -> None:
    photo, recorder = replace(plate(size=(100, 150)), lens=lens), Recorder()
    InDirtyRectangle(recorder).insert(photo, [card(1.3, size=(100, 150))], ScatterReference())
    assert recorder.seen[0][0].rgb.shape == (100, 150, 3)


# The paper's matte, and blurring all anew.


def test_the_matte_is_eroded_and_smoothed_and_without_filters_occlusion_by_depth() -> None:
    matte = SmoothedMatte(erode_px=2, sigma_px=0.0).smoothed(card(1.0).alpha)
    assert matte.sum() == (24 - 4) * (24 - 4)
    np.testing.assert_array_equal(matte[14:34, 22:42], 1.0)
    row = SmoothedMatte(erode_px=0, sigma_px=1.5).smoothed(card(1.0).alpha)[24]
    assert row[19] + row[20] == pytest.approx(1.0, abs=1e-3) and 0.0 < row[18] < row[19] < row[20] < row[21] < 1.0
    depth_m = np.full(SIZE, 3.0, np.float32)
    depth_m[:, :32] = 0.7
    photo, layer = plate(depth_m), card(1.3)
    plain = OverPhotograph().insert(photo, [layer], ScatterReference()).rgb
    np.testing.assert_allclose(SmoothedMatte(0, 0.0).insert(photo, [layer], ScatterReference()).rgb, plain, atol=1e-6)
    refused("pixels from 0 up, got erosion -1", SmoothedMatte, erode_px=-1)


@pytest.mark.parametrize("changed", [SmoothedMatte(erode_px=3), SmoothedMatte(sigma_px=2.0)])
def test_each_size_of_the_matte_matters(changed: SmoothedMatte) -> None:
    photo = plate()
    pictures = [each.insert(photo, [card(1.3)], ScatterReference()).rgb for each in (SmoothedMatte(), changed)]
    assert np.abs(pictures[0] - pictures[1]).max() > 0.02


def test_blurring_anew_needs_the_sharp_scene_and_shows_near_things_before_the_layer() -> None:
    with pytest.raises(InputError, match="all-in-focus picture and depth are needed"):
        Rerendered().insert(replace(plate(), sharp_rgb=None), [card(1.3)], ScatterReference())
    depth_m = np.full(SIZE, 3.0, np.float32)
    depth_m[:, :32] = 0.7
    photo = plate(depth_m, LENS.focused_at(0.7))
    picture = inserted("rerender", [card(1.3)], photo).rgb
    np.testing.assert_allclose(picture[24, 22:28], photo.rgb[24, 22:28], atol=2e-3)
    np.testing.assert_allclose(picture[24, 35:38], np.broadcast_to(np.float32(RED), (3, 3)), atol=2e-2)
    assert DEFAULT_MODE in MODES
    refused("front, over, matte, between, rerender, got 'under'", insertion_of, "under")


@pytest.mark.parametrize("mode", sorted(MODES))
def test_what_touches_the_lens_is_left_out_everywhere(mode: str) -> None:
    """At 1 mm a circle is 20,000 px wide, and padding for it would take petabytes; light of it would be no 1000th in the picture."""
    photo, layer = plate(), card(0.001)
    layer = replace(layer, extra={"matte": layer.alpha[..., None]})
    left = without_what_touches_the_lens(layer, photo)
    assert not left.alpha.any() and not left.rgb.any() and not left.extra["matte"].any() and np.isinf(left.depth_m).all()
    assert without_what_touches_the_lens(card(0.5), photo).alpha.any()
    np.testing.assert_array_equal(insertion_of(mode).insert(photo, [layer], PolygonDifferences()).rgb, photo.rgb)
