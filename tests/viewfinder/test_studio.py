"""The studio: a state, its command line and its preview are one picture; what is refused, kept and shared between pages."""

import asyncio
import io
import json
import os
import shlex
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import aiohttp
import cv2
import numpy as np
import pytest
from typer.main import get_command

from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.commands.composite import app as composite
from mrbokeh.images.color import srgb_codes
from mrbokeh.images.image_io import write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.optics.lens_library import FOLDER as LIBRARY
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.solving.solved_camera import HIGH, LOW, SOLVED, SolvedCamera
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh
from tests.support.made_studio import ALIEN, CAKE, HEIGHT, WIDTH, made_studio, write_floor
from tests.support.refusals import refused
from tests.support.renderer_banks import bank_folder
from tests.support.waiting import comes_true, wait_until
from viewfinder.studio import desk as desks
from viewfinder.studio import photograph
from viewfinder.studio.command_line import command_line, options_of, words_of
from viewfinder.studio.loupe import Region, WholePhotograph, region_of
from viewfinder.studio.photograph import MOST_PX, OpenedPhotograph, open_photograph, placed, shrunk
from viewfinder.studio.preview import Previewer, Wish, preview_of
from viewfinder.studio.project import Project, read_project
from viewfinder.studio.running import StudioOptions, project_of
from viewfinder.studio.site import bokeh_svg
from viewfinder.studio.state import StudioState, state_of

AT_PX = (120.0, 140.0)
PLACED = {"object": str(CAKE), "at_px": AT_PX}


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return write_floor(tmp_path / "a floor.png")


def whole_state(photo: Path, **more: Any) -> StudioState:
    """Without a shadow, half of a picture's time, unless one is asked for."""
    first = {
        "photo": str(photo),
        "object": str(CAKE),
        "at_px": AT_PX,
        "height": "0.4",
        "camera_height_m": 1.2,
        "pitch_deg": 3.0,
        "shadow": 0,
    }
    return state_of(first | {"pitch_deg": 3.0, "shadow": 0} | more)


STATES: list[dict[str, Any]] = [
    {},
    {"turn_deg": -33.3, "sun_deg": [-60, 40], "shadow": 0.5, "exposure": 1.3, "warmth_k": 9000, "roll_deg": 4},
    {"before": [{"object": str(ALIEN), "at_px": [60, 150], "height": "0.3", "turn_deg": 20}], "turn_deg": 5, "shadow": 1},
    {"height": "60px", "f_number": 2.8, "focus_m": 6.25, "focal_length_mm": 35, "sensor_width_mm": 23.5, "matched": False},
]


@pytest.mark.parametrize("changes", STATES)
def test_the_command_line_of_a_state_says_its_options(photo: Path, changes: dict[str, Any]) -> None:
    """The command's own parser reads back each value; what a state leaves open is left out."""
    options = options_of(whole_state(photo, **changes))
    words = words_of(options, Path("out.png"))
    parsed = get_command(composite).make_context("composite", list(words[1:])).params
    groups = [getattr(options, each.name) for each in fields(options) if each.name != "photo"]
    wanted = {each.name: getattr(group, each.name) for group in groups for each in fields(group)}

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(each) for each in value] or None
        return value.absolute() if isinstance(value, Path) else value or None

    assert {name: plain(parsed[name]) for name in wanted} == {name: plain(value) for name, value in wanted.items()}
    assert parsed["photo"] == photo and parsed["out"] == Path("out.png")
    assert "--mode" not in words and command_line(options, Path("out.png")).startswith("mrbokeh composite '")


