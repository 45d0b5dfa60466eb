"""The studio's page in a real headless Chromium: hands, keys, undo, focus, light, saving, on a desk and on a phone held both ways."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from datasets_scripts.gallery.pictures import CHROMIUM, Page
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.video.picture_source import open_source
from tests.support.live_clip import write_live_clip
from tests.support.made_studio import ALIEN, CAKE, HEIGHT, WIDTH, MadeStudio, made_studio, unsolved, write_floor
from tests.support.shared_chromium import shared_page
from tests.support.waiting import comes_true
from viewfinder.studio import photograph
from viewfinder.studio.clip import clip_state
from viewfinder.studio.state import StudioState

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the studio is tested by clients in Python only"),
]
DESK, UPRIGHT, LEVEL = (1280, 800), (390, 844), (844, 390)
AXE = Path(__file__).resolve().parents[2] / "viewfinder" / "page_source" / "node_modules" / "axe-core" / "axe.min.js"
MESSAGE = "document.getElementById('message').textContent"
RESTS = "studio.shown && !studio.shown.draft && !studio.isChanging"


@asynccontextmanager
async def opened(folder: Path, size_px: tuple[int, int], state: StudioState | None = None) -> AsyncIterator[tuple[Page, MadeStudio]]:
    """The page of a studio with a photograph, once that is opened and its camera looked for; without shadows, half of a picture's time."""
    first = state or StudioState(photo=write_floor(folder / "floor.png"), pitch_deg=0.0, shadow=0.0)
    async with made_studio(folder, first) as made, shared_page(made.url, size_px) as page:
        await page.comes_true("window.studio?.told?.photo && studio.told.busy === ''", 40.0)
        yield page, made


async def placed(page: Page, made: MadeStudio, x: float = 0.5, y: float = 0.8) -> None:
    """Choose the cake and tap it into the picture."""
    await page.choose("#object", str(CAKE))
    await page.comes_true(f"studio.state.object === '{CAKE}' && !studio.isChanging")
    await page.tap("#stage", x, y)
    await page.comes_true("studio.state.at_px !== null && !studio.isChanging")
    await page.comes_true(RESTS, 60.0)
    assert made.desk.state.at_px == pytest.approx((x * WIDTH, y * HEIGHT), abs=WIDTH / 100)


async def pressed(page: Page, key: str, times: int = 1, shift: bool = False, ctrl: bool = False) -> None:
    """Press a key as a keyboard does."""
    modifiers = (8 if shift else 0) | (2 if ctrl else 0)
    for _ in range(times):
        for kind in ("keyDown", "keyUp"):
            await page.send(
                "Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, text=key if len(key) == 1 and not ctrl else ""
            )


