"""The viewfinder for a long time, with viewers in processes of their own who come and go: memory, threads and open files stay.

MRBOKEH_SOAK_S: how long, in seconds; 600 unless set.
"""

import asyncio
import gc
import json
import os
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.live_clip import write_live_clip
from tests.scenes.live_viewfinder import Live, live
from tests.scenes.streaming_viewers import comes_true

SOAK_S = float(os.environ.get("MRBOKEH_SOAK_S", "600"))
WARM_UP = 0.3
"""This share of the rounds, and at least four, may grow: kernels are loaded and allocators take what they will keep."""
GROWTH_MB = 24.0
"""A decoded picture of the clip has 0.4 MB: a leak of one in fifty would show in ten minutes."""
VIEWERS_S = (1.0, 3.0, 5.0)


@dataclass(frozen=True)
class Rest:
    """What the process holds while nobody watches."""

    rss_mb: float
    threads: tuple[str, ...]
    open_files: int


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory and open files are read from /proc, which only Linux has")
def test_memory_threads_and_open_files_stay_while_viewers_come_and_go(tmp_path: Path) -> None:
    rests = asyncio.run(asyncio.wait_for(_soak(tmp_path), 2 * SOAK_S + 120))
    settled = rests[max(4, round(WARM_UP * len(rests))) :]
    assert len(settled) >= 3, f"only {len(rests)} rounds: give MRBOKEH_SOAK_S more than {SOAK_S:g}"
    rss_mb = np.array([each.rss_mb for each in settled])
    third = -(-len(rss_mb) // 3)
    growth_mb = float(np.median(rss_mb[-third:]) - np.median(rss_mb[:third]))
    print(f"{len(rests)} rounds in {SOAK_S:g} s, {rss_mb[0]:.0f} to {rss_mb[-1]:.0f} MB, growth of the medians {growth_mb:.1f} MB")
    assert growth_mb < GROWTH_MB
    assert {each.threads for each in settled} == {settled[0].threads}
    assert {each.open_files for each in settled} == {settled[0].open_files}


async def _soak(folder: Path) -> list[Rest]:
    clip, rests = write_live_clip(folder, 480, 270, 12), list[Rest]()
    end_s = time.monotonic() + SOAK_S
    async with live(clip, folder / "captures") as one:
        while time.monotonic() < end_s:
            watching = asyncio.gather(*(_viewer(one.url, seconds) for seconds in VIEWERS_S))
            await _play(one, len(rests))
            rates = await watching
            # Nobody is forgotten: this is no measurement, the cores are shared with the viewers.
            assert min(rates) > 1.0
            await comes_true(lambda: not one.is_watched, 30)
            rests.append(await _rest())
    return rests


async def _viewer(url: str, time_s: float) -> float:
    """Pictures per second that a viewer saw."""
    command = [sys.executable, "-m", "tests.scenes.live_viewers", url, "1", str(time_s)]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    said, _ = await process.communicate()
    assert process.returncode == 0
    return float(json.loads(said.splitlines()[-1])["rates"][0])


async def _play(one: Live, round_number: int) -> None:
    """What a photographer does meanwhile."""
    away_m = 0.02 * (-1) ** round_number
    await comes_true(lambda: one.viewfinder.compositor.last is not None, 60)
    for message in (
        {"object": {"name": "card", "move_m": [away_m, 0.0]}},
        {"focus": {"distance_m": 0.5 + 0.1 * (round_number % 3)}},
        {"lens": ("clip", "wide")[round_number % 2]},
        {"renderer": ("polygon", "scatter")[round_number % 2]},
        {"record": True},
        {"view": "depth"},
    ):
        await one.done(message)
        await asyncio.sleep(0.3)
    await one.done({"view": "final"})
    await comes_true(lambda: one.moment.pose is not None, 60)
    await one.done({"capture": {}})
    await one.done({"record": False})


async def _rest() -> Rest:
    """Two seconds later: sockets of viewers who left close a moment after them."""
    await asyncio.sleep(2.0)
    gc.collect()
    rss_mb = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    threads = sorted(thread.name for thread in threading.enumerate() if not thread.name.startswith("asyncio"))
    return Rest(rss_mb, tuple(threads), await _open_files())


async def _open_files() -> int:
    """The most of several looks: between two passes the clip is closed for a moment."""
    looks = []
    for _ in range(10):
        looks.append(len(os.listdir("/proc/self/fd")))
        await asyncio.sleep(0.05)
    return max(looks)
