"""Tests; types of arguments are checked as type checkers do: a whole number may stand for a float, as in `Lens(50, 2)` of the API."""

try:
    from beartype import BeartypeConf, beartype
except ModuleNotFoundError:  # a machine lent for its GPU has only what it has: tests/conftest.py then checks no types
    checked = None
else:
    checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
