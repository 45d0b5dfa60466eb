import numpy as np
import pytest

from mrbokeh.compositing.over import OverPhotograph, behind, occlusion_matte
from mrbokeh.compositing.plate import Inserted, plate_of
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from tests.support.refusals import refused

LENS = Lens(50.0, 2.0, 1.0, 36.0)
SIZE = (48, 64)


def card(depth_m: float, colour: tuple[float, float, float] = (0.8, 0.1, 0.1)) -> Layer:
    alpha = np.zeros(SIZE, np.float32)
    alpha[12:36, 20:44] = 1.0
    return Layer(alpha[..., None] * np.array(colour, np.float32), alpha, np.where(alpha > 0, depth_m, np.inf).astype(np.float32))


def inserted(photo_rgb: np.ndarray, layer: Layer, scene_m: np.ndarray | None = None) -> Inserted:
    return OverPhotograph().insert(plate_of(photo_rgb, LENS, scene_m), [layer], ScatterReference())


def photo() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (*SIZE, 3)).astype(np.float32)


def test_an_object_replaces_the_photograph_where_it_touches_it_alone() -> None:
    found = inserted(photo(), card(1.3))
    untouched = found.virtual.alpha == 0
    assert untouched.mean() > 0.3
    np.testing.assert_array_equal(found.rgb[untouched], photo()[untouched])
    picture = inserted(photo(), card(1.0)).rgb
    np.testing.assert_allclose(picture[13:35, 21:43], np.broadcast_to(np.float32([0.8, 0.1, 0.1]), (22, 22, 3)), atol=1e-6)
    refused("virtual layer is 64x48 px but the photograph is 10x10 px", inserted, np.zeros((10, 10, 3), np.float32), card(1.0))


def test_the_photographed_scene_hides_what_is_behind_it_in_part_or_whole() -> None:
    scene_m = np.full(SIZE, 0.5, np.float32)
    picture = inserted(photo(), card(1.3), scene_m).rgb
    np.testing.assert_array_equal(picture, photo())
    scene_m = np.full(SIZE, 3.0, np.float32)
    scene_m[:, :32] = 0.5
    blurred = inserted(photo(), card(1.0), scene_m).virtual
    assert blurred.alpha[20, 21:32].max() == 0.0 and blurred.alpha[20, 32:43].min() == pytest.approx(1.0)


def test_matte_goes_over_smoothly_and_surfaces_that_touch_do_not_sink_in() -> None:
    virtual_m = (2.0 * np.linspace(1.01, 1.05, 41)[None]).astype(np.float32)
    matte = occlusion_matte(virtual_m, np.full_like(virtual_m, 2.0), tolerance=0.03, softness=0.02)[0]
    assert matte[0] == 1 and matte[-1] == 0 and matte[20] == pytest.approx(0.5, abs=1e-4)
    assert (np.diff(matte) <= 0).all()
    noisy_m = np.random.default_rng(0).normal(1.0, 0.005, (8, 8)).astype(np.float32)
    assert (occlusion_matte(np.ones((8, 8), np.float32), noisy_m) == 1).all()
    matte = occlusion_matte(np.full((2, 2), np.inf, np.float32), np.full((2, 2), 2.0, np.float32))
    assert (matte == 0).all()
    alpha = np.full(SIZE, 0.5, np.float32)
    layer = Layer(np.full((*SIZE, 3), 0.5, np.float32), alpha, np.ones(SIZE, np.float32))
    picture = Inserted(behind(np.full((*SIZE, 3), 0.02, np.float32), layer), layer).rgb
    np.testing.assert_allclose(picture, 0.51, rtol=1e-6)
