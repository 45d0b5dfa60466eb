"""mrbokeh.images.color: the table gives the codes of the plain formula, value by value."""

import numpy as np
import pytest

from mrbokeh.images.color import _table, plain_srgb_codes, srgb_codes

both = pytest.mark.parametrize("dtype", [np.uint8, np.uint16])


@both
def test_the_floats_around_every_step_are_coded_as_by_the_formula(dtype: type) -> None:
    steps = _table(np.dtype(dtype))[1][:-1]
    assert len(steps) == np.iinfo(dtype).max and (np.diff(steps) > 0).all()
    around = (steps.view(np.int32)[None, :, None] + np.arange(-2, 3, dtype=np.int32)).view(np.float32)
    found = srgb_codes(around, dtype)
    np.testing.assert_array_equal(found, plain_srgb_codes(around, dtype))
    np.testing.assert_array_equal(found[0, :, 2], np.arange(1, len(steps) + 1))


@both
def test_any_values_are_coded_as_by_the_formula(dtype: type) -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(0.3, 0.5, 30000), 10.0 ** rng.uniform(-9, 3, 29994), [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0]])
    rgb = values.astype(np.float32).reshape(100, 200, 3)
    np.testing.assert_array_equal(srgb_codes(rgb, dtype), plain_srgb_codes(rgb, dtype))
    np.testing.assert_array_equal(srgb_codes(rgb[:, ::2], dtype), plain_srgb_codes(rgb[:, ::2], dtype))
