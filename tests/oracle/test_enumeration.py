"""The sum over all histories of the modes, against integrals on a grid and batch densities."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import norm
from sensor_plants import any_law, close, inputs, law, plant, with_modes

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.enumeration import enumerate_modes
from fkgen.oracle.plants.sensor import gamma_delta, simulate_sensor

PORTS = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation",
    "innovation_covariance",
    "log_likelihood",
)


def scalar_case(seed, T):
    rng = np.random.default_rng(seed)
    system, a_law = plant(rng, T=T, n=1, p=1), any_law(rng)
    u = inputs(rng, system)
    return system, a_law, simulate_sensor(system, a_law, u, rng)[0], u


def on_a_grid(system, a_law, y, u):
    """Bayes' rule for p(x, mode) on points of x: integrals in place of Kalman filters."""
    x = np.linspace(-20.0, 20.0, 2001)
    step = x[1] - x[0]
    density = a_law.initial[:, None] * norm.pdf(x, system.x0[0], np.sqrt(system.P0[0, 0]))
    gamma, delta = gamma_delta(a_law, np.arange(4))
    for k in range(system.length):
        signal = system.C[k, 0, 0] * x + system.D[k, 0, 0] * u[k, 0]
        deviation = np.sqrt(delta * system.R[k, 0, 0])[:, None]
        density = density * norm.pdf(y[k, 0], gamma[:, None] * signal, deviation)
        evidence = density.sum() * step
        density /= evidence
        mass = density.sum(axis=1) * step
        mean = (density @ x) * step / mass
        variance = np.array([d @ (x - m) ** 2 for d, m in zip(density, mean, strict=True)])
        yield np.log(evidence), mass, mean, variance * step / mass
        ahead = system.A[k, 0, 0] * x + system.B[k, 0, 0] * u[k, 0]
        spread = norm.pdf(x[:, None], ahead, np.sqrt(system.Q[k, 0, 0]))
        density = a_law.kernel.T @ (density @ spread.T) * step


