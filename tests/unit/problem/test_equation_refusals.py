"""What is wrong with equations is said in one line: place, given, expected."""

from __future__ import annotations

import numpy as np
import pytest
from equations import ATTITUDE, ROBOT, read, table

import fkgen
from fkgen.errors import FkgenError, SpecError

PLAIN = {
    "states": [{"name": "p"}, {"name": "v"}],
    "inputs": [{"name": "force"}],
    "outputs": [{"name": "y"}],
    "noises": [{"name": "w", "variance": "dt"}],
    "R": [[1.0]],
    "x0": [0.0, 1.0],
    "P0": np.eye(2).tolist(),
    "f": {"p": "p + v*dt", "v": "v + sin(force) + w"},
    "h": {"y": "p*p"},
}

WRONG = {
    "an unknown name": ({"h": {"y": "q*p"}}, "model.h.y", "not the name 'q'"),
    "a misspelt name": ({"h": {"y": "forse*p"}}, "model.h.y", "did you mean 'force'?"),
    "let before": ({"let": {"a": "b + p", "b": "v"}}, "model.let.a", "what stands before it"),
    "a cycle": ({"let": {"a": "a*p"}}, "model.let.a", "a cycle has no order"),
    "let twice": ({"let": {"v": "p"}}, "model.let.v", "a name that is not taken"),
    "let a word": ({"let": {"sin": "p"}}, "model.let.sin", "word of the expression language"),
    "let a keyword": ({"let": {"lambda": "p"}}, "model.let.lambda", "keyword of Python"),
    "let no table": ({"let": ["p"]}, "model.let", "definitions in order"),
    "f of no state": ({"f": {"y": "p"}}, "model.f.y", "names of states: p, v"),
    "h of no output": ({"h": {"p": "p"}}, "model.h.p", "names of outputs: y"),
    "f of other length": ({"f": ["p"]}, "model.f", "a list of 2 in order"),
    "no h": ({"h": {}}, "model.h.y", "an expression of states and inputs"),
    "noise in h": ({"h": {"y": "p + w"}}, "model.h.y", "noises enter through f"),
    "noise by let": (
        {"let": {"a": "w*p"}, "h": {"y": "a"}},
        "model.h.y",
        "noises enter through f",
    ),
    "a vector": ({"h": {"y": "[p, v]"}}, "model.h.y", "a number"),
    "a vector in a call": ({"h": {"y": "sin([p, v])"}}, "model.h.y", "not a vector of 2"),
    "an index": ({"h": {"y": "[p, v][2]"}}, "model.h.y", "an index 0..1"),
    "an index of a number": ({"h": {"y": "p[0]"}}, "model.h.y", "behind a vector"),
    "a negative index": ({"h": {"y": "[p, v][-1]"}}, "model.h.y", "an index 0..1"),
    "lengths": ({"h": {"y": "norm([p, v] + [1, 2, 3])"}}, "model.h.y", "of one length"),
    "product": ({"h": {"y": "norm([p, v] * [1, 2])"}}, "model.h.y", "dot(a, b)"),
    "power": ({"h": {"y": "norm([p, v] ** 2)"}}, "model.h.y", "no ** of a number and a vector"),
    "cross": ({"h": {"y": "norm(cross([p, v], [p, v]))"}}, "model.h.y", "vectors of 3"),
    "arguments": ({"h": {"y": "dot([p, v])"}}, "model.h.y", "2 arguments of 'dot'"),
    "rotate": ({"h": {"y": "rotate(p, [1, 2, 3])[0]"}}, "model.h.y", "vectors such as"),
    "text": ({"h": {"y": "p +"}}, "model.h.y", "an expression"),
    "attribute": ({"h": {"y": "p.real"}}, "model.h.y", "attribute"),
    "a boolean": ({"h": {"y": True}}, "model.h.y", "a finite number, or an expression"),
    "a list of lists": ({"let": {"a": [["p"]]}}, "model.let.a[0]", "numbers or expressions"),
    "f beside A": ({"A": [[1.0, 0.0], [0.0, 1.0]]}, "model.A", "either A or f"),
    "B without A": ({"B": [[1.0], [0.0]]}, "model.B", "either A or f"),
    "D beside h": ({"D": [[1.0]]}, "model.D", "either C or h"),
    "integrator": ({"integrator": "rk4"}, "model.integrator", 'time = "continuous"'),
    "substeps": (
        {"time": "continuous", "sample_time": 0.1, "substeps": 0},
        "model.substeps",
        "whole number in 1..100",
    ),
    "no time": ({"time": "continuous"}, "model.sample_time", "the seconds from sample"),
    "variance": ({"noises": [{"name": "w", "variance": -1.0}]}, "model.noises[0].variance", "vari"),
    "variance 2": ({"noises": [{"name": "w"}]}, "model.noises[0].variance", "a variance"),
    "noise twice": (
        {"noises": [{"name": "w", "variance": 1.0}] * 2},
        "model.noises",
        "distinct names",
    ),
    "noise a state": (
        {"noises": [{"name": "p", "variance": 1.0}]},
        "model.noises[0].name",
        "that mean one thing",
    ),
    "state a parameter": (
        {"states": [{"name": "dt"}, {"name": "v"}]},
        "model.states[0].name",
        "that mean one thing",
    ),
    "state a word": (
        {"states": [{"name": "exp"}, {"name": "v"}]},
        "model.states[0].name",
        "word of the expression language",
    ),
    "x0": ({"x0": [0.0]}, "model.x0", "2 numbers"),
    "P0": ({"P0": [[1.0]]}, "model.P0", "shape (2, 2)"),
    "no Q": ({"noises": [], "f": {}}, "model.Q", "a (2, 2) covariance"),
    "no states": ({"states": []}, "model.states", "states by name"),
    "wrap": ({"outputs": [{"name": "y", "wrap": "yes"}]}, "model.outputs[0].wrap", "true or false"),
    "manifold": (
        {"states": [{"name": "p", "manifold": "SO2"}, {"name": "v"}]},
        "model.states[0].manifold",
        "one of SO3",
    ),
    "infinite at x0": ({"h": {"y": "log(p)"}}, "model.h.y", "finite values and derivatives"),
    "derivative at x0": ({"h": {"y": "sqrt(p)"}}, "model.h.y", "finite values and derivatives"),
    "derivative 2": ({"h": {"y": "hypot(p, v - 1)"}}, "model.h.y", "finite values and derivatives"),
    "division": ({"f": {"p": "1/p"}}, "model.f.p", "finite values and derivatives"),
    "no value at all": ({"h": {"y": "p + 1/0"}}, "model.h.y", "division by zero"),
    "a linear row": ({"f": ["p", "v/(dt - 0.1)"], "noises": []}, "model.f.v", "finite values"),
}


