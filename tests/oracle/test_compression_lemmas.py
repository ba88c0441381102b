"""Lemmas 1 and 2 and Theorem 1 of Lee & Lee in numbers of any size, and a misprint."""

from __future__ import annotations

import numpy as np
import pytest
from plants import covariance

#: Some inversions of well-conditioned matrices.
EXACT = 1e-10


def best(M, z, H, R, S):
    """Correction and covariance from z = H e + v with cov(v, e) = S: (6)."""
    W = H @ M @ H.T + H @ S.T + S @ H.T + R
    K = np.linalg.solve(W, H @ M + S).T
    return K @ z, M - K @ (H @ M + S), K


def setting(seed, rows):
    """A random prior and a measurement whose noise is correlated with its error."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 6)), rows or int(rng.integers(1, 5))
    whole = covariance(rng, n + m)
    M, S, R = whole[:n, :n], whole[n:, :n], whole[n:, n:]
    return rng, M, rng.standard_normal(m), rng.standard_normal((m, n)), R, S


def assert_same(found, expected):
    for a, b in zip(found[:2], expected[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=EXACT * (1 + np.abs(b).max()))


@pytest.mark.parametrize("seed", range(20))
def test_stacking_is_the_same_as_maintenance(seed):
    rng, M, z, H, R, _ = setting(seed, None)
    G, r, w = rng.standard_normal((2, len(M))), covariance(rng, 2), rng.standard_normal(2)
    m = len(z)
    none, zero = np.zeros((m, 2)), np.zeros((m + 2, len(M)))
    stacked = best(M, np.append(z, w), np.vstack([H, G]), np.block([[R, none], [none.T, r]]), zero)
    dx, P, _ = best(M, z, H, R, zero[:m])
    more, covariance_after, _ = best(P, w - G @ dx, G, r, zero[:2])
    assert_same((dx + more, covariance_after), stacked)


@pytest.mark.parametrize("seed", range(20))
def test_a_measurement_may_be_scaled_and_decorrelated(seed):
    rng, M, z, H, R, S = setting(seed, None)
    T = rng.standard_normal((len(z), len(z)))
    expected = best(M, z, H, R, S)
    assert_same(best(M, T @ z, T @ H, T @ R @ T.T, T @ S), expected)
    free = np.linalg.solve(M, S.T).T
    assert_same(best(M, z, H + free, R - free @ S.T, 0 * S), expected)


@pytest.mark.parametrize("seed", range(20))
def test_more_rows_than_states_may_be_compressed(seed):
    rng, M, _, _, _, _ = setting(seed, 1)
    n, m = len(M), len(M) + 3
    H, R, z = rng.standard_normal((m, n)), covariance(rng, m), rng.standard_normal(m)
    weighted = np.linalg.solve(R, H).T
    noise = np.linalg.inv(weighted @ H)
    expected = best(M, z, H, R, np.zeros((m, n)))
    assert_same(best(M, noise @ weighted @ z, np.eye(n), noise, np.zeros((n, n))), expected)


@pytest.mark.parametrize("seed", range(20))
def test_a_measurement_may_be_used_one_sample_late(seed):
    rng, M, z, H, R, S = setting(seed, None)
    n = len(M)
    F = rng.standard_normal((n, n)) + 2 * np.eye(n)
    Q, late = covariance(rng, n), H @ np.linalg.inv(F)
    dx, P, _ = best(M, z, H, R, S)
    moved = best(F @ M @ F.T + Q, z, late, R + late @ Q @ late.T, S @ F.T - late @ Q)
    assert_same(moved, (F @ dx, F @ P @ F.T + Q))


@pytest.mark.parametrize("seed", range(20))
def test_the_cross_terms_of_the_covariance_are_subtracted(seed):
    _, M, z, H, R, S = setting(seed, None)
    _, P, K = best(M, z, H, R, S)
    A = np.eye(len(M)) - K @ H
    squares, cross = A @ M @ A.T + K @ R @ K.T, A @ (K @ S).T
    np.testing.assert_allclose(squares - cross - cross.T, P, rtol=0, atol=EXACT)
    assert np.abs(squares + cross + cross.T - P).max() > 1e-4  # (6) as printed
