"""Cameras that go away and come back: opened again and again, with growing pauses."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from threading import Event
from typing import Any, TypeVar

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0

Item = TypeVar("Item")


class CameraAwayError(Exception):
    """The camera is away and may come back; the message is the sentence that people read meanwhile."""


def reconnecting(
    session: Callable[[], Generator[Item, Any, Any]],
    stopping: Event,
    tell: Callable[[str | None], None],
    first_pause_s: float = FIRST_PAUSE_S,
) -> Iterator[Item]:
    """What a session gives, session after session, until `stopping` is set.

    session: opens the camera, yields, closes the camera at its end; raises CameraAwayError where the camera is away. Other errors
    are not caught. tell: gets that sentence, and None as soon as something comes again. Pauses double up to LONGEST_PAUSE_S.
    """
    pause_s = first_pause_s
    while not stopping.is_set():
        try:
            with closing(session()) as items:
                for item in items:
                    tell(None)
                    pause_s = first_pause_s
                    yield item
        except CameraAwayError as error:
            tell(str(error))
        stopping.wait(pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
