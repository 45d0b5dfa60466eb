"""How finely to draw: coarser where a drawing takes too long, finer again where there is time."""

RESOLUTIONS = (1.0, 0.75, 0.5)
LONGEST_S = 1 / 8
_SPARE = 0.8


class AdaptiveResolution:
    """now: what the next drawing should have. The time of a drawing grows with its pixels."""

    def __init__(self) -> None:
        self.now = 1.0

    def took(self, resolution: float, seconds: float) -> None:
        """A drawing at this resolution took so long."""
        place = RESOLUTIONS.index(resolution)
        if seconds > LONGEST_S:
            self.now = RESOLUTIONS[min(place + 1, len(RESOLUTIONS) - 1)]
        elif place == 0:
            self.now = resolution
        else:
            finer = RESOLUTIONS[place - 1]
            self.now = finer if seconds * (finer / resolution) ** 2 < _SPARE * LONGEST_S else resolution
