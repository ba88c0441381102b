"""Every mistake in a spec is refused in one line: file, key, what was given, what was expected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import INF, KF, MKF, MME, NAN, REMOVED, Case, changed, check, refusal

from fkgen.problem import Spec


@pytest.mark.parametrize("base", [KF, MKF, MME])
def test_what_the_cases_start_from_is_right(base: dict[str, Any]) -> None:
    Spec.from_dict(base)


@pytest.mark.parametrize(
    ("table", "given"),
    [
        ({}, "an empty spec"),
        ([], "the list []"),
        (None, "the NoneType None"),
        ("motor.toml", "the text 'motor.toml'"),
        (3, "the int 3"),
        ({1: 2}, "the key 1"),
    ],
)
def test_what_is_no_spec(table: object, given: str) -> None:
    error = refusal(table)
    assert error.key == "spec"
    assert error.given == given
    assert "a table" in error.expected or error.expected == "keys that are text"


KEYS: list[Case] = [
    (KF, {"a\nb": 1}, "'a\\nb'", "an unknown key", "one of name, model"),
    (KF, {"m" * 99: 1}, f"'{'m' * 59}...", "an unknown key", "one of name, model"),
    (KF, {"": 1}, "''", "an unknown key", "one of name, model"),
    (KF, {"modell": {}}, "modell", "an unknown key", "did you mean 'model'?"),
    (KF, {"model.a": [[1]]}, "model.a", "an unknown key", "did you mean 'A'?"),
    (KF, {"model.sampletime": 1}, "model.sampletime", "unknown", "did you mean 'sample_time'?"),
    (KF, {"model.sample_time": "tu"}, "model.sample_time", "'tu'", "did you mean 'tau'?"),
    (KF, {"model.sample_time": -1}, "model.sample_time", "-1", "or the name of a parameter"),
    (
        KF,
        {"model.sample_time": "tau", "parameters.tau": 0.0},
        "model.sample_time",
        "'tau', whose default is 0.0",
        "a parameter with a positive default",
    ),
    (KF, {"record": {"columns": {"y1": "b"}}}, "record.columns.y1", "an unknown name", "y0, tau"),
    (KF, {"record": {"columns": {"tau": 1}}}, "record.columns.tau", "the int 1", "heading"),
    (KF, {"record": {"time": 1}}, "record.time", "the int 1", "heading"),
    (KF, {"model.zzzz": 1}, "model.zzzz", "an unknown key", "one of A, B, C, D, Q, R"),
    (KF, {"faults.actuators": {}}, "faults.actuators", "unknown", "did you mean 'actuator'?"),
    (
        MKF,
        {"faults.actuator.sucess_rate": 1},
        "faults.actuator.sucess_rate",
        "unk",
        "'success_rate'?",
    ),
    (MME, {"filter.hypothesis": [1]}, "filter.hypothesis", "unknown", "did you mean 'hypotheses'?"),
    (KF, {"code.scaler": "float"}, "code.scaler", "an unknown key", "did you mean 'scalar'?"),
    (KF, {"model.states": [{"nam": "a"}, {}]}, "model.states[0].nam", "unknown", "'name'?"),
    (KF, {"name": REMOVED}, "name", "the key is missing", "a C identifier"),
    (KF, {"model": REMOVED}, "model", "the key is missing", "a table with the plant"),
    (KF, {"filter": REMOVED}, "filter", "the key is missing", "the family of the filter"),
    (KF, {"filter": {}}, "filter.family", "the key is missing", "one of kf, "),
    (KF, {"model.A": REMOVED}, "model.A", "the key is missing", "A maps the state to itself"),
    (KF, {"model.C": REMOVED}, "model.C", "missing", "C maps the state to the measurement"),
    (KF, {"model.Q": REMOVED}, "model.Q", "missing", "(2, 2) covariance, or F and V (Q = F V F')"),
    (KF, {"model.R": REMOVED}, "model.R", "missing", "(1, 1) covariance, or G and W (R = G W G')"),
    (KF, {"model.x0": REMOVED}, "model.x0", "the key is missing", "a list of 2 numbers"),
    (KF, {"model.P0": REMOVED}, "model.P0", "missing", "P0 is the covariance of the error of x0"),
    (
        MKF,
        {"model.B": REMOVED},
        "model.B",
        "no input",
        "the family mkf is about faults of the input",
    ),
    (
        MME,
        {"model.B": REMOVED},
        "model.B",
        "no input",
        "the family mme is about faults of the input",
    ),
    (MKF, {"model.B": [[], []]}, "model.B", "no input", "about faults of the input"),
    (MME, {"filter.hypotheses": REMOVED}, "filter.hypotheses", "missing", "a list of hypotheses"),
    (KF, {"model.states": [{}, {}]}, "model.states[0].name", "missing", "a C identifier"),
    (KF, {"filter.family": "mmee"}, "filter.family", "'mmee'", "did you mean 'mme'?"),
    (KF, {"filter.family": "KF"}, "filter.family", "'KF'", "did you mean 'kf'?"),
    (KF, {"filter.family": "xyzzy"}, "filter.family", "'xyzzy'", "one of kf, "),
    (KF, {"filter.family": 3}, "filter.family", "3", "one of kf, "),
    (KF, {"filter.family": ["kf"]}, "filter.family", "['kf']", "one of kf, "),
    (KF, {"model": [1]}, "model", "the list [1]", "a table with A, B"),
    (KF, {"parameters": [1]}, "parameters", "the list [1]", "a table of default values"),
    (KF, {"parameters": {1: 2.0}}, "parameters", "the key 1", "text"),
    (KF, {"faults": 3}, "faults", "the int 3", "a table with actuator"),
    (MKF, {"faults": {"actuator": 0.7}}, "faults.actuator", "the float 0.7", "a table with"),
    (KF, {"filter": "kf"}, "filter", "the text 'kf'", "a table with family"),
    (KF, {"code": "float"}, "code", "the text 'float'", "a table with scalar"),
    (KF, {"code.scalar": "flaot"}, "code.scalar", "'flaot'", "did you mean 'float'?"),
    (KF, {"code.update": 1}, "code.update", "1", "one of auto, short, joseph"),
    (KF, {"code.fma": 1}, "code.fma", "the int 1", "true or false"),
    (KF, {"code.fma": "yes"}, "code.fma", "the text 'yes'", "true or false"),
]


A, ONES = "model.A", [[1.0, 0.0], [0.0, 1.0]]
MATRICES: list[Case] = [
    (KF, {A: 0.9}, A, "the float 0.9", "a list of rows"),
    (KF, {A: "eye"}, A, "the text 'eye'", "a list of rows"),
    (KF, {A: {}}, A, "the table {}", "a list of rows"),
    (KF, {A: None}, A, "the NoneType None", "a list of rows"),
    (KF, {A: []}, A, "an empty list", "a list of rows"),
    (KF, {A: [0.9, 0.1]}, "model.A[0]", "the float 0.9", "a row"),
    (KF, {A: np.ones(2)}, "model.A[0]", "the float 1.0", "a row"),
    (KF, {A: np.ones((2, 2, 2))}, "model.A[0][0]", "the list [1.0, 1.0]", "a finite number"),
    (KF, {A: [[1.0, 0.0], [0.0]]}, "model.A[1]", "1 entries", "2: all rows have the same length"),
    (KF, {A: [[1.0, 0.0]]}, A, "shape (1, 2)", "shape (1, 1): A maps the state to itself"),
    (KF, {A: [[1.0]]}, "model.C", "shape (1, 2)", "shape (any, 1): C maps the state to the meas"),
    (KF, {"model.C": [[1.0]]}, "model.C", "shape (1, 1)", "shape (any, 2): C maps the state"),
    (
        KF,
        {"model.B": [[1.0]]},
        "model.B",
        "shape (1, 1)",
        "(2, any): B maps the input to the state",
    ),
    (
        MKF,
        {"model.D": [[1.0, 2.0]]},
        "model.D",
        "(1, 2)",
        "(1, 1): D maps the input to the measure",
    ),
    (KF, {"model.D": [[1.0]]}, "model.D", "D without B", "no D where there is no input"),
    (
        KF,
        {"model.Q": [[1.0]]},
        "model.Q",
        "shape (1, 1)",
        "(2, 2): Q is the covariance of the noise",
    ),
    (KF, {"model.R": ONES}, "model.R", "shape (2, 2)", "(1, 1): R is the covariance of the noise"),
    (KF, {"model.P0": [[1.0]]}, "model.P0", "shape (1, 1)", "(2, 2): P0 is the covariance"),
    (KF, {"model.x0": [0.0]}, "model.x0", "1 entries", "2 numbers or expressions: the state"),
    (KF, {"model.x0": 0.0}, "model.x0", "the float 0.0", "a list of 2 numbers"),
    (KF, {"model.x0": [[0.0, 0.0], 1.0]}, "model.x0[0]", "the list [0.0, 0.0]", "a finite number"),
    (KF, {"model.x0": [0.0, NAN]}, "model.x0[1]", "nan", "a finite number"),
    (KF, {A: [[True, 0.0], [0.0, 1.0]]}, "model.A[0][0]", "the boolean True", "a finite number"),
    (KF, {A: np.eye(2, dtype=bool)}, "model.A[0][0]", "the boolean True", "a finite number"),
    (KF, {A: np.eye(2) * 1j}, "model.A[0][0]", "the complex 1j", "a finite number"),
    (KF, {A: [[NAN, 0.0], [0.0, 1.0]]}, "model.A[0][0]", "nan", "a finite number"),
    (KF, {A: [[0.0, -INF], [0.0, 1.0]]}, "model.A[0][1]", "-inf", "a finite number"),
    (KF, {A: [[0.0, 10**400], [0.0, 1.0]]}, "model.A[0][1]", "1000", "that fits a double"),
    (KF, {A: [[0.0, 10**5000], [0.0, 1.0]]}, "model.A[0][1]", "an int too long", "fits a double"),
    (KF, {A: [[0.0, [1.0]], [0.0, 1.0]]}, "model.A[0][1]", "the list [1.0]", "a finite number"),
    (KF, {A: [[0.0, None], [0.0, 1.0]]}, "model.A[0][1]", "the NoneType None", "a finite number"),
    (KF, {A: [["1 +", 0], [0, 1]]}, "model.A[0][0]", "'1 +'", "an expression of"),
    (KF, {A: [[1, "tua"], [0, 1]]}, "model.A[0][1]", "'tua'", "did you mean 'tau'?"),
    (KF, {A: [[1, "os.sep"], [0, 1]]}, "model.A[0][1]", "'os.sep'", "attribute access"),
    (KF, {A: [[1, "1/(tau - 0.05)"], [0, 1]]}, "model.A[0][1]", "1.0 / (tau - 0.05)", "tau = 0.05"),
    (KF, {A: [[1, "log(-tau)"], [0, 1]]}, "model.A[0][1]", "log(-tau)", "log(-0.05) is not a real"),
    (KF, {A: [[1, "sqrt(-tau)"], [0, 1]]}, "model.A[0][1]", "sqrt", "sqrt(-0.05) is not a real"),
    (KF, {A: [[1, "exp(1e5*tau)"], [0, 1]]}, "model.A[0][1]", "exp", "exp(5000.0) is too large"),
    (KF, {"model.x0": ["tau0", 0.0]}, "model.x0[0]", "'tau0'", "only parameters"),
    (
        KF,
        {"model.Q": [[1, 0.5], [0.4, 1]]},
        "model.Q",
        "[1][0] = 0.4 and [0][1] = 0.5",
        "symmetric",
    ),
    (KF, {"model.P0": [[1, 0.5], [0.4, 1]]}, "model.P0", "[1][0] = 0.4", "a symmetric matrix"),
    (
        KF,
        {"model.Q": [[1, 2], [2, 1]]},
        "model.Q",
        "smallest eigenvalue -1",
        "positive semidefinite",
    ),
    (
        KF,
        {"model.P0": [[1, 2], [2, 1]]},
        "model.P0",
        "smallest eigenvalue -1",
        "positive semidefinite",
    ),
    (KF, {"model.R": [[-1e-4]]}, "model.R", "variance -0.0001", "positive semidefinite"),
    (KF, {"model.R": [["0.01 - tau"]]}, "model.R", "variance -0.04", "positive semidefinite"),
    (KF, {"model.F": ONES}, "model.F", "F beside Q", "either Q, or F and V (Q = F V F')"),
    (KF, {"model.V": ONES}, "model.V", "V beside Q", "either Q, or F and V"),
    (KF, {"model.G": [[1]]}, "model.G", "G beside R", "either R, or G and W (R = G W G')"),
    (
        KF,
        {"model.Q": REMOVED, "model.V": ONES},
        "model.F",
        "missing) beside V",
        "F, since Q = F V F'",
    ),
    (KF, {"model.Q": REMOVED, "model.F": [[1.0]]}, "model.F", "(1, 1)", "(2, any): F maps a noise"),
    (
        KF,
        {"model.Q": REMOVED, "model.F": ONES, "model.V": [[1.0]]},
        "model.V",
        "shape (1, 1)",
        "shape (2, 2): V is the covariance of what F maps",
    ),
    (
        KF,
        {"model.Q": REMOVED, "model.F": ONES, "model.V": [[1.0, 2.0], [2.0, 1.0]]},
        "model.V",
        "smallest eigenvalue -1",
        "positive semidefinite",
    ),
    (
        KF,
        {"model.R": REMOVED, "model.G": [[1e200]]},
        "model.G",
        "a noise factor",
        "a finite covariance, but 1e+200 * 1e+200 is too large",
    ),
    (KF, {"model.Q": [[0, 0], [0, 0]], "model.R": [[0]]}, "model.R", "singular", "process noise"),
    (MME, {"model.R": [[0]]}, "model.R", "singular", "positive definite R for the family mme"),
    (KF, {"model.sample_time": 0}, "model.sample_time", "0.0", "a positive number of seconds"),
    (KF, {"model.sample_time": -1}, "model.sample_time", "-1.0", "a positive number of seconds"),
    (KF, {"model.sample_time": NAN}, "model.sample_time", "nan", "a positive number of seconds"),
    (KF, {"model.sample_time": True}, "model.sample_time", "the boolean True", "a positive number"),
    (KF, {"model.sample_time": "1"}, "model.sample_time", "'1'", "a positive number"),
    (KF, {"model.system": 3}, "model.A", "A beside system", "either system or A"),
]


@pytest.mark.parametrize("case", KEYS + MATRICES, ids=lambda case: f"{case[2]}: {case[3]}")
def test_keys_and_matrices(case: Case) -> None:
    check(*case)


FLOAT = {"code.scalar": "float"}


@pytest.mark.parametrize(
    ("changes", "key", "given", "expected"),
    [
        ({"model.x0": [1e300, 0.0]}, "model.x0[0]", "1e+300", "at most 1e+100"),
        ({"model.R": [[1e-320]]}, "model.R[0][0]", "9.99989e-321", "0 or at least 1e-100"),
        ({"model.P0": [[1e308, 0.0], [0.0, 1.0]]}, "model.P0[0][0]", "1e+308", "at most 1e+100"),
        ({"model.A": [[1e39, 0.0], [0.0, 1.0]], **FLOAT}, "model.A[0][0]", "1e+39", "at most"),
        ({"model.C": [[0.0, "1e30*tau"]], **FLOAT}, "model.C[0][1]", "5e+28", "scalar 'float'"),
    ],
)
def test_numbers_that_leave_the_range_of_the_scalar(changes, key, given, expected) -> None:
    check(MKF, changes, key, given, expected)


def test_large_numbers_that_fit_are_taken() -> None:
    wide = changed(MKF, {"model.P0": [[1e60, 0.0], [0.0, 1.0]], "model.R": [[1e-60]]})
    assert Spec.from_dict(wide).model.P0.values()[0, 0] == 1e60
