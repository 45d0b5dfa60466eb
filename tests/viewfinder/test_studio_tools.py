"""The studio's tools on the picture.

Brush: strokes snap to edges of the picture, mattes are as soft as that, and previews, loupe and command agree on them. Lines: the camera
follows them.
"""

import asyncio
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.compositing.plate import read_matte, shrunk_matte
from mrbokeh.images.color import srgb_codes
from mrbokeh.images.image_io import write_image
from mrbokeh.solving.solved_camera import read_solved_camera
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh
from tests.support.made_studio import ALIEN, CAKE, HEIGHT, WIDTH, made_studio, unsolved, write_floor
from tests.support.waiting import comes_true
from viewfinder.studio import photograph
from viewfinder.studio.brush import Brush, as_shown, snapped, tinted
from viewfinder.studio.command_line import options_of, words_of
from viewfinder.studio.desk import Desk
from viewfinder.studio.loupe import Region, WholePhotograph, region_of
from viewfinder.studio.photograph import open_photograph, solved_by_hand
from viewfinder.studio.preview import preview_of
from viewfinder.studio.project import read_project
from viewfinder.studio.state import Stroke, StudioState, shadow_of, state_of, stroke_of

SIZE, MIDDLE, RADIUS = 300, (150, 150), 60.0


FLOOR_LINES = [[140, 110, 200, 170, "z"], [100, 110, 40, 170, "z"], [20, 150, 220, 150, "x"]]
"""Edges of the floor's tiles: those ahead meet at the middle of the level horizon."""


