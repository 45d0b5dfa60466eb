import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels.laplacian_integration import STENCIL, integrate, integrate_by_pyramid, laplacian
from mrbokeh.system.errors import InputError
from tests.support.spreadlet_references import integrate_reference


def disc(diameter_px: float, size: int) -> np.ndarray:
    """A disc of height about 1 in the middle of (size, size, 1)."""
    kernel = Aperture.disc().rasterize(diameter_px).kernel
    image, start = np.zeros((size, size, 1)), size // 2 - kernel.shape[0] // 2
    image[start : start + kernel.shape[0], start : start + kernel.shape[0], 0] = kernel / kernel.max()
    return image


def inner_laplacian(image: np.ndarray) -> np.ndarray:
    return laplacian(image)[1:-1, 1:-1]


@pytest.mark.parametrize(("polynomial", "expected"), [
    (lambda x, y: 0 * x * y + 1, lambda x, y: 0 * x * y), (lambda x, y: x**2 + y**2, lambda x, y: 0 * x * y + 4),
    (lambda x, y: x * (x**2 + y**2), lambda x, y: 8 * x + 0 * y), (lambda x, y: 3 * x**2 * y - y**3, lambda x, y: 0 * x * y),
    (lambda x, y: ((x + 1j * y) ** 7).real, lambda x, y: 0 * x * y),
])  # fmt: skip
def test_the_stencil_has_the_true_laplacian_of_cubic_and_harmonic_polynomials(polynomial, expected) -> None:
    y, x = np.mgrid[-5:6, -5:6].astype(np.float64)
    found = laplacian(polynomial(x, y))[2:-2, 2:-2]
    np.testing.assert_allclose(found, expected(x, y)[1:-1, 1:-1], atol=1e-9)
    assert STENCIL.sum() == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("size", [(24, 30), (31, 17), (3, 3)])
def test_agreement_with_a_sparse_linear_solver(size: tuple[int, int]) -> None:
    source = np.random.default_rng(0).normal(size=(*size, 2))
    np.testing.assert_allclose(integrate(source), integrate_reference(source), atol=1e-12)


@pytest.mark.parametrize(("precision", "error"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_a_picture_with_a_dark_border_comes_back(precision: type, error: float) -> None:
    image = np.pad(np.random.default_rng(1).uniform(size=(200, 300, 3)), ((2, 2), (2, 2), (0, 0)))
    found = integrate(inner_laplacian(image).astype(precision))
    assert found.dtype == precision
    np.testing.assert_allclose(found, image, atol=error)


def test_a_light_of_a_million_leaves_the_dark_as_it_is_in_double_precision() -> None:
    """Why Laplacians are summed in double precision: single leaves errors of the lamp's rounding all over the picture."""
    image = np.pad(np.random.default_rng(2).uniform(size=(200, 300, 1)), ((2, 2), (2, 2), (0, 0)))
    image[100, 150] = 1e6
    source = inner_laplacian(image)
    errors = [np.abs(integrate(source.astype(precision)) - image)[:50].max() for precision in (np.float64, np.float32)]
    assert errors[0] < 1e-8
    assert errors[1] > 1e-4


def test_the_number_of_threads_changes_no_bit_and_integration_is_linear() -> None:
    source = np.random.default_rng(3).normal(size=(600, 540, 2))
    np.testing.assert_array_equal(integrate(source, 1), integrate(source, 3))
    one, other = np.random.default_rng(4).normal(size=(2, 40, 50, 1))
    np.testing.assert_allclose(integrate(2.0 * one - other), 2.0 * integrate(one) - integrate(other), atol=1e-11)
    with pytest.raises(InputError, match="at least 3 x 3"):
        integrate(np.zeros((2, 9, 1)))


@pytest.mark.parametrize("diameter_px", [40.0, 120.0])
def test_the_pyramid_is_a_few_per_cent_off(diameter_px: float) -> None:
    """Moroto measured 3 % on average and 10 % at most; of ours the same holds, within the disc, and the exact way has none of it."""
    image = disc(diameter_px, 256)
    source = inner_laplacian(image)
    pyramid, exact = np.abs(integrate_by_pyramid(source) - image), np.abs(integrate(source) - image)
    assert 0.01 < pyramid[image > 0].mean() < 0.03
    assert 0.05 < pyramid.max() < 0.12
    assert exact.max() < 1e-12


def test_the_pyramid_integrates_the_light_of_a_constant_field_on_all_its_levels() -> None:
    """Odd and even sizes: nothing moves by half a pixel from level to level."""
    for size in (127, 128):
        image = disc(41.0, size)
        found = integrate_by_pyramid(inner_laplacian(image))[..., 0]
        rows, columns = np.indices(found.shape)
        near = image[..., 0] > 0
        assert (found * columns)[near].sum() / found[near].sum() == pytest.approx((image[..., 0] * columns).sum() / image.sum(), abs=0.15)
        assert (found * rows)[near].sum() / found[near].sum() == pytest.approx((image[..., 0] * rows).sum() / image.sum(), abs=0.15)
