"""How near the renderers come to scenes whose defocused truth is known: ray-traced ones and the card scene.

The bounds are those that this project set itself against what others reach on such scenes, of thin occluders / open ones: no
blur 18.6 / 20.0 dB, per-pixel gather 23.1 / 26.2, scatter without depth order 30.4 / 36.1; wanted are 31.5 / 37.0, and 33.0 from
two layers. On cards Blender's Defocus has 32.7 dB at a radius of 12 px (26.7 near edges) and 30.4 at 32 px (27.3), GEGL's
lens-blur 32.4 and 30.0.

How hard a scene is varies by 2 to 3 dB with its seed. The seeds of the shipped ones were chosen by these three baselines alone,
before any renderer had seen the candidates (but those of seed 2, which were shipped before): of fence and leaves 1 to 4 and
checkers 1 to 12, at 320x180 px and 512 samples, those whose baselines lie nearest to the numbers above, by the root mean square
of the three differences. Thin: fence_3 (0.30 dB), then fence_4 (0.47). Open: checkers_4 (1.06) and checkers_3 (1.08), all but
equal, though from RGB + depth polygon has 37.0 dB in the one and 35.7 in the other. Over all candidates scatter without order
has 30.0 / 35.0 dB on average and polygon 31.8 / 36.5, and 34.8 from two layers. Scatter without order knows no cat-eye here; one
that does has 31.6 / 36.6 dB on the shipped scenes, and by its numbers fence_4 and checkers_3 would be nearest (31.7 / 35.7).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.renderers.choose import make_renderer
from tests.bench.fidelity_baselines import BASELINES
from tests.support.fidelity_cases import Case, card_cases, truth_cases

TRUTH = Path(__file__).parents[1] / "data" / "truth"
FAST = ("polygon", "low-rank")
ON_TRACED = ("polygon", pytest.param("low-rank", marks=pytest.mark.slow))


@pytest.fixture(scope="module", name="traced")
def fixture_traced() -> list[Case]:
    return list(truth_cases(TRUTH))


@pytest.fixture(scope="module", name="baselines")
def fixture_baselines(traced: list[Case]) -> dict[str, list[dict[str, float]]]:
    """What each of them reaches, case by case."""
    return {name: [case.measure(blur(case.picture, case.lens)) for case in traced] for name, blur in BASELINES.items()}


@pytest.fixture(scope="module", name="plain")
def fixture_plain(baselines: dict[str, list[dict[str, float]]]) -> list[dict[str, float]]:
    return baselines["scatter without order"]


def mean(cases: list[Case], measures: list[dict[str, float]], what: str, **of: str) -> float:
    """Over the cases of a group or a shape."""
    return float(
        np.nanmean([each[what] for case, each in zip(cases, measures, strict=True) if all(getattr(case, k) == v for k, v in of.items())])
    )


@pytest.mark.slow
def test_the_shipped_truth_is_what_it_should_be(traced: list[Case], baselines: dict[str, list[dict[str, float]]]) -> None:
    """Two scenes, five apertures, three focus distances, about as hard as the scenes that the bounds were measured on; less
    than 0.5 dB easier for scatter without order, from which the bounds were drawn."""
    assert {case.group for case in traced} == {"thin", "open"}
    assert len({case.shape for case in traced}) == 5 and len(traced) == 30
    for group, measured_db, far_db in (("thin", (18.6, 23.1, 30.4), 0.4), ("open", (20.0, 26.2, 36.1), 1.1)):
        here_db = np.array([mean(traced, reached, "frame", group=group) for reached in baselines.values()])
        assert np.sqrt(np.mean((here_db - measured_db) ** 2)) < far_db
        assert here_db[-1] < measured_db[-1] + 0.5


@pytest.mark.parametrize("method", ON_TRACED)
@pytest.mark.slow
def test_traced_scenes_from_a_picture_with_depth(traced: list[Case], plain: list[dict[str, float]], method: str) -> None:
    """32.7 and 37.0 dB, 2.0 and 1.4 dB over scatter without order (discs at 640 px: 32.9 and 38.4). With a cat-eye it is 5 dB, because
    that one does not know it; so each shape alone must gain, over the frame and around lights, where errors of kernels show."""
    renderer = make_renderer(method)
    reached = [case.measure(renderer.render([case.picture], case.lens).rgb) for case in traced]
    for group, frame, over_plain in (("thin", 31.5, 1.7), ("open", 37.0, 1.2)):
        assert mean(traced, reached, "frame", group=group) > frame
        assert mean(traced, reached, "frame", group=group) > mean(traced, plain, "frame", group=group) + over_plain
    for shape in sorted({case.shape for case in traced}):
        assert mean(traced, reached, "frame", shape=shape, group="thin") > mean(traced, plain, "frame", shape=shape, group="thin") + 0.8
        assert mean(traced, reached, "frame", shape=shape, group="open") > mean(traced, plain, "frame", shape=shape, group="open") + 0.3
        assert mean(traced, reached, "lights", shape=shape) > mean(traced, plain, "lights", shape=shape) + 0.5, shape


@pytest.mark.parametrize("method", ON_TRACED)
def test_traced_scenes_from_two_layers(traced: list[Case], method: str) -> None:
    """35.9 dB over all cases; every fifth is blurred here."""
    renderer = make_renderer(method)
    layered = [case for case in traced if case.layers][::5]
    reached = [case.measure(renderer.render(case.layers, case.lens).rgb) for case in layered]
    assert mean(layered, reached, "frame") > 33.0


def cards(seeds: list[int], radius_px: int) -> Iterator[Case]:
    return (case for case in card_cases(seeds, None) if case.group == f"cards {radius_px} px")


def check_cards(cases: list[Case], method: str, *wanted_db: tuple[float, float]) -> None:
    """(frame, edges) in dB that must be reached on average from the picture, from the picture with all cards behind it and from the
    cards alone. The light: within 0.5 % in every scene where the cards are known, on average and within 0.6 % where they are not.

    Measured at worst, at 32 px: 0.52 % from the picture, 0.25 % with the cards behind it, 0.18 % from the cards. What is more than
    0.25 % is not the method's, then: in seed 1 the wall behind the leaves is darker than beside them, which no picture tells.
    """
    renderer = make_renderer(method)
    for kind, (frame, edges) in enumerate(wanted_db):
        inputs = [([case.picture], [case.picture, *case.layers], case.layers)[kind] for case in cases]
        reached = [case.measure(renderer.render(layers, case.lens).rgb) for case, layers in zip(cases, inputs, strict=True)]
        energy = np.array([each["energy"] for each in reached])
        assert np.mean([each["frame"] for each in reached]) > frame
        assert np.mean([each["edges"] for each in reached]) > edges
        assert energy.mean() == pytest.approx(1.0, abs=0.005)
        assert np.abs(energy - 1.0).max() < (0.006 if kind == 0 else 0.005)


@pytest.mark.slow
def test_cards_blurred_by_12_px() -> None:
    """37.4 / 32.5, 39.4 / 34.8 and 39.2 / 35.4 dB."""
    cases = [next(cards([0], 12))]
    for method in FAST:
        check_cards(cases, method, (36.5, 31.5), (38.0, 33.0), (38.0, 34.0))


@pytest.mark.slow
def test_cards_blurred_by_32_px() -> None:
    """34.0 / 30.8, 35.5 / 32.5 and 36.0 / 33.8 dB."""
    cases = list(cards([0, 1], 32))
    for method in FAST:
        check_cards(cases, method, (33.5, 30.3), (34.8, 31.8), (35.0, 32.5))
