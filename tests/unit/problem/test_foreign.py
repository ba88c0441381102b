"""Matrices of NumPy, SymPy, CasADi and python-control are as good as lists."""

from __future__ import annotations

import copy
import subprocess
import sys
from fractions import Fraction
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
import sympy as sp

from fkgen.errors import SpecError
from fkgen.problem import Matrix, Spec, parse
from fkgen.problem.text.expression import FUNCTIONS

BASE: dict[str, Any] = {
    "name": "motor",
    "model": {
        "A": [[0.98, "exp(-0.01 / tau)"], [0.0, 0.9]],
        "B": [[0.5], [0.25]],
        "C": [[0.0, 1.0]],
        "D": [[0.0]],
        "Q": [[2.0, "tau"], ["tau", 1.0]],
        "R": [[0.25]],
        "x0": [1.0, 2.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
        "sample_time": 0.01,
    },
    "parameters": {"tau": 0.05, "rate": 0.5},
    "faults": {"actuator": {"success_rate": "rate"}},
    "filter": {"family": "mkf"},
}
TAU = sp.Symbol("tau")
SX_TAU, SX_RATE = ca.SX.sym("tau"), ca.SX.sym("rate")


def spec(*, drop: tuple[str, ...] = (), **model: object) -> Spec:
    table = copy.deepcopy({**BASE, "model": {}})
    table["model"] = {key: value for key, value in BASE["model"].items() if key not in drop}
    table["model"].update(model)
    return Spec.from_dict(table)


def refusal(**model: object) -> SpecError:
    with pytest.raises(SpecError) as caught:
        spec(**model)
    assert str(caught.value).isprintable()
    assert caught.value.__suppress_context__ or caught.value.__context__ is None
    return caught.value


def values(entry: object, **parameters: float) -> float:
    """Return the value of an expression of another library, read as entry [0][0] of A."""
    matrix = spec(A=[[entry, 0.0], [0.0, 0.9]]).model.A
    return float(matrix.values({"tau": 0.05, "rate": 0.5, **parameters})[0, 0])


@pytest.mark.parametrize(
    "model",
    [
        {"B": np.array([[0.5], [0.25]])},
        {"B": np.array([[0.5], [0.25]], dtype=np.float32)},
        {"B": np.array([[0.5], [0.25]], dtype=np.longdouble)},
        {"B": [[np.float32(0.5)], [np.float64(0.25)]]},
        {"B": ((Fraction(1, 2),), (0.25,))},
        {"B": [np.array([0.5]), np.array([0.25])]},
        {"B": np.array([["1/2"], [0.25]], dtype=object)},
        {"B": sp.Matrix([sp.Rational(1, 2), 0.25])},
        {"B": sp.ImmutableMatrix([[sp.Rational(1, 2)], [sp.Rational(1, 4)]])},
        {"B": [[sp.Rational(1, 2)], [sp.Float(0.25)]]},
        {"B": ca.DM([0.5, 0.25])},
        {"B": ca.SX([0.5, 0.25])},
        {"B": [[ca.DM(0.5)], [ca.SX(0.25)]]},
        {"B": Matrix.of([[0.5], [0.25]])},
        {"C": ca.DM(ca.Sparsity(1, 2), []) + ca.DM([[0, 1]])},
        {"R": np.float64(0.25) * np.eye(1)},
        {"x0": np.array([1.0, 2.0])},
        {"x0": np.array([[1], [2]])},
        {"x0": [1, np.int64(2)]},
        {"x0": sp.Matrix([1, 2])},
        {"x0": ca.DM([1, 2])},
        {"x0": ["1", "4/2"]},
        {"P0": np.eye(2, dtype=int)},
        {"P0": ca.SX.eye(2)},
        {"P0": sp.eye(2)},
        {"Q": sp.Matrix([[2, TAU], [TAU, 1]])},
        {"Q": ca.vertcat(ca.horzcat(2, SX_TAU), ca.horzcat(SX_TAU, 1))},
        {"A": sp.Matrix([[0.98, sp.exp(-0.01 / TAU)], [0, 0.9]])},
        {"A": ca.vertcat(ca.horzcat(0.98, ca.exp(-0.01 / SX_TAU)), ca.horzcat(0, 0.9))},
        {"A": [[0.98, parse("exp(-0.01 / tau)")], [0.0, 0.9]]},
        {"sample_time": np.float64(0.01)},
    ],
    ids=lambda model: next(f"{key}: {type(value).__name__}" for key, value in model.items()),
)
def test_the_same_plant_in_another_library_is_the_same_spec(model: dict[str, object]) -> None:
    assert spec(**model) == Spec.from_dict(BASE)


def test_rates_may_come_from_elsewhere_too() -> None:
    for rate in (sp.Symbol("rate"), ca.SX.sym("rate")):
        table = {**BASE, "faults": {"actuator": {"success_rate": rate}}}
        assert Spec.from_dict(table) == Spec.from_dict(BASE)


@pytest.mark.parametrize(
    "text",
    [
        "tau + rate - 2",
        "tau*rate/3",
        "1/tau",
        "tau**2",
        "tau**(-3)",
        "rate**tau",
        "2**tau",
        "sqrt(tau)",
        "1/sqrt(tau)",
        "tau**1.5",
        "-tau",
        "-2*tau/(rate*(tau + 1))",
        "exp(-tau)",
        "log(rate)",
        "sin(tau) + cos(tau)*tan(tau)",
        "atan2(tau, -rate)",
        "abs(-tau*rate - sin(tau))",
        "asin(tau) + acos(rate)*sinh(tau) - cosh(rate)/tanh(tau)",
        "min(tau, rate)*max(rate, 2*tau) + sign(-tau)",
    ],
)
def test_expressions_keep_their_value(text: str) -> None:
    at = {"tau": 0.3, "rate": 0.7}
    here = values(text, **at)
    symbols = {"tau": sp.Symbol("tau"), "rate": sp.Symbol("rate")}
    functions = symbols | {"min": sp.Min, "max": sp.Max, "acos": sp.acos, "sign": sp.sign}
    assert values(sp.sympify(text, functions), **at) == pytest.approx(here, rel=1e-14)
    functions = {key: getattr(ca, key) for key in FUNCTIONS if hasattr(ca, key)}
    scope = {"abs": ca.fabs, "min": ca.fmin, "max": ca.fmax, "tau": SX_TAU, "rate": SX_RATE}
    scope |= functions
    expression = eval(text, scope)  # noqa: S307 - the texts above
    assert values(expression, **at) == pytest.approx(here, rel=1e-14)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (sp.pi, np.pi),
        (sp.E, np.e),
        (sp.sqrt(2) * TAU, np.sqrt(2) * 0.05),
        (SX_TAU * SX_TAU, 0.0025),
        (2 * SX_TAU, 0.1),
        (ca.inv(SX_TAU), 20.0),
        (ca.if_else(SX_TAU > 0.1, 1 / (SX_TAU - 0.05), SX_TAU), 0.05),
        (ca.if_else(ca.logic_and(SX_TAU < 0.1, SX_RATE != 1), 3, 4), 3.0),
        (ca.hypot(3 * SX_TAU, 4 * SX_TAU), 0.25),
        (sp.Piecewise((1 / (TAU - sp.Float(0.05)), TAU > 1), (2, TAU > 0), (3, True)), 2.0),
        (sp.Piecewise((2, sp.And(TAU > 0, TAU < 0.01)), (3, True)), 3.0),
        (sp.Max(TAU, 0.01, TAU**2), 0.05),
    ],
)
def test_constants_and_special_instructions(entry: object, expected: float) -> None:
    assert values(entry) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (sp.asinh(TAU), "asinh"),
        (sp.asin(2 - 0 * TAU), "asin"),
        (sp.Function("f")(TAU), "without f"),
        (sp.Piecewise((TAU, TAU > 0), (0, TAU < 0)), "Piecewise"),
        (sp.I, "ImaginaryUnit"),
        (sp.oo, "Infinity"),
        (sp.nan, "NaN"),
        (sp.true, "BooleanTrue"),
        (sp.MatrixSymbol("M", 2, 2), "MatrixSymbol"),
        (sp.log(0, evaluate=False), "log(0.0) is not a real number"),
        (sp.Symbol("taw"), "symbols that are in [parameters]; did you mean 'tau'?"),
        (sp.Integer(10) ** 400, "fit a double"),
        (ca.asinh(SX_TAU), "asinh"),
        (ca.floor(SX_TAU), "floor"),
        (ca.SX(np.nan), "finite numbers"),
        (ca.DM(np.inf), "finite"),
        (ca.log(-1 - 0 * SX_TAU), "finite"),
        (ca.SX.sym("taw"), "the symbol 'taw'"),
        (ca.MX.sym("tau"), "a CasADi SX or DM matrix"),
        (1 / (SX_TAU - 0.05), "division by zero"),
        (1 / (TAU - sp.Float(0.05)), "division by zero"),
        (control.ss(0.5, 1, 1, 0, 0.1), "a finite number"),
        (object(), "a finite number"),
        (np.datetime64("2001-01-01"), "a finite number"),
        (np.sin, "a finite number"),
    ],
)
def test_what_has_no_counterpart_is_refused_by_name(entry: object, words: str) -> None:
    error = refusal(A=[[entry, 0.0], [0.0, 0.9]])
    assert error.key == "model.A[0][0]"
    assert words in str(error)


