"""Numbers that a user states, and what they have to be."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fkgen.errors import DataError


def probability(name: str, value: Any) -> float:
    """A probability strictly between 0 and 1."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0.0 < number < 1.0:
        raise DataError(name, given=repr(value), expected="a probability in (0, 1), such as 0.001")
    return number


def whole(name: str, value: Any, *, least: int, expected: str, most: float = math.inf) -> int:
    """A whole number within bounds."""
    number = not isinstance(value, bool) and isinstance(value, int | np.integer)
    if not number or not least <= value <= most:
        raise DataError(name, given=repr(value), expected=expected)
    return int(value)