def refused(model, parameters=None, **sections):
    with pytest.raises(SpecError) as caught:
        read(model, parameters, **sections)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_names_its_place_and_what_is_expected(name):
    change, key, expected = WRONG[name]
    model = PLAIN | {"Q": np.eye(2).tolist()} | change
    if name == "no Q":
        del model["Q"]
    fault = refused(model)
    assert fault.key == key
    assert expected in f"{fault.given} {fault.expected}"


def test_a_value_that_is_not_finite_is_said_with_its_place_in_the_state_space():
    fault = refused(PLAIN | {"h": {"y": "hypot(p, v - 1)"}})
    assert "hypot(p, v - 1)" in fault.given
    assert "derivative with respect to p that is not a number" in fault.given
    assert fault.given.endswith("at x0 (p = 0, v = 1)")


def test_a_definition_without_a_value_is_named_and_so_is_a_place_in_a_table():
    fault = refused(PLAIN | {"let": {"a": "log(v - 2)", "b": "2*a"}, "h": {"y": "b + p"}})
    assert (fault.key, fault.given[:12]) == ("model.let.a", "'log(v - 2)'")
    tables = {"t": {"x": [0.0, 1.0], "y": [0.0, 1.0]}}
    fault = refused(PLAIN | {"h": {"y": "interp(log(v - 2), 't')"}}, tables=tables)
    assert fault.key == "model.h.y"
    assert "a value that is not a number at x0 (v = 1)" in fault.given


def test_a_variance_that_float_cannot_hold_is_refused():
    noises = [{"name": "w", "variance": 1e-40}]
    assert read(PLAIN | {"noises": noises}).model.ne == 2
    fault = refused(PLAIN | {"noises": noises}, code={"scalar": "float"})
    assert fault.key == "model.noises[0].variance"


def test_an_input_that_is_zero_is_no_fault():
    assert read(PLAIN | {"f": {"p": "p + v/force"}}).model.nx == 2


