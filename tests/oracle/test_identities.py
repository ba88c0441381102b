"""SymPy proves every identity, and would not prove a wrong one."""

from __future__ import annotations

import pytest

from fkgen.oracle.theorems.identity import Identity
from fkgen.oracle.theorems.mkf import IDENTITIES, setting


@pytest.mark.parametrize("identity", IDENTITIES, ids=lambda identity: identity.claim)
def test_the_identity_holds(identity):
    assert identity.holds()


def test_claims_are_distinct_and_have_a_source():
    assert len({identity.claim for identity in IDENTITIES}) == len(IDENTITIES)
    assert all(identity.source for identity in IDENTITIES)


def without_cross_term():
    s = setting()
    wrong = s.A * s.P * s.C.T * s.inverse
    return ((s.expanded(wrong), s.riccati),)


def short_form_at_another_gain():
    s = setting()
    K = 2 * s.gain
    return ((s.open_loop - K * s.innovation * K.T, s.expanded(K)),)


def rate_in_place_of_variance():
    s = setting()
    return ((s.N, s.xi * s.U * s.U),)


def gain_of_the_filter_moved_on():
    s = setting()
    return ((s.gain, s.A * s.filter_gain),)


def a_hundredth_of_one_entry():
    s = setting()
    return ((s.riccati + s.Q / 100, s.riccati),)


@pytest.mark.parametrize(
    "equations",
    [
        without_cross_term,
        short_form_at_another_gain,
        rate_in_place_of_variance,
        gain_of_the_filter_moved_on,
        a_hundredth_of_one_entry,
    ],
)
def test_a_wrong_identity_does_not_hold(equations):
    assert not Identity(claim="wrong", source="none", equations=equations).holds()
