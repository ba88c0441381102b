"""Equations that are linear in states and inputs, found on the tree: matrices do for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from fkgen.problem.equations import Equations, Increment
from fkgen.problem.table.place import show
from fkgen.problem.table.section import Section, check_finite
from fkgen.problem.text.expression import (
    ONE,
    ZERO,
    Expression,
    Name,
    Number,
    Operation,
    is_large,
    operation,
)
from fkgen.problem.text.matrix import Matrix, congruence, plain

if TYPE_CHECKING:
    from fkgen.problem.model import Model

#: Coefficients by the name of a state or an input; under "" what is added.
Affine = Mapping[str, Expression]


class _Reader:
    """Takes trees apart; definitions are put in where they are named."""

    def __init__(self, equations: Equations) -> None:
        self.variables = {*equations.states, *equations.inputs}
        self.variables |= {noise.name for noise in equations.noises}
        self.found: dict[str, Affine | None] = {}
        for name, tree in equations.let:
            self.found[name] = self.read(tree)

    def read(self, tree: Expression) -> Affine | None:
        """The coefficients of a tree, if it is affine and not too large when written out."""
        with suppress(ArithmeticError):
            result = self.converted(tree)
            if result is not None and not any(map(is_large, result.values())):
                return result
        return None

    def converted(self, tree: Expression) -> Affine | None:  # noqa: PLR0911 - one per node
        """The coefficients of a node."""
        if not isinstance(tree, Operation):
            return self.leaf(tree)
        parts = [self.converted(each) for each in tree.arguments]
        given = [each for each in parts if each is not None]
        if len(given) < len(parts):
            return None
        constants = [each.get("", ZERO) for each in given]
        if all(_is_constant(each) for each in given):
            return {"": operation(tree.operator, *constants, table=tree.table)}
        match tree.operator, given:
            case "neg", [inner]:
                return {key: operation("neg", each) for key, each in inner.items()}
            case ("+" | "-") as operator, [left, right]:
                return _merged(partial(operation, operator), left, right)
            case "if", [condition, first, second] if _is_constant(condition):
                return _merged(partial(operation, "if", constants[0]), first, second)
            case "*", [left, right] if _is_constant(left):
                return {key: operation("*", constants[0], each) for key, each in right.items()}
            case ("*" | "/") as operator, [left, right] if _is_constant(right):
                return {key: operation(operator, each, constants[1]) for key, each in left.items()}
        return None

    def leaf(self, tree: Expression) -> Affine | None:
        """The coefficients of a name or a number."""
        name = tree.identifier if isinstance(tree, Name) else ""
        if name in self.variables:
            return {name: ONE}
        return self.found.get(name, {"": tree})


def _merged(combine: Callable[..., Expression], left: Affine, right: Affine) -> Affine:
    keys = dict.fromkeys((*left, *right))
    return {key: combine(left.get(key, ZERO), right.get(key, ZERO)) for key in keys}


def _is_constant(found: Affine) -> bool:
    return all(key == "" or each == ZERO for key, each in found.items())


def linear_plant(equations: Equations, Q: Matrix, section: Section) -> dict[str, Matrix] | None:
    """Matrices of equations that are affine; Q has what noises add to it. None for all others."""
    found = matrices(equations)
    if found is None:
        return None
    variances = [noise.variance for noise in equations.noises]
    if variances:
        V = Matrix.zeros(len(variances), len(variances))
        V = V.mapped(lambda i, j, zero: variances[i] if i == j else zero)
        added = congruence(found["G"], V)
        Q = Q.mapped(lambda i, j, entry: operation("+", entry, added.rows[i][j]))
    del found["G"]
    for letter, matrix in (found | {"Q": Q}).items():
        key = "h" if letter in "CDd" else "f"
        for row in matrix.rows:
            for entry in row:
                check_finite(entry, section.place.entry(key), section.defaults)
    return found | {"Q": Q}


def matrices(equations: Equations) -> dict[str, Matrix] | None:
    """A, B, c, G (of noises), C, D and d of equations that are affine; None for all others."""
    if equations.attitudes or equations.continuous:
        return None
    reader = _Reader(equations)
    rows: dict[str, list[Affine]] = {"f": [], "h": []}
    for key, trees in (("f", equations.f), ("h", equations.h)):
        for tree in trees:
            found = None if isinstance(tree, Increment) else reader.read(tree)
            if found is None:
                return None
            rows[key].append(found)

    def matrix(key: str, columns: tuple[str, ...]) -> Matrix:
        return Matrix(
            tuple(tuple(row.get(column, ZERO) for column in columns) for row in rows[key])
        )

    states, inputs, one = equations.states, equations.inputs, ("",)
    noises = tuple(noise.name for noise in equations.noises)
    letters = {"A": ("f", states), "B": ("f", inputs), "c": ("f", one)}
    letters |= {"G": ("f", noises), "C": ("h", states), "D": ("h", inputs), "d": ("h", one)}
    return {letter: matrix(*where) for letter, where in letters.items()}


def affine_parts(equations: Equations) -> tuple[bool, bool]:
    """Whether f (from sample to sample) and h are affine in states, inputs and noises."""
    if equations.attitudes:
        return False, False
    reader = _Reader(equations)
    f, h = (
        all(not isinstance(tree, Increment) and reader.read(tree) is not None for tree in trees)
        for trees in (equations.f, equations.h)
    )
    return f and not equations.continuous, h


def why_not_linear(equations: Equations, model: Model) -> tuple[str, str]:
    """Which key of a model, or of a mode of it, says that it is not linear, and what it says."""
    for i, each in enumerate(model.states):
        if each.manifold:
            return f"states[{i}]", f"the attitude {each.name}"
    reader = _Reader(equations)
    named = (("f", equations.f, model.states), ("h", equations.h, model.outputs))
    for key, trees, signals in named:
        for tree, signal in zip(trees, signals, strict=True):
            if isinstance(tree, Increment) or reader.read(tree) is None:
                return f"{key}.{signal.name}", show(plain(tree))
    return _why_not_plain(model)


def _why_not_plain(model: Model) -> tuple[str, str]:
    """Why a model whose equations are linear is not a linear one."""
    for key, signals in (("states", model.states), ("outputs", model.outputs)):
        for i, each in enumerate(signals):
            if each.wrap:
                return f"{key}[{i}].wrap", f"the angle {each.name}, which wraps"
    return "f", "equations of dx/dt, which an integrator solves (matrices A, B of dx/dt are exact)"


def rows(matrix: Matrix, names: tuple[str, ...]) -> list[list[Expression]]:
    """The terms of a matrix times a vector of these names, row by row."""
    return [
        [
            operation("*", entry, Name(name))
            for entry, name in zip(row, names, strict=True)
            if entry != Number(0.0)
        ]
        for row in matrix.rows
    ]
