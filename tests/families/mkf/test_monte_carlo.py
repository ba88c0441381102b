"""Errors over many simulated records are as large as the compiled filter says."""

from __future__ import annotations

import numpy as np
import pytest
from plants import built, common, independent, random_model, spec

RUNS, T = 20000, 12
RATE = 0.7
RNG_SEED = 20

#: Two actuators that push both states, and little noise beside their faults.
MODEL = random_model(31, 2, 2, 2, direct=True) | {
    "B": [[1.0, 2.0], [2.0, 1.0]],
    "D": [[0.0, 0.0], [0.5, 0.5]],
    "Q": [[1e-2, 0.0], [0.0, 1e-2]],
    "R": [[1e-2, 0.0], [0.0, 1e-2]],
}


def records(model, *, runs=RUNS):
    """Records of plants whose two actuators fail together: y (runs, T, 2), x[1..T], u (T, 2)."""
    A, B, C, D = (np.array(model[letter]) for letter in "ABCD")
    rng = np.random.default_rng(RNG_SEED)
    deviation = {letter: np.linalg.cholesky(np.array(model[letter])) for letter in ("Q", "R", "P0")}
    x = np.array(model["x0"]) + rng.standard_normal((runs, 2)) @ deviation["P0"].T
    u = np.ones((T, 2))
    y, states = np.empty((runs, T, 2)), np.empty((runs, T, 2))
    for k in range(T):
        applied = (rng.random((runs, 1)) < RATE) * u[k]
        y[:, k] = x @ C.T + applied @ D.T + rng.standard_normal((runs, 2)) @ deviation["R"].T
        x = x @ A.T + applied @ B.T + rng.standard_normal((runs, 2)) @ deviation["Q"].T
        states[:, k] = x
    return y, states, u


@pytest.fixture(scope="module")
def simulated():
    return records(MODEL)


def filtered(actuator, y, u):
    plant = spec(MODEL, family="mkf", actuator=actuator)
    return built(plant).run_batch(
        y, u, keep=("nis", "predicted_state", "predicted_covariance", "innovation")
    )


def test_prediction_errors_have_the_covariance_that_the_filter_states(simulated):
    y, states, u = simulated
    result = filtered(common(RATE), y, u)
    for k in (0, 3, T - 1):
        error = states[:, k] - result.predicted_state[:, k]
        root = np.linalg.cholesky(result.predicted_covariance[0, k])
        white = np.linalg.solve(root, error.T).T
        # Standard errors of variances and covariances from 20000 runs: below 0.014, four of them.
        np.testing.assert_allclose(np.cov(white.T), np.eye(2), atol=0.06)
        # 4.8 standard errors of a mean.
        assert np.abs(white.mean(axis=0)).max() < 4.8 / np.sqrt(RUNS)


def test_mean_nis_is_the_number_of_measurements(simulated):
    y, _, u = simulated
    # 240000 samples with a deviation of 2: a standard error of 0.2 %, five times that.
    assert filtered(common(RATE), y, u).nis.mean() == pytest.approx(2.0, rel=0.01)


def test_innovations_are_uncorrelated_over_time(simulated):
    y, _, u = simulated
    e = filtered(common(RATE), y, u).innovation
    correlation = np.corrcoef(e[:, T - 2].T, e[:, T - 1].T)[:2, 2:]
    # Five standard errors of a correlation.
    assert np.abs(correlation).max() < 5.0 / np.sqrt(RUNS)


def test_common_faults_taken_for_independent_ones_show_in_the_nis(simulated):
    y, _, u = simulated
    # The right model keeps 2 within 1 %; forgetting that both pull together costs forty times that.
    assert filtered(independent(RATE), y, u).nis.mean() > 2.5
