"""JpegStream: a FrameSink that encodes each picture once, in a thread of its own, for all WebSockets that wait for one.

A message of the stream is a 4-byte big-endian length, a JSON header of that length, and a JPEG.
"""

import json
import logging
import struct
import time
from threading import Event, Thread
from typing import Any

from viewfinder.flow.frame_header import frame_header
from viewfinder.flow.frames import OutputFrame
from viewfinder.flow.newest import Newest
from viewfinder.server.waiting_room import WaitingRoom

_POLL_S = 0.1

log = logging.getLogger(__name__)


class JpegStream:
    """Runs until `close`, or the end of a `with`. room: where the sockets wait for messages and hear of failures."""

    def __init__(self, jpeg_quality: int = 85) -> None:
        self.room = WaitingRoom()
        self._jpeg_quality = jpeg_quality
        self._newest: Newest[OutputFrame] = Newest()
        self._encoding, self._stopping = Event(), Event()
        self._thread = Thread(target=self._work, name="jpeg", daemon=True)
        self._thread.start()

    @property
    def wants_frame(self) -> bool:
        """Whether a viewer waits whom the picture at hand will not reach."""
        return self.room.waited_for and not self._encoding.is_set() and not self._newest.waiting

    def show(self, frame: OutputFrame) -> None:
        self._newest.put(frame)

    def fail(self, sentence: str) -> None:
        self.room.fail(sentence)

    def __enter__(self) -> "JpegStream":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread; sockets get nothing more."""
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stopping.is_set():
            frame = self._newest.take(_POLL_S)
            if frame is None or not self.room.waited_for:
                continue
            self._encoding.set()
            try:
                self.room.publish(jpeg_message(frame, self._jpeg_quality))
            except Exception:
                log.exception("a picture could not be encoded")
            finally:
                self._encoding.clear()


def jpeg_message(frame: OutputFrame, jpeg_quality: int) -> bytes:
    """A message of the stream; the time of the encoding is the last of its stages."""
    import cv2

    started_s = time.perf_counter()
    jpeg = cv2.imencode(".jpg", frame.bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
    header = frame_header(frame)
    header["stages_ms"]["jpeg"] = round(1000 * (time.perf_counter() - started_s), 2)
    return packed(header, jpeg)


def packed(header: dict[str, Any], jpeg: bytes) -> bytes:
    """Length of the header, header, JPEG."""
    encoded = json.dumps(header).encode()
    return struct.pack(">I", len(encoded)) + encoded + jpeg
