"""Capture times on the clock of RTP."""

from viewfinder.streaming.encoder import TICKS_PER_S


class RtpClock:
    """Counts from the first picture; grows also where a picture is shown twice or a camera's clock steps back."""

    def __init__(self) -> None:
        self._origin_s: float | None = None
        self._last_ticks = -1

    def ticks(self, captured_s: float) -> int:
        """In units of `encoder.TIME_BASE`."""
        if self._origin_s is None:
            self._origin_s = captured_s
        self._last_ticks = max(self._last_ticks + 1, round((captured_s - self._origin_s) * TICKS_PER_S))
        return self._last_ticks