def disc_in_noise(blur_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A rough red disc on a rough grey ground as codes, and its coverage; both are blurred together, as by a lens."""
    rng = np.random.default_rng(1)
    cover = np.zeros((SIZE, SIZE), np.float32)
    cv2.circle(cover, MIDDLE, int(RADIUS), 1.0, -1, cv2.LINE_AA)
    light = cv2.GaussianBlur(rng.normal(0.0, 60.0, (SIZE, SIZE, 1)).astype(np.float32), (0, 0), 2.0)[..., None]
    disc, ground = np.float32([200, 90, 60]) + light, np.float32([120, 130, 120]) - light
    cover, disc = ((cv2.GaussianBlur(each, (0, 0), blur_px) if blur_px else each) for each in (cover, disc * cover[..., None]))
    return np.clip(disc + ground * (1.0 - cover[..., None]), 0, 255).astype(np.uint8), cover


@pytest.mark.parametrize("blur_px", [0.0, 4.0])
def test_a_rough_stroke_takes_the_whole_thing_and_its_edge(blur_px: float) -> None:
    """A short line through the middle, whose rim is up to 25 px within or beyond the edge: 3 % of the area is half a pixel of that."""
    codes, cover = disc_in_noise(blur_px)
    found = snapped(codes, np.zeros((SIZE, SIZE), bool), [(130.0, 145.0), (165.0, 152.0)], 50.0)
    wrong = (found != (cover > 0.5)).sum() / (cover > 0.5).sum()
    assert wrong < 0.03, wrong
    soft, band = as_shown(codes, found), (cover > 0.02) & (cover < 0.98)
    if not band.any():
        assert np.abs(soft - found).mean() < 0.01
        return
    hard_error, soft_error = (np.abs(each - cover)[band].mean() for each in (found, soft))
    assert soft_error < 0.75 * hard_error and (soft[cover < 1e-3] < 0.1).mean() > 0.99


def test_a_stroke_beside_what_is_marked_keeps_it_and_one_behind_takes_away() -> None:
    codes, cover = disc_in_noise()
    right = np.zeros((SIZE, SIZE), bool)
    right[:, 150:] = cover[:, 150:] > 0.5
    left = snapped(codes, right, [(120.0, 120.0), (115.0, 180.0)], 35.0)
    both = left | right
    assert (both != (cover > 0.5)).mean() < 0.01
    ground = snapped(codes, ~both, [(230.0, 60.0), (250.0, 240.0)], 30.0)
    assert (ground & (cover > 0.5)).sum() < 20, "a stroke on the ground takes none of the disc away"


def test_a_single_point_is_a_dab() -> None:
    codes, cover = disc_in_noise()
    found = snapped(codes, np.zeros((SIZE, SIZE), bool), [(150.0, 150.0)], 55.0)
    assert (found != (cover > 0.5)).sum() / (cover > 0.5).sum() < 0.05
    even = snapped(np.full((40, 50, 3), 99, np.uint8), np.zeros((40, 50), bool), [(0.0, 39.0)], 10.0)
    assert even[39, 0] and not even[:15].any() and not even[:, 25:].any(), "where nothing is seen it is the brush's own disc, about"


def photo_of_disc(path: Path) -> Path:
    codes, _cover = disc_in_noise(2.0)
    Image.fromarray(codes).save(path)
    return path


@pytest.mark.parametrize("has_depth", [False, True])
def test_strokes_add_up_in_a_matte_of_the_command(tmp_path: Path, has_depth: bool) -> None:
    """With depth a matte is hard, and transparent where no stroke came; without, what no stroke reached is behind."""
    brush, file = Brush(photo_of_disc(tmp_path / "disc.png"), has_depth=has_depth), tmp_path / "matte.png"
    brush.paint(None, Stroke(((130.0, 145.0), (165.0, 152.0)), 50.0, is_front=True), file)
    first = read_matte(file)
    brush.paint(file, Stroke(((150.0, 100.0), (150.0, 110.0)), 12.0, is_front=False), file)
    second = read_matte(file)
    assert first[150, 150] == 1.0 and first[105, 150] == 1.0 and second[150, 150] == 1.0 and second[105, 150] == 0.0
    assert np.isnan(second[5, 5]) if has_depth else second[5, 5] == 0.0
    soft = np.nanmax(np.minimum(first, 1.0 - first))
    assert soft < 1e-6 if has_depth else soft > 0.3
    tint = np.asarray(Image.open(BytesIO(tinted(file, (150, 150)))))
    assert tint[75, 75].tolist() == [255, 140, 0, 127] and tint[2, 2, 3] == 0
    assert (tint[52, 75].tolist() == [40, 120, 255, 127]) if has_depth else tint[52, 75, 3] == 0
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(file)
    with pytest.raises(InputError, match="9x9 px, but the photograph 300x300"):
        Brush(tmp_path / "disc.png", has_depth=has_depth).paint(file, Stroke(((1.0, 1.0),), 5.0, is_front=True), tmp_path / "out.png")
    assert not (tmp_path / "out.png").exists()


def test_a_cut_out_is_a_matte_too(tmp_path: Path) -> None:
    """Of a picture in RGB its alpha counts, also where it is white; of a grey one its numbers, where it is opaque."""
    cut = np.zeros((8, 8, 4), np.uint8)
    cut[2:6, 2:6] = (255, 255, 255, 80)
    Image.fromarray(cut).save(tmp_path / "cut.png")
    np.testing.assert_allclose(read_matte(tmp_path / "cut.png"), cut[..., 3] / 255.0, atol=1e-6)
    grey = Image.merge("LA", [Image.fromarray(cut[..., 3]), Image.fromarray(np.where(cut[..., 3] > 0, 255, 0).astype(np.uint8))])
    grey.save(tmp_path / "grey.png")
    held = read_matte(tmp_path / "grey.png")
    np.testing.assert_allclose(held[2:6, 2:6], 80 / 255.0, atol=1e-6)
    assert np.isnan(held[0]).all()


def test_a_thin_stroke_stays_in_a_smaller_matte() -> None:
    held = np.full((60, 60), np.nan, np.float32)
    held[:, 27:34] = 1.0
    small = shrunk_matte(held, (12, 12))
    assert (~np.isnan(small)).any(axis=1).all() and np.nanmin(small) == 1.0


def test_many_strokes_do_not_wear_a_matte_away(tmp_path: Path) -> None:
    """Bars of 3 px, softened by every stroke: another stroke far away leaves them as the first one had them."""
    photo = np.full((120, 240, 3), 60, np.uint8)
    photo[20:100, 20:100:12] = photo[20:100, 21:100:12] = photo[20:100, 22:100:12] = 220
    Image.fromarray(cv2.GaussianBlur(photo, (0, 0), 1.5)).save(tmp_path / "bars.png")
    brush, files = Brush(tmp_path / "bars.png", has_depth=False), [tmp_path / f"{number}.png" for number in range(5)]
    brush.paint(None, Stroke(((20.0, 60.0), (100.0, 60.0)), 30.0, is_front=True), files[0])
    for before, after in pairwise(files):
        brush.paint(before, Stroke(((200.0, 60.0),), 6.0, is_front=True), after)
    first, last = (read_matte(each)[:, :150] for each in (files[1], files[-1]))
    assert abs(first.sum() - last.sum()) < 0.002 * first.sum()


def state_with_matte(folder: Path) -> StudioState:
    """Half of the floor's picture is told to be in front of the alien, with a soft edge."""
    matte = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    matte[:, :118] = 1.0
    write_image(folder / "matte.png", cv2.GaussianBlur(matte, (0, 0), 2.0), "linear")
    placed = {"object": ALIEN, "at_px": (120.0, 150.0), "height": "100px", "camera_height_m": 1.2, "pitch_deg": 3.0}
    return StudioState(photo=write_floor(folder / "floor.png"), matte=folder / "matte.png", **placed)  # type: ignore[arg-type]


def test_preview_loupe_and_command_show_what_is_behind_a_matte(tmp_path: Path) -> None:
    state, kept = state_with_matte(tmp_path), KeptParts()
    options, out = options_of(state), tmp_path / "out.png"
    done = mrbokeh(*words_of(options, out))
    assert done.returncode == 0, done.stderr
    stored = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)[..., ::-1]
    opened, _rgb = open_photograph(state.photo)  # type: ignore[arg-type]
    preview = preview_of(opened, options, kept).rgb
    np.testing.assert_array_equal(srgb_codes(preview, np.uint16), stored)
    changed = np.abs(preview - opened.plate.rgb).max(axis=2) > 0.02
    assert changed[80:140, 124:].sum() > 300 and changed[:, :108].sum() == 0
    kept.holds_light = True
    shown = region_of(WholePhotograph(opened), options, kept, Region(120.0, 110.0, 48))
    # But for grain, as the loupe says.
    np.testing.assert_allclose(shown, preview[86:134, 96:144], atol=0.02)


