"""What a command tells, for people and as JSON, which knows no infinity and no NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A table, sentences and notes; the facts are all the numbers there are, for programs."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    sentences: Sequence[str]
    facts: Mapping[str, Any]
    notes: Sequence[str] = ()
    indent: int | None = 2  # of the JSON text

    def to_json(self) -> str:
        """The facts; what is not finite becomes null."""
        return json.dumps(finite_or_none(self.facts), indent=self.indent)


def finite_or_none(value: Any) -> Any:
    """Numbers, arrays, and nested lists and dicts of them; what is not finite becomes None."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: finite_or_none(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
