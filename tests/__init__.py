"""Tests; types of arguments are checked as type checkers do: a whole number may stand for a float, as in `Lens(50, 2)` of the API."""

from typing import Any


def __getattr__(name: str) -> Any:
    """Make `checked` where it is asked for first: workers that import what a test sends them check no types, and begin sooner."""
    if name != "checked":
        raise AttributeError(name)
    try:
        from beartype import BeartypeConf, beartype
    except ModuleNotFoundError:  # a machine lent for its GPU has only what it has: tests/conftest.py then checks no types
        made = None
    else:
        made = beartype(conf=BeartypeConf(is_pep484_tower=True))
    globals()[name] = made
    return made
