"""One Chromium for all tests of a process that need no flags of their own: to start one takes longer than most pages do."""

import atexit
import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path

from datasets_scripts.gallery.pictures import Chromium, Page


@cache
def _browser() -> Chromium:
    profile = Path(tempfile.mkdtemp(prefix="mrbokeh_chromium_"))
    atexit.register(shutil.rmtree, profile, ignore_errors=True)
    browser = Chromium(profile)
    atexit.register(browser.close)  # before its profile goes
    return browser


@asynccontextmanager
async def shared_page(url: str, size_px: tuple[int, int] = (390, 844), script: str = "") -> AsyncIterator[Page]:
    """A page with cookies and storage of its own."""
    async with _browser().page(url, size_px, script) as page:
        yield page
