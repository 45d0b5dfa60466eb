"""The data channel "status": beside the pictures what is known of each, and a clock.

The page gets a JSON object for each picture (see `frame_header`) with the RTP timestamp by which `requestVideoFrameCallback` names
the picture on the screen, and {"failure": sentence} when the camera fails; it may ask {"clock": t} and gets
{"clock": t, "server_ms": now} for the age of what it shows.
"""

import json
import time
from typing import Any

from aiortc import RTCDataChannel

LABEL = "status"
# More in the channel than this means that the network does not carry it: later messages say the same of newer pictures.
_CHANNEL_FULL_BYTES = 32768
_LARGEST_MESSAGE = 1024


class StatusChannel:
    """Says nothing until the page has opened its channel."""

    def __init__(self) -> None:
        self._channel: RTCDataChannel | None = None

    def open(self, channel: RTCDataChannel, failure: str | None) -> None:
        """failure: what the camera suffers from now."""
        self._channel = channel
        channel.on("message", self._answer)
        if failure:
            self.say({"failure": failure})

    def say(self, message: dict[str, Any]) -> None:
        channel = self._channel
        if channel is not None and channel.readyState == "open" and channel.bufferedAmount < _CHANNEL_FULL_BYTES:
            channel.send(json.dumps(message))

    def _answer(self, text: str | bytes) -> None:
        """A message that is not understood changes nothing."""
        try:
            message = json.loads(text) if len(text) <= _LARGEST_MESSAGE else None
        except (ValueError, RecursionError):
            message = None
        if isinstance(message, dict) and set(message) == {"clock"} and isinstance(message["clock"], int | float):
            self.say({"clock": message["clock"], "server_ms": 1000 * time.monotonic()})
        else:
            self.say({"error": 'expected {"clock": milliseconds}'})
