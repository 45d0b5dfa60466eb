"""Objects between the blurred layers of a photograph against ray-traced truth: object alone, scene alone, both traced together.

The cards are traced by tests/support/card_tracer.py, which runs everywhere; what the sets of datasets_scripts/mixed_reality.py give
is in docs/compositing_results.md. The bounds are those of the project: 3 dB over the better of two simple ways on every picture,
40 dB on average.
"""

import numpy as np
import pytest

from mrbokeh.compositing.choose import insertion_of
from mrbokeh.images.image_metrics import psnr
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.support.mixed_reality_cases import card_cases, small_card_cases

RENDERER = PolygonDifferences()
GAIN_DB, MEAN_DB = 3.0, 40.0


@pytest.mark.parametrize("index", range(3), ids=["on leaves", "on the object", "on a fence behind"])
def test_between_is_far_nearer_the_truth_than_the_simple_ways(index: int) -> None:
    case = small_card_cases()[index]
    found = insertion_of("between").insert(case.plate, [case.virtual], RENDERER)
    simple_db = max(psnr(each.rgb, case.truth) for each in case.baselines(RENDERER).values())
    assert psnr(found.rgb, case.truth) > simple_db + GAIN_DB
    untouched = found.virtual.alpha == 0
    assert untouched.mean() > 0.3
    np.testing.assert_array_equal(found.rgb[untouched], case.plate.rgb[untouched])


def test_blurring_anew_comes_between_the_simple_ways_and_between() -> None:
    """On the object's own focus; elsewhere what lies hidden behind near things decides, which nobody knows."""
    case = small_card_cases()[1]
    found = {mode: psnr(insertion_of(mode).insert(case.plate, [case.virtual], RENDERER).rgb, case.truth) for mode in ("over", "rerender")}
    assert found["rerender"] > found["over"] + GAIN_DB


@pytest.mark.slow
def test_every_picture_and_the_mean_of_three_openings_and_three_focus_distances() -> None:
    found_db = []
    for case in card_cases(320, 214, ("disc", "blades7", "heart"), positions=400):
        found_db.append(psnr(insertion_of("between").insert(case.plate, [case.virtual], RENDERER).rgb, case.truth))
        assert found_db[-1] > max(psnr(each.rgb, case.truth) for each in case.baselines(RENDERER).values()) + GAIN_DB, case.name
    assert np.mean(found_db) > MEAN_DB
