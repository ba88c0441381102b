"""f and h as objects of Python: CasADi functions and expressions, SymPy, callables."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import equations
import numpy as np
import pytest
import sympy as sp
from equations import ATTITUDE, ROBOT, read, table

import fkgen
from fkgen.errors import DataError, SpecError
from fkgen.problem import Parameter
from fkgen.problem.table.place import Place
from fkgen.problem.text import foreign
from fkgen.problem.text.expression import size
from fkgen.problem.text.foreign import LARGE
from fkgen.runtime import record

POINT = ([1.0, 2.0, 0.3], [2.0, 0.5], [0.1], {"dt": 0.1, "bias": 0.25})
PARAMETERS = {"dt": 0.1, "bias": 0.25}


def robot(f, h, **change):
    model = {key: value for key, value in ROBOT.items() if key != "let"}
    return read({**model, "f": f, "h": h, **change}, PARAMETERS)


def motion(x, u, w, p):
    c = ca.cos(x.heading)
    return [
        x.x + u.speed * c * p.dt,
        x.y + u.speed * ca.sin(x.heading) * p.dt,
        x.heading + (u.turn + w.w_turn) * p.dt + p.bias * c**2,
    ]


def measurement(x, _, p):
    return {"range": ca.hypot(x.x, x.y), "bearing": ca.atan2(x[1], x[0]) - x.heading + p.bias}


def functions():
    x, u, w, p = (ca.SX.sym(name, n) for name, n in (("x", 3), ("u", 2), ("w", 1), ("p", 2)))
    c = ca.cos(x[2])
    f = ca.vertcat(
        x[0] + u[0] * c * p[0],
        x[1] + u[0] * ca.sin(x[2]) * p[0],
        x[2] + (u[1] + w[0]) * p[0] + p[1] * c**2,
    )
    h = ca.vertcat(ca.hypot(x[0], x[1]), ca.atan2(x[1], x[0]) - x[2] + p[1])
    return ca.Function("f", [x, u, w, p], [f]), ca.Function("h", [x, u, p], [h])


def symbolic(mathematics, column, hypotenuse):
    names = "x y heading speed turn w_turn dt bias"
    x, y, heading, speed, turn, w, dt, bias = mathematics(names)
    library = ca if column is ca.vertcat else sp
    c = library.cos(heading)
    f = [
        x + speed * c * dt,
        y + speed * library.sin(heading) * dt,
        heading + (turn + w) * dt + bias * c**2,
    ]
    return column(*f), column(hypotenuse(x, y), library.atan2(y, x) - heading + bias)


SOURCES = {
    "text": lambda: (
        {
            "x": "x + speed*cos(heading)*dt",
            "y": "y + speed*sin(heading)*dt",
            "heading": "heading + (turn + w_turn)*dt + bias*cos(heading)**2",
        },
        {"range": "hypot(x, y)", "bearing": "atan2(y, x) - heading + bias"},
    ),
    "callables": lambda: (motion, measurement),
    "functions": functions,
    "MX functions": lambda: tuple(
        ca.Function(each.name(), m, [each(*m)])
        for each in functions()
        for m in [[ca.MX.sym(f"m{i}", each.size1_in(i)) for i in range(each.n_in())]]
    ),
    "SX": lambda: symbolic(
        lambda names: [ca.SX.sym(each) for each in names.split()], ca.vertcat, ca.hypot
    ),
    "SX by name": lambda: (
        dict(zip(("x", "y", "heading"), ca.vertsplit(SOURCES["SX"]()[0]), strict=True)),
        SOURCES["SX"]()[1],
    ),
    "SymPy": lambda: symbolic(
        sp.symbols, lambda *rows: sp.Matrix(rows), lambda x, y: sp.sqrt(x**2 + y**2)
    ),
    "a list of SymPy": lambda: tuple(map(list, SOURCES["SymPy"]())),
}


@pytest.mark.parametrize("name", SOURCES)
def test_every_source_has_the_numbers_of_the_text(name):
    expected = robot(*SOURCES["text"]()).model.equations.evaluate(*POINT)
    spec = robot(*SOURCES[name]())
    found = spec.model.equations.evaluate(*POINT)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-14)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-14)
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec


def test_what_casadi_computes_once_is_defined_once():
    found = robot(*SOURCES["functions"]()).model.equations
    assert [name for name, _ in found.let] == ["f:1"]
    x = ca.SX.sym("x")
    grown = x
    for _ in range(40):  # written out it has 2^40 terms
        grown = grown * grown + ca.sin(grown)
    one = {
        "states": [{"name": "x"}],
        "outputs": [{"name": "y"}],
        "x0": [0.0],
        "f": grown,
        "h": ["x"],
    }
    one |= {key: [[1.0]] for key in ("Q", "R", "P0")}
    assert len(read(one).model.equations.let) <= 80


def test_a_casadi_function_that_is_linear_is_a_matrix():
    x, u, w, p = (ca.SX.sym(name, n) for name, n in (("x", 2), ("u", 0), ("w", 0), ("p", 1)))
    model = {
        "states": [{"name": "s"}, {"name": "v"}],
        "outputs": [{"name": "y"}],
        "Q": np.eye(2),
        "R": [[1.0]],
        "x0": [0.0, 0.0],
        "P0": np.eye(2),
    }
    f = ca.Function("f", [x, u, w, p], [ca.vertcat(x[0] + p[0] * x[1], 0.5 * x[1])])
    matrices = {"A": [[1.0, "dt"], [0.0, 0.5]], "C": [[2.0, 0.0]]}
    by_function = read({**model, "f": f, "h": lambda x, _, __: [2 * x.s]}, family="kf")
    assert by_function == read({**model, **matrices}, family="kf")


def test_an_attitude_is_four_numbers_of_a_function_and_three_rates():
    def turned(x, u, w, p):
        q, rate = x.q, ca.vertcat(u.gx - x.bx, u.gy - x.by, u.gz - x.bz)
        d = rate * p.dt
        half = 0.5 * d
        w0 = q[0] - q[1] * half[0] - q[2] * half[1] - q[3] * half[2]
        v = q[0] * half + q[1:] + ca.cross(q[1:], half)
        return [w0, v, x.bx, x.by, x.bz]

    u = [0.01, -0.02, 0.03]
    start = [*np.array([0.8, 0.6, 0.0, 0.0]), 0.0, 0.0, 0.0]
    found = read(ATTITUDE | {"f": turned}).model.equations
    exact = read(ATTITUDE).model.equations.moved(start, u, [], {"dt": 0.1})
    np.testing.assert_allclose(found.moved(start, u, [], {"dt": 0.1}), exact, atol=1e-8)
    rates = {"time": "continuous", "sample_time": "dt"}
    rates["f"] = lambda x, u, _, __: ca.vertcat(u[0] - x.bx, u[1] - x.by, u[2] - x.bz, 0, 0, 0)
    moved = read(ATTITUDE | rates).model.equations.moved(start, u, [], {"dt": 0.1})
    np.testing.assert_allclose(moved, exact, rtol=1e-13)


def test_a_vector_of_parameters_is_one_symbol():
    parameters = {"dt": 0.1, "m": [0.6, 0.0, 0.8]}
    model = ATTITUDE | {"h": lambda x, _, p: [p.m[0] * x.bx, p.m[1], p.m[2] + p.dt]}
    by_text = ATTITUDE | {"h": ["m[0]*bx", "m[1]", "m[2] + dt"]}
    spec = read(model, parameters)
    assert spec.model.equations.h == read(by_text, parameters).model.equations.h
    assert spec.to_dict()["parameters"] == parameters
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    x, q = ca.SX.sym("bx"), ca.SX.sym("q", 4)
    seen = read(ATTITUDE | {"h": [x, q[1], q[3]]}).model.equations
    assert seen.seen([1, 2, 3, 4, 5, 6, 7], [0, 0, 0], {"dt": 0.1}) == (5, 2, 4)


def raising(x, u, w, p):
    return x.headin


def mathematical(x, u, w, p):
    return [math.cos(x.heading), 0.0, 0.0]


WRONG = {
    "arguments": (lambda x, _: [x], "a function of (x, u, w, p)"),
    "an attribute": (raising, "did you mean 'heading'?"),
    "math": (mathematical, "casadi's do"),
    "rows": (lambda x, _, __, ___: [x.x, x.y], "3: x (1), y (1), heading (1)"),
    "nothing": (lambda *_: None, "a list, a dict by name or a column"),
    "text": (lambda *_: ["x", "y", "z"], "numbers"),
    "a name": (ca.vertcat(ca.SX.sym("q"), 0, 0), "symbols out of x, y, heading"),
    "an operation": (ca.vertcat(ca.erf(ca.SX.sym("x")), 0, 0), "sinh, cosh, tanh"),
    "sizes": (ca.Function("f", [ca.SX.sym("x", 3)], [ca.SX.sym("x", 3)], {"allow_free": True}), ""),
    "MX": (ca.MX.sym("x", 3), "SX or DM"),
    "not finite": (ca.vertcat(ca.SX.sym("x"), np.inf, 0), "finite numbers"),
    "SymPy": (sp.Matrix([sp.Symbol("q"), 0, 0]), "symbols out of x, y, heading"),
    "a SymPy function": (sp.Matrix([sp.gamma(sp.Symbol("x")), 0, 0]), "without gamma"),
    "a class": (dict, "a table of expressions"),
    "a number": (3.0, "a list of 3 in order"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_source_is_said_in_one_line(name):
    source, expected = WRONG[name]
    with pytest.raises(SpecError) as caught:
        fkgen.Spec.from_dict(table({**ROBOT, "f": source}))
    assert caught.value.key.startswith("model.f")
    assert expected in f"{caught.value.given} {caught.value.expected}"
    assert "\n" not in str(caught.value)


def test_a_vector_of_parameters_is_given_whole_or_entry_by_entry():
    named = [("dt", 0.1), ("m_0", 1.0), ("m_1", 2.0)]

    def values(params, samples=3):
        return [each.tolist() for each in record.values_of(named, params, samples, np.float64)]

    assert values({"m": [5.0, 6.0]}) == [[0.1], [5.0], [6.0]]
    assert values({"m": np.arange(6.0).reshape(3, 2)}) == [[0.1], [0, 2, 4], [1, 3, 5]]
    assert values({"m_1": 7.0}) == [[0.1], [1.0], [7.0]]
    for wrong in ([1.0], 1.0, [[1.0, 2.0, 3.0]]):
        with pytest.raises(DataError, match=r"params\.m"):
            values({"m": wrong})


def test_what_a_filter_is_told_of_faults_is_no_argument():
    faults = {"sensor": {"noise_factor": 4.0}}
    f, h = SOURCES["functions"]()
    model = {key: value for key, value in ROBOT.items() if key != "let"}
    given = table({**model, "f": f, "h": h}, PARAMETERS, faults=faults)
    plain = fkgen.Spec.from_dict(given).model
    told = replace(equations.FAMILY.traits, told=(Parameter("gamma", 1.0), Parameter("delta", 1.0)))
    equations.TOLD = replace(equations.FAMILY, traits=told)
    assert fkgen.Spec.from_dict(given | {"filter": {"family": "equations:TOLD"}}).model == plain


def nested(count, x, y, mathematics):
    """Two numbers that hold each other some times over: few parts, and trees beyond bounds."""
    a, b = x + 1, y + 1
    for _ in range(count):
        above = mathematics.sin(a * b) / (2 + a**2) + a / 3
        a, b = above, mathematics.cos(a - b) / 2 + b / (3 + a**2)
    return a, b


def test_parts_of_sympy_that_are_equal_are_converted_once():
    a, b = nested(6, *sp.symbols("x y"), sp)
    with pytest.raises(SpecError, match="at most 2000 terms"):
        foreign.sympy_tree(a, Place())
    found = read(ROBOT | {"h": {"range": a, "bearing": b}}).model.equations
    assert len(found.let) < 100
    assert max(map(size, found.trees)) <= 2 * LARGE
    seen = found.seen([0.3, -0.7, 0.2], [0.0, 0.0], {"dt": 0.1})
    np.testing.assert_allclose(seen, nested(6, 0.3, -0.7, math), rtol=1e-13)


def test_an_expression_of_too_many_different_parts_is_refused(monkeypatch):
    monkeypatch.setattr(foreign, "MAX_DISTINCT", 60)
    with pytest.raises(SpecError, match="at most 60 different terms and factors"):
        read(ROBOT | {"h": {"range": nested(6, *sp.symbols("x y"), sp)[0], "bearing": "heading"}})
    read(ROBOT | {"h": {"range": nested(1, *sp.symbols("x y"), sp)[0], "bearing": "heading"}})
