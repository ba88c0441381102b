"""Which tests of numbers C may leave out, on phases of a few statements."""

from __future__ import annotations

import math

import pytest

from fkgen.backend import ir
from fkgen.backend.ir import (
    Assign,
    Element,
    IfPositive,
    IfPresent,
    Literal,
    Operate,
    Operator,
    Require,
    Space,
    Temp,
)
from fkgen.backend.size.guards import without_implied
from fkgen.symbolic.interface import Kind, Status

A, B, C = (Element(Space.SELF, name, None) for name in "abc")
X, Y = (Element(Space.LOCAL, name, None) for name in "xy")
T = [Temp(i) for i in range(9)]
ZERO, ONE = Literal(0.0), Literal(1.0)
PIVOT = Require((A,), Kind.POSITIVE, Status.NOT_POSITIVE_DEFINITE)


def finite(*values):
    return Require(values, Kind.FINITE, Status.RESULT_NOT_FINITE)


def operate(i, operator, *arguments):
    return Operate(T[i], operator, arguments)


def left(*body, initial=0.0):
    """The values that are still tested."""
    locals_ = (ir.Local("x", 1, initial), ir.Local("y", 1, initial))
    phase = ir.Phase(locals_, body, reads_input=False, reads_parameters=False, chunks=((0, ""),))
    return [
        v for node in without_implied(phase).body if isinstance(node, Require) for v in node.values
    ]


SUM = operate(0, Operator.ADD, A, B)
TAKEN = (operate(1, Operator.MUL, X, B), operate(2, Operator.ADD, Y, T[1]), Assign(Y, T[2]))


@pytest.mark.parametrize("operator", [Operator.ADD, Operator.SUB, Operator.MUL])
def test_a_finite_result_has_finite_parts(operator):
    assert left(operate(0, operator, A, B), finite(A, B, C, T[0])) == [C, T[0]]


def test_what_is_divided_by_may_be_infinite_where_the_quotient_is_finite():
    assert left(operate(0, Operator.DIV, A, B), finite(A, B, T[0])) == [B, T[0]]


@pytest.mark.parametrize("operator", [Operator.EXP, Operator.ATAN2, Operator.MAX, Operator.MIN])
def test_functions_that_are_bounded_say_nothing(operator):
    arguments = (A,) if operator is Operator.EXP else (A, B)
    assert left(operate(0, operator, *arguments), finite(A, T[0])) == [A, T[0]]


def test_a_result_does_not_follow_from_its_parts():
    assert left(SUM, finite(A, B), PIVOT, finite(T[0])) == [A, B, A, T[0]]


def test_a_test_relies_on_those_before_it_and_not_on_later_ones_of_another_reason():
    assert left(SUM, finite(T[0]), PIVOT, finite(A)) == [T[0], A]
    assert left(SUM, finite(A), PIVOT, finite(T[0])) == [A, A, T[0]]
    assert left(SUM, finite(A), finite(T[0])) == [T[0]]


@pytest.mark.parametrize(
    ("other", "expected"), [(0, [Y]), (1, [X, Y]), (None, [X, Y])], ids=["same", "other", "any"]
)
def test_what_a_row_sets_and_uses_is_finite_without_the_row_too(other, expected):
    body = (IfPresent(0, (Assign(X, A),)), IfPresent(other, TAKEN), finite(X, Y))
    assert left(*body) == expected


def test_what_a_row_uses_is_not_known_without_the_row():
    assert left(Assign(X, A), IfPresent(0, TAKEN), finite(X, Y, B)) == [X, Y, B]


def test_a_number_that_both_ways_lead_to_is_known():
    assert left(Assign(Y, A), IfPresent(0, TAKEN), finite(A, Y)) == [Y]
    assert left(Assign(Y, A), IfPositive(C, TAKEN), finite(A, Y)) == [Y]


@pytest.mark.parametrize("initial", [math.inf, math.nan, None])
def test_what_begins_otherwise_than_at_a_number_is_tested(initial):
    body = (IfPresent(0, (Assign(X, A),)), IfPresent(0, TAKEN), finite(X, Y))
    assert left(*body, initial=initial) == [X, Y]


def test_what_was_overwritten_says_nothing_of_what_is_there_now():
    body = (Assign(X, A), operate(0, Operator.ADD, X, ONE), Assign(X, B), finite(X, A, T[0]))
    assert left(*body) == [X, T[0]]
