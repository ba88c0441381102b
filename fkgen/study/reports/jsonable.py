"""Numbers for JSON, which knows no infinity and no NaN."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def finite_or_none(value: ArrayLike) -> Any:
    """A number or nested lists of numbers; those that are not finite become None."""
    return _plain(np.asarray(value, dtype=float).tolist())


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value if math.isfinite(value) else None
