"""One table of a spec, read key by key; what it does not know it refuses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import TypeVar

from fkgen.problem.covariance import checked_covariance
from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.text.expression import (
    MAX_DEPTH,
    Expression,
    Name,
    Number,
    Operation,
    depth,
    evaluate,
    names,
    parse,
    to_text,
)
from fkgen.problem.text.foreign import plain_entry, plain_list
from fkgen.problem.text.matrix import NO_PARAMETERS, Matrix

Choice = TypeVar("Choice", bound=str)


class Section:
    """A table of a spec."""

    def __init__(
        self,
        table: object,
        place: Place,
        *,
        known: Sequence[str],
        defaults: Mapping[str, float] = NO_PARAMETERS,
    ) -> None:
        self.place, self.defaults = place, defaults
        self.table = as_table(table, place, f"a table with {', '.join(known)}")
        for key in self.table:
            if key not in known:
                hint = suggestion(key, known)
                raise self.error(key, "an unknown key", f"one of {', '.join(known)}{hint}")

    def __contains__(self, key: str) -> bool:
        """Whether the key was given."""
        return key in self.table

    def error(self, key: str, given: str, expected: str) -> Exception:
        """Return (not raise) the error about what a key says."""
        return self.place.entry(key).error(given, expected)

    def require(self, key: str, expected: str) -> object:
        """Return what was given for a key that must be there."""
        if key not in self.table:
            raise self.error(key, "nothing (the key is missing)", expected)
        return self.table[key]

    def choice(self, key: str, choices: Sequence[Choice], default: Choice) -> Choice:
        """Return the one of the choices that was given, or the default."""
        given = self.table.get(key, default)
        for choice in choices:
            if isinstance(given, str) and given == choice:
                return choice
        hint = suggestion(given, choices) if isinstance(given, str) else ""
        raise self.error(key, show(given), f"one of {', '.join(choices)}{hint}")

    def flag(self, key: str, *, default: bool) -> bool:
        """Return the truth value that was given, or the default."""
        given = self.table.get(key, default)
        if not isinstance(given, bool):
            raise self.error(key, describe(given), "true or false")
        return given

    def number(
        self,
        key: str,
        expected: str,
        accepted: Callable[[float], bool],
        default: float | None = None,
    ) -> float:
        """Return the number that was given, or the default; without one the key must be there."""
        given = self.require(key, expected) if default is None else self.table.get(key, default)
        number = as_number(given, self.place.entry(key), expected)
        if not accepted(number):
            raise self.error(key, show(number), expected)
        return number

    def probability(self, key: str, meaning: str = "", default: float | None = None) -> float:
        """Return the number in [0, 1] that was given, or the default."""
        expected = f"a probability in [0, 1]{meaning}"
        return self.number(key, expected, lambda number: 0.0 <= number <= 1.0, default)

    def whole(self, key: str, expected: str, largest: int, default: int | None = None) -> int:
        """Return the whole number from 1 to the largest that was given, or the default."""
        number = self.number(key, expected, math.isfinite, default)
        if not (number.is_integer() and 1 <= number <= largest):
            raise self.error(key, show(self.table[key]), expected)
        return int(number)

    def positive(self, key: str, default: float, below: float = math.inf) -> float:
        """Return the positive number that was given, or the default."""
        expected = "a positive number" if below == math.inf else f"a number in (0, {below:g})"
        return self.number(key, expected, lambda number: 0.0 < number < below, default)

    def count(self, key: str, default: int, largest: int, what: str = "samples") -> int:
        """Return the number of something that was given, or the default."""
        expected = f"a number of {what}, a whole number in 1..{largest}"
        return self.whole(key, expected, largest, default)

    def matrix(self, key: str, shape: tuple[int | None, int | None], because: str) -> Matrix:
        """Return a matrix that must be there; None in its shape is any number."""
        rows, columns = ("any" if size is None else size for size in shape)
        expected = f"shape ({rows}, {columns}): {because}"
        matrix = as_matrix(
            self.require(key, f"a matrix of {expected}"), self.place.entry(key), self.defaults
        )
        if any(size not in {None, found} for size, found in zip(shape, matrix.shape, strict=True)):
            raise self.error(key, f"shape {matrix.shape}", expected)
        return matrix

    def covariance(self, key: str, size: int, because: str) -> Matrix:
        """Return a covariance matrix that must be there."""
        matrix = self.matrix(key, (size, size), because)
        return checked_covariance(matrix, self.place.entry(key), self.defaults)

    def column(self, key: str, count: int, entries: str, of: str = "state") -> Matrix:
        """Return a vector over the state or the measurement, (count, 1), that must be there."""
        place = self.place.entry(key)
        expected = f"a list of {count} {entries}: the {of} has {count} components"
        rows = []
        for i, entry in enumerate(as_list(self.require(key, expected), place, expected, count)):
            plain = plain_list(entry, place.item(i))
            if not (isinstance(plain, list) and len(plain) == 1):
                plain = [entry]  # not a row of a column matrix of another library
            rows.append((as_entry(plain[0], place.item(i), self.defaults),))
        return Matrix(tuple(rows))


def as_table(value: object, place: Place, expected: str) -> dict[str, object]:
    """Return a copy of a mapping whose keys are text."""
    if not isinstance(value, Mapping):
        raise place.error(describe(value), expected)
    for key in value:
        if not isinstance(key, str):
            raise place.error(f"the key {show(key)}", "keys that are text")
    return {str(key): entry for key, entry in value.items()}


def as_list(
    value: object, place: Place, expected: str, count: int | None = None, what: str = "entries"
) -> list[object]:
    """Return a copy of a list, tuple or one-dimensional array, of this length if there is one."""
    plain = plain_list(value, place)
    if not isinstance(plain, list):
        raise place.error(describe(value), expected)
    if count not in {None, len(plain)}:
        raise place.error(f"{len(plain)} {what}", expected)
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


def as_entry(
    value: object,
    place: Place,
    defaults: Mapping[str, float],
    expected: str = "a finite number or an expression of the parameters",
) -> Expression:
    """Return a number, or an expression that is finite at the default parameters."""
    plain = plain_entry(value, place)
    if isinstance(plain, str):
        expression = parse(plain, place=place, parameters=defaults)
    elif isinstance(plain, Number | Name | Operation):
        expression = plain
    else:
        return Number(as_number(plain, place, expected))
    for name in sorted(names(expression)):
        if name not in defaults:
            hint = suggestion(name, defaults)
            raise place.error(f"the symbol '{name}'", f"symbols that are in [parameters]{hint}")
    if depth(expression) > MAX_DEPTH:
        raise place.error("an expression", f"at most {MAX_DEPTH} levels of nesting")
    check_finite(expression, place, defaults)
    return expression


def check_finite(expression: Expression, place: Place, defaults: Mapping[str, float]) -> None:
    """Refuse an expression that has no finite and real value at the default parameters."""
    try:
        evaluate(expression, defaults)
    except ArithmeticError as fault:
        at = ", ".join(f"{name} = {defaults[name]!r}" for name in sorted(names(expression)))
        raise place.error(
            show(to_text(expression)), f"a finite real value at the defaults ({at}), but {fault}"
        ) from None


def as_matrix(value: object, place: Place, defaults: Mapping[str, float]) -> Matrix:
    """Return a matrix from nested lists or from an object of another library."""
    expected = "a matrix: a list of rows, such as [[1.0, 0.0], [0.0, 1.0]]"
    rows = as_list(value, place, expected)
    if not rows:
        raise place.error("an empty list", expected)
    result: list[tuple[Expression, ...]] = []
    for i, row in enumerate(rows):
        where = place.item(i)
        entries = as_list(row, where, f"a row, in {expected}")
        if result and len(entries) != len(result[0]):
            raise where.error(
                f"{len(entries)} entries", f"{len(result[0])}: all rows have the same length"
            )
        result.append(
            tuple(as_entry(entry, where.item(j), defaults) for j, entry in enumerate(entries))
        )
    return Matrix(tuple(result))