async def opened_desk(desk: Desk) -> None:
    while desk.photograph is None or desk.busy:
        await desk.news_after(desk.number, 1.0)


async def test_what_changes_while_a_tool_works_is_kept(tmp_path: Path) -> None:
    """A cleared matte stays cleared under a stroke that was under way, and a camera of lines is taken whatever else changed."""
    async with made_studio(tmp_path, StudioState(photo=photo_of_disc(tmp_path / "disc.png"), object=CAKE)) as made:
        desk = made.desk
        await opened_desk(desk)
        await desk.paint(stroke_of({"points": [[150, 150]], "radius": 50, "front": True}))
        under_way = asyncio.create_task(desk.paint(stroke_of({"points": [[20, 20]], "radius": 10, "front": True})))
        await asyncio.sleep(0)
        await desk.change({"matte": None})
        await under_way
        held = read_matte(desk.state.matte)  # type: ignore[arg-type]
        assert held[20, 20] > 0.5 and held[150, 150] == 0.0
        with pytest.raises(InputError, match="no picture 3 of a focal stack"):
            await desk.change({"slice": 3})
    (tmp_path / "floor").mkdir()
    async with made_studio(tmp_path / "floor", StudioState(photo=write_floor(tmp_path / "floor.png"), object=CAKE)) as made:
        desk = made.desk
        await opened_desk(desk)
        under_way = asyncio.create_task(desk.change({"lines": FLOOR_LINES}))
        await asyncio.sleep(0.01)
        await desk.change({"exposure": 1.5})
        await under_way
        assert desk.state.camera is not None and desk.state.exposure == 1.5 and len(desk.state.lines) == 3


