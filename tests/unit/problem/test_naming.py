"""Names that C could not take are refused, and so are units that could end a comment."""

from __future__ import annotations

import pytest
from refusals import KF, NAN, Case, check

X, Y, IN = "model.states", "model.outputs", "model.inputs"
NAMES: list[Case] = [
    (KF, {"name": "2motor"}, "name", "'2motor'", "a C identifier"),
    (KF, {"name": "dc motor"}, "name", "'dc motor'", "a C identifier"),
    (KF, {"name": "motör"}, "name", "'motör'", "a C identifier"),
    (KF, {"name": "motor\n"}, "name", "'motor\\n'", "a C identifier"),
    (KF, {"name": ""}, "name", "''", "a C identifier"),
    (KF, {"name": 3}, "name", "the int 3", "a C identifier"),
    (KF, {"name": "m" * 41}, "name", "with 41 characters", "at most 40 characters"),
    (KF, {"name": "_motor"}, "name", "'_motor'", "without leading"),
    (KF, {"name": "motor_"}, "name", "'motor_'", "trailing"),
    (KF, {"name": "dc__motor"}, "name", "'dc__motor'", "double underscores"),
    (KF, {"name": "main"}, "name", "'main'", "do not reserve"),
    (KF, {"name": "uint32_t"}, "name", "'uint32_t'", "do not reserve"),
    (KF, {"name": "size"}, "name", "'size'", "'size_t' belongs to the C library"),
    (KF, {"name": "math"}, "name", "'math'", "'math.h' or"),
    *(
        (KF, {"name": word}, "name", f"'{word}'", "a keyword of C or C++")
        for word in ("while", "restrict", "static_assert", "class", "constexpr", "xor", "nullptr")
    ),
    (KF, {X: [{"name": "a"}]}, X, "1 entries", "2: the model has 2 states"),
    (KF, {X: "ab"}, X, "the text 'ab'", "a list of 2 tables"),
    (KF, {X: ["a", "b"]}, "model.states[0]", "the text 'a'", "a table with name, unit"),
    (KF, {Y: []}, Y, "0 entries", "1: the model has 1 outputs"),
    (KF, {IN: [{"name": "u"}]}, IN, "1 entries", "0: the model has 0 inputs"),
    (KF, {X: [{"name": "a"}, {"name": "a"}]}, X, "'a' twice", "states with distinct names"),
    (KF, {X: [{"name": "a"}, {"name": "A"}]}, X, "'a' and 'A'", "states with distinct names"),
    (KF, {X: [{"name": "a"}, {"name": "if"}]}, "model.states[1].name", "'if'", "keyword"),
    (KF, {X: [{"name": "a"}, {"name": 1}]}, "model.states[1].name", "the int 1", "identifier"),
    (KF, {Y: [{"name": "y", "unit": 1}]}, "model.outputs[0].unit", "the int 1", "a text"),
    (KF, {Y: [{"name": "y", "unit": "*/"}]}, "model.outputs[0].unit", "'*/'", "in a C comment"),
    (KF, {Y: [{"name": "y", "unit": "a\nb"}]}, "model.outputs[0].unit", "'a\\nb'", "printable"),
    (KF, {Y: [{"name": "y", "unit": "\\"}]}, "model.outputs[0].unit", "'\\\\'", "printable"),
    (KF, {Y: [{"name": "y", "unit": "V" * 41}]}, "model.outputs[0].unit", "VVV", "at most 40"),
    (KF, {"parameters.1a": 1.0}, "parameters.1a", "'1a'", "a C identifier"),
    (KF, {"parameters.double": 1.0}, "parameters.double", "'double'", "keyword"),
    (KF, {"parameters.exp": 1.0}, "parameters.exp", "'exp'", "not a word"),
    (KF, {"parameters.atan2": 1.0}, "parameters.atan2", "'atan2'", "not a word"),
    *(
        (KF, {f"parameters.{word}": 1.0}, f"parameters.{word}", f"'{word}'", expected)
        for words, expected in (
            ("lambda from as global None del", "a keyword of Python"),
            ("min max sign hypot pi interp asin tanh", "a word of the expression language"),
            ("DBL_MAX SIZE_MAX INT32_MAX UINT8_C FLT_EPSILON HUGE_VAL M_PI", "a macro of C's"),
            ("MOTOR_NX MOTOR_OK MOTOR_H_INCLUDED", "do, with MOTOR_"),
        )
        for word in words.split()
    ),
    (KF, {"parameters._a": 1.0}, "parameters._a", "'_a'", "without leading"),
    (KF, {"parameters.I": 1.0}, "parameters.I", "'I'", "complex.h"),
    (KF, {"parameters.TAU": 1.0}, "parameters", "'tau' and 'TAU'", "distinct names"),
    (KF, {"parameters.tau": "0.05"}, "parameters.tau", "the text '0.05'", "a finite number"),
    (KF, {"parameters.tau": True}, "parameters.tau", "the boolean True", "a finite number"),
    (KF, {"parameters.tau": NAN}, "parameters.tau", "nan", "a finite number"),
    (KF, {"parameters.tau": [1.0]}, "parameters.tau", "the list [1.0]", "a finite number"),
]


@pytest.mark.parametrize("case", NAMES, ids=lambda case: f"{case[2]}: {case[3]}")
def test_names(case: Case) -> None:
    check(*case)
