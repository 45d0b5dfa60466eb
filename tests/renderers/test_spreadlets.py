from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.bank.kernel_files import fingerprint, read_spreadlets, write_spreadlets
from mrbokeh.renderers.kernels._laplacian_numba import cell_sums, nearest, solve, throw_darts
from mrbokeh.renderers.kernels.laplacian_integration import integrate
from mrbokeh.renderers.kernels.spreadlets import (
    Sparsification,
    Spreadlet,
    Spreadlets,
    biharmonic_table,
    fitted_values,
    outline_px,
    potential_of,
    sparsify,
    turned,
    whole_laplacian,
)
from mrbokeh.system.errors import InputError

QUICK = Sparsification(annealing_steps=20)
KERNEL = Aperture.disc().rasterize(40.0).kernel


def integrated(spreadlet: Spreadlet, size: int) -> np.ndarray:
    source = np.zeros((size, size, spreadlet.values.shape[1]))
    x, y = spreadlet.points.T.astype(int) + size // 2
    np.add.at(source, (y, x), spreadlet.values)
    return integrate(source)


def embedded(kernel: np.ndarray, size: int) -> np.ndarray:
    side = (size - kernel.shape[0]) // 2
    return np.pad(kernel.reshape(*kernel.shape[:2], -1), ((side, side), (side, side), (0, 0)))


def relative_error(spreadlet: Spreadlet, kernel: np.ndarray = KERNEL) -> float:
    size = kernel.shape[0] + 60
    truth = embedded(kernel, size)
    return float(np.linalg.norm(integrated(spreadlet, size) - truth) / np.linalg.norm(truth))


def tilted_kernel() -> np.ndarray:
    """A heart: no symmetry but one, its centroid not quite on the middle pixel."""
    kernel = Aperture.heart().rotated(0.4).rasterize(44.0).kernel
    return np.dstack([kernel, kernel[::-1], np.roll(kernel, 1, axis=0)])


def test_the_whole_laplacian_is_the_kernel_and_half_a_turn_of_it_exact() -> None:
    assert relative_error(whole_laplacian(KERNEL)) < 1e-12
    assert len(whole_laplacian(KERNEL).points) < 0.4 * np.count_nonzero(KERNEL)
    upright = whole_laplacian(tilted_kernel())
    points, values = turned(upright.points, upright.values, np.pi)
    expected = {tuple(point): tuple(value) for point, value in zip(-upright.points, upright.values, strict=True)}
    assert {tuple(point): tuple(value) for point, value in zip(points, values, strict=True)} == expected


@pytest.mark.parametrize("kernel", [KERNEL, tilted_kernel()], ids=["disc", "colours"])
def test_light_and_centroid_are_kept_exactly(kernel: np.ndarray) -> None:
    """By Green's second identity: charge and dipole 0, sum v (x^2 + y^2) / 4 the light, sum v x (x^2 + y^2) / 8 its centroid."""
    found = sparsify(kernel, QUICK)
    x, y = found.points.T.astype(np.float64)
    colours = kernel.reshape(*kernel.shape[:2], -1)
    rows, columns = np.indices(kernel.shape[:2]) - kernel.shape[0] // 2
    scale = np.abs(found.values).sum()
    for polynomial, light in (
        (np.ones_like(x), 0.0),
        (x, 0.0),
        (y, 0.0),
        (x * x - y * y, 0.0),
        (x * y, 0.0),
        (x**3 - 3 * x * y * y, 0.0),
        ((x * x + y * y) / 4, colours.sum((0, 1))),
        (x * (x * x + y * y) / 8, (colours * columns[..., None]).sum((0, 1))),
        (y * (x * x + y * y) / 8, (colours * rows[..., None]).sum((0, 1))),
    ):
        np.testing.assert_allclose(polynomial @ found.values, light, atol=1e-10 * scale * np.abs(polynomial).max())