@pytest.mark.parametrize("changes", [pytest.param(each, marks=() if each in STATES[::2] else pytest.mark.slow) for each in STATES])
def test_the_preview_of_a_small_photograph_is_the_picture_of_its_command_line(photo: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    options = options_of(whole_state(photo, **changes))
    out = tmp_path / "out.png"
    done = mrbokeh(*words_of(options, out))
    assert done.returncode == 0, done.stderr
    opened, _rgb = open_photograph(photo)
    kept = KeptParts()
    kept.draft = True
    draft = preview_of(opened, options, kept, 1e4)
    kept.draft = False
    preview = preview_of(opened, options, kept)
    stored = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(srgb_codes(preview.rgb, np.uint16), stored)
    assert draft.rgb.shape == (87, 115, 3), "10000 px of 4:3"
    left, top, right, bottom = preview.told["boxes"][-1]
    assert left < AT_PX[0] / WIDTH < right and top < AT_PX[1] / HEIGHT < bottom
    np.testing.assert_allclose(draft.told["boxes"][-1], preview.told["boxes"][-1], atol=0.03)


def test_a_smaller_preview_shows_the_same_place_and_size(photo: Path) -> None:
    """All that counts pixels is made smaller with the photograph: a third of the width gives the same shares."""
    opened, _rgb = open_photograph(photo)
    options = options_of(whole_state(photo, height="60px"))
    boxes = [preview_of(opened, options, KeptParts(), most_px).told["boxes"][-1] for most_px in (MOST_PX, WIDTH * HEIGHT / 9)]
    np.testing.assert_allclose(boxes[1], boxes[0], atol=1.5 / (WIDTH / 3))


def test_the_loupe_shows_the_finished_picture_pixel_by_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a photograph larger than its preview, 600 by 450 px; grain would differ. Beyond the frame it is black."""
    monkeypatch.setattr(photograph, "MOST_PX", 2.5e5)
    photo = write_floor(tmp_path / "large.png", 600, 450)
    options = options_of(whole_state(photo, at_px=(300, 350), f_number=1.4, focus_m=2.0, matched=False, warmth_k=9000.0, shadow=1.0))
    opened, _rgb = open_photograph(photo)
    kept = KeptParts()
    kept.small = True
    preview = preview_of(opened, options, kept)
    assert preview.rgb.shape[0] == opened.plate.rgb.shape[0] < 450
    kept.holds_light = True
    side_px, blur_px = 120, preview.told["coc_px"][1]
    shown = region_of(WholePhotograph(opened), options, kept, Region(300.0, 350.0, side_px, blur_px))
    beside = region_of(WholePhotograph(opened), options, kept, Region(0.0, 0.0, side_px, blur_px))
    assert mrbokeh(*words_of(options, tmp_path / "out.png")).returncode == 0
    stored = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)[290:410, 240:360, ::-1]
    # In codes of 8 bits: the light on the ground is interpolated between other points, and the light is that of the smaller photograph.
    apart = np.abs(srgb_codes(shown, np.uint16).astype(int) - stored) / 257
    assert apart.mean() < 0.3 and apart.max() < 25
    assert (beside[:60] == 0.0).all() and (beside[60:, 60:] > 0.0).all()


def test_metres_follow_from_the_first_place_and_then_stay(photo: Path) -> None:
    """A quarter of the picture's height at first; farther away, at half the distance below the horizon, it looks half as high."""
    opened, _rgb = open_photograph(photo)
    first = placed(state_of({"photo": str(photo), "object": str(CAKE), "at_px": [120, 170], "pitch_deg": 0.0}), opened)
    assert first.camera_height_m == 1.5 and first.height is not None
    farther = replace(first, at_px=(120.0, 130.0))
    assert placed(farther, opened) == farther
    tops = [preview_of(opened, options_of(each), KeptParts()).told["boxes"][0] for each in (first, farther)]
    high = [(box[3] - box[1]) * HEIGHT for box in tops]
    # The box also holds the base's depth, which perspective shows.
    assert 0.8 * HEIGHT / 4 < high[0] < 1.7 * HEIGHT / 4 and high[1] == pytest.approx(high[0] / 2, rel=0.15)


async def test_a_camera_from_lines_is_taken_where_nobody_chose_one(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turned by 2 degrees and looking down by 10: the command line names its file, and makes the preview's picture."""
    turned = looking_down(np.radians(10.0), np.radians(2.0)).T
    found = SolvedCamera(WIDTH, HEIGHT, 240.0, SOLVED, camera_from_world=turned, confidence=HIGH)
    monkeypatch.setattr(photograph, "solved", lambda _: found)
    async with made_studio(tmp_path, StudioState(photo=photo, object=CAKE)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        camera = made.desk.state.camera
        assert camera is not None and camera.is_file()
        _, told = await asked(one, made.url + "state", {"changes": {"at_px": AT_PX}})
        assert told["photo"]["pitch_deg"] == pytest.approx(10.0) and told["photo"]["focal_px"] == pytest.approx(240.0)
        assert str(camera) in shlex.split(told["command"]) and "--pitch" not in told["command"]
        state, opened = made.desk.state, made.desk.photograph
        assert opened is not None
        preview = preview_of(opened, options_of(state), KeptParts())
        assert mrbokeh(*words_of(options_of(state), tmp_path / "out.png")).returncode == 0
        np.testing.assert_array_equal(
            srgb_codes(preview.rgb, np.uint16), cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
        )
        _, told = await asked(one, made.url + "state", {"changes": {"pitch_deg": 4.0}})
        assert told["photo"]["pitch_deg"] == pytest.approx(4.0) and "--pitch 4 " in told["command"]
    monkeypatch.setattr(photograph, "solved", lambda _: replace(found, confidence=LOW))
    async with made_studio(tmp_path, StudioState(photo=photo, object=CAKE)) as made:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        assert made.desk.state.camera is None, "a doubtful one is offered only"


def test_what_nobody_told_is_in_the_command_line_too(photo: Path, tmp_path: Path) -> None:
    """So that it makes the preview's picture without looking at lines again."""
    opened, _rgb = open_photograph(photo)
    state = placed(state_of({"photo": str(photo), "object": str(CAKE), "at_px": [100, 105]}), opened)
    # 15 px below the middle of 180 the ground is 4.6 degrees below a level camera of 28 mm (187 px): 10 are usual.
    assert (
        state.pitch_deg is not None
        and state.pitch_deg == pytest.approx(10.0 - 4.6, abs=0.1)
        and state.camera_height_m == pytest.approx(1.5, rel=0.01)
    )
    preview = preview_of(opened, options_of(state), KeptParts())
    assert mrbokeh(*words_of(options_of(state), tmp_path / "out.png")).returncode == 0
    stored = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(srgb_codes(preview.rgb, np.uint16), stored)


@pytest.mark.parametrize(
    ("document", "why"),
    [
        ([1], "object of names"),
        ({"colour": 1}, "has no 'colour'"),
        ({"turn_deg": "3"}, "turn_deg to be a number"),
        ({"turn_deg": True}, "turn_deg to be a number"),
        ({"f_number": float("nan")}, "f_number to be a number"),
        ({"f_number": 0}, "from 0.1 to 1000"),
        ({"at_px": [1]}, "two numbers"),
        ({"at_px": [1, None]}, r"at_px\[1\]"),
        ({"height": "-2"}, "metres above 0"),
        ({"height": "tall"}, "120px"),
        ({"plain": 1}, "true or false"),
        ({"photo": 7}, "name of a file"),
        ({"sun_deg": [0, 0]}, r"sun_deg\[1\]"),
        ({"sun_deg": [0, 40], "plain": True}, "leave one"),
        ({"focus_m": 1, "focus_at_px": [1, 1]}, "leave one"),
    ],
)
def test_states_that_cannot_be_meant_are_refused(document: Any, why: str) -> None:
    refused(why, state_of, document)


def test_what_is_missing_is_asked_for(photo: Path) -> None:
    refused("no photograph yet", options_of, StudioState())
    refused("no object yet", options_of, StudioState(photo=photo))
    refused("no place yet", options_of, StudioState(photo=photo, object=CAKE))


def test_of_each_page_only_the_newest_picture_is_made(photo: Path) -> None:
    opened, _rgb = open_photograph(photo)
    options = options_of(whole_state(photo))
    previewer = Previewer()
    try:
        first = previewer.ask("one", Wish(opened, options, MOST_PX, draft=False))
        wait_until(lambda: not previewer._waiting)
        rest = [previewer.ask("one", Wish(opened, options, MOST_PX, draft=False)) for _ in range(3)]
        other = previewer.ask("two", Wish(opened, options, 1e4, draft=True))
        answers = [each.result(60) for each in rest]
        assert answers[:-1] == [None, None] and answers[-1] is not None and first.result(1) is not None
        told, jpeg = other.result(60)  # type: ignore[misc]
        assert told["draft"] and jpeg[:2] == b"\xff\xd8"
        bad = previewer.ask("one", Wish(opened, replace(options, standing=replace(options.standing, at_pixel=["9,3"])), 1e4, draft=True))
        with pytest.raises(InputError, match="horizon"):
            bad.result(60)
    finally:
        previewer.close()


def test_a_project_keeps_the_history_and_is_moved_with_its_folder(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = Project(tmp_path / "kept.json", objects=[CAKE])
    state = whole_state(photo)
    project.add(state)
    project.add(replace(state, turn_deg=20.0))
    project.step(-1)
    project.write()
    read = read_project(project.path)
    assert [each.turn_deg for each in read.history] == [0.0, 0.0, 20.0] and read.place == 1
    read.step(1)
    refused("nothing to redo", read.step, 1)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in (photo.name, "kept.json"):
        (tmp_path / name).rename(moved / name)
    monkeypatch.chdir(moved)
    assert read_project(moved / "kept.json").state.photo == Path(photo.name)
    (moved / photo.name).unlink()
    refused("not there any more", read_project, moved / "kept.json")


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "mrbokeh studio", "version": 1, "states": [], "place": 0}', '{"format": "lens"}'])
def test_files_that_are_no_projects_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    refused("expected a project file", project_of, StudioOptions(tmp_path / "x.json"))


def test_options_of_the_command_are_checked_before_anything_listens(photo: Path, tmp_path: Path) -> None:
    for words, why in (
        (["gone.jpg"], "no such file"),
        ([tmp_path], "without a merged focal stack"),
        ([photo, "--object", "gone.glb"], "GLB file"),
        ([photo, "--object", photo], "to be a .glb file"),
        ([photo, "--lens", photo], "lens file"),
        ([photo, "--depth", "gone.exr"], "depth of the photograph"),
        ([photo, "--interface", "eth0"], "--lan"),
        ([photo, "--pictures", photo], "is a file"),
    ):
        done = mrbokeh("studio", *words)
        assert done.returncode == 2 and why in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
    write_lens(tmp_path / "lens.json", Lens(35.0, 2.8, 1.0, 23.5))
    lenses = (tmp_path / "lens.json", bank_folder(tmp_path / "bank", Lens(35.0, 2.8, 1.0, 23.5)))
    project = project_of(StudioOptions(photo, (CAKE,), lenses=(*lenses, Path("biotar-58")), pictures=tmp_path))
    assert project.state == StudioState(photo=photo, object=CAKE) and project.lenses == [*lenses, LIBRARY / "biotar-58.json"]
    assert len(project.history) == 1, "there is nothing to undo yet"
    assert project.path == tmp_path / "a floor.studio.json"
    project.add(replace(project.state, lens=lenses[1]))
    project.write()
    again = read_project(project.path)
    assert again.state.lens == lenses[1] and again.lenses[:2] == [*lenses] and "path" in bokeh_svg(lenses[1])
    assert '"library:biotar-58"' in project.path.read_text(encoding="utf-8")
    (tmp_path / "biotar-58").mkdir()
    assert read_project(project.path).lenses[2] == LIBRARY / "biotar-58.json", "a folder of that name beside the project is another thing"


async def asked(session: aiohttp.ClientSession, url: str, message: Any = None) -> tuple[int, Any]:
    """Answer of a GET, or of a POST with a message."""
    kind = "GET" if message is None else "POST"
    async with session.request(kind, url, json=message) as answer:
        return answer.status, await answer.json()


async def test_pages_see_each_others_changes_and_undo_them(photo: Path, tmp_path: Path) -> None:
    """The newest state wins; the other page's is one step back."""
    async with made_studio(tmp_path, StudioState(photo=photo, object=CAKE)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        _, told = await asked(one, made.url + "state")
        assert told["photo"]["width_px"] == WIDTH and told["command"] is None
        waiting = asyncio.create_task(asked(one, f"{made.url}state?after={told['number']}"))
        await asyncio.sleep(0.05)
        assert not waiting.done()
        status, answer = await asked(one, made.url + "state", {"changes": {"at_px": AT_PX}})
        assert status == 200 and answer["state"]["camera_height_m"] == 1.5 and answer["state"]["height"] is not None
        assert "--at-pixel 120,140 " in answer["command"]
        assert (await waiting)[1]["state"]["at_px"] == [120.0, 140.0]
        await asked(one, made.url + "state", {"changes": {"turn_deg": 20}})
        _, back = await asked(one, made.url + "history", {"step": -1})
        assert back["state"]["turn_deg"] == 0.0 and back["state"]["at_px"] == [120.0, 140.0] and back["can_redo"]
        _, again = await asked(one, made.url + "history", {"step": 1})
        assert again["state"]["turn_deg"] == 20.0 and not again["can_redo"]
        assert read_project(made.desk.project.path).state.turn_deg == 20.0, "kept at once"


async def test_what_a_page_may_not_ask_for_is_refused_in_a_sentence(photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with made_studio(tmp_path, StudioState(photo=photo)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        for path, message, why in (
            ("state", {"changes": {"turn_deg": "much"}}, "turn_deg to be a number"),
            ("state", {"changes": {"object": "/etc/passwd"}}, "may choose only"),
            ("state", {"changes": {"photo": "/etc/passwd"}}, "may choose only"),
            ("state", ["changes"], "message in JSON"),
            ("state", {}, "changes of the state"),
            ("history", {"step": 5}, "step of -1 or 1"),
            ("history", {"step": -1}, "nothing to undo"),
            ("save", {"format": "png"}, "no object yet"),
            ("cancel", {"number": 9}, "no picture number 9"),
            ("preview", {"page": "p", "pixels": 1e5}, "no object yet"),
            ("preview", {"page": "../", "pixels": 1e5}, "the page that asks"),
            ("preview", {"page": "p", "pixels": "many"}, "how many pixels"),
            ("preview", {"page": "p", "pixels": 1e5, "changes": PLACED, "region": [1, 2]}, "region of a loupe"),
        ):
            status, answer = await asked(one, made.url + path, message)
            assert status == 400 and why in answer["error"], (path, answer)
        assert (await asked(one, made.url + "saved/1"))[0] == 400 and (await asked(one, made.url + "lens/7"))[0] == 400

        async def upload(kind: str, name: str, body: bytes) -> str:
            async with one.post(made.url + "upload", params={"kind": kind, "name": name}, data=io.BytesIO(body)) as answer:
                return str((await answer.json()).get("error"))

        assert "no GLB file" in await upload("object", "cake.obj", b"v 0 0 0")
        assert "does not begin with glTF" in await upload("object", "cake.glb", b"v 0 0 0")
        assert "not a readable glTF" in await upload("object", "cake.glb", CAKE.read_bytes()[:200])
        assert "empty" in await upload("object", "cake.glb", b"")
        assert (await upload("photo", "holiday.jpg", b"no picture")) != "None"
        assert "photo, object" in await upload("script", "x.sh", b"rm")
        monkeypatch.setitem(desks.LARGEST, "object", 1 << 20)
        assert "larger than the 1 MB" in await upload("object", "cake.glb", b"glTF" + bytes(2 << 20))
        assert list((tmp_path / "studio_files").glob("*[!n]")) == [] and made.desk.state.object is None


async def test_dropped_files_become_the_photograph_and_the_object(tmp_path: Path) -> None:
    async with made_studio(tmp_path) as made, aiohttp.ClientSession() as one:
        floor = write_floor(tmp_path / "f.png").read_bytes()
        for kind, name, body in (("object", "../My cake!.glb", ALIEN.read_bytes()), ("photo", "floor.png", floor)):
            async with one.post(made.url + "upload", params={"kind": kind, "name": name}, data=io.BytesIO(body)) as answer:
                assert answer.status == 200, await answer.text()
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        files = tmp_path / "studio_files"
        assert made.desk.state.photo == files / "floor.png" and made.desk.state.object == files / "My_cake_.glb"
        assert files / "My_cake_.glb" in made.desk.project.objects
        async with one.get(made.url + "photo") as answer:
            shown = cv2.imdecode(np.frombuffer(await answer.read(), np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape == (HEIGHT, WIDTH, 3)


async def test_previews_come_with_what_is_told_of_them(photo: Path, tmp_path: Path) -> None:
    async with made_studio(tmp_path, whole_state(photo)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None)
        message = {"page": "p1", "pixels": 1e6, "changes": {"turn_deg": 10}}
        async with one.post(made.url + "preview", json=message) as answer:
            body = await answer.read()
        (length,) = struct.unpack_from(">I", body)
        told = json.loads(body[4 : 4 + length])
        assert "--turn 10" in told["command"] and told["guessed"] and told["size_px"] == [WIDTH, HEIGHT]
        assert made.desk.state.turn_deg == 0.0, "asked for, not kept"


@pytest.mark.parametrize(("kind", "suffix"), [("png", ".png"), pytest.param("exr", ".exr", marks=pytest.mark.slow)])
async def test_a_saved_picture_is_that_of_the_command_line_bit_for_bit(photo: Path, tmp_path: Path, kind: str, suffix: str) -> None:
    """As a process of its own makes it, in each format; a second one gets another name; one is cancelled and leaves nothing."""
    async with made_studio(tmp_path, whole_state(photo)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        _, told = await asked(one, made.url + "save", {"format": kind})
        save = told["saves"][0]
        await comes_true(lambda: made.desk.saves.told()[0]["state"] != "running", 60.0)
        assert made.desk.saves.told()[0]["state"] == "done", made.desk.saves.told()
        async with one.get(f"{made.url}saved/{save['number']}") as answer:
            saved = await answer.read()
        own = tmp_path / f"own{suffix}"
        assert mrbokeh(*words_of(options_of(made.desk.state), own)).returncode == 0
        assert saved == own.read_bytes() == Path(save["path"]).read_bytes() and f"_mrbokeh{suffix}" in save["command"]
        await asked(one, made.url + "save", {"format": kind})
        _, told = await asked(one, made.url + "cancel", {"number": 2})
        await comes_true(lambda: not made.desk.saves._tasks)
        assert told["saves"][0]["name"] == f"a floor_mrbokeh_2{suffix}" and made.desk.saves.told()[0]["state"] == "cancelled"
        assert not (tmp_path / f"a floor_mrbokeh_2{suffix}").exists()


def test_a_studio_that_was_killed_goes_on_where_it_was(photo: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "mrbokeh.cli", "studio", str(photo), "--object", str(CAKE), "--pictures", str(tmp_path), "--port", "0"]

    @contextmanager
    def started() -> Iterator[tuple["subprocess.Popen[str]", str]]:
        began_s = time.monotonic()
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}) as process:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "mrbokeh studio starts"
            # 0.3 s on a free machine; others share this one.
            assert time.monotonic() - began_s < 3.0
            yield process, process.stdout.readline().split()[1]
            process.kill()

    def told(asked: str | Request) -> Any:
        with urlopen(asked, timeout=30) as answer:
            return json.load(answer)

    with started() as (process, url):
        message = Request(url + "state", json.dumps({"changes": {"turn_deg": 33}}).encode(), {"Content-Type": "application/json"})
        assert told(message)["state"]["turn_deg"] == 33
    with started() as (process, url):
        assert told(url + "state")["state"]["turn_deg"] == 33
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def test_a_photograph_with_depth_keeps_its_depth_when_it_is_made_smaller(photo: Path) -> None:
    """Depth is picked, so that it has no values between those of two surfaces."""
    opened, _rgb = open_photograph(photo)
    depth_m = np.where(np.arange(WIDTH) < WIDTH // 2, 1.0, 9.0).astype(np.float32) * np.ones((HEIGHT, 1), np.float32)
    small = shrunk(replace(opened.plate, depth_m=depth_m), 77, 58)
    assert small.depth_m is not None and set(np.unique(small.depth_m)) == {1.0, 9.0} and small.camera.width_px == 77
    with_depth = OpenedPhotograph(photo, None, opened.told, None, plate=replace(opened.plate, depth_m=depth_m))
    state = placed(state_of({"photo": str(photo), "object": str(CAKE), "at_px": [30, 140]}), with_depth)
    assert state.camera_height_m is None and state.height is not None
    far = preview_of(with_depth, options_of(replace(state, focus_at_px=(200.0, 100.0))), KeptParts())
    assert far.told["focus_m"] == pytest.approx(9.0)


def test_a_picture_of_one_pixel_is_no_fault(tmp_path: Path) -> None:
    write_image(tmp_path / "dot.png", np.full((1, 1, 3), 0.5, np.float32))
    opened, _rgb = open_photograph(tmp_path / "dot.png")
    options = options_of(whole_state(tmp_path / "dot.png", at_px=(0.5, 0.5)))
    with pytest.raises(InputError):
        preview_of(opened, options, KeptParts())


async def test_depth_of_a_file_hides_what_stands_behind(photo: Path, tmp_path: Path) -> None:
    """A wall 2 m away in the left half, and the floor farther than it: the cake at 4 m is hidden there; the command line says --depth."""
    rows = np.mgrid[:HEIGHT, :WIDTH][0]
    floor_m = 1.2 * 187.0 / np.maximum(rows + 0.5 - HEIGHT / 2, 1.0)
    depth_m = np.where(np.arange(WIDTH) < WIDTH // 2, np.minimum(floor_m, 2.0), floor_m).astype(np.float32)
    write_layer(tmp_path / "depth.exr", Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), np.ones_like(depth_m), depth_m))
    project = project_of(StudioOptions(photo, (CAKE,), tmp_path / "depth.exr", pictures=tmp_path))
    project.add(replace(project.state, at_px=(122.0, 145.0), height="0.8"))
    project.write()
    assert read_project(project.path).state.depth == project.state.depth
    opened, _rgb = open_photograph(photo, project.state.depth)
    options = options_of(placed(project.state, opened))
    preview = preview_of(opened, options, KeptParts())
    assert "--depth" in words_of(options, tmp_path / "out.png") and options.standing.camera_height is None
    assert mrbokeh(*words_of(options, tmp_path / "out.png")).returncode == 0
    stored = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(srgb_codes(preview.rgb, np.uint16), stored)
    changed = np.abs(preview.rgb - opened.plate.rgb).max(axis=2) > 0.05
    left, top, right, bottom = preview.told["boxes"][0]
    inside = changed[int(top * HEIGHT) : int(bottom * HEIGHT)]
    assert left < 0.5 < right and inside[:, WIDTH // 2 + 4 :].any() and not inside[:, : WIDTH // 2 - 4].any()


async def test_objects_are_added_chosen_and_taken_away(photo: Path, tmp_path: Path) -> None:
    """A dropped GLB is added beside the chosen one and as high; each has its own place, and all of it can be undone and kept."""
    async with made_studio(tmp_path, whole_state(photo)) as made, aiohttp.ClientSession() as one:
        await comes_true(lambda: made.desk.photograph is not None and made.desk.busy == "")
        first = made.desk.state.objects[0]
        async with one.post(made.url + "upload", params={"kind": "object", "name": "a.glb"}, data=io.BytesIO(ALIEN.read_bytes())) as answer:
            assert answer.status == 200, await answer.text()
        state = made.desk.state
        assert state.before == (first,) and state.object == tmp_path / "studio_files" / "a.glb" and state.height == first.height
        assert state.at_px is not None and abs(state.at_px[0] - first.at_px[0]) == pytest.approx(0.15 * WIDTH)
        _, told = await asked(one, made.url + "add", {"object": str(CAKE)})
        assert len(told["state"]["before"]) == 2 and told["command"].count("--object") == told["command"].count("--at-pixel") == 3
        assert (await asked(one, made.url + "add", {"object": "/etc/passwd"}))[0] == 400
        stranger = {"object": "/etc/passwd", "at_px": [1, 2]}
        nowhere = {"object": str(ALIEN), "at_px": None}
        for bad, why in (([stranger], "may choose only"), ([{"at_px": [1, 2]}, nowhere], "each of before"), ("cake", "list of at most")):
            status, answered = await asked(one, made.url + "state", {"changes": {"before": bad}})
            assert status == 400 and why in answered["error"], answered
        await asked(one, made.url + "history", {"step": -1})
        assert made.desk.state == state
        kept = read_project(made.desk.project.path)
        assert [each.object.name for each in kept.state.objects] == [CAKE.name, "a.glb"]
        assert str(tmp_path) not in json.dumps(json.loads(made.desk.project.path.read_text())["states"][1]["object"]), (
            "the folder can be moved"
        )


def test_each_object_has_its_box_and_one_without_height_gets_one(photo: Path) -> None:
    """The box of the corners is that of the picture, to a pixel of its rim."""
    opened, _rgb = open_photograph(photo)
    alien = {"object": str(ALIEN), "at_px": [60, 150], "height": "0.3"}
    state = placed(whole_state(photo, before=[alien], height=None, camera_height_m=None), opened)
    assert state.height is not None and state.camera_height_m == 1.5 and state.before[0].height == "0.3"
    both = preview_of(opened, options_of(state), KeptParts()).told["boxes"]
    alone = [replace(state, before=()), state_of(whole_state(photo).document() | {**alien, "camera_height_m": 1.5})]
    boxes = [preview_of(opened, options_of(each), KeptParts()).told["boxes"][0] for each in reversed(alone)]
    np.testing.assert_allclose(both, boxes, atol=2 / HEIGHT)
