"""SenderClock: the sender's time in ours, freed of the network's jitter."""

from collections import deque


class SenderClock:
    """A packet is never early: of the last arrivals the least delayed one tells how the clocks differ (as in NTP's clock filter,
    RFC 5905). What all packets are late by stays in; the delay between video and pose, which the user sets, contains it.
    """

    def __init__(self, window: int = 128) -> None:
        self._differences_s: deque[float] = deque(maxlen=window)

    def ours_s(self, sender_s: float | None, arrived_s: float) -> float:
        """When it was sent, by our clock; a sender that says no time is taken at the arrival."""
        if sender_s is None:
            return arrived_s
        self._differences_s.append(arrived_s - sender_s)
        return sender_s + min(self._differences_s)
