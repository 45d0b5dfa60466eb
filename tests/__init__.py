"""Tests; types of arguments are checked as type checkers do: a whole number may stand for a float, as in `Lens(50, 2)` of the API."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
