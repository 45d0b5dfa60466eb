"""A whole viewfinder in this process, from the source to the server, and a viewer that knows what it sees and when it was captured."""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
from aiortc.mediastreams import MediaStreamError

from mrbokeh.optics.lens import Lens
from mrbokeh.video.color import color_of
from mrbokeh.video.frames import display_bgr
from tests.support.live_clip import LiveClip, board_tracker
from tests.support.streaming_viewers import Viewer, watching
from tests.support.traced_board_clip import LENS
from viewfinder.app.live_compositor import CompositedFrame
from viewfinder.app.opening import LensBook, Parts, open_overlays, renderers_of
from viewfinder.app.running import Viewfinder, running
from viewfinder.options import ViewfinderOptions
from viewfinder.server.endpoint import serving_site
from viewfinder.sources.frame_source import FrameSource, SizeLimit
from viewfinder.sources.playback import VideoFileSource

WIDE = Lens(22.0, 2.0, 0.6, 24.0)
"""The clip's lens opened to f/2."""


@dataclass(frozen=True, eq=False)
class Live:
    """url ends with a slash."""

    viewfinder: Viewfinder
    url: str

    async def ask(self, message: Any) -> tuple[int, dict[str, Any]]:
        """POST /control: (HTTP status, answer)."""
        async with aiohttp.ClientSession() as session, session.post(self.url + "control", json=message) as answer:
            return answer.status, await answer.json()

    async def done(self, message: Any) -> dict[str, Any]:
        status, answer = await self.ask(message)
        assert status == 200, answer
        return answer

    async def state(self) -> dict[str, Any]:
        async with aiohttp.ClientSession() as session, session.get(self.url + "state") as answer:
            return await answer.json()

    @property
    def moment(self) -> CompositedFrame:
        """What the newest picture was made of; there must have been one."""
        return self.viewfinder.compositor.last

    @property
    def is_watched(self) -> bool:
        """Whether anybody wants pictures."""
        return any(sink.wants_frame for sink in self.viewfinder.pipeline._sinks)


@asynccontextmanager
async def live(
    clip: LiveClip, captures: Path, source: FrameSource | None = None, lenses: Mapping[str, Lens] | None = None
) -> AsyncIterator[Live]:
    """With a board tracker, the polygon renderer and the ray caster. source: the clip as a file unless given. All threads must end."""
    before = Counter(thread.name for thread in threading.enumerate())
    width, height = clip.plates[0].shape[1::-1]
    renderers = renderers_of(["polygon", "scatter"], (), {})
    book = LensBook(lenses or {"clip": LENS, "wide": WIDE})
    options = ViewfinderOptions(str(clip.path), scene=clip.scene, backend="embree", captures=captures)
    overlays = open_overlays(options, book.lens, renderers)
    source = source or VideoFileSource(clip.path, SizeLimit(width, height))
    parts = Parts(options, source, overlays, book, renderers, tracker=board_tracker(), intrinsics=clip.cameras[0])
    with running(parts) as viewfinder:
        async with serving_site(viewfinder.site, "127.0.0.1", 0) as url:
            yield Live(viewfinder, url)
    assert_threads_ended(before)


def assert_threads_ended(before: Counter[str], limit_s: float = 5.0) -> None:
    """No more than before; those of executors may end a moment later, and those of the event loop with the loop."""
    end_s = time.monotonic() + limit_s
    while left := Counter(thread.name for thread in threading.enumerate() if not thread.name.startswith("asyncio")) - before:
        assert time.monotonic() < end_s, left
        time.sleep(0.02)


class Seen:
    """A decoded picture and the status that came for it. arrived_s: when its decoding was done."""

    def __init__(self, frame: Any, status: dict[str, Any], arrived_s: float) -> None:
        self._frame, self.status, self.arrived_s = frame, status, arrived_s
        self.sequence = int(status["sequence"])

    @cached_property
    def bgr(self) -> np.ndarray:
        """8-bit codes (H, W, 3), blue first."""
        return display_bgr(self._frame, color_of(self._frame, "stream"), (self._frame.width, self._frame.height))


class Watcher:
    """Takes pictures from a viewer all the time, as a screen does, and keeps those since `forget`; looks at the `most` newest."""

    def __init__(self, viewer: Viewer, keeps: bool = True, most: int = 400) -> None:
        self.viewer, self.count = viewer, 0
        self._most, self._keeps, self._shown, self._joined = most, keeps, list[tuple[Any, float]](), dict[int, Seen]()
        self._start = (0, 0)
        """How many pairs of a picture and a status agreed on it, and the RTP timestamp of the decoder's first picture."""
        self._task = asyncio.create_task(self._take())

    async def _take(self) -> None:
        with suppress(MediaStreamError):
            while True:
                frame = await self.viewer.transceiver.receiver.track.recv()
                self.count += 1
                if self._keeps:
                    self._shown.append((frame, time.monotonic()))

    async def stop(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    def forget(self) -> None:
        self._shown.clear()
        self._joined.clear()
        del self.viewer.messages[:-1]

    async def more(self, count: int, limit_s: float = 60.0) -> list[Seen]:
        """The pictures of which a status is known, as soon as there are so many since now."""
        self.forget()
        return await self.until(lambda seen: len(seen) >= count, limit_s)

    async def until(self, true_of: Callable[[list[Seen]], bool], limit_s: float = 60.0) -> list[Seen]:
        async with asyncio.timeout(limit_s):
            while not true_of(seen := self.seen()):
                assert not self._task.done(), "the stream ended"
                await asyncio.sleep(0.1)
        return seen

    def seen(self) -> list[Seen]:
        """Joined by the RTP timestamp; the decoder counts from its first picture, so that its start is what most ever agreed on."""
        shown, statuses = self._shown[-self._most :], self.viewer.statuses()
        starts = Counter((each["rtp_timestamp"] - frame.pts) & 0xFFFFFFFF for each in statuses for frame, _ in shown)
        if not starts:
            return []
        [(start, agreeing)] = starts.most_common(1)
        if agreeing > self._start[0]:
            if start != self._start[1]:
                # Where few pictures are known a wrong start may have as many votes.
                self._joined.clear()
            self._start = (agreeing, start)
        start = self._start[1]
        by_ticks = {(each["rtp_timestamp"] - start) & 0xFFFFFFFF: each for each in statuses}
        for frame, at_s in shown:
            if frame.pts in by_ticks and frame.pts not in self._joined:
                self._joined[frame.pts] = Seen(frame, by_ticks[frame.pts], at_s)
        return [self._joined[ticks] for ticks in sorted(self._joined)]


@asynccontextmanager
async def watcher(url: str, keeps: bool = True) -> AsyncIterator[Watcher]:
    """Over WHEP. keeps: False only counts pictures."""
    async with watching(url.rstrip("/")) as viewer:
        watch = Watcher(viewer, keeps)
        try:
            yield watch
        finally:
            await watch.stop()
