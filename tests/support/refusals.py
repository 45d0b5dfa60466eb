"""Refusals to a person, in one line."""

from collections.abc import Callable
from typing import Any

import pytest

from mrbokeh.system.errors import InputError


def refused(match: str, call: Callable[..., object], *arguments: Any, **named: Any) -> None:
    """Expect that a call with these arguments ends in a sentence to the user that matches."""
    with pytest.raises(InputError, match=match):
        call(*arguments, **named)