async def dragged(page: Page, start: tuple[float, float], way: tuple[float, float], mouse: bool) -> None:
    """Drag from a point of the window along a way, with the mouse or a finger."""
    points = [(start[0] + share * way[0], start[1] + share * way[1]) for share in np.linspace(0.0, 1.0, 9)]
    if not mouse:
        # As slow as a hand: Chromium takes a quick one for a fling, and the next tap for what stops it.
        for i, (x, y) in enumerate([*points, *points[-1:] * 3]):
            await page.send("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=[{"x": x, "y": y, "id": 0}])
            await asyncio.sleep(0.03)
        await page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        return
    for kind, (x, y) in zip(("mousePressed", *["mouseMoved"] * 8), points, strict=True):
        await page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    await page.send("Input.dispatchMouseEvent", type="mouseReleased", x=points[-1][0], y=points[-1][1], button="left", clickCount=1)


on_desk_and_slowly_on_phones = pytest.mark.parametrize(
    "size_px",
    [DESK, pytest.param(UPRIGHT, marks=pytest.mark.slow), pytest.param(LEVEL, marks=pytest.mark.slow)],
    ids=["desk", "upright", "level"],
)


@on_desk_and_slowly_on_phones
async def test_an_object_is_placed_dragged_turned_focused_on_undone_and_saved(tmp_path: Path, size_px: tuple[int, int]) -> None:
    async with opened(tmp_path, size_px) as (page, made):
        assert "Choose an object" in await page.value("document.getElementById('badge').textContent")
        left, top, width, height = await page.box("#stage")
        assert left >= 0 and top >= 0 and left + width <= size_px[0] and top + height <= size_px[1], "without scrolling"
        assert width / height == pytest.approx(WIDTH / HEIGHT, rel=0.01) and width > 0.4 * min(size_px)
        assert await page.value("document.documentElement.scrollWidth") <= size_px[0]
        await placed(page, made)
        first = made.desk.state
        await drag_and_undo(page, made, first, mouse=size_px == DESK)
        await keys(page, made)
        await focus(page, made)
        await save(page, made, waits=size_px == DESK)
        assert page.errors == []


async def drag_and_undo(page: Page, made: MadeStudio, first: StudioState, mouse: bool) -> None:
    left, top, width, height = await page.box("#stage")
    drafts = await page.value("studio.counts.drafts")
    await dragged(page, (left + width / 2, top + 0.78 * height), (-0.2 * width, 0.06 * height), mouse)
    await page.comes_true("!studio.isChanging && studio.told.can_undo")
    assert made.desk.state.at_px == pytest.approx((0.3 * WIDTH, 0.86 * HEIGHT), abs=0.02 * WIDTH)
    assert (made.desk.state.height, made.desk.state.camera_height_m) == (first.height, first.camera_height_m)
    await page.comes_true(f"studio.counts.drafts > {drafts}")
    await page.tap("#undo")
    await page.comes_true(f"studio.state.at_px[0] === {first.at_px[0]}")  # type: ignore[index]
    await page.tap("#redo")
    await page.comes_true("studio.told.can_redo === false")
    await pressed(page, "z", ctrl=True)
    await page.comes_true("studio.told.can_redo")
    assert made.desk.state == first


async def keys(page: Page, made: MadeStudio) -> None:
    before = made.desk.state
    assert before.at_px is not None and before.height is not None
    await page.value("document.getElementById('stage').focus()")
    await pressed(page, "ArrowRight", 3)
    await pressed(page, "ArrowDown", shift=True)
    await pressed(page, "]", 2)
    await pressed(page, "+")
    await page.comes_true("!studio.isChanging && studio.told.state.turn_deg === 2")
    after = made.desk.state
    assert after.at_px == (before.at_px[0] + 3, before.at_px[1] + 10)
    assert float(after.height or 0) == pytest.approx(1.05 * float(before.height), rel=1e-4)
    assert made.desk.project.place == len(made.desk.project.history) - 1 and len(made.desk.project.history) == 4, "one step for all of it"
    assert "--turn 2 " in await page.value("document.getElementById('command').textContent")


async def focus(page: Page, made: MadeStudio) -> None:
    """The floor at 0.7 of the height, 36 of 180 px below the level horizon, is H f / 36 px away."""
    await page.tap("#focus_here")
    assert "in focus" in await page.value(MESSAGE)
    await page.tap("#stage", 0.9, 0.7)
    await page.comes_true("studio.state.focus_m !== null && !studio.isChanging")
    focal_px = await page.value("studio.told.photo.focal_px")
    wanted_m = float(made.desk.state.camera_height_m or 0) * focal_px / (0.2 * HEIGHT)
    assert made.desk.state.focus_m == pytest.approx(wanted_m, rel=0.05)
    assert await page.value("document.getElementById('focus_here').getAttribute('aria-pressed')") == "false"
    await page.comes_true(f"studio.shown && Math.abs(studio.shown.focus_m - {made.desk.state.focus_m}) < 0.01", 30.0)
    await page.comes_true("document.getElementById('focus_told').textContent.includes('as chosen')")
    await page.value("document.getElementById('focus_auto').click()")
    await page.comes_true("studio.told.state.focus_m === null")


async def save(page: Page, made: MadeStudio, waits: bool) -> None:
    """Where nobody waits for the picture, its process ends with the studio."""
    await page.tap("#to_save")
    await page.comes_true(f"{MESSAGE}.includes('choose a format')")
    await page.tap("[data-format=jpeg]")
    await page.comes_true("studio.told.saves[0]?.name === 'floor_mrbokeh.jpg'")
    if not waits:
        await page.tap("#to_save")
        await page.comes_true("studio.told.saves[0]?.name === 'floor_mrbokeh_2.jpg'")
        return
    await page.comes_true("studio.told.saves[0]?.state === 'done'", 60.0)
    link = "document.querySelector('#saves a')"
    assert await page.value(f"{link}.textContent") == "Download floor_mrbokeh.jpg"
    assert await page.value(f"fetch({link}.href).then((answer) => answer.blob()).then((blob) => blob.size)") > 2000
    assert (made.folder / "floor_mrbokeh.jpg").is_file()
    assert await page.value("studio.told.command.endsWith('_2.jpg')"), "the next one is of the same format"


async def test_several_objects_are_added_chosen_by_hand_and_removed(tmp_path: Path) -> None:
    async with opened(tmp_path, DESK) as (page, made):
        await placed(page, made, 0.3)
        await page.choose("#add", str(ALIEN))
        await page.comes_true("studio.objects.length === 2 && !studio.isChanging && studio.shown?.boxes.length === 2")
        await page.comes_true(RESTS, 60.0)
        assert made.desk.state.object == ALIEN and made.desk.state.before[0].object == CAKE
        left, top, width, height = await page.box("#stage")
        await dragged(page, (left + 0.45 * width, top + 0.76 * height), (0.3 * width, 0.0), mouse=True)
        await page.comes_true("!studio.isChanging && studio.told.state.at_px[0] > 150")
        await page.comes_true(RESTS, 60.0)
        await page.comes_true("studio.shown.boxes[1][0] > 0.6")
        cake = await page.value("studio.shown.boxes[0]")
        await page.tap("#stage", cake[0] + 0.02, (cake[1] + cake[3]) / 2)
        await page.comes_true(f"studio.told.state.object === '{CAKE}' && !studio.isChanging")
        assert made.desk.state.before == () and made.desk.state.after[0].object == ALIEN, "chosen, and where it was"
        assert made.desk.state.at_px == pytest.approx((0.3 * WIDTH, 0.8 * HEIGHT), abs=WIDTH / 100)
        await page.comes_true(RESTS, 60.0)
        alien = await page.value("studio.shown.boxes[1]")
        start = (left + width * (alien[0] + alien[2]) / 2, top + height * (alien[1] + alien[3]) / 2)
        await dragged(page, start, (0.1 * width, 0.0), mouse=True)
        await page.comes_true(f"studio.told.state.object === '{ALIEN}' && !studio.isChanging")
        assert made.desk.state.at_px == pytest.approx((0.85 * WIDTH, 0.8 * HEIGHT), abs=WIDTH / 50)
        assert made.desk.state.before[0].at_px == pytest.approx((0.3 * WIDTH, 0.8 * HEIGHT), abs=WIDTH / 100)
        await page.choose("#chosen", "0")
        await page.comes_true(f"studio.told.state.object === '{CAKE}' && !studio.isChanging")
        assert (await page.value("document.getElementById('command').textContent")).count("--at-pixel") == 2
        await page.value("document.getElementById('stage').focus()")
        await pressed(page, "Delete")
        await page.comes_true(f"studio.told.state.object === '{ALIEN}' && studio.objects.length === 1 && !studio.isChanging")
        await page.tap("#undo")
        await page.comes_true("studio.objects.length === 2")
        await page.value("document.getElementById('remove').click()")
        await page.comes_true("studio.objects.length === 1")
        await page.value("document.getElementById('remove').click()")
        await page.comes_true("studio.objects.length === 0 && studio.told.state.at_px === null")
        await comes_true(lambda: made.desk.state.object is None)
        assert page.errors == []


async def test_two_fingers_scale_and_turn_and_the_wheel_too(tmp_path: Path) -> None:
    async with opened(tmp_path, UPRIGHT) as (page, made):
        await placed(page, made)
        high = float(made.desk.state.height or 0)
        left, top, width, height = await page.box("#stage")
        x, y = left + width / 2, top + height / 2
        # Two fingers 60 px apart come to 90 px, turned by 30 degrees.
        steps = [(30 + 5 * i, np.radians(10 * i)) for i in range(4)]
        await page.touch(*([(x - r * np.cos(t), y - r * np.sin(t)), (x + r * np.cos(t), y + r * np.sin(t))] for r, t in steps))
        await page.comes_true("!studio.isChanging && Math.abs(studio.told.state.turn_deg - 30) < 3")
        assert float(made.desk.state.height or 0) == pytest.approx(1.5 * high, rel=0.05)
        await page.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=400)
        await page.comes_true("!studio.isChanging && studio.told.state.height !== null")
        await asyncio.sleep(0.7)
        assert float(made.desk.state.height or 0) == pytest.approx(1.5 * high / np.e, rel=0.06)