@pytest.mark.parametrize("seed", [1, 2])
def test_every_moment_equals_the_integral_of_bayes_rule(seed):
    system, a_law, y, u = scalar_case(seed, 4)
    result = enumerate_modes(system, a_law, y, u)
    for k, (evidence, mass, mean, variance) in enumerate(on_a_grid(system, a_law, y, u)):
        # The rectangle rule is exact to rounding for analytic densities that vanish at the ends.
        total = mass @ mean
        spread = mass @ (variance + (mean - total) ** 2)
        np.testing.assert_allclose(result.log_likelihood[k], evidence, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(result.mode_probability[k], mass, rtol=1e-9)
        np.testing.assert_allclose(result.predicted_mode_probability[k], mass @ a_law.kernel)
        np.testing.assert_allclose(result.mode_filtered_state[k, :, 0], mean, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(result.mode_filtered_covariance[k, :, 0, 0], variance, rtol=1e-8)
        np.testing.assert_allclose(result.filtered_state[k, 0], total, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(result.filtered_covariance[k, 0, 0], spread, rtol=1e-8)


@pytest.mark.parametrize("rows", [(0,), (0, 1)])
@pytest.mark.parametrize("missing", [False, True])
def test_the_mixture_is_that_of_batch_estimates_of_all_histories(rows, missing):
    rng = np.random.default_rng(3)
    system, a_law = plant(rng, T=3), any_law(rng, rows=rows)
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, a_law, u, rng)
    if missing:
        y[0, 0] = y[1, 1] = np.nan
    histories = list(product(range(4), repeat=3))
    batch = [batch_lmmse(with_modes(system, a_law, h), y, u) for h in histories]
    result = enumerate_modes(system, a_law, y, u)
    prior = [a_law.initial[a] * a_law.kernel[a, b] * a_law.kernel[b, c] for a, b, c in histories]
    for k in range(3):
        weights = softmax(np.log(prior) + [b.log_likelihood[: k + 1].sum() for b in batch])
        means = np.array([b.filtered_state[k] for b in batch])
        second = [
            b.filtered_covariance[k] + np.outer(m, m) for b, m in zip(batch, means, strict=True)
        ]
        mean = weights @ means
        np.testing.assert_allclose(result.filtered_state[k], mean, rtol=1e-10)
        np.testing.assert_allclose(
            result.filtered_covariance[k],
            np.einsum("i,ijk->jk", weights, second) - np.outer(mean, mean),
            rtol=1e-9,
        )
        modes = np.array(histories)[:, k]
        np.testing.assert_allclose(
            result.mode_probability[k], np.bincount(modes, weights), rtol=1e-10
        )


def test_the_innovation_is_that_of_the_predicted_mixture():
    rng = np.random.default_rng(4)
    system, a_law = plant(rng, T=2), any_law(rng)
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, a_law, u, rng)
    result = enumerate_modes(system, a_law, y, u)
    past = [batch_lmmse(with_modes(system, a_law, h), y, u) for h in product(range(4), repeat=2)]
    prior = [a_law.initial[a] * a_law.kernel[a, b] for a, b in product(range(4), repeat=2)]
    weights = softmax(np.log(prior) + [b.log_likelihood[0] for b in past])
    means = np.array([y[1] - b.innovation[1] for b in past])
    second = [b.innovation_covariance[1] + np.outer(m, m) for b, m in zip(past, means, strict=True)]
    mean = weights @ means
    np.testing.assert_allclose(result.innovation[1], y[1] - mean, rtol=1e-10)
    np.testing.assert_allclose(
        result.innovation_covariance[1],
        np.einsum("i,ijk->jk", weights, second) - np.outer(mean, mean),
        rtol=1e-9,
    )


def test_known_modes_leave_one_history():
    rng = np.random.default_rng(6)
    turn = np.eye(4)[[2, 0, 3, 1]]
    system, a_law = plant(rng, T=6), law(turn, np.eye(4)[1])
    u = inputs(rng, system)
    y, modes = simulate_sensor(system, a_law, u, rng)
    np.testing.assert_array_equal(modes, [1, 0, 2, 3, 1, 0])
    result = enumerate_modes(system, a_law, y, u)
    close(result, batch_lmmse(with_modes(system, a_law, modes), y, u), PORTS, rtol=1e-9)
    np.testing.assert_array_equal(result.mode_probability, np.eye(4)[modes])
    possible = np.isfinite(result.mode_filtered_state).all(axis=2)
    np.testing.assert_array_equal(possible, np.eye(4)[modes] > 0.0)


def test_a_missing_sample_says_nothing():
    system, a_law, y, u = scalar_case(7, 3)
    y[1] = np.nan
    result = enumerate_modes(system, a_law, y, u)
    np.testing.assert_allclose(
        result.mode_probability[1], result.predicted_mode_probability[0], rtol=1e-12
    )
    np.testing.assert_allclose(result.filtered_state[1], result.predicted_state[0], rtol=1e-12)
    assert result.log_likelihood[1] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(result.innovation[1]).all()


def test_a_measurement_far_away_keeps_everything_finite():
    system, a_law, y, u = scalar_case(8, 3)
    y[1] = 1e8
    result = enumerate_modes(system, a_law, y, u)
    for port in PORTS:
        assert np.isfinite(getattr(result, port)).all(), port
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=1e-12)


def test_a_long_record_is_refused():
    system, a_law, y, u = scalar_case(9, 7)
    with pytest.raises(DataError, match="at most 6"):
        enumerate_modes(system, a_law, y, u)


def test_probabilities_are_those_of_simulated_modes():
    rng = np.random.default_rng(10)
    system, a_law = plant(rng, T=2, n=1, p=1), any_law(rng)
    u = inputs(rng, system)
    surprise = np.zeros(4)
    believed = np.zeros(4)
    for _ in range(400):
        y, modes = simulate_sensor(system, a_law, u, rng)
        mu = enumerate_modes(system, a_law, y, u).mode_probability[-1]
        surprise += np.eye(4)[modes[-1]] - mu
        believed += mu * (1.0 - mu)
    # Given y the error has mean zero and the variance mu (1 - mu); four standard deviations.
    assert (np.abs(surprise) < 4.0 * np.sqrt(believed)).all()
