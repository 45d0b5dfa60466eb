"""Numbers as JSON takes them, which has neither nan nor infinity."""


def exact(value: float | None) -> float | str | None:
    """Write what is not finite as a word, which `float` reads."""
    return value if value is None or abs(value) < float("inf") else str(float(value))


def finite(value: float | None) -> float | None:
    """Write null for what is not finite."""
    return value if value is not None and abs(value) < float("inf") else None