ZOOMED = "document.getElementById('scale').textContent"


async def wheeled(page: Page, x: float, y: float, delta: float, ctrl: bool = False) -> None:
    """Turn the wheel over a point of the window."""
    await page.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=delta, modifiers=2 if ctrl else 0)


async def two_fingers(page: Page, *places: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Put two fingers down at the first places, move them along the others as slowly as a hand, rest, and lift them."""
    for i, both in enumerate([*places, *places[-1:] * 3]):
        points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(both)]
        await page.send("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=points)
        await asyncio.sleep(0.03)
    await page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


async def pixel_under(page: Page, x: float, y: float) -> tuple[float, float]:
    """Return the pixel of the floor that a point of the window shows."""
    left, top, width, height = await page.box("#stage")
    return (x - left) / width * WIDTH, (y - top) / height * HEIGHT


async def comes_true_of(found: Callable[[], Awaitable[tuple[float, float]]], wanted: tuple[float, float]) -> None:
    """Wait until a place of the page is the wanted one within 2 px, or 5 s."""
    for _ in range(100):
        if await found() == pytest.approx(wanted, abs=2.0):
            return
        await asyncio.sleep(0.05)
    assert await found() == pytest.approx(wanted, abs=2.0)


async def test_the_wheel_with_ctrl_and_drags_beside_the_object_zoom_and_move_the_picture(tmp_path: Path) -> None:
    """What lies under the pointer stays there, taps and drags land where they are seen, and all of it is one Escape away."""
    async with opened(tmp_path, DESK) as (page, made):
        await placed(page, made)
        fitted, room = await page.box("#stage"), await page.box("#room")
        x, y = fitted[0] + 0.4 * fitted[2], fitted[1] + 0.6 * fitted[3]
        seen = await pixel_under(page, x, y)
        first = made.desk.state
        await wheeled(page, x, y, -200, ctrl=True)
        await page.comes_true("parts.picture.view.isEnlarged")
        assert (await page.box("#stage"))[2] == pytest.approx(fitted[2] * np.sqrt(np.e), rel=0.01)
        assert await pixel_under(page, x, y) == pytest.approx(seen, abs=0.5)
        assert made.desk.state == first, "the object keeps its size"
        await dragged(page, (room[0] + 100, room[1] + 90), (70.0, 40.0), mouse=True)
        assert await pixel_under(page, x + 70, y + 40) == pytest.approx(seen, abs=0.5)
        assert made.desk.state == first, "and its place"
        foot = np.array(await page.box("#stage"))[:2] + np.array([0.5, 0.75]) * (await page.box("#stage"))[2:]
        await dragged(page, tuple(foot), (-60.0, 0.0), mouse=True)
        px = WIDTH / (await page.box("#stage"))[2]
        await page.comes_true(f"!studio.isChanging && studio.told.state.at_px[0] < {0.5 * WIDTH - 0.8 * 60 * px}")
        assert made.desk.state.at_px == pytest.approx((0.5 * WIDTH - 60 * px, 0.8 * HEIGHT), abs=1.5), "finer than at full view"
        await pressed(page, "Escape")
        assert await page.box("#stage") == pytest.approx(fitted, abs=0.5)
        await wheeled(page, x, y, 400, ctrl=True)
        assert await page.box("#stage") == pytest.approx(fitted, abs=0.5), "never smaller than the window"
        assert page.errors == []


@pytest.mark.parametrize(
    ("size_px", "at"), [(UPRIGHT, (0.25, 0.5)), pytest.param(LEVEL, (0.5, 0.25), marks=pytest.mark.slow)], ids=["upright", "level"]
)
async def test_two_fingers_beside_the_object_zoom_the_picture(tmp_path: Path, size_px: tuple[int, int], at: tuple[float, float]) -> None:
    """Along the side that fills the window what lies between the fingers stays there; along the other it is centred until it fills it."""
    async with opened(tmp_path, size_px) as (page, made):
        await placed(page, made, 0.8)
        fitted, first = await page.box("#stage"), made.desk.state
        x, y = fitted[0] + at[0] * fitted[2], fitted[1] + at[1] * fitted[3]
        # Fingers 40 px apart come to 100 px, then both move by 24 px to the left and 12 up.
        await two_fingers(page, *(((x - 20 - 10 * i, y), (x + 20 + 10 * i, y)) for i in range(4)))
        await page.comes_true("parts.picture.view.isEnlarged")
        assert (await page.box("#stage"))[2] == pytest.approx(2.5 * fitted[2], rel=0.06)
        seen = await pixel_under(page, x, y)
        assert seen == pytest.approx((at[0] * WIDTH, at[1] * HEIGHT), abs=4.0)
        await two_fingers(page, *(((x - 50 - 6 * i, y - 3 * i), (x + 50 - 6 * i, y - 3 * i)) for i in range(5)))
        await comes_true_of(lambda: pixel_under(page, x - 24, y - 12), seen)
        assert made.desk.state == first
        await page.tap("#zoom")
        assert await page.box("#stage") == pytest.approx(fitted, abs=0.5)
        await page.tap("#zoom")
        left, top, width, height = await page.box("#stage")
        assert width == pytest.approx(2.0 * fitted[2], rel=0.01), "twice as large, where one by one is smaller"
        room = await page.box("#room")
        assert room[0] < left + 0.8 * width < room[0] + room[2] and room[1] < top + 0.8 * height < room[1] + room[3], "the foot is in sight"
        # On the object too, once it is enlarged.
        x, y = left + 0.8 * width, top + 0.7 * height
        await two_fingers(page, *(((x - 20 - 5 * i, y), (x + 20 + 5 * i, y)) for i in range(3)))
        await page.comes_true(f"parseFloat(document.getElementById('stage').style.width) > {1.2 * width}")
        await page.tap("#brush")
        wide = (await page.box("#stage"))[2]
        await two_fingers(page, *(((x - 60 + 5 * i, y), (x + 60 - 5 * i, y)) for i in range(5)))
        await page.comes_true(f"parseFloat(document.getElementById('stage').style.width) < {0.85 * wide}")
        await page.tap("#magnify")
        for gone in ("getElementById('brush_row').hidden", "getElementById('loupe').hidden", "getElementById('scale').hidden"):
            assert not await page.value(f"document.{gone}")
            await pressed(page, "Escape")
            assert await page.value(f"document.{gone}"), "one after the other"
        assert made.desk.state == first and page.errors == []


async def darkest(page: Page, canvas: str, x_px: float, y_px: float) -> int:
    """Return the least red of a canvas within a pixel of where it shows a pixel of the photograph on the screen."""
    told = f"""(() => {{
        const [canvas, stage] = [document.getElementById('{canvas}'), document.getElementById('stage')];
        const [own, whole, photo] = [canvas.getBoundingClientRect(), stage.getBoundingClientRect(), studio.told.photo];
        const x = (whole.left + {x_px} / photo.width_px * whole.width - own.left) / own.width * canvas.width;
        const y = (whole.top + {y_px} / photo.height_px * whole.height - own.top) / own.height * canvas.height;
        const {{ data }} = canvas.getContext('2d').getImageData(Math.floor(x) - 1, Math.floor(y), 3, 1);
        return Math.min(data[0], data[4], data[8]);
    }})()"""
    return int(await page.value(told))


async def test_an_enlarged_picture_shows_the_photographs_own_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line of one dark pixel in 1.5 megapixels is lost in the preview, and there at full size, with and without an object."""
    monkeypatch.setattr(photograph, "solved", unsolved)
    photo = write_floor(tmp_path / "floor.png", 1400, 1050)
    light = read_image(photo).copy()
    light[210:350, 699] = 0.0
    write_image(photo, light)
    async with opened(tmp_path, (960, 640), StudioState(photo=photo, pitch_deg=0.0, shadow=0.0)) as (page, made):
        await page.tap("#zoom")
        assert await page.value(ZOOMED) == "100 %"
        await page.comes_true("!document.getElementById('sharp').hidden", 30.0)
        assert await darkest(page, "sharp", 699.5, 280.0) < 60 < 100 < await darkest(page, "picture", 699.5, 280.0)
        await page.tap("#zoom")
        assert await page.value("document.getElementById('sharp').hidden")
        await page.choose("#object", str(CAKE))
        await page.tap("#stage", 0.5, 0.8)
        await page.comes_true(RESTS, 60.0)
        fitted = await page.box("#stage")
        await wheeled(page, fitted[0] + 0.5 * fitted[2], fitted[1] + 0.3 * fitted[3], -400, ctrl=True)
        await page.comes_true("!document.getElementById('sharp').hidden", 30.0)
        assert await darkest(page, "sharp", 699.5, 280.0) < 60
        await page.value("studio.change({exposure: 2}), 0")
        assert await page.value("document.getElementById('sharp').hidden"), "an older picture is not shown over a newer one"
        await page.comes_true("!document.getElementById('sharp').hidden", 60.0)
        number = await page.value("studio.told.number")
        counted = "studio.region = (...all) => { asked++; return region(...all); }"
        await page.value(f"(() => {{ window.asked = 0; const region = studio.region.bind(studio); {counted}; }})()")
        made.desk.tell_all()
        await page.comes_true(f"studio.told.number > {number}")
        await held_before(page)
        assert page.errors == []


async def held_before(page: Page) -> None:
    """The photograph as it was is shown with its own pixels too, and news of the server ask for none."""
    left, top, _width, _height = await page.box("#hold_before")
    await asyncio.sleep(0.4)
    assert await page.value("asked") == 0
    await page.send("Input.dispatchMouseEvent", type="mousePressed", x=left + 5, y=top + 5, button="left", buttons=1, clickCount=1)
    await page.comes_true("!document.getElementById('sharp_before').hidden", 30.0)
    assert await darkest(page, "sharp_before", 699.5, 280.0) < 60 and await page.value("asked") == 1
    await page.send("Input.dispatchMouseEvent", type="mouseReleased", x=left + 5, y=top + 5, button="left", clickCount=1)
    assert await page.value("document.getElementById('sharp_before').hidden && !document.getElementById('sharp').hidden")


@pytest.mark.parametrize("size_px", [pytest.param(DESK, marks=pytest.mark.slow), UPRIGHT], ids=["desk", "upright"])
async def test_what_is_in_front_is_painted(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """A dark tile of the floor is painted over the cake; then a smaller brush says that it is behind, and both are undone."""
    async with opened(tmp_path, size_px) as (page, made):
        await placed(page, made)
        await page.tap("#brush")
        assert not await page.value("document.getElementById('brush_row').hidden")
        assert "paint over" in await page.value(MESSAGE)
        left, top, width, height = await page.box("#stage")
        await dragged(page, (left + 0.45 * width, top + 0.7 * height), (0.1 * width, 0.0), mouse=size_px == DESK)
        await page.comes_true("studio.told.state.matte !== null && !studio.isChanging", 30.0)
        await page.comes_true("!document.getElementById('matte').hidden && document.getElementById('matte').naturalWidth > 0")
        first = made.desk.state
        assert first.at_px == (0.5 * WIDTH, 0.8 * HEIGHT) and first.matte is not None, "the object stays"
        await page.tap("#brush_hide")
        assert await page.value("!document.getElementById('before').hidden")
        await page.tap("#brush_behind")
        await page.send("Input.dispatchMouseEvent", type="mouseWheel", x=left + width / 2, y=top + height / 2, deltaX=0, deltaY=200)
        await page.comes_true("document.getElementById('brush_size').valueAsNumber < 35")
        await page.tap("#stage", 0.5, 0.7)
        await page.comes_true(f"studio.told.state.matte !== '{first.matte}'", 30.0)
        await page.tap("#undo")
        await page.comes_true(f"studio.told.state.matte === '{first.matte}'")
        await pressed(page, "Escape")
        await page.comes_true("document.getElementById('matte').hidden && document.getElementById('brush_row').hidden")
        assert await page.value("document.getElementById('before').hidden")
        await page.comes_true(RESTS, 60.0)
        assert "--matte" in await page.value("document.getElementById('command').textContent")
        assert page.errors == []


@pytest.mark.parametrize("size_px", [DESK, pytest.param(LEVEL, marks=pytest.mark.slow)], ids=["desk", "level"])
async def test_lines_are_drawn_corrected_and_removed(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """Two edges of tiles ahead and one across: the horizon lies in the middle of the picture, where the tilt had it elsewhere."""
    async with opened(tmp_path, size_px, StudioState(photo=write_floor(tmp_path / "floor.png"), pitch_deg=9.0)) as (page, made):
        await page.tap("#draw_lines")
        edges = [("z", 0.583, 0.611, 0.833, 0.944), ("z", 0.417, 0.611, 0.1, 0.944), ("x", 0.1, 0.83, 0.9, 0.83)]
        for count, (axis, x1, y1, x2, y2) in enumerate(edges, 1):
            await page.tap(f"#axis_{axis}")
            left, top, width, height = await page.box("#stage")
            await dragged(page, (left + x1 * width, top + y1 * height), ((x2 - x1) * width, (y2 - y1) * height), mouse=size_px == DESK)
            await page.comes_true(f"studio.told.state.lines.length === {count} && studio.told.busy === '' && !studio.isChanging", 30.0)
        assert "drawn lines" in await page.value(MESSAGE)
        # The end of the second line was beside its edge: it is dragged there, though another direction is chosen.
        await dragged(page, (left + 0.1 * width, top + 0.944 * height), (0.067 * width, 0.0), mouse=size_px == DESK)
        await page.comes_true(f"studio.told.state.lines[1][2] > {0.15 * WIDTH} && studio.told.busy === '' && !studio.isChanging", 30.0)
        assert len(made.desk.state.lines) == 3 and made.desk.state.lines[1][2] == pytest.approx(40, abs=WIDTH / 100)
        assert made.desk.state.camera is not None
        await page.comes_true("Math.abs(studio.told.photo.pitch_deg) < 1.0")
        await page.tap("#stage", 0.5, 0.83)
        await page.comes_true("studio.told.state.lines.length === 2 && studio.told.busy === ''", 30.0)
        await page.tap("#axis_h")
        for y in (0.4, 0.25):
            await dragged(page, (left + 0.1 * width, top + y * height), (0.8 * width, 0.0), mouse=size_px == DESK)
            await page.comes_true(f"Math.abs(studio.told.state.lines.at(-1)[1] - {y * HEIGHT}) < 2 && studio.told.busy === ''", 30.0)
        assert [each[4] for each in made.desk.state.lines].count("h") == 1, "there is one horizon"
        # The camera looks down by how far the horizon lies above the middle.
        down_px = "Math.tan(studio.told.photo.pitch_deg / 57.2958) * studio.told.photo.focal_px"
        await page.comes_true(f"Math.abs({down_px} - {0.25 * HEIGHT}) < 3")
        await page.tap("#brush")
        assert await page.value("document.getElementById('lines_row').hidden && document.getElementById('lines').childElementCount === 0")
        assert page.errors == []


@on_desk_and_slowly_on_phones
async def test_somebody_of_known_height_gives_the_ground_its_metres(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """A foot a third of the picture below the level horizon and a head a ninth below it: the camera is 1.5 times as high as that."""
    async with opened(tmp_path, size_px) as (page, made):
        await placed(page, made, 0.8, 0.9)
        box = await page.value("studio.shown.boxes[0]")
        await page.tap("#draw_lines")
        await page.tap("#axis_m")
        assert "foot to the head" in await page.value(MESSAGE)
        left, top, width, height = await page.box("#stage")
        await dragged(page, (left + 0.3 * width, top + 5 / 6 * height), (0.0, -2 / 9 * height), mouse=size_px == DESK)
        await page.comes_true("studio.told.state.measured !== null && !studio.isChanging && studio.told.state.camera_height_m !== 1.5")
        assert made.desk.state.camera_height_m == pytest.approx(1.5 * 1.7, rel=0.05)
        await page.comes_true(f"{MESSAGE}.includes('By the known height the camera stands')")
        await page.comes_true(RESTS, 60.0)
        np.testing.assert_allclose(await page.value("studio.shown.boxes[0]"), box, atol=0.01)
        await page.value(
            "(() => { const m = document.getElementById('metres'); m.value = '0.85'; m.dispatchEvent(new Event('change')); })()"
        )
        await page.comes_true("studio.told.state.measured?.[4] === 0.85 && studio.told.state.camera_height_m < 2 && !studio.isChanging")
        assert made.desk.state.camera_height_m == pytest.approx(1.5 * 0.85, rel=0.05)
        # Its end is dragged like any other: half as long, it is taken nearly twice as high above the ground.
        await dragged(page, (left + 0.3 * width, top + 11 / 18 * height), (0.0, 1 / 9 * height), mouse=size_px == DESK)
        await page.comes_true("studio.told.state.camera_height_m > 2 && !studio.isChanging")
        assert made.desk.state.camera_height_m == pytest.approx(3.0 * 0.85, rel=0.1) and made.desk.state.lines == ()
        assert f"--camera-height {made.desk.state.camera_height_m:g}" in await page.value("document.getElementById('command').textContent")
        await page.tap("#lines_clear")
        await page.comes_true("studio.told.state.measured === null")
        assert page.errors == []


@pytest.mark.parametrize("size_px", [DESK, pytest.param(UPRIGHT, marks=pytest.mark.slow)], ids=["desk", "upright"])
async def test_the_sun_is_found_by_a_shadow_that_is_pointed_at(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """The shadow of a post lies to the right and is twice as long as that is high: the sun is at the left, atan(1 / 2) high."""
    async with opened(tmp_path, size_px) as (page, made):
        await page.tap("#sun_by")
        for x, y, next_words in ((0.5, 4 / 6, "foot"), (0.5, 5 / 6, "tip"), (0.75, 5 / 6, "by the shadow the sun is 9")):
            assert made.desk.state.sun_deg is None
            await page.tap("#stage", x, y)
            await page.comes_true(f"{MESSAGE}.includes('{next_words}')")
        assert made.desk.state.sun_deg == pytest.approx((-90.0, 26.6), abs=2.5) and made.desk.state.at_px is None
        assert await page.value("document.getElementById('sun_by').getAttribute('aria-pressed') === 'false'")
        assert await page.value("document.getElementById('pointed').childElementCount === 0")
        await page.tap("#sun_by")
        await page.tap("#stage", 0.5, 0.7)
        await pressed(page, "Escape")
        assert not await page.value("document.getElementById('sun_by').getAttribute('aria-pressed') === 'true'")
        assert page.errors == []


async def test_objects_keep_their_size_in_the_picture_when_the_ground_moves(tmp_path: Path) -> None:
    """With the camera twice as high the ground is twice as far, and all metres are twice as many; metres that were typed stay."""

    async def typed(page: Page, field: str, text: str) -> None:
        told = f"const field = document.getElementById('{field}'); field.value = '{text}'; field.dispatchEvent(new Event('change'))"
        await page.value(f"(() => {{ {told} }})()")
        await page.comes_true("!studio.isChanging")

    async with opened(tmp_path, DESK) as (page, made):
        await placed(page, made)
        await page.comes_true("studio.told.state.height !== null && !studio.isChanging")
        height, high_m = float(made.desk.state.height or 0), made.desk.state.camera_height_m
        assert high_m == 1.5
        await typed(page, "camera_height", "3")
        assert float(made.desk.state.height or 0) == pytest.approx(2.0 * height, rel=1e-4) and made.desk.state.camera_height_m == 3.0
        await typed(page, "height", "0.5")
        await typed(page, "camera_height", "1.5")
        assert made.desk.state.height == "0.5" and page.errors == []


@on_desk_and_slowly_on_phones
async def test_a_turned_camera_is_levelled(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """The horizon rises to the right by the angle that the camera is turned clockwise; the tilt by the slider leaves that as it is."""
    async with opened(tmp_path, size_px) as (page, made):
        await placed(page, made)
        await page.value("document.querySelectorAll('details').forEach((each) => (each.open = true))")
        await page.value("document.getElementById('roll').scrollIntoView({block: 'center'})")
        slider = "(() => {{ const s = document.getElementById('{}'); s.value = '{}'; s.dispatchEvent(new Event('{}')); }})()"
        await page.value(slider.format("roll", 8, "input"))
        line = "document.querySelector('#ground .horizon').getAttribute('d').match(/-?[0-9.]+/g).map(Number)"
        x1, y1, x2, y2 = await page.value(line)
        assert np.degrees(np.arctan2(y1 - y2, x2 - x1)) == pytest.approx(8.0, abs=0.01), "at once"
        await page.value(slider.format("roll", 8, "change"))
        await page.comes_true("!studio.isChanging && studio.told.state.roll_deg === 8")
        await page.comes_true("Math.abs(studio.told.photo.roll_deg - 8) < 0.01")
        await page.value(slider.format("pitch", 5, "change"))
        await page.comes_true("!studio.isChanging && studio.told.state.pitch_deg === 5")
        x1, y1, x2, y2 = await page.value(line)
        assert np.degrees(np.arctan2(y1 - y2, x2 - x1)) == pytest.approx(8.0, abs=0.01)
        words = await page.value("document.getElementById('command').textContent")
        assert "--pitch 5 --roll 8 " in words
        await page.comes_true(RESTS, 60.0)
        assert made.desk.state.roll_deg == 8.0 and page.errors == []


@on_desk_and_slowly_on_phones
async def test_the_objects_light_gets_warmer_at_once_and_the_ground_keeps_its_colour(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """By 75 millionths of 1 / K warmer: white then has 1.32 times as much red and 0.64 times as much blue."""
    seen = """(() => {{
        const canvas = document.getElementById('picture'), [left, top, right, bottom] = studio.shown.boxes[0];
        const [from, to] = [{low}, {high}].map((share) => Math.floor((top + share * (bottom - top)) * canvas.height));
        const [first, last] = [0.3, 0.7].map((share) => Math.floor((left + share * (right - left)) * canvas.width));
        const data = canvas.getContext('2d').getImageData(first, from, last - first, to - from).data;
        const light = (channel) => data.filter((_, i) => i % 4 === channel);
        return [0, 2].map((channel) => [...light(channel)].reduce((sum, code) => sum + ((code / 255 + 0.055) / 1.055) ** 2.4, 0));
    }})()"""
    on_cake, in_shadow = seen.format(low=0.4, high=0.8), seen.format(low=1.02, high=1.08)
    shadowed = StudioState(photo=write_floor(tmp_path / "floor.png"), pitch_deg=0.0)
    async with opened(tmp_path, size_px, shadowed) as (page, made):
        await placed(page, made)
        before, ground = np.array(await page.value(on_cake)), np.array(await page.value(in_shadow))
        await page.value("document.getElementById('warmth').scrollIntoView({block: 'center'})")
        slider = "(() => {{ const s = document.getElementById('warmth'); s.value = '75'; s.dispatchEvent(new Event('{}')); }})()"
        drafts = await page.value("studio.counts.drafts")
        await page.value(slider.format("input"))
        await page.comes_true(f"studio.counts.drafts > {drafts} && studio.shown.draft || studio.counts.drafts > {drafts + 1}")
        ratio = np.array(await page.value(on_cake)) / before
        assert ratio[0] == pytest.approx(1.32, rel=0.12) and ratio[1] == pytest.approx(0.64, rel=0.12)
        await page.value(slider.format("change"))
        await page.comes_true(f"{RESTS} && studio.told.state.warmth_k === {round(1e6 / (1e6 / 6504 - 75))}", 60.0)
        ratio = np.array(await page.value(on_cake)) / before
        assert ratio[0] == pytest.approx(1.32, rel=0.08) and ratio[1] == pytest.approx(0.64, rel=0.08)
        np.testing.assert_allclose(np.array(await page.value(in_shadow)), ground, rtol=0.06)
        assert "--match-white 12698" in await page.value("document.getElementById('command').textContent")
        assert "warmer by 75" in await page.value("document.getElementById('warmth').parentElement.textContent")
        await page.tap("#undo")
        await page.comes_true("studio.state.warmth_k === null")
        assert page.errors == []


async def test_light_lens_and_before_are_shown(tmp_path: Path) -> None:
    photo = write_floor(tmp_path / "floor.png")
    async with opened(tmp_path, DESK, StudioState(photo=photo, pitch_deg=0.0)) as (page, made):
        write_lens(tmp_path / "ring.json", Lens(35.0, 1.4, 2.0, 36.0, aperture=Aperture.ring(0.5)))
        made.desk.project.offer(tmp_path / "ring.json")
        made.desk.tell_all()
        await placed(page, made)
        await page.value("document.getElementById('dome').scrollIntoView()")
        left, top, width, _height = await page.box("#dome")
        # From the right, half way down to the rim of radius 100 of 110: 45 degrees above the horizon.
        await dragged(page, (left + width / 2, top + width / 2), (0.25 * width * 100 / 110 * 0.999, 0.0), mouse=True)
        await page.comes_true("!studio.isChanging && studio.told.state.sun_deg !== null")
        assert made.desk.state.sun_deg == pytest.approx((90, 45), abs=2)
        assert not await page.value("document.getElementById('sun_auto').checked")
        await page.value("document.querySelector('#lenses img').parentElement.click()")
        await page.comes_true(f"studio.told.state.lens === '{tmp_path / 'ring.json'}'")
        await page.comes_true("document.querySelector('#lenses img').naturalWidth > 0")
        await page.comes_true("/^Black [0-9.]+ %, white [0-9.]+ %/.test(document.getElementById('clipped').textContent)")
        painted = "document.getElementById('histogram').getContext('2d').getImageData(0, 0, 256, 80).data.filter((each) => each).length"
        assert await page.value(painted) > 1000
        await page.comes_true(RESTS, 60.0)
        left, top, _width, _height = await page.box("#hold_before")
        shown = "!document.getElementById('before').hidden"
        await page.send("Input.dispatchMouseEvent", type="mousePressed", x=left + 5, y=top + 5, button="left", buttons=1, clickCount=1)
        assert await page.value(shown)
        await page.send("Input.dispatchMouseEvent", type="mouseReleased", x=left + 5, y=top + 5, button="left", clickCount=1)
        assert not await page.value(shown)
        await page.tap("#magnify")
        left, top, width, height = await page.box("#stage")
        await page.send("Input.dispatchMouseEvent", type="mouseMoved", x=left + width / 2, y=top + 0.7 * height)
        await page.comes_true("Number(document.getElementById('loupe').dataset.looked) > 0", 30.0)
        assert (await page.box("#loupe"))[2] == 240
        assert page.errors == []


@on_desk_and_slowly_on_phones
async def test_a_clip_shows_its_track_and_is_filmed(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """The path of the object's foot through the frames follows where it stands; saved is what `mrbokeh video` makes of it."""
    clip = write_live_clip(tmp_path, WIDTH, HEIGHT, 2)
    write_track(tmp_path / "track.json", CameraTrack({number: TrackedFrame(each) for number, each in enumerate(clip.cameras)}))
    first = clip_state(clip.path, tmp_path / "track.json", tmp_path / "studio_files", StudioState())
    async with opened(tmp_path, size_px, first) as (page, made):
        hidden = "[...document.querySelectorAll('.of_still')].every((each) => each.hidden)"
        assert await page.value(hidden), "the track says how the camera was held"
        await placed(page, made, 0.5, 0.6)
        above_m = -clip.cameras[0].world_from_camera[2, 3]
        assert made.desk.state.camera_height_m == pytest.approx(above_m, rel=1e-3) and made.desk.state.pitch_deg is None
        drawn = "(document.querySelector('#ground .track')?.getAttribute('d') ?? '')"
        await page.comes_true(f"{drawn}.length && studio.told.clip.command")
        path = await page.value(drawn)
        assert path.count("L") == len(clip.plates) - 1
        left, top, width, height = await page.box("#stage")
        await dragged(page, (left + 0.5 * width, top + 0.55 * height), (0.1 * width, 0.05 * height), mouse=size_px == DESK)
        await page.comes_true(f"!studio.isChanging && studio.told.clip.command && {drawn}.length && {drawn} !== '{path}'", 30.0)
        start = await page.value(f"{drawn}.match(/-?[0-9.]+/g).slice(0, 2).map(Number)")
        assert start == pytest.approx(made.desk.state.at_px, abs=0.2)
        commands = (await page.value("document.getElementById('command').textContent")).split("\n\n")
        assert [each.split()[1] for each in commands] == ["video", "composite"] and str(tmp_path / "track.json") in commands[0]
        if size_px == DESK:
            await page.tap("[data-format=clip]")
            await page.comes_true("studio.told.saves[0]?.state === 'done'", 60.0)
            filmed = list(open_source(tmp_path / "board_mrbokeh.mp4").frames(0, len(clip.plates), 1))
            assert len(filmed) == len(clip.plates) and filmed[0].rgb.shape == (HEIGHT, WIDTH, 3)
            assert (np.abs(filmed[0].rgb - read_image(first.photo)).max(axis=2) > 0.05).sum() > 300  # type: ignore[arg-type]
            assert commands[0] == made.desk.saves.told()[0]["command"]
        assert page.errors == []


async def test_refusals_are_sentences_and_another_page_is_followed(tmp_path: Path) -> None:
    async with opened(tmp_path, DESK) as (page, made):
        await page.tap("#stage", 0.5, 0.8)
        assert "choose an object first" in await page.value(MESSAGE)
        await page.value("studio.upload(new File(['v 0 0 0'], 'cake.glb')), 0")
        await page.comes_true(f"{MESSAGE}.includes('no GLB file')")
        await placed(page, made)
        await page.value(
            "document.getElementById('height').value = 'tall', document.getElementById('height').dispatchEvent(new Event('change'))"
        )
        await page.comes_true(f"{MESSAGE}.includes('120px')")
        await made.desk.change({"turn_deg": 77})
        await page.comes_true("studio.state.turn_deg === 77 && document.getElementById('turn').valueAsNumber === 77")
        assert all("400" in each for each in page.errors), page.errors


@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not installed: `npm ci` in viewfinder/page_source")
@pytest.mark.parametrize("size_px", [DESK, UPRIGHT], ids=["desk", "upright"])
async def test_the_page_is_accessible(tmp_path: Path, size_px: tuple[int, int]) -> None:
    """WCAG 2.1 A and AA by axe-core; everything is reached by the keyboard."""
    async with opened(tmp_path, size_px) as (page, made):
        await placed(page, made)
        await page.value("document.querySelectorAll('details').forEach((each) => (each.open = true))")
        await page.tap("#brush")
        await page.tap("#draw_lines")
        await page.value(AXE.read_text() + "; 0")
        found = await page.value(
            "axe.run(document, {runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa']})"
            ".then((all) => all.violations.map((each) => each.id + ': ' + each.nodes.map((node) => node.target).join(' ')))"
        )
        assert found == []
        reached = set()
        await page.value("document.activeElement.blur()")
        for _ in range(60):
            await page.send("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
            reached.add(
                await page.value("document.activeElement.id || document.activeElement.dataset.format || document.activeElement.tagName")
            )
        wanted = {
            "stage",
            "undo",
            "focus_here",
            "grid",
            "hold_before",
            "magnify",
            "brush",
            "draw_lines",
            "object",
            "height",
            "turn",
            "focus",
            "f_number",
        }
        wanted |= {
            "height",
            "turn",
            "focus",
            "f_number",
            "sun_right",
            "sun_above",
            "exposure",
            "shadow",
            "matched",
            "pitch",
            "roll",
            "zoom",
            "camera_height",
            "png",
            "copy",
            "open_photo",
        }
        assert wanted <= reached, wanted - reached


async def test_without_a_photograph_the_page_asks_for_one_and_takes_it(tmp_path: Path) -> None:
    floor = write_floor(tmp_path / "floor.png")
    async with made_studio(tmp_path) as made, shared_page(made.url, UPRIGHT) as page:
        await page.comes_true("window.studio?.told && document.getElementById('welcome').innerText.includes('Drop a photograph')")
        document = await page.send("DOM.getDocument")
        for selector, file in (("#open_photo", floor), ("#open_object", ALIEN)):
            node = await page.send("DOM.querySelector", nodeId=document["root"]["nodeId"], selector=selector)
            await page.send("DOM.setFileInputFiles", nodeId=node["nodeId"], files=[str(file)])
            await page.comes_true(f"studio.told.state.{'object' if file is ALIEN else 'photo'}", 30.0)
        assert made.desk.state.photo == tmp_path / "studio_files" / "floor.png"
        await page.comes_true("studio.told.photo && studio.told.busy === ''", 40.0)
        await page.tap("#stage", 0.5, 0.8)
        await page.comes_true(RESTS, 60.0)
        assert page.errors == []
