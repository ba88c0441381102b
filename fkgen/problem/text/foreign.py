"""Values of other libraries, as lists, numbers and expressions.

NumPy, SymPy, CasADi and python-control objects are recognised by the module that defines their
type, so none of those libraries is imported unless the user has handed one of its objects over.
"""

from __future__ import annotations

from numbers import Real
from typing import Any

from fkgen.problem.table.place import Place, describe, show
from fkgen.problem.text.expression import Name, Number, Operation
from fkgen.problem.text.from_casadi import casadi_rows
from fkgen.problem.text.from_sympy import sympy_expression, sympy_rows
from fkgen.problem.text.matrix import Matrix

_LIBRARIES = ("numpy", "sympy", "casadi", "control")


def library(value: object) -> str:
    """Return which of the known libraries a value comes from, or an empty text."""
    for base in type(value).__mro__:
        root = (base.__module__ or "").partition(".")[0]
        if root in _LIBRARIES:
            return root
    return ""


def plain_list(value: object, place: Place) -> object:
    """Return a list for anything list-like (a copy), else the value itself.

    A matrix becomes a list of rows; the elements are numbers, texts or expressions.
    """
    if isinstance(value, Matrix):
        return [list(row) for row in value.rows]
    if isinstance(value, list | tuple):
        return list(value)
    match library(value):
        case "numpy":
            return _numpy_list(value)
        case "sympy":
            return sympy_rows(value, place)
        case "casadi":
            return casadi_rows(value, place)
        case "control":
            raise place.error(describe(value), "a matrix; a StateSpace goes under 'model.system'")
        case _:
            return value


def plain_entry(value: object, place: Place) -> object:
    """Return a plain number, a text or an expression for one scalar, else the value itself."""
    if isinstance(value, str | bool | int | float | Number | Name | Operation):
        return value
    match library(value):
        case "numpy":
            return _numpy_list(value)
        case "sympy":
            return sympy_expression(value, place)
        case "casadi":
            rows = casadi_rows(value, place)
            single = len(rows) == 1 and len(rows[0]) == 1
            return _unwrapped(rows[0][0]) if single else rows
        case _:
            return value


def _unwrapped(entry: object) -> object:
    return entry.value if isinstance(entry, Number) else entry


def _numpy_list(value: Any) -> object:
    plain: object = value.tolist() if hasattr(value, "tolist") else value
    return plain


def state_space(system: object, place: Place) -> tuple[dict[str, object], float | None]:
    """Take a discrete-time python-control ``StateSpace`` apart."""
    if library(system) != "control" or not all(
        hasattr(system, key) for key in ("A", "B", "C", "D")
    ):
        hint = "; convert it with control.ss" if library(system) == "control" else ""
        raise place.error(describe(system), f"a control.StateSpace{hint}")
    dt: object = getattr(system, "dt", None)
    if dt is True:
        sample_time = None
    elif isinstance(dt, Real) and float(dt) > 0:
        sample_time = float(dt)
    else:
        kind = "a model without a time base" if dt is None else "a continuous-time model"
        raise place.error(
            f"{kind} (dt = {show(dt)})",
            "a discrete-time model; discretise it with control.sample_system, or state its dt",
        )
    return {key: getattr(system, key) for key in ("A", "B", "C", "D")}, sample_time
