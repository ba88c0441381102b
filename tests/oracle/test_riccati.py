"""Two Riccati solvers agree with each other, with the batch estimate, and on having no answer."""

from __future__ import annotations

import numpy as np
import pytest

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.riccati import (
    constant_input_noise,
    stationary_prediction,
    stationary_prediction_by_control,
)

SOLVERS = [stationary_prediction, stationary_prediction_by_control]


def plant(rng, n, p):
    root = rng.standard_normal((n + p, n + p))
    joint = root @ root.T + 0.1 * np.eye(n + p)
    A = 1.2 * rng.standard_normal((n, n)) / np.sqrt(n)
    return A, rng.standard_normal((p, n)), joint[:n, :n], joint[n:, n:], joint[:n, n:]


@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 1), (3, 2), (6, 3)])
@pytest.mark.parametrize("crossed", [False, True])
def test_scipy_and_control_agree(n, p, crossed):
    A, C, Q, R, S = plant(np.random.default_rng(n + p), n, p)
    ours, theirs = (solve(A, C, Q, R, S if crossed else None) for solve in SOLVERS)
    # Both reduce a matrix pencil of moderate condition.
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-9)
    assert ours[1] == pytest.approx(theirs[1], abs=1e-9)
    assert ours[1] < 1.0


@pytest.mark.parametrize("solve", SOLVERS)
def test_rounding_that_leaves_q_and_r_unsymmetric_changes_nothing(solve):
    A, C, Q, R, S = plant(np.random.default_rng(4), 3, 2)
    rounded = [matrix + np.triu(2e-16 * np.abs(matrix), 1) for matrix in (Q, R)]
    # What is moved by one rounding moves the solution by some: its condition is moderate.
    np.testing.assert_allclose(solve(A, C, *rounded, S)[0], solve(A, C, Q, R, S)[0], rtol=1e-12)


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_filter_started_at_the_stationary_covariance_stays_there(solve):
    rng = np.random.default_rng(1)
    A, C, Q, R, _ = plant(rng, 2, 1)
    T, u = 8, np.array([2.0])
    B, D = rng.standard_normal((2, 1)), rng.standard_normal((1, 1))
    rows = {
        name: np.broadcast_to(m, (T, *m.shape))
        for name, m in zip("ABCDQR", (A, B, C, D, Q, R), strict=True)
    }
    system = LinearSystem(
        **rows,
        x0=np.zeros(2),
        P0=np.eye(2),
        rate=np.full((T, 1), 0.7),
        fault_covariance=np.full((T, 1, 1), 0.21),
    )
    P, _ = solve(A, C, *constant_input_noise(system, u))
    started = LinearSystem(**{**vars(system), "P0": P})
    result = batch_lmmse(started, rng.standard_normal((T, 1)), np.broadcast_to(u, (T, 1)))
    # An error of the solution shrinks from step to step, so its residual bounds what is seen.
    np.testing.assert_allclose(result.predicted_covariance, rows["Q"] * 0 + P, rtol=1e-9)


@pytest.mark.parametrize("solve", SOLVERS)
def test_the_cross_covariance_of_failing_actuators_matters(solve):
    A, C, Q, R, S = plant(np.random.default_rng(2), 2, 1)
    with_cross, without = solve(A, C, Q, R, S), solve(A, C, Q, R)
    # The sign of S tells them apart at the order of the covariance itself.
    assert np.abs(with_cross[0] - without[0]).max() > 1e-2


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize(
    ("why", "A", "C", "Q"),
    [
        ("unstable and unseen", [[1.1, 0.0], [0.0, 0.5]], [[0.0, 1.0]], np.eye(2)),
        ("drifting and unseen", [[1.0, 0.0], [0.0, 0.5]], [[0.0, 1.0]], np.eye(2)),
        ("constant and never excited", [[1.0, 0.0], [0.0, 0.5]], [[1.0, 1.0]], np.diag([0.0, 1.0])),
        (
            "oscillating and never excited",
            [[0.0, 1.0], [-1.0, 0.0]],
            [[1.0, 0.0]],
            np.zeros((2, 2)),
        ),
        ("no measurement at all", [[1.1]], [[0.0]], np.eye(1)),
    ],
)
def test_without_a_stabilising_solution_the_answer_is_none(solve, why, A, C, Q):
    assert solve(np.array(A), np.array(C), Q, np.eye(1)) is None, why


@pytest.mark.parametrize("solve", SOLVERS)
def test_an_unstable_mode_that_is_seen_has_a_stationary_covariance(solve):
    P, radius = solve(np.array([[2.0]]), np.eye(1), np.eye(1), np.eye(1))
    # P = 4 P / (P + 1) + 1 has the root 2 + sqrt(5); the closed loop is 2 / (P + 1).
    assert P[0, 0] == pytest.approx(2.0 + np.sqrt(5.0), rel=1e-12)
    assert radius == pytest.approx(2.0 / (3.0 + np.sqrt(5.0)), rel=1e-12)


@pytest.mark.parametrize("solve", SOLVERS)
def test_an_unstable_mode_without_noise_is_tracked_all_the_same(solve):
    P, radius = solve(np.array([[2.0]]), np.eye(1), np.zeros((1, 1)), np.eye(1))
    # P = 4 P / (P + 1) has the roots 0 and 3; only 3 stabilises, with 2 / 4.
    assert P[0, 0] == pytest.approx(3.0, rel=1e-12)
    assert radius == pytest.approx(0.5, rel=1e-12)
