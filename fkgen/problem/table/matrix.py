"""Matrices and rates as the user gives them, checked entry by entry and for their shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.table.section import as_number
from fkgen.problem.text.expression import (
    MAX_DEPTH,
    MAX_NODES,
    Expression,
    Name,
    Number,
    Operation,
    depth,
    evaluate,
    names,
    parse,
    size,
    to_text,
)
from fkgen.problem.text.foreign import plain_entry, plain_list
from fkgen.problem.text.matrix import Matrix

_ENTRY = "a finite number or an expression of the parameters"


@dataclass(frozen=True, slots=True)
class Role:
    """What a matrix is for: the shape it must have, and why."""

    rows: int | None  # rows, columns: The shape; None where any size will do
    columns: int | None
    because: str  # What the matrix maps to what

    @property
    def shape(self) -> str:
        """The shape as text."""
        rows, columns = ("any" if size is None else size for size in (self.rows, self.columns))
        return f"({rows}, {columns})"

    def fits(self, shape: tuple[int, int]) -> bool:
        """Whether a matrix of this shape can play the role."""
        return self.rows in {None, shape[0]} and self.columns in {None, shape[1]}


def read_matrix(value: object, place: Place, role: Role, defaults: Mapping[str, float]) -> Matrix:
    """Return a matrix from nested lists or from an object of another library."""
    matrix = Matrix(tuple(_rows(value, place, defaults)))
    if not role.fits(matrix.shape):
        raise place.error(f"shape {matrix.shape}", f"shape {role.shape}: {role.because}")
    return matrix


def _rows(
    value: object, place: Place, defaults: Mapping[str, float]
) -> list[tuple[Expression, ...]]:
    expected = "a matrix: a list of rows, such as [[1.0, 0.0], [0.0, 1.0]]"
    rows = plain_list(value, place)
    if not isinstance(rows, list):
        raise place.error(describe(value), expected)
    if not rows:
        raise place.error("an empty list", expected)
    result: list[tuple[Expression, ...]] = []
    for i, row in enumerate(rows):
        entries = plain_list(row, place.item(i))
        if not isinstance(entries, list):
            raise place.item(i).error(describe(row), f"a row, in {expected}")
        if result and len(entries) != len(result[0]):
            raise place.item(i).error(
                f"{len(entries)} entries", f"{len(result[0])}: all rows have the same length"
            )
        result.append(
            tuple(read_entry(entry, place.item(i, j), defaults) for j, entry in enumerate(entries))
        )
    return result


def read_entry(value: object, place: Place, defaults: Mapping[str, float]) -> Expression:
    """Return one entry: a number, or an expression that is finite at the default parameters."""
    plain = plain_entry(value, place)
    if isinstance(plain, str):
        expression = parse(plain, place=place, parameters=defaults)
    elif isinstance(plain, Number | Name | Operation):
        expression = plain
    else:
        return Number(as_number(plain, place, _ENTRY))
    for name in sorted(names(expression)):
        if name not in defaults:
            hint = suggestion(name, defaults)
            raise place.error(f"the symbol '{name}'", f"symbols that are in [parameters]{hint}")
    if depth(expression) > MAX_DEPTH:
        raise place.error("an expression", f"at most {MAX_DEPTH} levels of nesting")
    value_at_defaults(expression, place, defaults)
    return expression


def value_at_defaults(expression: Expression, place: Place, defaults: Mapping[str, float]) -> float:
    """Return the value at the default parameters, which must be finite and real."""
    try:
        return evaluate(expression, defaults)
    except ArithmeticError as fault:
        used = {name: defaults[name] for name in sorted(names(expression))}
        at = ", ".join(f"{name} = {value!r}" for name, value in used.items())
        raise place.error(
            show(to_text(expression)), f"a finite real value at the defaults ({at}), but {fault}"
        ) from None


def check_matrix(matrix: Matrix, place: Place, defaults: Mapping[str, float]) -> None:
    """Refuse a computed matrix whose entries are too large to be written or not finite."""
    for row in matrix.rows:
        for expression in row:
            if size(expression) > MAX_NODES or depth(expression) > MAX_DEPTH:
                raise place.error("a product with very large expressions", "the product itself")
            value_at_defaults(expression, place, defaults)