def test_matrices_name_the_entry() -> None:
    error = refusal(A=sp.Matrix([[1, 0], [sp.asinh(TAU), 1]]))
    assert (error.key, error.given) == ("model.A[1][0]", "asinh(tau)")
    assert refusal(A=ca.MX.eye(2)).expected == "a CasADi SX or DM matrix"


def test_expressions_that_explode_are_refused() -> None:
    squares = SX_TAU
    for _ in range(200):
        squares = squares * squares + SX_TAU
    assert "operations when written out" in refusal(A=[[squares, 0], [0, 1]]).expected
    chain = SX_TAU
    for _ in range(2000):
        chain = ca.sin(chain)
    assert "nested at most 100 deep" in refusal(A=[[chain, 0], [0, 1]]).expected
    nested: Any = TAU
    for _ in range(150):
        nested = sp.sin(nested) + 1
    assert "levels of nesting" in refusal(A=[[nested, 0], [0, 1]]).expected
    deeper: Any = TAU
    for _ in range(3000):
        deeper = sp.sin(deeper, evaluate=False)
    assert "nested less deeply" in refusal(A=[[deeper, 0], [0, 1]]).expected
    wide = sp.Add(*(TAU**k for k in range(2000)))
    assert "at most 2000 terms" in refusal(A=[[wide, 0], [0, 1]]).expected