async def test_pages_paint_and_see_it(tmp_path: Path) -> None:
    async with made_studio(tmp_path, StudioState(photo=photo_of_disc(tmp_path / "disc.png"), object=CAKE)) as made:
        desk = made.desk
        while desk.photograph is None or desk.busy:
            await desk.news_after(desk.number, 1.0)
        await desk.paint(stroke_of({"points": [[150, 150]], "radius": 50, "front": True}))
        first = desk.state.matte
        assert first is not None and first.parent.name == "studio_files" and read_matte(first)[150, 150] == 1.0
        await desk.paint(stroke_of({"points": [[150, 150]], "radius": 20, "front": False}))
        assert desk.state.matte != first and read_matte(desk.state.matte)[150, 150] < 0.5  # type: ignore[arg-type]
        await desk.step(-1)
        assert desk.state.matte == first and first.is_file()
        await desk.change({"matte": None})
        assert desk.state.matte is None
        with pytest.raises(InputError, match="only what it was offered"):
            await desk.change({"matte": "/etc/passwd"})


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ({}, "points of a stroke as a list"),
        ({"points": [], "radius": 5, "front": True}, "points of a stroke as a list"),
        ({"points": [[1, "x"]], "radius": 5, "front": True}, r"points\[0\]\[1\] to be a number"),
        ({"points": [[1, 2]], "radius": 0, "front": True}, "radius to be a number from 1"),
        ({"points": [[1, 2]], "radius": 5, "front": 1}, "front to be true or false"),
    ],
)
def test_strokes_that_cannot_be_meant_are_refused(message: dict[str, object], why: str) -> None:
    with pytest.raises(InputError, match=why):
        stroke_of(message)


