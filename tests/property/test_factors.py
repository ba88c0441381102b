"""U D U' against matrices in NumPy, where variances are 0 and rows are in another order too."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from fkgen.estimators.gaussian.ud import (
    Factors,
    _grown,
    _orthogonal,
    columns_of,
    factors_of,
    merged,
)
from fkgen.symbolic.linalg import sparse, unpack

ORDER, n = (2, 0, 1), 3


def numbers(value):
    return np.array(ca.DM(ca.densify(value)))


def whole(factors):
    """P in the order of states, by the definition of factors."""
    rows, U = np.argsort(factors.order), numbers(factors.unit)
    assert np.allclose(np.triu(U), U)
    assert np.allclose(np.diag(U), 1.0)
    return (U @ np.diag(numbers(factors.scale)[:, 0]) @ U.T)[np.ix_(rows, rows)]


def semidefinite(seed, rank=n, size=n):
    root = np.random.default_rng(seed).normal(size=(size, rank))
    return root @ root.T


def factored(P):
    return factors_of(ca.SX(ca.DM(P)), ORDER, "double")[0]


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_factors_are_those_of_the_matrix(rank):
    P = semidefinite(3, rank)
    found = factored(P)
    np.testing.assert_allclose(whole(found), P, atol=1e-12)
    np.testing.assert_allclose(numbers(unpack(found.covariance(), n)), P, atol=1e-12)
    assert (numbers(found.scale) > 0.0).sum() == rank
    C = np.random.default_rng(4).normal(size=(2, n))
    np.testing.assert_allclose(
        numbers(unpack(found.seen(ca.SX(ca.DM(C))), 2)), C @ P @ C.T, atol=1e-12
    )


@pytest.mark.parametrize("rank", [0, 1, 3])
@pytest.mark.parametrize("triangular", [False, True])
def test_moved_factors_are_those_of_the_moved_matrix(rank, triangular):
    rng, P = np.random.default_rng(5), semidefinite(6, rank)
    M, G, w = rng.normal(size=(n, n)), rng.normal(size=(n, 2)), np.array([0.5, 0.0])
    if triangular:  # in the order of factors
        M[np.ix_(ORDER, ORDER)] = np.triu(M)
        G[ORDER[2]] = 0.0
    given = (sparse(ca.SX(ca.DM(each))) for each in (M, G))
    found = factored(P).moved(*given, ca.SX(ca.DM(w)))
    expected = M @ P @ M.T + G @ np.diag(w) @ G.T
    np.testing.assert_allclose(whole(found), expected, atol=1e-12)


@pytest.mark.parametrize("way", [_grown, _orthogonal])
@pytest.mark.parametrize("rank", [0, 1, 3])
def test_columns_are_added_to_a_triangle_in_either_way(way, rank):
    rng, P = np.random.default_rng(8), factored(semidefinite(6, rank))
    M, G, w = np.triu(rng.normal(size=(n, n))), rng.normal(size=(n, 2)), np.array([0.5, 0.0])
    M[0, 1] = G[2, 0] = 0.0
    carried, added = (sparse(ca.SX(ca.DM(each))) for each in (M @ numbers(P.unit), G))
    unit, left = way(carried, P.scale, added, ca.SX(ca.DM(w)), "double")
    found = whole(Factors(unit, left, tuple(range(n)), "double"))
    own = M @ numbers(P.unit)
    expected = own @ np.diag(numbers(P.scale)[:, 0]) @ own.T + G @ np.diag(w) @ G.T
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_mixture_has_the_moments_of_its_parts():
    rng, weights = np.random.default_rng(7), np.array([0.2, 0.5, 0.3])
    means, parts = rng.normal(size=(3, n)), [semidefinite(seed) for seed in (1, 2, 3)]
    given = [(ca.SX(ca.DM(m)), factored(P)) for m, P in zip(means, parts, strict=True)]
    mean, wide = merged([ca.SX(w) for w in weights], given)
    spread = [P + np.outer(m, m) for m, P in zip(means, parts, strict=True)]
    middle = weights @ means
    np.testing.assert_allclose(numbers(mean)[:, 0], middle, atol=1e-12)
    expected = np.einsum("i,ijk->jk", weights, spread) - np.outer(middle, middle)
    np.testing.assert_allclose(whole(wide.narrow()), expected, atol=1e-12)


def test_what_is_beside_the_state_is_independent_of_it():
    P, other = semidefinite(8), semidefinite(9, 2, 2)
    found = whole(factored(P).joined(ca.SX(ca.DM(other))))
    np.testing.assert_allclose(found[:n, :n], P, atol=1e-12)
    np.testing.assert_allclose(found[n:, n:], other, atol=1e-12)
    assert not found[n:, :n].any()
    columns, weights = columns_of(ca.SX(ca.DM(other)), "double")
    square = numbers(columns) @ np.diag(numbers(weights)[:, 0]) @ numbers(columns).T
    np.testing.assert_allclose(square, other, atol=1e-12)
