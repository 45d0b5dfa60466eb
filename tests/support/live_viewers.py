"""Viewers in a process of their own: `python -m tests.support.live_viewers URL COUNT SECONDS`.

It prints a line as soon as all see pictures, and at the end one JSON object: `rates`, `ages_ms` and `stages_ms` (see
tests/bench/bench_viewfinder.py).
"""

import asyncio
import json
import sys
import time
from contextlib import AsyncExitStack

import aiohttp
import numpy as np

from tests.support.live_viewfinder import Watcher
from tests.support.streaming_viewers import Viewer
from viewfinder.sources.marker_buffer import release_on_marker

_WARM_UP_S = 3.0


async def main(url: str, count: int, time_s: float) -> None:
    async with AsyncExitStack() as closing:
        watchers = [await _watcher(url.rstrip("/"), closing) for _ in range(count)]
        for watch in watchers:
            await watch.until(lambda seen: len(seen) > 5, 60)
        await asyncio.sleep(_WARM_UP_S)
        print("watching", flush=True)
        counted = [watch.count for watch in watchers]
        for watch in watchers:
            watch.forget()
        started_s = time.monotonic()
        await asyncio.sleep(time_s)
        took_s = time.monotonic() - started_s
        rates = [(watch.count - before) / took_s for watch, before in zip(watchers, counted, strict=True)]
        seen = [each for watch in watchers for each in watch.seen()]
    ages_ms = [1000 * each.arrived_s - each.status["captured_ms"] for each in seen]
    names = dict.fromkeys(name for each in seen for name in each.status.get("stages_ms", {}))
    stages_ms = {name: float(np.median([each.status["stages_ms"].get(name, 0.0) for each in seen])) for name in names}
    print(json.dumps({"rates": rates, "ages_ms": ages_ms, "stages_ms": stages_ms}), flush=True)


async def _watcher(url: str, closing: AsyncExitStack) -> Watcher:
    """aiortc keeps every picture until the next one begins; browsers do not, and neither do we."""
    viewer = Viewer()
    closing.push_async_callback(viewer.peer.close)
    release_on_marker(viewer.transceiver.receiver)
    async with aiohttp.ClientSession() as session:
        await viewer.connect(url, session)
    watch = Watcher(viewer, most=100_000)
    closing.push_async_callback(watch.stop)
    return watch


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3])))
