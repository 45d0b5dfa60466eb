"""The studio over a focal stack: one slice at a time, chosen by a slider or by what is to be in focus; preview, loupe and command agree."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.images.color import srgb_codes
from mrbokeh.system.errors import InputError
from tests.support.card_stack import CARD_PX, SIZE, make_card_stack
from tests.support.command_line import mrbokeh
from tests.support.made_studio import ALIEN, made_studio
from viewfinder.studio.command_line import options_of, words_of
from viewfinder.studio.loupe import Region, WholePhotograph, region_of
from viewfinder.studio.photograph import open_photograph, placed
from viewfinder.studio.preview import preview_of
from viewfinder.studio.project import read_project
from viewfinder.studio.running import StudioOptions, project_of
from viewfinder.studio.state import StudioState


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A card in front of a wall, focused at three distances: the card, between, the wall."""
    return make_card_stack(tmp_path_factory.mktemp("stacks") / "card", 0).folder


def state_of_slice(folder: Path, number: int) -> StudioState:
    """The alien behind the card's edge, before the wall."""
    state = StudioState(photo=folder, slice=number, object=ALIEN, at_px=(38.0, 40.0), height="30px", pitch_deg=0.0)
    return placed(state, open_photograph(folder, None, number)[0])


@pytest.mark.parametrize("number", [0, 2])
def test_each_slice_is_the_picture_of_its_command_line(folder: Path, tmp_path: Path, number: int) -> None:
    state, out = state_of_slice(folder, number), tmp_path / "out.png"
    options = options_of(state)
    words = words_of(options, out)
    assert words[words.index("--slice") + 1] == str(number)
    done = mrbokeh(*words)
    assert done.returncode == 0, done.stderr
    (opened, _rgb), kept = open_photograph(folder, None, number), KeptParts()
    preview = preview_of(opened, options, kept)
    stored = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(srgb_codes(preview.rgb, np.uint16), stored)
    changed = np.abs(preview.rgb - open_plate(folder, number).rgb).max(axis=2) > 0.02
    assert changed[:, CARD_PX + 3 :].sum() > 50
    if number == 0:
        assert not changed[:, : CARD_PX - 3].any(), "the card is sharp and hides it"
    kept.holds_light = True
    shown = region_of(WholePhotograph(opened), options, kept, Region(36.0, 24.0, 24))
    # Rims are moved by what a part shows, which differs from the whole in a few pixels at the card's edge, and nowhere else.
    off = np.abs(shown - preview.rgb[12:36, 24:48]).max(axis=2)
    at_rim = np.abs(np.arange(24, 48) - CARD_PX + 0.5) < 4.0
    assert off.mean() < 0.002 and off[:, ~at_rim].max() < 0.02
    assert (off > 0.04).sum() <= 3 and off.max() < 0.06


def test_the_object_is_blurred_as_its_surroundings_in_every_slice(folder: Path) -> None:
    blurs = []
    for number in range(3):
        opened, _rgb = open_photograph(folder, None, number)
        blurs.append(preview_of(opened, options_of(state_of_slice(folder, number)), KeptParts()).told["coc_px"][1])
    assert blurs[0] > 1.2 * blurs[1] > 2.0 * blurs[2]


async def test_a_click_chooses_the_slice_that_is_in_focus_there(folder: Path, tmp_path: Path) -> None:
    async with made_studio(tmp_path, StudioState(photo=folder, object=ALIEN)) as made:
        desk = made.desk
        while desk.photograph is None or desk.busy:
            await desk.news_after(desk.number, 1.0)
        assert desk.photograph.stack is not None and desk.state.slice == desk.photograph.stack.reference, "the reference at first"
        for x_px, number in ((10.0, 0), (60.0, 2)):
            await desk.change({"focus_at_px": [x_px, 24.0]})
            assert desk.state.slice == number and desk.state.focus_at_px is None and desk.photograph.slice == number
        await desk.change({"slice": 1})
        assert desk.photograph.slice == 1
        np.testing.assert_array_equal(desk.photograph.plate.rgb, open_plate(folder, 1).rgb)
        await desk.step(-1)
        while desk.photograph is None or desk.busy:
            await desk.news_after(desk.number, 1.0)
        assert desk.photograph.slice == desk.state.slice == 2
        assert read_project(desk.project.path).state.photo == folder


def test_a_stack_is_opened_by_its_folder_and_states_its_lens(folder: Path, tmp_path: Path) -> None:
    project = project_of(StudioOptions(folder, (ALIEN,), pictures=tmp_path))
    assert project.state.photo == folder and project.path == tmp_path / "card.studio.json"
    opened, rgb = open_photograph(folder)
    assert opened.size_px == SIZE[::-1] and rgb.shape == (*SIZE, 3) and opened.has_depth
    stated = StudioState(photo=folder, slice=0, object=ALIEN, at_px=(38.0, 40.0), f_number=2.0)
    with pytest.raises(InputError, match="states its lens itself"):
        opened.plate_for(options_of(stated), 1e6)
    with pytest.raises(InputError, match="focal stack of 3 slices"):
        open_photograph(folder, None, 7)
    with pytest.raises(InputError, match="no merged focal stack"):
        open_photograph(tmp_path)
