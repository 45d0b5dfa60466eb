"""Fade: an object whose track is lost goes away over half a second and comes back as slowly, so that neither startles."""

FADE_S = 0.5


class Fade:
    """opacity: 0 to 1; it begins with 1, for a scene that appears for the first time has nothing to come back from."""

    def __init__(self) -> None:
        self.opacity = 1.0
        self._last_s: float | None = None

    def at(self, is_tracked: bool, time_s: float) -> float:
        """The opacity at a time; times that go back count as no time at all."""
        step = 0.0 if self._last_s is None else max(time_s - self._last_s, 0.0) / FADE_S
        self._last_s = time_s
        self.opacity = min(self.opacity + step, 1.0) if is_tracked else max(self.opacity - step, 0.0)
        return self.opacity
