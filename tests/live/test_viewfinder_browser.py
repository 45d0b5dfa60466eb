"""The page of a viewfinder with a finished layer in a real browser, where Chromium is installed."""

from pathlib import Path

import numpy as np
import pytest

from datasets_scripts.gallery.headless_chromium import CHROMIUM, chromium_page
from tests.scenes.layer_viewfinder import HEIGHT, WIDTH, in_time, running, write_plate
from viewfinder.sources.playback import VideoFileSource


@pytest.fixture
def plate(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return write_plate(tmp_path)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed; the page is tested by clients in Python only")
@pytest.mark.parametrize("transport", ["whep", "jpeg"])
def test_the_page_shows_the_stream_in_a_browser(tmp_path: Path, plate: tuple[Path, np.ndarray], transport: str) -> None:
    """The plate on the screen, red in the square, and beside the square more red when a finger has moved the focus."""

    async def work() -> None:
        async with (
            running(VideoFileSource(plate[0], WIDTH, HEIGHT)) as url,
            chromium_page(f"{url}?transport={transport}", tmp_path / "profile") as page,
        ):

            async def color_at(x_px: float, y_px: float) -> np.ndarray:
                left, top, width, height = await page.box("#stage")
                column, row = int(left + (x_px + 0.5) / WIDTH * width), int(top + (y_px + 0.5) / HEIGHT * height)
                return (await page.screenshot())[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)

            await page.comes_true("window.viewfinder && viewfinder.counts.shown > 20 && viewfinder.age > 0")
            assert 0 < float(await page.value("viewfinder.age")) < 1000
            np.testing.assert_allclose(await color_at(20, 20), plate[1][20, 20, ::-1], atol=10)
            beside = (await color_at(64, 45))[0]
            await page.value("(s => { s.value = 1; s.dispatchEvent(new Event('input')); })(document.getElementById('focus'))")
            await page.comes_true("viewfinder.focus === 1")
            assert (await color_at(64, 45))[0] > beside + 25
            assert await page.value("document.getElementById('message').textContent") == ""
            assert page.errors == []

    in_time(work, 60.0)
