"""The plane sweep by torch gives the costs of the compiled one."""

from collections.abc import Iterator

import numpy as np
import pytest

from mrbokeh.depth.views.dense_depth import DenseSettings, dense_depth
from mrbokeh.depth.views.plane_sweep import Matching, plane_sweep
from mrbokeh.depth.views.sweep_view import SweepView
from tests.depth.test_plane_sweep import turned_view
from tests.support.plane_sweep_scenes import card, traced, wall
from tests.support.refusals import refused

torch = pytest.importorskip("torch")

from mrbokeh.depth.views.torch_plane_sweep import plane_sweep_on  # noqa: E402
from tests.support.torch_device import NAME  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small pictures gain nothing from threads, which wait for one another where tests run side by side."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def assert_same_costs(reference: SweepView, neighbours: list[SweepView], planes: np.ndarray, **options: object) -> None:
    """Equal to a unit of 255, but for the few points at the very border of a neighbour, seen by one and not by the other."""
    ours = plane_sweep(reference, neighbours, planes, **options)  # type: ignore[arg-type]
    theirs = plane_sweep_on(NAME, reference, neighbours, planes, **options)  # type: ignore[arg-type]
    assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
    assert np.mean(np.abs(ours.astype(int) - theirs.astype(int)) > 1) < 1e-3
    assert 0 < ours.min() + 1 < ours.max()


def test_turned_and_distorted_views_and_a_shell_around_a_surface() -> None:
    neighbours = [turned_view(1, (0.03, 0.01), 0.1), turned_view(2, (0.0, 0.0), 0.2), turned_view(3, (-0.1, 0.0), 0.1, (24, 30))]
    assert_same_costs(turned_view(0, (0.05, -0.02), 0.1), neighbours, np.linspace(0.4, 2.0, 7), matching=Matching(2, 2, 0.01))
    scene = traced((wall(1.6, tilt=0.3), card(0.8, -0.1, 0.06)), noise=0.01)
    assert_same_costs(scene.views[0], scene.views[1:], np.array([-0.02, 0.0, 0.02]), base_dioptre=scene.dioptre)


def test_a_device_that_is_not_there_is_refused() -> None:
    view = turned_view(0, (0.0, 0.0), 0.1)
    refused("cuda:99", plane_sweep_on, "cuda:99", view, [view], np.array([1.0]))
    refused("neighbouring view", plane_sweep_on, "cpu", view, [], np.array([1.0]))


@pytest.mark.slow
def test_the_sweep_of_a_device_may_stand_in() -> None:
    """A cost may be rounded the other way, and where two planes are as good as one another the other may win."""
    scene = traced((wall(1.6, tilt=0.3), card(0.8, -0.1, 0.06)), noise=0.01)
    by_loops, by_torch = (
        dense_depth(scene.rgb[0], scene.views[0], scene.views[1:], (0.4, 1.5), settings=DenseSettings(most_planes=12, device=device))
        for device in (None, NAME)
    )
    assert np.mean(np.abs(by_torch.depth_m / by_loops.depth_m - 1.0) > 0.001) < 0.01
