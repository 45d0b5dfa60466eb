"""The page in a real headless Chromium at the sizes of phones and screens: nothing lies over a control, and what must be told is seen."""

import asyncio
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from datasets_scripts.gallery.headless_chromium import CHROMIUM, Page, chromium_page
from tests.scenes.made_viewfinder import in_time, made_viewfinder

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the page is tested by clients in Python only"),
]
SIZES = [(390, 844), (844, 390), (960, 600), (1280, 720)]
SHOWN = "window.viewfinder && viewfinder.counts.shown > 3"

# Each control with the part of it that its scrolling ancestors and the window leave visible.
VISIBLE = """[...document.querySelectorAll('#stage, button, input, select, summary')].map((control) => {
  let { left, top, right, bottom } = control.getBoundingClientRect();
  for (let box = control.parentElement; box; box = box.parentElement) {
    if (getComputedStyle(box).overflowY === 'visible') continue;
    const clip = box.getBoundingClientRect();
    [left, top] = [Math.max(left, clip.left), Math.max(top, clip.top)];
    [right, bottom] = [Math.min(right, clip.right), Math.min(bottom, clip.bottom)];
  }
  [right, bottom] = [Math.min(right, innerWidth), Math.min(bottom, innerHeight)];
  return { name: control.id || control.textContent, box: [Math.max(left, 0), Math.max(top, 0), right, bottom] };
}).filter(({ box }) => box[2] - box[0] > 0.5 && box[3] - box[1] > 0.5)"""

# What a finger meets that aims at the middle of a control, once the page was scrolled to it.
UNREACHABLE = """[...document.querySelectorAll('button, input, select, summary')]
  .filter((control) => control.checkVisibility() && control.getBoundingClientRect().width > 0)
  .filter((control) => {
    control.scrollIntoView({ block: 'nearest' });
    const box = control.getBoundingClientRect();
    const met = document.elementFromPoint((box.left + box.right) / 2, (box.top + box.bottom) / 2);
    return !(met && (control.contains(met) || met.contains(control) && met.tagName === 'LABEL'));
  }).map((control) => control.id || control.textContent)"""


def overlapping(controls: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Pairs whose boxes share more than half a pixel."""
    found = []
    for one, other in combinations(controls, 2):
        (left, top, right, bottom), (x, y, x_end, y_end) = one["box"], other["box"]
        if min(right, x_end) - max(left, x) > 0.5 and min(bottom, y_end) - max(top, y) > 0.5:
            found.append((one["name"], other["name"]))
    return found


async def assert_nothing_covered(page: Page, what: str) -> None:
    for scrolled in (0, 10_000):
        await page.value(f"document.getElementById('panel').scrollTo(0, {scrolled})")
        controls = await page.value(VISIBLE)
        assert {"stage", "capture", "record"} <= {each["name"] for each in controls}, what
        assert overlapping(controls) == [], what
    assert await page.value(UNREACHABLE) == [], what
    assert await page.value("document.documentElement.scrollWidth <= innerWidth"), what


def test_no_control_covers_another_at_any_size(tmp_path: Path) -> None:
    """Where the capture buttons floated, they lay over "smooth tracking" at 960x600. With all aids open, for both hands."""

    async def work() -> None:
        async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
            await page.comes_true(SHOWN)
            await page.value("document.querySelector('vf-aids details').open = true")
            for width_px, height_px in SIZES:
                await page.size(width_px, height_px)
                for hand in ("right", "left"):
                    await asyncio.sleep(0.3)
                    await assert_nothing_covered(page, f"{width_px}x{height_px}, {hand} hand")
                    stage = await page.box("#stage")
                    assert stage[2] * stage[3] > 0.25 * width_px * height_px, "the picture is what the page is for"
                    await page.value("document.getElementById('aid_leftHand').click()")
            assert page.errors == []

    in_time(work, 90.0)


def test_the_page_says_where_the_focus_came_from_and_when_the_tilt_is_unsure(tmp_path: Path) -> None:
    focus, badge = "document.getElementById('focus_from').textContent", "document.getElementById('tracking')"

    async def work() -> None:
        async with made_viewfinder() as made, chromium_page(made.url, tmp_path / "profile") as page:
            await page.comes_true(SHOWN)
            assert await page.value(focus) == "from the file of the lens"
            for name, told in (("by hand", "by hand"), ("blur of the board", "from blur of the board"), ("the camera", "from the camera")):
                made.controls.values["focus_from"] = name
                await page.comes_true(f"{focus} === '{told}'")
            # Seen without scrolling, on the smallest phone.
            left, top, width, height = await page.box("#focus_from")
            assert left >= 0 and left + width <= 390 and top + height < (await page.box("vf-shutter"))[1]
            made.controls.values |= {"tracking": 0.07, "tracking_unsure": True}
            await page.comes_true(f"{badge}.textContent === 'tilt unsure: go nearer' && {badge}.dataset.quality === 'unsure'")
            made.controls.values |= {"tracking": 0.9, "tracking_unsure": False}
            await page.comes_true(f"{badge}.textContent === 'tracking 90 %'")
            assert page.errors == []

    in_time(work, 60.0)