ALL = ("A", "B", "C", "D", "sample_time")


def discrete(dt: object) -> object:
    return control.ss([[0.98, 0.1], [0.0, 0.9]], [[0.5], [0.25]], [[0.0, 1.0]], [[0.0]], dt)


def test_a_state_space_gives_matrices_and_sample_time() -> None:
    got = spec(drop=ALL, system=discrete(0.01))
    assert got == spec(A=[[0.98, 0.1], [0.0, 0.9]])
    assert spec(drop=ALL, system=discrete(True)).model.sample_time is None
    assert spec(drop=ALL, system=discrete(True), sample_time=0.01) == got
    assert spec(drop=ALL, system=discrete(0.01), sample_time=0.01) == got


@pytest.mark.parametrize(
    ("model", "key", "given", "expected"),
    [
        ({"system": discrete(0)}, "system", "a continuous-time model", "discrete-time"),
        ({"system": discrete(None)}, "system", "without a time base", "discrete-time"),
        ({"system": np.eye(2)}, "system", "the ndarray", "a control.StateSpace"),
        ({"system": control.tf([1], [1, 2], 0.1)}, "system", "TransferFunction", "control.ss"),
        ({"system": discrete(0.01), "A": [[1.0]]}, "A", "A beside system", "either"),
        ({"system": discrete(0.01), "sample_time": 0.02}, "sample_time", "0.02", "0.01"),
    ],
)
def test_a_state_space_that_does_not_fit(
    model: dict[str, object], key: str, given: str, expected: str
) -> None:
    with pytest.raises(SpecError) as caught:
        spec(drop=ALL, **model)
    assert caught.value.key == f"model.{key}"
    assert given in caught.value.given
    assert expected in caught.value.expected


def test_a_state_space_is_no_matrix() -> None:
    assert "model.system" in refusal(A=discrete(0.01)).expected


def test_the_libraries_are_not_imported_unasked() -> None:
    code = (
        "import sys, fkgen.problem\n"
        f"fkgen.problem.Spec.from_dict({BASE!r})\n"
        "loaded = {'casadi', 'sympy', 'control', 'scipy'} & set(sys.modules)\n"
        "sys.exit(str(loaded) if loaded else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_the_user_gave_is_neither_kept_nor_changed() -> None:
    A = np.array([[0.98, 0.1], [0.0, 0.9]])
    system: Any = discrete(0.01)
    first, second = spec(A=A), spec(drop=ALL, system=system)
    A[:] = 7.0
    system.A[:] = 7.0
    assert first == second == spec(A=[[0.98, 0.1], [0.0, 0.9]])
