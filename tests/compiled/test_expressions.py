"""Expressions in C: the numbers that Python makes of them, in every family, or a refusal."""

from __future__ import annotations

import math
import tomllib

import numpy as np
import pytest
from plants import assert_agree, built, generated, interpreted
from scipy.interpolate import PchipInterpolator
from toolchain import C_COMPILERS, C_ONLY, FLAGS, call, check_only, each, needs_compiler, run_main

import fkgen
from fkgen.families import NAMES
from fkgen.study.reports.starters import starter

pytestmark = needs_compiler()

TABLES = {
    "drag": {"x": [0.0, 0.5, 2.0], "y": [1.0, 0.2, 0.6]},
    "curve": {"x": [-1.0, 0.0, 1.0, 1.5], "y": [1.0, 0.2, 0.6, 0.5], "kind": "pchip"},
}


def drag(x):
    return float(np.interp(x, TABLES["drag"]["x"], TABLES["drag"]["y"]))


def curve(x):
    return float(PchipInterpolator(TABLES["curve"]["x"], TABLES["curve"]["y"])(np.clip(x, -1, 1.5)))


#: Expressions, and the same in Python: a is -2 to 2, b is 0.1 to 3.
SAME = {
    "if(a > 0, 1/(1 + a), exp(a))": "1/(1 + a) if a > 0 else math.exp(a)",
    "if(a <= 0, 0.5, sqrt(log(1 + a)))": "0.5 if a <= 0 else math.log(1 + a) ** 0.5",
    "if(a - 1, 2, 3)": "3 if a == 1 else 2",
    "if((a < b)*(a != -2), 0.7, if(b == a, 1, 0.4))": (
        "0.7 if a < b and a != -2 else 1 if a == b else 0.4"
    ),
    "min(b, 0.9) - max(0.5, abs(a)/4)": "min(b, 0.9) - max(0.5, abs(a)/4)",
    "sign(a) + 0.1*(0.5 <= b < 2) + (a >= 1)": (
        "math.copysign(1, a) + (0.1 if 0.5 <= b < 2 else 0) + (1 if a >= 1 else 0)"
    ),
    "hypot(a, b) + tanh(a)": "math.sqrt(a*a + b*b) + math.tanh(a)",
    "cosh(b) + sinh(a)": "math.cosh(b) + math.sinh(a)",
    "2*pi*asin(a/2.5)": "2*math.pi*math.asin(a/2.5)",
    "acos(a/2)": "math.acos(a/2)",
    "interp(b, 'drag')": "drag(b)",
    "interp(a, 'curve') + interp(b, 'curve')": "curve(a) + curve(b)",
}


def in_python(text, a, b):
    known = {"math": math, "drag": drag, "curve": curve, "a": float(a), "b": float(b)}
    return eval(text, known)  # noqa: S307 - text from above


def parameters(T):
    """Values of a and b, at first where decisions turn and tables have points and ends."""
    rng = np.random.default_rng(12)
    a, b = rng.uniform(-2.0, 2.0, T), rng.uniform(0.1, 3.0, T)
    a[:6], b[:6] = [-2.0, 1.0, 2.0, -1.0, 1.5, 0.7], [0.5, 2.0, 3.0, 1.5, 1.0, 0.7]
    return {"a": a, "b": b}


ONE = [[1.0]]
START = {"C": ONE, "Q": ONE, "R": ONE, "x0": [0.0], "P0": ONE}


def only(expressions, scalar="double", **given):
    """A filter whose next state is the expression that belongs to the input that is 1."""
    model = {"A": [[1e-30]], "B": [list(expressions)], **START}
    code = {"scalar": scalar}
    table = {"name": "plant", "model": model, "tables": TABLES, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table | {"code": code, "parameters": {"a": 0.5, "b": 0.8, **given}})


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_the_numbers_are_those_of_python(scalar):
    real, T = np.float32 if scalar == "float" else np.float64, 60
    given = {name: values.astype(real) for name, values in parameters(T).items()}
    found = built(only(SAME, scalar))
    for i, text in enumerate(SAME.values()):
        u = np.zeros((T, len(SAME)))
        u[:, i] = 1.0
        result = found.run(np.full((T, 1), np.nan), u, given).predicted_state[:, 0]
        expected = [in_python(text, a, b) for a, b in zip(*given.values(), strict=True)]
        # Functions err by a few units in the last place, and numbers of up to 10 are added.
        limit = 60.0 * float(np.finfo(real).eps)
        np.testing.assert_allclose(result, expected, rtol=limit, atol=limit)


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_they_compile_without_a_warning(scalar, compiler, tmp_path):
    source = generated(only(SAME, scalar))
    source.write(tmp_path / "out")
    flags = ["-std=c99", "-O1", *FLAGS, *C_ONLY, check_only(compiler)]
    call(*C_COMPILERS[compiler], *flags, "plant.c", cwd=tmp_path / "out")


