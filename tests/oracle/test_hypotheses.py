"""The textbook bank of filters against joint densities, counting and its own reductions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fkgen.oracle.exact.batch import batch_lmmse, joint_distribution
from fkgen.oracle.exact.hypotheses import batch_posterior, textbook_mme
from fkgen.oracle.plants.actuator import LinearSystem, simulate

RATES = (0.1, 0.3, 0.5, 0.7, 0.9)
UNIFORM = np.full(5, 0.2)
PORTS = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")


def with_rate(system, rate, *, dependence="common"):
    rate = np.broadcast_to(np.asarray(rate, dtype=float), system.rate.shape)
    variance = rate * (1.0 - rate)
    q = system.nu
    shape = np.ones((q, q)) if dependence == "common" else np.eye(q)
    return replace(system, rate=rate, fault_covariance=variance[:, :, None] * shape)


def motor(T, *, D, W):
    """Build the motor of eq. (26) with the measurements (29)."""
    return LinearSystem(
        A=np.broadcast_to([[0.9802, -0.0002], [0.0094, 0.9048]], (T, 2, 2)),
        B=np.broadcast_to([[0.0198], [0.0001]], (T, 2, 1)),
        C=np.broadcast_to([[0.0, 1.0], [0.0, 0.0]], (T, 2, 2)),
        D=np.broadcast_to([[0.0], [D]], (T, 2, 1)),
        Q=np.broadcast_to(1e-4 * np.eye(2), (T, 2, 2)),
        R=np.broadcast_to(np.diag([5e-6, W]), (T, 2, 2)),
        x0=np.zeros(2),
        P0=np.eye(2),
        rate=np.ones((T, 1)),
        fault_covariance=np.zeros((T, 1, 1)),
    )


def bank(system, rates=RATES, **options):
    return [with_rate(system, rate, **options) for rate in rates]


def record(T, *, D=1.0, W=1e-2, missing=0.0, seed=1, rate=0.7):
    system = motor(T, D=D, W=W)
    u = np.ones((T, 1))
    y = simulate(with_rate(system, rate), u, np.random.default_rng(seed), missing=missing)
    return system, y, u


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("prior", [UNIFORM, np.array([0.4, 0.3, 0.2, 0.1, 0.0])])
def test_gaussian_weights_equal_the_joint_density_of_the_record(prior, missing):
    system, y, u = record(10, missing=missing)
    exact = batch_posterior(bank(system), prior, y, u)
    textbook = textbook_mme(bank(system), prior, y, u, weight_floor=0.0, likelihood="gaussian")
    # A log density of order 10 carries 1e-14 of rounding; ten of them are summed.
    np.testing.assert_allclose(textbook.mode_probability, exact, rtol=1e-8)
    np.testing.assert_allclose(exact.sum(axis=1), 1.0, rtol=1e-12)


def test_a_hypothesis_wrong_by_a_thousandth_is_seen():
    system, y, u = record(10)
    exact = batch_posterior(bank(system), UNIFORM, y, u)
    wrong = bank(replace(system, R=1.001 * system.R))
    textbook = textbook_mme(wrong, UNIFORM, y, u, weight_floor=0.0, likelihood="gaussian")
    # Rounding stays below 1e-8; a thousandth of R is far above it.
    assert np.abs(textbook.mode_probability - exact).max() > 1e-6


def test_log_likelihoods_add_up_to_the_evidence_of_the_record():
    system, y, u = record(8, missing=0.2)
    textbook = textbook_mme(bank(system), UNIFORM, y, u, weight_floor=0.0, likelihood="gaussian")
    finite = np.isfinite(y).ravel()
    densities = []
    for hypothesis in bank(system):
        joint = joint_distribution(hypothesis, u)
        root = joint.measurement_root.reshape(16, -1)[finite]
        residual = (y.ravel() - joint.measurement_mean.ravel())[finite]
        covariance = root @ root.T
        square = residual @ np.linalg.solve(covariance, residual)
        densities.append(-0.5 * (square + np.linalg.slogdet(2.0 * np.pi * covariance)[1]))
    # The joint covariance has a condition number of some 1e5 here.
    assert textbook.log_likelihood.sum() == pytest.approx(
        np.log(UNIFORM @ np.exp(densities)), rel=1e-9
    )


@pytest.mark.parametrize("likelihood", ["gaussian", "mixture"])
@pytest.mark.parametrize("floor", [0.0, 1e-6])
def test_one_hypothesis_is_the_best_linear_filter(likelihood, floor):
    system, y, u = record(9, missing=0.2)
    only = with_rate(system, 0.7)
    textbook = textbook_mme([only], np.ones(1), y, u, weight_floor=floor, likelihood=likelihood)
    batch = batch_lmmse(only, y, u)
    for port in (*PORTS, "innovation", "innovation_covariance", "nis"):
        # Two routes to one estimate, P0 / W = 1e5: 1e-11 of rounding at most, on a scale of 1.
        np.testing.assert_allclose(
            getattr(textbook, port), getattr(batch, port), rtol=1e-9, atol=1e-12
        )
    np.testing.assert_array_equal(textbook.mode_probability, 1.0)
    np.testing.assert_allclose(textbook.success_rate_estimate, 0.7, rtol=1e-15)
    np.testing.assert_array_equal(textbook.paper_state[1:], textbook.predicted_state[:-1])
    np.testing.assert_array_equal(textbook.paper_state[0], system.x0)
    if likelihood == "gaussian":
        np.testing.assert_allclose(
            textbook.log_likelihood, batch.log_likelihood, rtol=1e-9, atol=1e-9
        )


def test_without_feedthrough_the_mixture_is_the_gaussian():
    system, y, u = record(30, D=0.0)
    mixture, gaussian = (
        textbook_mme(bank(system), UNIFORM, y, u, weight_floor=1e-6, likelihood=kind)
        for kind in ("mixture", "gaussian")
    )
    # Both add the same density in another order.
    np.testing.assert_allclose(mixture.mode_probability, gaussian.mode_probability, rtol=1e-10)
    np.testing.assert_allclose(mixture.log_likelihood, gaussian.log_likelihood, rtol=1e-10)


def test_with_feedthrough_the_gaussian_is_more_confident_than_the_mixture():
    system, y, u = record(15)
    mixture, gaussian = (
        textbook_mme(bank(system), UNIFORM, y, u, weight_floor=0.0, likelihood=kind)
        for kind in ("mixture", "gaussian")
    )
    # They differ at the order of the weights themselves.
    assert np.abs(mixture.mode_probability - gaussian.mode_probability).max() > 0.02


def test_an_almost_exact_current_sensor_counts_successes():
    T = 60
    system, y, u = record(T, W=1e-6)
    result = textbook_mme(bank(system), UNIFORM, y, u, weight_floor=0.0, likelihood="mixture")
    worked = np.cumsum(y[:, 1] > 0.5)[:, None]
    failed = np.arange(1, T + 1)[:, None] - worked
    rates = np.array(RATES)
    counted = rates**worked * (1.0 - rates) ** failed
    counted /= counted.sum(axis=1, keepdims=True)
    # The speed sensor adds a little: the input moves it by 1e-4 against a noise of 1e-2.
    assert np.abs(result.mode_probability - counted).mean() < 0.01


def two_inputs(T, *, rates, dependence):
    system = replace(
        motor(T, D=1.0, W=1e-2),
        B=np.broadcast_to([[0.02, 0.01], [0.0, 0.1]], (T, 2, 2)),
        D=np.broadcast_to([[0.0, 0.5], [1.0, 0.0]], (T, 2, 2)),
        rate=np.ones((T, 2)),
        fault_covariance=np.zeros((T, 2, 2)),
    )
    return bank(system, rates, dependence=dependence)


def test_common_and_independent_faults_are_told_apart():
    T = 12
    u = np.ones((T, 2))
    common = two_inputs(T, rates=RATES, dependence="common")
    independent = two_inputs(T, rates=RATES, dependence="independent")
    y = simulate(common[3], u, np.random.default_rng(4))
    results = [
        textbook_mme(systems, UNIFORM, y, u, weight_floor=1e-6, likelihood="mixture")
        for systems in (common, independent)
    ]
    # The covariance of y differs at the order of N itself.
    assert np.abs(results[0].mode_probability - results[1].mode_probability).max() > 0.01
    assert results[0].success_rate_estimate.shape == (T,)
    assert results[1].success_rate_estimate.shape == (T, 2)


@pytest.mark.parametrize("floor", [1e-6, 1e-3])
def test_the_floor_keeps_every_hypothesis_alive(floor):
    system, y, u = record(80)
    result = textbook_mme(bank(system), UNIFORM, y, u, weight_floor=floor, likelihood="mixture")
    assert result.mode_probability.min() >= floor
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=1e-12)


def test_a_sample_that_is_wholly_missing_leaves_the_weights_alone():
    system, y, u = record(10)
    y[4] = np.nan
    result = textbook_mme(bank(system), UNIFORM, y, u, weight_floor=1e-3, likelihood="mixture")
    np.testing.assert_array_equal(result.mode_probability[4], result.mode_probability[3])
    assert result.nis[4] == 0.0
    assert result.log_likelihood[4] == 0.0
    assert np.isnan(result.innovation[4]).all()
    assert np.isfinite(result.innovation_covariance[4]).all()


def test_relabelling_the_hypotheses_relabels_the_weights():
    system, y, u = record(12, missing=0.1)
    prior = np.array([0.1, 0.2, 0.3, 0.25, 0.15])
    order = [3, 0, 4, 2, 1]
    options = {"weight_floor": 1e-4, "likelihood": "mixture"}
    here = textbook_mme(bank(system), prior, y, u, **options)
    there = textbook_mme(bank(system, np.array(RATES)[order]), prior[order], y, u, **options)
    # The sums run in another order.
    np.testing.assert_allclose(there.mode_probability, here.mode_probability[:, order], rtol=1e-11)
    for port in PORTS:
        np.testing.assert_allclose(
            getattr(there, port), getattr(here, port), rtol=1e-11, atol=1e-15
        )


def test_a_hypothesis_given_twice_shares_its_weight():
    system, y, u = record(12)
    options = {"weight_floor": 0.0, "likelihood": "mixture"}
    once = textbook_mme(bank(system, (0.3, 0.7)), np.array([0.5, 0.5]), y, u, **options)
    twice = textbook_mme(
        bank(system, (0.3, 0.7, 0.7)), np.array([0.5, 0.25, 0.25]), y, u, **options
    )
    # The sums run in another order.
    np.testing.assert_allclose(
        twice.mode_probability[:, 1:].sum(axis=1), once.mode_probability[:, 1]
    )
    np.testing.assert_array_equal(twice.mode_probability[:, 1], twice.mode_probability[:, 2])
    for port in (*PORTS, "paper_state", "log_likelihood"):
        np.testing.assert_allclose(
            getattr(twice, port), getattr(once, port), rtol=1e-11, atol=1e-15
        )


def test_a_prior_of_zero_stays_zero_without_a_floor():
    system, y, u = record(40, rate=0.9)
    prior = np.array([0.25, 0.25, 0.25, 0.25, 0.0])
    result = textbook_mme(bank(system), prior, y, u, weight_floor=0.0, likelihood="mixture")
    np.testing.assert_array_equal(result.mode_probability[:, 4], 0.0)
    np.testing.assert_array_equal(batch_posterior(bank(system), prior, y, u)[:, 4], 0.0)


def test_a_dead_hypothesis_may_fit_beyond_all_measure():
    system, y, u = record(20, W=1e-6)
    prior = np.array([1.0, 0.0])
    systems = bank(system, (1.0, 0.7))
    result = textbook_mme(systems, prior, y, u, weight_floor=0.0, likelihood="mixture")
    # The living one has been contradicted: its density is exp(-500000) of the dead one's.
    np.testing.assert_array_equal(result.mode_probability, np.tile(prior, (20, 1)))
    np.testing.assert_array_equal(batch_posterior(systems, prior, y, u), np.tile(prior, (20, 1)))


def test_certain_hypotheses_are_legal_and_die_of_one_contradiction():
    T = 20
    system, y, u = record(T, W=1e-6)
    rates = (0.0, 0.7, 1.0)
    options = {"weight_floor": 0.0, "likelihood": "mixture"}
    result = textbook_mme(bank(system, rates), np.full(3, 1.0 / 3.0), y, u, **options)
    assert np.isfinite(result.mode_probability).all()
    # One contradiction is a thousand standard deviations, exp(-500000).
    np.testing.assert_allclose(result.mode_probability[-1], [0.0, 1.0, 0.0], atol=1e-300)


def test_the_combined_covariance_is_that_of_the_mixture_of_the_filters():
    system, y, u = record(6)
    options = {"weight_floor": 0.0, "likelihood": "gaussian"}
    result = textbook_mme(bank(system), UNIFORM, y, u, **options)
    alone = [batch_lmmse(hypothesis, y, u) for hypothesis in bank(system)]
    for k in range(6):
        w = result.mode_probability[k]
        for time in ("filtered", "predicted"):
            means = np.array([getattr(a, f"{time}_state")[k] for a in alone])
            covariances = np.array([getattr(a, f"{time}_covariance")[k] for a in alone])
            mean = w @ means
            second = np.einsum("i,ijk->jk", w, covariances + means[:, :, None] * means[:, None, :])
            # Second moment less squared mean loses digits where the mean is large beside P.
            np.testing.assert_allclose(getattr(result, f"{time}_state")[k], mean, rtol=1e-8)
            np.testing.assert_allclose(
                getattr(result, f"{time}_covariance")[k], second - np.outer(mean, mean), atol=1e-11
            )
        before = system.x0[None] if k == 0 else np.array([a.predicted_state[k - 1] for a in alone])
        weights = np.ones(1) if k == 0 else w
        np.testing.assert_allclose(result.paper_state[k], weights @ before, rtol=1e-8, atol=1e-12)
        held = UNIFORM if k == 0 else result.mode_probability[k - 1]
        expected = np.array([y[k] - a.innovation[k] for a in alone])
        spread = np.einsum("i,ij,ik->jk", held, expected, expected)
        within = np.einsum("i,ijk->jk", held, np.array([a.innovation_covariance[k] for a in alone]))
        S = within + spread - np.outer(held @ expected, held @ expected)
        nu = y[k] - held @ expected
        np.testing.assert_allclose(result.innovation[k], nu, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(result.innovation_covariance[k], S, rtol=1e-8, atol=1e-12)
        assert result.nis[k] == pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-6)
