from types import SimpleNamespace

import numpy as np
import pytest

from mrbokeh.images.layer import Layer, clear, flatten, opaque, over
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused


def flat(rgb: tuple[float, float, float], alpha: float, depth_m: float) -> Layer:
    """A 2x3 layer of one straight colour, stored premultiplied."""
    colour = np.full((2, 3, 3), rgb, np.float32) * np.float32(alpha)
    return Layer(colour, np.full((2, 3), alpha, np.float32), np.full((2, 3), depth_m, np.float32))


def test_over_of_half_white_on_dark_is_their_linear_mix() -> None:
    result = over(flat((1, 1, 1), 0.5, 1.0), flat((0.02, 0.02, 0.02), 1.0, 2.0))
    np.testing.assert_allclose(result.rgb, 0.5 * 1.0 + 0.5 * 0.02, rtol=1e-6)
    np.testing.assert_allclose(result.alpha, 1.0)
    np.testing.assert_allclose(result.depth_m, 1.0)


def test_over_is_associative() -> None:
    a, b, c = flat((1, 0, 0), 0.3, 1), flat((0, 1, 0), 0.6, 2), flat((0, 0, 1), 0.9, 3)
    left, right = over(over(a, b), c), over(a, over(b, c))
    np.testing.assert_allclose(left.rgb, right.rgb, atol=1e-6)
    np.testing.assert_allclose(left.alpha, right.alpha, atol=1e-6)


def test_depth_of_a_clear_front_is_that_behind() -> None:
    assert (over(clear(2, 3), flat((1, 1, 1), 1.0, 4.0)).depth_m == 4.0).all()


def test_flatten_puts_the_first_layer_in_front() -> None:
    red, blue = flat((1, 0, 0), 1.0, 1.0), flat((0, 0, 1), 1.0, 2.0)
    np.testing.assert_array_equal(flatten([red, blue]).rgb, red.rgb)


def test_flatten_of_nothing_says_what_it_wants() -> None:
    refused("at least one layer", flatten, [])


def test_sizes_must_agree() -> None:
    with pytest.raises(InputError, match="resize them to one size"):
        Layer.__post_init__(
            SimpleNamespace(rgb=np.zeros((2, 3, 3)), alpha=np.zeros((2, 3)), depth_m=np.zeros((3, 2)))
        )  # past the shape checker


def test_opaque_covers_everything() -> None:
    layer = opaque(np.zeros((2, 3, 3), np.float32), np.ones((2, 3), np.float32))
    assert (layer.alpha == 1).all()
    assert (layer.width_px, layer.height_px) == (3, 2)
