"""The mixed-reality truth: the object lies where it should, both pictures differ by it alone, sets go on where they stopped."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from datasets_scripts.made_sets.truth_set import TruthPlan
from datasets_scripts.mixed_reality import (
    OBJECT_DISTANCES_M,
    main,
    mixed_reality,
    scene_around,
    virtual_object,
    with_object,
    without_shadows,
)
from datasets_scripts.scenes.truth_scenes import make_scene
from datasets_scripts.tracers.truth_scene import pack
from tests.support.card_scene import FOCUS_CARD, mixed_cards
from tests.support.mixed_reality_cases import traced_cases
from tests.support.refusals import refused
from tests.support.scalar_truth_tracer import require_mitsuba

virtual_objects = cache(virtual_object)
PLAN = TruthPlan(width_px=64, height_px=36, samples=4, scenes=("fence",), shapes=("disc",))


@pytest.mark.parametrize(("name", "seed"), [*zip(OBJECT_DISTANCES_M, (1, 2), strict=True)])
def test_the_object_lies_behind_all_near_things_and_before_the_rest(name: str, seed: int) -> None:
    """Of the rest, what lies in the picture counts; the ground reaches below it to the camera."""
    scene, virtual = scene_around(name, seed), virtual_objects(name, seed)
    depths_m = [body.vertices_m[:, 2] for body in virtual.bodies]
    nearest_m, farthest_m = min(each.min() for each in depths_m), max(each.max() for each in depths_m)
    assert max(body.vertices_m[:, 2].max() for body in scene.bodies if body.thin) < nearest_m
    seen = [body.vertices_m[np.abs(body.vertices_m[:, 1]) < 0.21 * body.vertices_m[:, 2]] for body in scene.bodies if not body.thin]
    assert min([*(each[:, 2].min() for each in seen if len(each)), *(lamp.centre_m[2] for lamp in scene.lamps)]) > farthest_m


def test_without_shadows_all_light_is_light_of_the_sky_on_one_object_for_a_seed() -> None:
    packed = pack(with_object(make_scene("fence", 1), virtual_objects("fence", 1)), PLAN.camera(0))
    flat = without_shadows(packed)
    assert not flat.facets[:, 6:9].any() and packed.facets[:, 6:9].any()
    np.testing.assert_allclose(flat.facets[:, 9:12], packed.facets[:, 6:9] + packed.facets[:, 9:12], rtol=1e-6)
    objects = (virtual_objects("fence", 1), virtual_object("fence", 1), virtual_object("fence", 2))
    first, again, other = (each.bodies[0].vertices_m for each in objects)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_cards_with_and_without_the_virtual_one() -> None:
    cards = mixed_cards(0, 96, 96)
    assert [card.name for card in cards.both.cards if card.name not in {each.name for each in cards.scene.cards}] == ["focus"]
    assert len(cards.scene.lamps) == sum(lamp.card != FOCUS_CARD for lamp in cards.both.lamps)
    names = {(cards.scene.cards[lamp.card].name, lamp.x_px) for lamp in cards.scene.lamps}
    assert names <= {(cards.both.cards[lamp.card].name, lamp.x_px) for lamp in cards.both.lamps}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A written set of one opening."""
    require_mitsuba()
    out = tmp_path_factory.mktemp("mixed")
    assert mixed_reality(out, PLAN) == 2 + 2 * 3
    return out


def test_a_complete_set_is_left_alone_and_other_settings_are_refused(folder: Path) -> None:
    view = folder / "fence_1" / "view_00"
    kept = (view / "object.exr").stat().st_mtime_ns
    (view / "both" / "disc_1.exr").unlink()
    assert mixed_reality(folder, PLAN) == 1 and mixed_reality(folder, PLAN) == 0
    assert (view / "object.exr").stat().st_mtime_ns == kept and (view / "sheet.png").is_file()
    refused("made with other settings", mixed_reality, folder, replace(PLAN, samples=8))


def test_where_the_object_does_not_reach_both_pictures_are_one(folder: Path) -> None:
    cases = list(traced_cases(folder))
    assert len(cases) == 3
    for case in cases:
        far = np.s_[:, :6]  # the object hangs in the middle of the frame
        np.testing.assert_allclose(case.truth[far], case.plate.rgb[far], atol=2e-3)
        assert np.abs(case.truth - case.plate.rgb).max() > 0.05
        assert 0.0 < case.virtual.alpha.mean() < 0.4 and np.isfinite(case.virtual.depth_m[case.virtual.alpha > 0]).all()


def test_the_command_says_what_it_cannot_do() -> None:
    require_mitsuba()
    app = typer.Typer()
    app.command()(main)
    found = CliRunner().invoke(app, ["nowhere", "--scenes", "checkers"])
    assert found.exit_code == 2 and "expected scenes out of fence,leaves, got checkers" in found.output
