"""The textbook filters on plants of any shape: against the batch estimate and enumeration."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.hypotheses import textbook_mme
from fkgen.oracle.plants.actuator import LinearSystem, simulate

PORTS = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation",
    "innovation_covariance",
    "nis",
    "log_likelihood",
)


def plant(rng, *, T, n, p, q):
    root = rng.standard_normal((T, p, p))
    return LinearSystem(
        A=rng.standard_normal((T, n, n)) / np.sqrt(n),
        B=rng.standard_normal((T, n, q)),
        C=rng.standard_normal((T, p, n)),
        D=rng.standard_normal((T, p, q)),
        Q=np.broadcast_to(np.diag([1.0] * (n - 1) + [0.0]), (T, n, n)),
        R=root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(p),
        x0=rng.standard_normal(n),
        P0=np.eye(n),
        rate=np.ones((T, q)),
        fault_covariance=np.zeros((T, q, q)),
    )


def independent(system, rate):
    rate = np.broadcast_to(rate, system.rate.shape)
    variance = rate * (1.0 - rate)
    return replace(system, rate=rate, fault_covariance=variance[:, :, None] * np.eye(system.nu))


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("u_scale", [1.0, 1e3])
def test_the_textbook_step_is_the_best_linear_filter_of_any_plant(missing, u_scale):
    rng = np.random.default_rng(6)
    T, n, p, q = 8, 3, 2, 2
    rate = rng.uniform(0.2, 0.8, (T, q))
    deviation = np.sqrt(rate * (1.0 - rate))
    correlation = np.array([[1.0, -0.2], [-0.2, 1.0]])
    faults = correlation * deviation[:, :, None] * deviation[:, None, :]
    system = replace(
        plant(rng, T=T, n=n, p=p, q=q),
        P0=np.diag([1.0, 0.0, 2.0]),
        rate=rate,
        fault_covariance=faults,
    )
    u = u_scale * rng.standard_normal((T, q))
    y = simulate(system, u, rng, missing=missing)
    options = {"weight_floor": 0.0, "likelihood": "gaussian"}
    textbook = textbook_mme([system], np.ones(1), y, u, **options)
    batch = batch_lmmse(system, y, u)
    for port in PORTS:
        actual, expected = getattr(textbook, port), getattr(batch, port)
        # The covariances reach u^2 / R = 1e7 times the noise, of which the inverse costs digits.
        scale = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(actual, expected, rtol=1e-8, atol=1e-11 * scale)


def test_two_sensors_that_see_almost_the_same_keep_both_directions():
    T = 3
    system = plant(np.random.default_rng(7), T=T, n=1, p=2, q=1)
    system = replace(
        independent(system, 0.5),
        C=np.zeros((T, 2, 1)),
        D=np.ones((T, 2, 1)),
        R=np.broadcast_to(1e-2 * np.eye(2), (T, 2, 2)),
    )
    u = np.full((T, 1), 1e4)
    y = np.broadcast_to([1e4 + 0.1, 1e4 - 0.1], (T, 2))
    options = {"weight_floor": 0.0, "likelihood": "gaussian"}
    result = textbook_mme([system], np.ones(1), y, u, **options)
    # Sum and difference are independent, of variance 4 s u^2 + 2 W and 2 W; a change of variables
    # of determinant 2. The condition number 5e9 of the correlation takes ten of sixteen digits.
    total, apart = 1e8 + 0.02, 0.02
    density = -0.5 * (1e8 / total + 0.04 / apart + np.log(total * apart)) - np.log(2.0 * np.pi)
    np.testing.assert_allclose(result.log_likelihood, density + np.log(2.0), rtol=1e-6)


def test_inputs_that_are_only_measured_make_the_mixture_exact():
    T, q = 4, 2
    rates = [(0.2, 0.6), (0.8, 0.6), (0.5, 0.1)]
    rng = np.random.default_rng(3)
    system = plant(rng, T=T, n=1, p=1, q=q)
    system = replace(system, C=0.0 * system.C, R=np.full((T, 1, 1), 0.3))
    u = rng.standard_normal((T, q))
    y = rng.standard_normal((T, 1))
    evidence = np.zeros(3)
    for i, rate in enumerate(np.array(rates)):
        for history in product(product((0.0, 1.0), repeat=q), repeat=T):
            gamma = np.array(history)
            residual = y[:, 0] - np.einsum("kj,kj->k", system.D[:, 0], gamma * u)
            likelihood = np.exp(-0.5 * np.sum(residual**2) / 0.3)
            evidence[i] += likelihood * np.prod(np.where(gamma > 0.0, rate, 1.0 - rate))
    prior = np.full(3, 1.0 / 3.0)
    hypotheses = [independent(system, rate) for rate in rates]
    result = textbook_mme(hypotheses, prior, y, u, weight_floor=0.0, likelihood="mixture")
    # All 256 histories of the faults are summed on one side, 4 patterns per sample on the other.
    np.testing.assert_allclose(result.mode_probability[-1], evidence / evidence.sum(), rtol=1e-11)
    assert result.success_rate_estimate.shape == (T, q)
    np.testing.assert_allclose(
        result.success_rate_estimate, result.mode_probability @ np.array(rates)
    )


def test_five_independent_inputs_fall_back_to_the_gaussian():
    T = 4
    rng = np.random.default_rng(5)
    system = plant(rng, T=T, n=2, p=2, q=5)
    u, y = np.ones((T, 5)), rng.standard_normal((T, 2))
    systems = [independent(system, rate) for rate in (0.2, 0.5, 0.9)]
    mixture, gaussian = (
        textbook_mme(systems, np.full(3, 1.0 / 3.0), y, u, weight_floor=1e-6, likelihood=kind)
        for kind in ("mixture", "gaussian")
    )
    np.testing.assert_array_equal(mixture.mode_probability, gaussian.mode_probability)
