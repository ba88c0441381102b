"""One table of a spec, read key by key; what it does not know it refuses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import TypeVar

from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.text.foreign import plain_entry, plain_list

Choice = TypeVar("Choice", bound=str)


class Section:
    """A table of a spec."""

    def __init__(self, table: object, place: Place, *, known: Sequence[str]) -> None:
        self.place = place
        self.table = as_table(table, place, f"a table with {', '.join(known)}")
        for key in self.table:
            if key not in known:
                hint = suggestion(key, known)
                raise place.entry(key).error("an unknown key", f"one of {', '.join(known)}{hint}")

    def __contains__(self, key: str) -> bool:
        """Whether the key was given."""
        return key in self.table

    def require(self, key: str, expected: str) -> object:
        """Return what was given for a key that must be there."""
        if key not in self.table:
            raise self.place.entry(key).error("nothing (the key is missing)", expected)
        return self.table[key]

    def choice(self, key: str, choices: Sequence[Choice], default: Choice) -> Choice:
        """Return the one of the choices that was given, or the default."""
        if key not in self.table:
            return default
        given = self.table[key]
        for choice in choices:
            if isinstance(given, str) and given == choice:
                return choice
        hint = suggestion(given, choices) if isinstance(given, str) else ""
        raise self.place.entry(key).error(show(given), f"one of {', '.join(choices)}{hint}")

    def flag(self, key: str, *, default: bool) -> bool:
        """Return the truth value that was given, or the default."""
        given = self.table.get(key, default)
        if not isinstance(given, bool):
            raise self.place.entry(key).error(describe(given), "true or false")
        return given

    def positive(self, key: str, default: float, below: float = math.inf) -> float:
        """The positive number that was given, or the default."""
        place = self.place.entry(key)
        expected = "a positive number" if below == math.inf else f"a number in (0, {below:g})"
        number = as_number(self.table.get(key, default), place, expected)
        if not 0.0 < number < below:
            raise place.error(show(number), expected)
        return number

    def count(self, key: str, default: int, largest: int, what: str = "samples") -> int:
        """The whole number from 1 to the largest that was given, or the default."""
        place = self.place.entry(key)
        expected = f"a number of {what}, a whole number in 1..{largest}"
        number = as_number(self.table.get(key, default), place, expected)
        if number != int(number) or not 1 <= number <= largest:
            raise place.error(show(self.table[key]), expected)
        return int(number)


def as_table(value: object, place: Place, expected: str) -> dict[str, object]:
    """Return a copy of a mapping whose keys are text."""
    if not isinstance(value, Mapping):
        raise place.error(describe(value), expected)
    for key in value:
        if not isinstance(key, str):
            raise place.error(f"the key {show(key)}", "keys that are text")
    return {str(key): entry for key, entry in value.items()}


def as_list(value: object, place: Place, expected: str) -> list[object]:
    """Return a copy of a list, tuple or one-dimensional array."""
    plain = plain_list(value, place)
    if not isinstance(plain, list):
        raise place.error(describe(value), expected)
    return plain


def as_number(value: object, place: Place, expected: str = "a finite number") -> float:
    """Return a finite number as a float; a boolean is not a number, nor is a text."""
    plain = plain_entry(value, place)
    if isinstance(plain, bool) or not isinstance(plain, Real):
        raise place.error(describe(value), expected)
    try:
        number = float(plain)
    except OverflowError:
        raise place.error(show(value), f"{expected} that fits a double") from None
    if not math.isfinite(number):
        raise place.error(show(value), expected)
    return number + 0.0  # minus zero is zero


def as_text(value: object, place: Place, expected: str) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise place.error(describe(value), expected)
    return str(value)
