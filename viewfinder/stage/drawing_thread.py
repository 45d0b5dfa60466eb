"""DrawingThread: draws the newest request beside the stream, as finely as time allows, and reloads the scene when its files change."""

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Event, Lock, Thread

from mrbokeh.system.errors import InputError
from viewfinder.frames import Newest
from viewfinder.stage.drawing import Drawing, DrawRequest, draw, is_outdated
from viewfinder.stage.stage_setup import SceneWatch, SetupLoader, StageSetup

RESOLUTIONS = (1.0, 0.75, 0.5)
LONGEST_S = 1 / 8
_SPARE = 0.8


class AdaptiveResolution:
    """Resolution of the next drawing (`now`). The time of a drawing grows with its pixels."""

    def __init__(self) -> None:
        self.now = 1.0

    def took(self, resolution: float, seconds: float) -> None:
        """Learn that a drawing at this resolution took so long."""
        place = RESOLUTIONS.index(resolution)
        if seconds > LONGEST_S:
            self.now = RESOLUTIONS[min(place + 1, len(RESOLUTIONS) - 1)]
        elif place == 0:
            self.now = resolution
        else:
            finer = RESOLUTIONS[place - 1]
            self.now = finer if seconds * (finer / resolution) ** 2 < _SPARE * LONGEST_S else resolution


_POLL_S = 0.1
_WATCH_S = 0.25
_AFTER_FAILURE_S = 0.25
_RATE_OVER_S = 2.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Drawing with what it was drawn from; started_s, finished_s: by `time.monotonic`."""

    drawing: Drawing
    setup: StageSetup
    started_s: float
    finished_s: float


class DrawingThread:
    """Thread that draws. newest: the last drawing that was finished. Requests that come while one is drawn replace one another.

    problem: a sentence about what keeps the scene file from being read or the scene from being drawn; None if nothing does.
    """

    def __init__(self, loader: SetupLoader) -> None:
        self._loader, self._setup, self._swapping = loader, loader.load(), Lock()
        self._watch = SceneWatch(self._setup.staged.description.files)
        self._asked: Newest[DrawRequest] = Newest()
        self._resolution, self._ends_s = AdaptiveResolution(), deque[float](maxlen=64)
        self._of_file, self._of_drawing = "", ""
        self.newest: Drawn | None = None
        self._busy, self._stopping = Event(), Event()
        self._thread = Thread(target=self._work, name="stage", daemon=True)
        self._thread.start()

    @property
    def setup(self) -> StageSetup:
        return self._setup

    @property
    def busy(self) -> bool:
        return self._busy.is_set()

    @property
    def problem(self) -> str | None:
        return self._of_file or self._of_drawing or None

    @property
    def draws_per_s(self) -> float:
        """Rate of drawings over the last two seconds."""
        since_s = time.monotonic() - _RATE_OVER_S
        return sum(end_s > since_s for end_s in tuple(self._ends_s)) / _RATE_OVER_S

    def ask(self, request: DrawRequest, finest: bool = False) -> None:
        """Draw this next; at the resolution that there is time for, or finest at every pixel."""
        self._asked.put(replace(request, resolution=1.0 if finest else self._resolution.now))

    def change(self, changed: Callable[[StageSetup], StageSetup]) -> None:
        """Swap the setup for a changed one; what `changed` raises goes to the caller and changes nothing."""
        with self._swapping:
            self._setup = changed(self._setup)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        looked_s = time.monotonic()
        while not self._stopping.is_set():
            request = self._asked.take(_POLL_S)
            if time.monotonic() - looked_s > _WATCH_S:
                self._reload_if_changed()
                looked_s = time.monotonic()
            if request is None or self._is_drawn(request):
                continue
            self._busy.set()
            self._draw(request)
            self._busy.clear()

    def _is_drawn(self, request: DrawRequest) -> bool:
        """Tell whether what was drawn since it was asked for will do: while one view is drawn, every frame asks for it again."""
        newest, setup = self.newest, self._setup
        if newest is None or newest.setup is not setup or newest.drawing.request.resolution < request.resolution:
            return False
        return not is_outdated(newest.drawing, request, setup.staged.is_animated)

    def _draw(self, request: DrawRequest) -> None:
        setup, started_s = self._setup, time.monotonic()
        try:
            drawing = draw(setup.staged, request, setup.render_setup)
        except Exception as error:
            # The stream goes on with the old drawing; another pose, focus or renderer may work.
            if not isinstance(error, InputError):
                log.exception("the scene could not be drawn")
            self._of_drawing = f"the scene could not be drawn: {error}"
            self._stopping.wait(_AFTER_FAILURE_S)
            return
        finished_s = time.monotonic()
        if self.newest is not None and self.newest.setup is setup:
            # The first drawing of a setup loads kernels and prepares the scene: it says nothing about the next.
            self._resolution.took(request.resolution, finished_s - started_s)
        self._of_drawing = ""
        self._ends_s.append(finished_s)
        self.newest = Drawn(drawing, setup, started_s, finished_s)

    def _reload_if_changed(self) -> None:
        if not self._watch.changed():
            return
        files = self._setup.staged.description.files
        try:
            loaded = self._loader.load(self._setup)
        except InputError as error:
            self._of_file = str(error)
        except Exception:
            log.exception("the scene file could not be loaded")
            self._of_file = f"{self._loader.path} could not be loaded; see the terminal"
        else:
            files, self._of_file = loaded.staged.description.files, ""
            self.change(lambda _: loaded)
        self._watch.follow(files)
