"""RateLimit: so many events per second and address, a few at once."""

import time
from collections import OrderedDict
from collections.abc import Callable

# More addresses than any home or studio has; the one that was quiet for longest is forgotten first.
_MOST_ADDRESSES = 1024


class RateLimit:
    """A bucket per address that holds `burst` events and fills with `per_s` of them each second. For one thread."""

    def __init__(self, per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, burst, clock
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, address: str) -> bool:
        """Take one event from the bucket of an address; False if it is empty, and then nothing is taken."""
        now_s = self._clock()
        left, since_s = self._left.pop(address, (self._burst, now_s))
        left = min(self._burst, left + (now_s - since_s) * self._per_s)
        allowed = left >= 1.0
        self._left[address] = (left - 1.0 if allowed else left, now_s)
        if len(self._left) > _MOST_ADDRESSES:
            self._left.popitem(last=False)
        return allowed
