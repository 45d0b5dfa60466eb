"""Who watches a stream, and what all of them are told when it fails."""

from collections.abc import Callable
from threading import Lock

from viewfinder.streaming.viewer_queue import ViewerQueue


class Audience:
    """Viewers come and go in any thread. failure: why there are no pictures; None where there are."""

    def __init__(self, capacity: int) -> None:
        """capacity: packets that may wait for one viewer."""
        self._capacity, self._lock = capacity, Lock()
        self.viewers: tuple[ViewerQueue, ...] = ()
        self.failure: str | None = None

    @property
    def wants_frames(self) -> bool:
        return any(viewer.wants_frames for viewer in self.viewers)

    def join(self, codec: str, wake: Callable[[], None]) -> ViewerQueue:
        """A new viewer's queue; who comes while the stream fails is told."""
        viewer = ViewerQueue(codec, self._capacity, wake)
        viewer.failure = self.failure
        with self._lock:
            self.viewers = (*self.viewers, viewer)
        return viewer

    def leave(self, viewer: ViewerQueue) -> None:
        with self._lock:
            self.viewers = tuple(each for each in self.viewers if each is not viewer)

    def tell(self, failure: str | None) -> None:
        self.failure = failure
        for viewer in self.viewers:
            viewer.fail(failure)
