"""Ranks do not depend on units, and what is hidden is named."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fkgen.study.diagnostics.subject import numerical_rank
from fkgen.study.diagnostics.visibility import unobservable, unreachable

CHAIN = np.array([[0.9, 0.0, 0.0], [0.3, 0.8, 0.0], [0.0, 0.2, 0.7]])
LAST = np.array([[0.0, 0.0, 1.0]])
FIRST = np.array([[1.0, 0.0, 0.0]])


def test_the_end_of_a_chain_shows_all_of_it():
    assert unobservable(CHAIN, LAST).size == 0


def test_the_beginning_of_a_chain_shows_only_itself():
    hidden = unobservable(CHAIN, FIRST)
    assert hidden.size == 2
    assert hidden.states == (1, 2)
    assert sorted(hidden.eigenvalues.real) == pytest.approx([0.7, 0.8])


@given(st.lists(st.floats(-9.0, 9.0), min_size=4, max_size=4))
def test_units_do_not_change_what_is_hidden(exponents):
    unit = 10.0 ** np.array(exponents[:3])
    A = CHAIN * unit[:, np.newaxis] / unit[np.newaxis, :]
    factor = 10.0 ** exponents[3]
    assert unobservable(A, factor * LAST / unit).size == 0
    assert unobservable(A, factor * FIRST / unit).states == (1, 2)


@given(st.integers(0, 2**32 - 1))
def test_a_turned_basis_hides_as_much(seed):
    T = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    assert unobservable(T @ CHAIN @ T.T, FIRST @ T.T).size == 2
    assert unobservable(T @ CHAIN @ T.T, LAST @ T.T).size == 0


def test_two_equal_modes_need_two_sensors():
    assert unobservable(np.eye(2), np.array([[1.0, 1.0]])).size == 1
    assert unobservable(np.eye(2), np.eye(2)).size == 0


def test_no_sensor_at_all_hides_everything():
    assert unobservable(CHAIN, np.zeros((1, 3))).size == 3


def test_noise_at_the_beginning_of_a_chain_reaches_all_of_it():
    assert unreachable(CHAIN, np.diag([1e-12, 0.0, 0.0])).size == 0


def test_noise_at_the_end_of_a_chain_reaches_nothing_else():
    assert unreachable(CHAIN, np.diag([0.0, 0.0, 1.0])).states == (0, 1)


def test_noise_of_rank_one_is_one_direction():
    F = np.array([[1.0], [2.0]])
    assert unreachable(0.5 * np.eye(2), F @ F.T).size == 1


def test_rank_of_a_covariance_does_not_depend_on_units():
    assert numerical_rank(np.diag([1e-20, 1.0, 1e20])) == 3
    assert numerical_rank(np.array([[1e-20, 1.0], [1.0, 1e20]])) == 1
    assert numerical_rank(np.zeros((2, 2))) == 0