def test_few_points_are_nearly_the_kernel_more_nearer_and_the_same_for_one_seed() -> None:
    """A tenth of the taps of a disc of 40 px, and an error of a tenth of its norm (measured: 0.090 and 0.105)."""
    found = sparsify(KERNEL, Sparsification(lloyd_steps=0, annealing_steps=0))
    assert len(found.points) < 0.1 * np.count_nonzero(KERNEL)
    assert relative_error(found) < 0.115
    errors = [relative_error(sparsify(KERNEL, Sparsification(annealing_steps=0, points_per_px=per_px))) for per_px in (0.5, 1.0, 2.0)]
    assert errors[0] > 1.5 * errors[1] > 1.5 * 1.5 * errors[2]
    one, same, other = (sparsify(KERNEL, replace(QUICK, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.points, same.points)
    np.testing.assert_array_equal(one.values, same.values)
    assert one.points.shape != other.points.shape or (one.points != other.points).any()
    small = Aperture.disc().rasterize(2.0).kernel
    np.testing.assert_array_equal(sparsify(small, Sparsification(points_per_px=10.0)).values, whole_laplacian(small).values)


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_line_becomes_few_points_too(rows: int, turn: int) -> None:
    """Its points lie in so few rows that y^3 is y or little else: moments that depend on others are kept with them.

    Few points are no good for a line (error: half its norm; renderers take its taps), but they are not wrong either.
    """
    kernel = np.zeros((241, 241), np.float32)
    middle = 120
    kernel[middle - (rows - 1) // 2 : middle + rows // 2 + 1, middle - 100 : middle + 101] = 1.0 / (201 * rows)
    kernel = np.rot90(kernel, turn).copy()
    found = sparsify(kernel, Sparsification(lloyd_steps=0, annealing_steps=0))
    x, y = found.points.T.astype(np.float64)
    scale = np.abs(found.values).sum()
    assert len(found.points) < 0.7 * len(whole_laplacian(kernel).points)
    for polynomial, light in ((x * 0 + 1, 0.0), (x, 0.0), (y, 0.0), ((x * x + y * y) / 4, 1.0)):
        assert polynomial @ found.values[:, 0] == pytest.approx(light, abs=1e-9 * scale * np.abs(polynomial).max())
    assert relative_error(found, kernel) < 0.6


def test_the_fit_and_annealing_beat_the_sums_of_the_paper() -> None:
    fitted = sparsify(KERNEL, QUICK)
    sums = sparsify(KERNEL, replace(QUICK, fit=False))
    np.testing.assert_array_equal(fitted.points, sums.points)
    assert relative_error(fitted) < 0.5 * relative_error(sums)
    assert sums.values.sum() == pytest.approx(0.0, abs=1e-12), "sums over cells keep the charge"
    lost = abs((sums.values[:, 0] * (sums.points.astype(float) ** 2).sum(axis=1)).sum() / 4 - 1.0)
    assert lost > 1e-3, "and not the light"
    plain, annealed = (sparsify(KERNEL, Sparsification(fit=False, annealing_steps=steps)) for steps in (0, 400))
    assert relative_error(annealed) < 0.95 * relative_error(plain)
    assert len(annealed.points) <= len(plain.points)


def test_the_outline_of_a_disc_is_its_circumference_and_odd_kernels_are_refused() -> None:
    """A slope of 1 px width is 1.04 to 1.1 times as long when it is measured by differences of neighbours; so is this one."""
    lengths = [outline_px(Aperture.disc().rasterize(size).kernel) / (np.pi * size) for size in (30.0, 60.0, 120.0)]
    assert min(lengths) > 1.0 and max(lengths) < 1.11
    for shape in ((4, 4), (5, 7)):
        with pytest.raises(InputError, match="square with an odd size"):
            sparsify(np.ones(shape))
    with pytest.raises(InputError, match="positive number of points"):
        Sparsification(points_per_px=0.0)


def test_the_values_are_the_best_for_their_points_and_those_of_the_whole_laplacian_itself() -> None:
    """Any change of values that keeps the ten moments makes the squared error larger."""
    found = sparsify(KERNEL, QUICK)
    x, y = found.points.T.astype(np.float64) / 20.0
    kept = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    change = np.random.default_rng(5).normal(size=len(x))
    change -= kept.T @ np.linalg.solve(kept @ kept.T, kept @ change)
    change *= 0.05 * np.linalg.norm(found.values) / np.linalg.norm(change)
    best = relative_error(found)
    for sign in (1.0, -1.0):
        assert relative_error(Spreadlet(found.points, found.values + sign * change[:, None])) > best
    xy = whole_laplacian(KERNEL).points.astype(np.int64)
    values = whole_laplacian(KERNEL).values
    radius = int(np.abs(xy).max())
    dense = np.zeros((2 * radius + 1, 2 * radius + 1, 1))
    dense[xy[:, 1] + radius, xy[:, 0] + radius] = values
    table = biharmonic_table(64)
    np.testing.assert_allclose(fitted_values(xy, xy, values, potential_of(dense, table), table), values, atol=1e-8 * np.abs(values).max())


def test_the_potential_is_the_sum_over_a_table_of_the_greens_function_of_the_squared_laplacian() -> None:
    charges = np.random.default_rng(6).normal(size=(9, 9, 1))
    table = biharmonic_table(16)
    plain = np.zeros_like(charges)
    for y, x in np.ndindex(9, 9):
        distances = table[np.abs(np.arange(9) - y)[:, None], np.abs(np.arange(9) - x)]
        plain[y, x, 0] = (distances * charges[..., 0]).sum()
    np.testing.assert_allclose(potential_of(charges, table), plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    # r^2 log r / (8 pi) and a quadratic that depends on where the border is: fitted to both at a few distances, it fits at others.
    table, r = biharmonic_table(64), np.arange(4, 41, dtype=np.float64)
    rest = table[0, 4:41] - r**2 * np.log(r) / (8 * np.pi)
    design = np.stack([np.ones_like(r), r**2, np.log(r), r**4], axis=1)
    coefficients = np.linalg.lstsq(design[::3], rest[::3], rcond=None)[0]
    np.testing.assert_allclose(design @ coefficients, rest, atol=2e-3)


@pytest.mark.parametrize("angle_rad", [0.3, -2.0])
def test_a_turned_spreadlet_keeps_light_and_centroid_and_shows_the_turned_kernel(angle_rad: float) -> None:
    kernel = Aperture.blades(5).rasterize(40.0).kernel
    upright = sparsify(kernel, Sparsification(lloyd_steps=0, annealing_steps=0))
    found = Spreadlet(*turned(upright.points, upright.values, angle_rad))
    x, y = found.points.T.astype(np.float64)
    for polynomial, light in ((x * 0 + 1, 0.0), (x, 0.0), (y, 0.0), ((x * x + y * y) / 4, 1.0)):
        assert polynomial @ found.values[:, 0] == pytest.approx(light, abs=1e-9)
    size = kernel.shape[0] + 60
    truth = embedded(Aperture.blades(5).rotated(angle_rad).rasterize(40.0).kernel, kernel.shape[0] + 60 + kernel.shape[0] % 2 - 1)
    error = np.linalg.norm(integrated(found, size)[: len(truth), : len(truth)] - truth) / np.linalg.norm(truth)
    assert error < 0.25


def test_darts_keep_their_distance_and_cells_keep_their_sums() -> None:
    rng = np.random.default_rng(7)
    xy = np.ascontiguousarray(np.argwhere(np.ones((30, 30), bool)))  # as `sparsify` has them, for which the kernels are compiled
    importance, radius_px = rng.uniform(0.5, 1.0, 900), np.full(900, 4.0)
    points = xy[throw_darts(xy, importance, radius_px, 10_000, 3)].astype(np.float64)
    apart = np.hypot(*(points[:, None] - points).transpose(2, 0, 1)) + 1e9 * np.eye(len(points))
    assert apart.min() >= 4.0 and len(points) > 30
    owner = np.empty(900, np.int64)
    nearest(points, xy, owner)
    np.testing.assert_array_equal(owner, np.argmin(((xy[:, None] - points) ** 2).sum(axis=2), axis=1))
    charges = rng.normal(size=(900, 2))
    expected = np.stack([np.bincount(owner, charges[:, c], len(points)) for c in range(2)], axis=1)
    np.testing.assert_allclose(cell_sums(points.astype(np.int64), xy, charges), expected, atol=1e-12)


def test_spreadlets_in_a_file(tmp_path: Path) -> None:
    kernels = (KERNEL, tilted_kernel()[..., :1])
    spreadlets = Spreadlets.joined([whole_laplacian(each) for each in kernels])
    path = tmp_path / "bank" / "spreadlets.npz"
    assert read_spreadlets(path, QUICK, fingerprint(kernels)) is None
    write_spreadlets(path, spreadlets, QUICK, fingerprint(kernels))
    found = read_spreadlets(path, QUICK, fingerprint(kernels))
    assert found is not None and len(found) == 2
    np.testing.assert_array_equal(found[1].points, whole_laplacian(kernels[1]).points)
    np.testing.assert_array_equal(found[1].values, whole_laplacian(kernels[1]).values)
    assert read_spreadlets(path, replace(QUICK, seed=9), fingerprint(kernels)) is None
    assert read_spreadlets(path, QUICK, fingerprint(kernels[::-1])) is None
    path.write_bytes(b"not a file of arrays")
    with pytest.raises(InputError, match="remove it"):
        read_spreadlets(path, QUICK, fingerprint(kernels))


def test_systems_are_solved_as_lapack_does() -> None:
    """Symmetric with a block of zeros, as those of points and moments are, and a singular one."""
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(70, 70))
    matrix += matrix.T
    matrix[60:, 60:] = 0.0
    right = rng.normal(size=(70, 3))
    found = right.copy()
    assert solve(matrix.copy(), found)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9)
    assert not solve(np.zeros((3, 3)), np.zeros((3, 1)))
