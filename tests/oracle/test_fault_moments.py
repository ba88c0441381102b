"""Moments of the fault indicators, and the decision whether Lemma 2 holds."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_plants import (
    ALTERNATING,
    law,
    product_law,
)

import fkgen
from fkgen.oracle.exact.moments import FaultMoments, satisfies_lemma_2

RARE = np.array([[0.8, 0.2], [0.8, 0.2]])
DRIFTING = np.array([[0.9, 0.1], [0.3, 0.7]])  # E[delta] depends on time
ABSORBING = np.array([[1.0, 0.0], [0.3, 0.7]])
EQUAL = np.array([[0.6, 0.4], [0.6, 0.4]])
PERIODIC = np.array([[0.0, 1.0], [1.0, 0.0]])
BURSTS = np.array([[0.9, 0.1], [0.1, 0.9]])


def test_an_empty_record_has_an_empty_result():
    none = FaultMoments.from_rates(0.7, 0.9, 0.8, T=0, rows=(0,))
    assert none.persistence.shape == (0,)
    assert satisfies_lemma_2(np.eye(4), np.eye(4)[0], horizon=1) == (True, 0.0)


@pytest.mark.parametrize(
    ("signal", "start", "holds"),
    [
        (EQUAL, (0.6, 0.4), True),
        (EQUAL, (0.1, 0.9), True),
        (np.eye(2), (0.3, 0.7), True),
        (ABSORBING, (0.3, 0.7), True),
        (PERIODIC, (1.0, 0.0), True),
        (PERIODIC, (0.5, 0.5), False),
        (ALTERNATING, (0.5, 0.5), False),
        (BURSTS, (1.0, 0.0), False),
        ([[0.6, 0.4], [0.6 + 1e-9, 0.4 - 1e-9]], (0.5, 0.5), False),
    ],
)
def test_lemma_2_is_decided(signal, start, holds):
    a_law = product_law(signal, DRIFTING, initial=(start, (0.5, 0.5)))
    found, difference = satisfies_lemma_2(a_law.kernel, a_law.initial)
    assert found is holds
    assert (difference == pytest.approx(0.0, abs=1e-12)) is holds


def test_the_difference_of_lemma_2_in_example_1_is_that_of_two_lags():
    a_law = product_law(ALTERNATING, RARE)
    # 0.1 after one step, 0.1^2 + 0.9^2 after two.
    assert satisfies_lemma_2(a_law.kernel, a_law.initial)[1] == pytest.approx(0.82 - 0.1)


def test_lemma_2_can_hold_for_gamma_that_is_no_chain():
    # Problem 4: delta decides whether the sensor fails for good; all paths have p11 = 1.
    kernel = [[1, 0, 0, 0], [0, 1, 0, 0], [0.2, 0.1, 0.7, 0], [0, 0.5, 0.2, 0.3]]
    assert satisfies_lemma_2(np.array(kernel), np.full(4, 0.25))[0]


def test_a_violation_that_shows_late_is_found():
    # Up to sample 4 the modes are known, at 5 the chain has been in two of them.
    kernel = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0.5, 0, 0, 0.5]])
    start = np.array([1.0, 0.0, 0.0, 0.0])
    assert satisfies_lemma_2(kernel, start, horizon=5)[0]
    assert not satisfies_lemma_2(kernel, start)[0]


def table(**sensor):
    one = [[1.0]]
    return {
        "name": "a",
        "filter": {"family": "linear_optimal"},
        "model": {"A": [[-0.8]], "C": one, "Q": one, "R": one, "x0": [0.0], "P0": [[0.0]]},
        "faults": {"sensor": {"noise_factor": 10.0, **sensor}},
    }


def test_moments_come_from_a_spec():
    numbers = {"gamma_rate": 0.93, "gamma_persistence": 0.94, "delta_nominal_rate": 0.8}
    stated = FaultMoments.from_spec(fkgen.Spec.from_dict(table(problem="moments", **numbers)), 4)
    np.testing.assert_allclose(stated.gamma, 0.93, rtol=1e-15)
    np.testing.assert_allclose(stated.persistence, [0.93, 0.94, 0.94, 0.94], rtol=1e-15)
    np.testing.assert_allclose(stated.delta, 2.8, rtol=1e-15)
    np.testing.assert_allclose(stated.root_delta, 0.8 + 0.2 * np.sqrt(10.0), rtol=1e-15)
    chained = FaultMoments.from_spec(
        fkgen.Spec.from_dict(table(problem=1, gamma_rate=0.93, delta_nominal_rate=0.8)), 4
    )
    np.testing.assert_allclose(chained.gamma, 0.93, rtol=1e-15)
    np.testing.assert_allclose(chained.persistence, 0.93, rtol=1e-14)
    np.testing.assert_allclose(chained.delta, 2.8, rtol=1e-15)


def test_p11_skips_samples_at_which_no_signal_is_possible():
    moments = FaultMoments.from_law(law(np.eye(4)[[2, 3, 0, 1]], [1, 0, 0, 0]), 5)
    np.testing.assert_array_equal(moments.gamma, [1, 0, 1, 0, 1])
    np.testing.assert_array_equal(moments.persistence, [1, 0, 1, 0, 1])