#: Factors that decide and look up, and the same in Python.
FACTOR = "if(a > 0, interp(b, 'drag'), 0.5 + 0.1*sign(b - 1)*tanh(log(-a))) * min(1, 0.2 + b)"
LIMITS = {"a": {"default": 0.5, "min": -2.0, "max": 2.0}, "b": {"default": 0.8, "min": 0.0}}


def factor(a, b):
    side = 1.0 if b > 1.0 else -1.0
    taken = drag(b) if a > 0.0 else 0.5 + 0.1 * side * math.tanh(math.log(-a))
    return taken * min(1.0, 0.2 + b)


def with_entries(family, A, R, given):
    """The spec that a family starts with, with another last entry of A and first one of R.

    Of equations the last of f is multiplied.
    """
    table = tomllib.loads(starter(family))
    table["model"]["R"][0][0] = R
    if "A" in table["model"]:
        table["model"]["A"][-1][-1] = A
    else:
        last = [*table["model"]["f"]][-1]
        table["model"]["f"][last] = f"({A})*({table['model']['f'][last]})"
    table["parameters"] = table.get("parameters", {}) | given
    if "window" in (soft := table.get("faults", {}).get("soft", {})):
        soft["window"] = 4
    return fkgen.Spec.from_dict(table | {"tables": TABLES})


@pytest.mark.parametrize("family", NAMES)
def test_every_family_computes_them_and_refuses_what_is_out_of_range(family):
    T = 14
    whole = with_entries(family, f"0.9*{FACTOR}", f"0.01 + {FACTOR}", LIMITS)
    told = with_entries(family, "0.9*f", "0.01 + f", {"f": factor(0.5, 0.8)})
    given = parameters(T)
    f = np.array([factor(a, b) for a, b in zip(*given.values(), strict=True)])
    rng = np.random.default_rng(3)
    y, u = rng.normal(size=(T, whole.model.ny)), rng.normal(size=(T, whole.model.nu))
    if whole.model.equations is not None:  # a record far out enlarges every rounding
        x0 = whole.model.x0.values().ravel()
        y = 0.1 * y + whole.model.equations.seen(x0, u[0], told.defaults)
    y[5] = y[9, -1] = np.nan
    expected = interpreted(told, y, u, {"f": f})
    found = built(whole)
    result = found.run(y, u if u.size else None, given)
    assert (result.status >= 0).all()
    ports = type("Ports", (), expected)
    # The factors differ by some 1e-16, which 14 samples and the weights of modes enlarge.
    # Rounding decides whether a step of iekf is taken that leads 1e-8 deviations.
    stays = "stayed" in result.ports
    shown = [n for n in expected if n in result.ports and n != "stayed"]
    assert_agree(result, ports, shown, 1e-6 if stays else 1e-9)
    for name, value in (("a", np.nextafter(2.0, 3.0)), ("a", -2.1), ("b", -1e-300)):
        wrong = {key: values.copy() for key, values in given.items()}
        wrong[name][7] = value
        status = found.run(y, u if u.size else None, wrong).status
        assert status[7] == -4
        np.testing.assert_array_equal(np.delete(status, 7) >= 0, True)


@pytest.mark.parametrize(
    "expression",
    [
        "if(log(a) < 0, 1, 2)",
        "max(sqrt(a), 0)",
        "min(1/(a + 1.5), 2)",
        "sign(log(a))",
        "interp(acos(a), 'drag')",
        "if(b > 0, if(sqrt(a), 1, 2), 3)",
        "(1/(a + 1.5) < 1)",
    ],
)
def test_a_decision_by_no_number_is_refused(expression):
    result = built(only([expression])).run([[1.0]] * 2, [[1.0]] * 2, {"a": [0.5, -1.5]})
    assert result.status.tolist() == [0, -4]


MAIN = """
#include "plant.h"
#include <stdio.h>
int main(void)
{
    plant_t self;
    plant_params_t params;
    const double u[1] = { 1.0 }, y[1] = { 1.0 };
    plant_init(&self);
    plant_params_init(&params);
    printf("%d %d ", plant_update(&self, &params, u, y, 1u), plant_predict(&self, &params, u));
    params.a = 0.0 / (params.a - 0.5);
    printf("%d %d ", plant_update(&self, &params, u, y, 1u), plant_predict(&self, &params, u));
    params.a = 0.5;
    params.b = 4.0;
    printf("%d %d", plant_update(&self, &params, u, y, 1u), plant_predict(&self, &params, u));
    return 0;
}
"""


def test_update_and_predict_refuse_a_parameter_each_by_itself(tmp_path):
    limited = only(["if(a > 0, 1, 2)"], b={"default": 0.8, "max": 3.0})
    generated(limited).write(tmp_path / "out")
    (line,) = run_main(tmp_path / "out", MAIN, "plant.c")
    assert line.split() == ["0", "0", "-4", "-4", "-4", "-4"]
