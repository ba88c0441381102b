"""SymPy proves the algebra of the linear filter, and would not prove a wrong one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import sympy

from fkgen.oracle.theorems.identity import Identity
from fkgen.oracle.theorems.linear_optimal import LINEAR_IDENTITIES, step
from fkgen.oracle.theorems.mkf import IDENTITIES

#: Two seconds and more of SymPy each.
LONG = ("(23e) is", "for independent gamma", "the covariance form", "V = A V A'", "for gamma = 1")


@pytest.mark.parametrize(
    "identity",
    [
        pytest.param(identity, marks=[pytest.mark.exhaustive] * identity.claim.startswith(LONG))
        for identity in LINEAR_IDENTITIES
    ],
    ids=lambda identity: identity.claim,
)
def test_the_identity_holds(identity):
    assert identity.holds()


def test_claims_are_distinct_and_have_a_source():
    claims = {identity.claim for identity in (*IDENTITIES, *LINEAR_IDENTITIES)}
    assert len(claims) == len(IDENTITIES) + len(LINEAR_IDENTITIES)
    assert all(identity.source for identity in LINEAR_IDENTITIES)


def orthogonality(s, F1, F2):
    right = step()
    xhat_z = right.V * right.A * right.H * right.p
    return ((F1 * xhat_z + F2 * right.signal, right.C * right.H * right.g),)


def rate_in_place_of_p11():
    s = replace(step(), p=step().g)
    return orthogonality(s, s.F1, s.F2)


def p11_once_in_place_of_its_square():
    s = step()
    bracket = s.signal - s.H * s.predicted * s.H.T * s.p
    F2 = s.numerator * bracket.inv()
    return orthogonality(s, s.A - F2 * s.p * s.H * s.A, F2)


def first_gain_without_p11():
    s = step()
    return orthogonality(s, s.A - s.F2 * s.H * s.A, s.F2)


def cross_term_of_the_other_sign():
    s = step()
    cross = s.F2 * s.p * s.H * s.A * s.V * s.F1.T
    wrong = s.estimate_moment(s.F1, s.F2) - 2 * (cross + cross.T)
    return ((wrong, s.predicted + s.F2 * s.bracket * s.F2.T),)


def old_second_moment():
    s = step()
    old = sympy.Matrix([[sympy.Symbol("old")]])
    wrong = replace(s, C=old)
    return orthogonality(wrong, wrong.F1, wrong.F2)


def filter_without_a_healthy_row():
    s = step(1, 2, (1,))
    t = step(1, 2, (0, 1))
    return ((s.numerator, t.numerator),)


@pytest.mark.parametrize(
    "equations",
    [
        rate_in_place_of_p11,
        p11_once_in_place_of_its_square,
        first_gain_without_p11,
        cross_term_of_the_other_sign,
        old_second_moment,
        filter_without_a_healthy_row,
    ],
)
def test_a_wrong_identity_does_not_hold(equations):
    assert not Identity(claim="wrong", source="none", equations=equations).holds()
