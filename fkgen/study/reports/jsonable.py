"""What a command tells, for people and as JSON, which knows no infinity and no NaN."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


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
        """The facts as JSON."""
        return json_text(self.facts, self.indent)


def json_text(facts: Any, indent: int | None = 2) -> str:
    """Numbers, arrays, and lists and dicts of them; what is not finite becomes null."""
    text = json.dumps(facts, default=lambda array: array.tolist())
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=indent)