ATTITUDES = {
    "length of x0": ({"x0": [1.1, 0, 0, 0, 0, 0, 0]}, "model.x0[0]", "unit quaternion"),
    "count of x0": ({"x0": [1.0, 0, 0, 0, 0, 0]}, "model.x0", "7 numbers"),
    "rows of P0": ({"P0": np.eye(7).tolist()}, "model.P0", "3 rows for an attitude"),
    "rows of Q": ({"Q": np.eye(7).tolist()}, "model.Q", "shape (6, 6)"),
    "a number": ({"f": {"q": "bx"}}, "model.f.q", "q * [a, b, c], or four numbers"),
    "three numbers": ({"f": {"q": "rate"}}, "model.f.q", "q * [a, b, c], or four numbers"),
    "an attitude for a number": ({"f": {"bx": "q"}}, "model.f.bx", "a number"),
    "A": ({"A": np.eye(7).tolist(), "f": {}}, "model.A", "either A or f"),
    "a rate in continuous time": (
        {"time": "continuous", "sample_time": 0.1, "f": {"q": "q * rate"}},
        "model.f.q",
        "the body rate of q, a vector of 3",
    ),
    "wrap": (
        {"states": [{"name": "q", "manifold": "SO3", "wrap": True}, *ATTITUDE["states"][1:]]},
        "model.states[0].wrap",
        "one of the two",
    ),
}


@pytest.mark.parametrize("name", ATTITUDES)
def test_what_is_wrong_with_an_attitude(name):
    change, key, expected = ATTITUDES[name]
    fault = refused(ATTITUDE | change)
    assert fault.key == key
    assert expected in f"{fault.given} {fault.expected}"


def test_an_x0_that_is_nearly_of_unit_length_is_normalised_with_a_note():
    spec = read(ATTITUDE | {"x0": [-0.8004, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0]})
    x0 = spec.model.x0.values().ravel()[:4]
    assert np.linalg.norm(x0) == pytest.approx(1.0, abs=1e-15)
    assert x0[0] > 0.0
    (note,) = spec.model.remarks
    assert (note.code, note.severity) == ("unit-quaternion", "note")
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    assert read(ATTITUDE).model.remarks == ()


def test_an_angle_that_wraps_is_in_radians():
    outputs = [{"name": "range"}, {"name": "bearing", "unit": "deg", "wrap": True}]
    (finding,) = read(ROBOT | {"outputs": outputs}).model.remarks
    assert finding.severity == "warning"
    assert "bearing" in finding.message
    assert read(ROBOT).model.remarks == ()


PIECES = (
    *("p", "v", "force", "dt", "w", "q", "1", "0", "1e300", "[p, v, dt]", "[1, 2]", "[0]", "[9]"),
    *("+", "-", "*", "/", "**", "(", ")", ",", "sin(", "norm(", "dot(", "rotate(", "cross("),
    *("if(", "interp(", "'t'", "hypot(", "<", "==", "[", "]", ".", ":1", "q.R:00", "let", "\u00b7"),
)
ODD = (None, True, 3, float("nan"), float("inf"), 1j, [], {}, "", "p", ["p"], {"p": 1}, [[]], b"x")


@pytest.mark.parametrize("base", [PLAIN, ATTITUDE])
def test_whatever_stands_in_the_tables_is_read_or_refused_in_one_line(base):
    rng = np.random.default_rng(7)
    accepted = 0

    def text():
        return "".join(PIECES[int(i)] for i in rng.integers(len(PIECES), size=rng.integers(1, 7)))

    def odd():
        return text() if rng.random() < 0.6 else ODD[int(rng.integers(len(ODD)))]

    for _ in range(1500):
        key = ("f", "h", "let", "noises", "x0", "states", "outputs", "Q")[int(rng.integers(8))]
        entry = odd()
        if rng.random() < 0.8 and isinstance(base.get(key), dict):
            name = [*base[key], "a", "q.R:00", "a[0]"][int(rng.integers(len(base[key]) + 3))]
            entry = {**base[key], name: odd()}
        elif rng.random() < 0.5 and key in {"noises", "states", "outputs"} and key in base:
            which = ("name", "unit", "variance", "wrap", "manifold")[int(rng.integers(5))]
            entry = [{**base[key][0], which: odd()}, *base[key][1:]]
        spec, message = outcome(table({**base, key: entry}))
        assert "\n" not in message
        if spec is not None:
            accepted += 1
            assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    assert accepted > 20


def outcome(given):
    try:
        return fkgen.Spec.from_dict(given), ""
    except FkgenError as error:
        return None, str(error)