async def test_a_shadow_tells_the_sun_in_pixels_of_the_whole_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A level camera, a post of 30 px and its shadow of 60 px straight to the left, in a photograph that is larger than its preview."""
    monkeypatch.setattr(photograph, "solved", unsolved)
    photo = write_floor(tmp_path / "floor.png", 5 * WIDTH, 5 * HEIGHT)
    async with made_studio(tmp_path, StudioState(photo=photo, object=CAKE, pitch_deg=0.0, plain=True)) as made:
        desk = made.desk
        while desk.photograph is None or desk.busy:
            await desk.news_after(desk.number, 1.0)
        said = await desk.sun_by(shadow_of({"points": [[5 * 120, 5 * 120], [5 * 120, 5 * 150], [5 * 60, 5 * 150]]}))
        assert said.startswith("by the shadow the sun is 90 degrees to the right of the view and 27 above")
        assert desk.state.sun_deg == pytest.approx((90.0, np.degrees(np.arctan(0.5))), abs=0.05) and not desk.state.plain
        for points, why in (([[1, 2], [3, 4]], "three points"), ([[600, 560], [600, 375], [310, 750]], "foot lies above the horizon")):
            with pytest.raises(InputError, match=why):
                await desk.sun_by(shadow_of({"points": points}))


async def test_drawn_lines_give_the_camera_until_they_are_taken_away(tmp_path: Path) -> None:
    async with made_studio(tmp_path, StudioState(photo=write_floor(tmp_path / "floor.png"), object=CAKE, pitch_deg=12.0)) as made:
        desk = made.desk
        while desk.photograph is None or desk.busy:
            await desk.news_after(desk.number, 1.0)
        await desk.change({"lines": FLOOR_LINES[:1]})
        assert desk.state.camera is None and desk.state.pitch_deg == 12.0 and "too little" in (desk.camera_told() or {})["told"]
        await desk.change({"lines": FLOOR_LINES})
        assert desk.state.camera is not None and desk.state.pitch_deg is None and "drawn lines" in (desk.camera_told() or {})["told"]
        solved = read_solved_camera(desk.state.camera)
        assert (solved.width_px, solved.height_px) == (WIDTH, HEIGHT)
        assert abs(solved.pitch_deg) < 0.3 and abs(solved.roll_deg) < 0.3
        first = desk.state
        await desk.step(-1)
        assert len(desk.state.lines) == 1
        await desk.step(1)
        assert desk.state == first
        kept = read_project(desk.project.path)
        assert kept.state.lines == tuple(tuple(each) for each in FLOOR_LINES)
        await desk.change({"lines": []})
        found = desk._cameras[desk.state.photo]
        expected = Path(found["file"]) if found.get("is_sure") else None
        assert desk.state.lines == () and desk.state.camera == expected != first.camera


async def test_a_known_height_tells_how_high_the_camera_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A level camera, a foot 60 px below the horizon and a head 10 px below it: the camera is 60 / 50 times as high as that is."""
    monkeypatch.setattr(photograph, "solved", unsolved)
    photo = write_floor(tmp_path / "floor.png", 5 * WIDTH, 5 * HEIGHT)
    first = StudioState(photo=photo, object=CAKE, pitch_deg=0.0, at_px=(600.0, 750.0))
    async with made_studio(tmp_path, first) as made:
        desk = made.desk
        await opened_desk(desk)
        await comes_true(lambda: desk.state.camera_height_m is not None)
        before = desk.state
        assert before.camera_height_m == 1.5 and before.height is not None
        person = [5 * 120, 5 * 150, 5 * 121, 5 * 100, 1.75]
        await desk.change({"measured": person})
        assert desk.state.camera_height_m == pytest.approx(1.75 * 60 / 50, rel=1e-3)
        assert float(desk.state.height or 0) == pytest.approx(float(before.height) * 2.1 / 1.5, rel=1e-3), "as large in the picture"
        assert read_project(desk.project.path).state.measured == tuple(map(float, person))
        await desk.change({"height": "0.5"}, metres_typed=True)
        await desk.change({"measured": [*person[:4], 0.875]}, metres_typed=True)
        assert desk.state.camera_height_m == pytest.approx(1.05, rel=1e-3) and desk.state.height == "0.5"
        # Tilted down by 20 degrees the same pixels are another height: of the rays' own geometry.
        await desk.change({"pitch_deg": 20.0})
        assert desk.photograph is not None
        focal_px = desk.photograph.plate_for(options_of(desk.state), 1e5)[0].lens.focal_px(5 * WIDTH)
        down = np.radians(20.0) + np.arctan(np.array([5 * 60, 5 * 10]) / focal_px)
        wanted_m = 0.875 / (1.0 - np.tan(down[1]) / np.tan(down[0]))
        assert desk.state.camera_height_m == pytest.approx(wanted_m, rel=2e-3)
        for measured, why in (
            ([5, 5 * 60, 5, 5 * 20, 1.7], "below the horizon"),
            ([8, 8, 8, 9], "metres"),
            ([0, 800, 1180, 800, 2], "leans"),
        ):
            with pytest.raises(InputError, match=why):
                await desk.change({"measured": measured, "pitch_deg": 0.0})


def test_drawn_lines_count_in_pixels_of_the_whole_photograph(tmp_path: Path) -> None:
    """A photograph of 1.6 MP, whose preview is smaller: the camera of its lines is that of the whole."""
    scale = 6.0
    opened, _rgb = open_photograph(write_floor(tmp_path / "large.png", round(scale * WIDTH), round(scale * HEIGHT)))
    lines = [(*(scale * each for each in line[:4]), line[4]) for line in FLOOR_LINES]  # type: ignore[operator]
    solved = solved_by_hand(opened, lines)  # type: ignore[arg-type]
    assert (solved.width_px, solved.height_px) == opened.size_px and opened.plate.rgb.shape[1] < solved.width_px
    assert abs(solved.pitch_deg) < 0.3 and 0.3 < solved.focal_length_px / solved.width_px < 3.0
    assert max(solved.segments_px[: len(lines)].max(1)) > opened.plate.rgb.shape[1], "segments too"


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ("x", "list of at most 60 lines"),
        ([[0, 0, 5, 5]], "x1, y1, x2, y2 and its direction"),
        ([[0, 0, 5, 5, "w"]], "x1, y1, x2, y2 and its direction"),
        ([[3, 3, 3, 3, "y"]], "draw along an edge"),
        ([[3, 3, -3, 3, "y"]], "number from 0"),
    ],
)
def test_lines_that_cannot_be_meant_are_refused(lines: object, why: str) -> None:
    with pytest.raises(InputError, match=why):
        state_of({"lines": lines})
