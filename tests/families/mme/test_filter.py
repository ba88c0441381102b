"""The compiled bank of filters: weights, estimates, reductions."""

from __future__ import annotations

import numpy as np
import pytest
from plants import (
    MOTOR,
    RATES,
    SENSED,
    assert_agree,
    common,
    distance,
    motor,
    random_model,
    record,
    run,
    spec,
    system_of,
)

from fkgen.oracle.exact.hypotheses import batch_posterior, textbook_mme

ESTIMATES = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
PORTS = (
    *ESTIMATES,
    "mode_probability",
    "success_rate_estimate",
    "paper_state",
    "innovation",
    "innovation_covariance",
    "nis",
    "log_likelihood",
)

#: Weights are exponentials of sums of log-likelihoods of order 100: three digits above 1e-14, and
#: P0 / R = 2e5 costs some more.
EXACT = 1e-8

#: The same arithmetic with terms in another order, through the same exponentials.
ROUNDING = 1e-11


def textbook(plant, y, u, **options):
    systems = [system_of(plant, len(y), rates=rates) for rates in plant.filter.options.hypotheses]
    prior = np.array(plant.filter.options.prior)
    chosen = {
        "weight_floor": plant.filter.options.weight_floor,
        "likelihood": plant.filter.options.likelihood,
    } | options
    return textbook_mme(systems, prior, y, u, **chosen)


@pytest.mark.parametrize("floor", [0.0, 1e-6, 1e-2])
@pytest.mark.parametrize("likelihood", ["gaussian", "mixture"])
@pytest.mark.parametrize("model", [MOTOR, SENSED], ids=["speed", "speed_and_voltage"])
def test_the_motor_agrees_with_the_textbook(model, likelihood, floor):
    plant = motor("mme", model, likelihood=likelihood, weight_floor=floor)
    y, u = record(plant, 40, missing=0.2, u=np.ones((40, 1)))
    assert_agree(run(plant, y, u), textbook(plant, y, u), PORTS, EXACT)


@pytest.mark.parametrize("likelihood", ["gaussian", "mixture"])
@pytest.mark.parametrize("dependence", ["common", "independent"])
def test_two_actuators_agree_with_the_textbook(dependence, likelihood):
    model = random_model(41, 3, 2, 2, direct=True, correlated=True)
    hypotheses = [0.2, 0.5, 0.9] if dependence == "common" else [[0.2, 0.7], [0.5, 0.5], 0.9]
    plant = spec(
        model,
        family="mme",
        actuator={"dependence": dependence},
        hypotheses=hypotheses,
        prior=[0.5, 0.3, 0.2],
        likelihood=likelihood,
    )
    y, u = record(plant, 15, missing=0.2)
    assert_agree(run(plant, y, u), textbook(plant, y, u), PORTS, EXACT)


def test_hypotheses_of_certainty_agree_with_the_textbook():
    plant = motor("mme", hypotheses=[0.0, 0.5, 1.0])
    y, u = record(plant, 20, rates=(0.5,), u=np.ones((20, 1)))
    assert_agree(run(plant, y, u), textbook(plant, y, u), PORTS, EXACT)


def test_gaussian_weights_are_the_posterior_of_the_joint_density():
    plant = motor("mme", likelihood="gaussian", weight_floor=0.0, prior=[0.4, 0.3, 0.2, 0.1, 0.0])
    y, u = record(plant, 12, missing=0.2, rates=(0.5,))
    systems = [system_of(plant, 12, rates=rates) for rates in plant.filter.options.hypotheses]
    expected = batch_posterior(systems, np.array(plant.filter.options.prior), y, u)
    assert distance(run(plant, y, u).mode_probability, expected) < EXACT


def test_a_float_bank_stays_near_the_double_one():
    y, u = record(motor("mme"), 60, missing=0.1, u=np.ones((60, 1)))
    double = run(motor("mme"), y, u)
    single = run(motor("mme", code={"scalar": "float"}), y, u)
    # 60 log-likelihoods of order 10 with 24 bits: 1e-4 each at worst, and half of that on average.
    np.testing.assert_allclose(single.mode_probability, double.mode_probability, atol=3e-3)
    # u / R = 2e5 states errors of 24 bits in terms of the noise.
    assert distance(single.filtered_state, double.filtered_state) < 1e-3


@pytest.mark.parametrize("likelihood", ["gaussian", "mixture"])
@pytest.mark.parametrize("model", [MOTOR, SENSED], ids=["speed", "speed_and_voltage"])
def test_one_hypothesis_is_the_modified_kalman_filter_to_the_bit(model, likelihood):
    bank = motor("mme", model, hypotheses=[0.7], likelihood=likelihood)
    alone = motor("mkf", model)
    y, u = record(alone, 40, missing=0.2)
    one, other = run(bank, y, u), run(alone, y, u)
    for port in (*ESTIMATES, "innovation", "innovation_covariance", "nis"):
        np.testing.assert_array_equal(one[port], other[port])
    np.testing.assert_array_equal(one.mode_probability, 1.0)
    np.testing.assert_array_equal(one.success_rate_estimate, 0.7)
    if likelihood == "gaussian":
        np.testing.assert_array_equal(one.log_likelihood, other.log_likelihood)


def test_weights_sum_to_one_and_stay_finite_over_log_odds_of_a_hundred_thousand():
    plant = motor("mme", SENSED | {"R": [[5e-6, 0.0], [0.0, 1e-4]]}, weight_floor=0.0)
    T = 60000
    y, u = record(plant, T, rates=(0.9,), u=np.ones((T, 1)))
    result = run(plant, y, u, keep=("mode_probability", "log_weight"))
    # Five roundings of numbers below one.
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert np.isfinite(result.log_weight).all()
    assert result.log_weight[-1].min() < -1e5
    assert result.mode_probability[-1, -1] == 1.0


def test_a_jump_of_log_odds_by_a_hundred_thousand_in_one_sample_stays_finite():
    plant = motor("mme", weight_floor=1e-6)
    # 140 deviations of the voltage sensor from either of its two means: -1e4 under all hypotheses.
    y = np.array([[0.0, 1.0], [0.0, 15.0], [3.0, 1.0], [0.0, 1.0]])
    result = run(plant, y, np.ones((4, 1)))
    assert np.isfinite(result.log_likelihood).all()
    assert result.log_likelihood[1] < -9000.0
    # Five roundings of numbers below one.
    np.testing.assert_allclose(result.mode_probability.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert result.mode_probability.min() >= 1e-6 * (1.0 - 1e-9)  # the floor, rounded


def test_permuted_hypotheses_have_permuted_weights_and_one_estimate():
    order = [3, 0, 4, 1, 2]
    prior = [0.3, 0.1, 0.25, 0.15, 0.2]
    one = motor("mme", prior=prior)
    other = motor("mme", hypotheses=[RATES[i] for i in order], prior=[prior[i] for i in order])
    y, u = record(one, 40, missing=0.1)
    a, b = run(one, y, u), run(other, y, u)
    assert distance(b.mode_probability, a.mode_probability[:, order]) < ROUNDING
    assert_agree(b, a, (*ESTIMATES, "success_rate_estimate", "paper_state"), ROUNDING)


def test_a_duplicated_hypothesis_shares_its_weight_and_leaves_the_estimate():
    one = motor("mme", hypotheses=[0.3, 0.7], weight_floor=0.0)
    twice = motor("mme", hypotheses=[0.3, 0.7, 0.7], prior=[0.5, 0.25, 0.25], weight_floor=0.0)
    y, u = record(one, 40, missing=0.1)
    a, b = run(one, y, u), run(twice, y, u)
    np.testing.assert_array_equal(b.mode_probability[:, 1], b.mode_probability[:, 2])
    assert distance(2.0 * b.mode_probability[:, 1], a.mode_probability[:, 1]) < ROUNDING
    assert_agree(b, a, (*ESTIMATES, "success_rate_estimate", "paper_state"), ROUNDING)


def test_a_hypothesis_of_prior_zero_stays_at_zero_without_a_floor_and_returns_with_one():
    prior = [0.25, 0.25, 0.25, 0.25, 0.0]
    y, u = record(motor("mme"), 400, rates=(0.9,), u=np.ones((400, 1)))
    dead, alive = (run(motor("mme", prior=prior, weight_floor=w), y, u) for w in (0.0, 1e-6))
    np.testing.assert_array_equal(dead.mode_probability[:, 4], 0.0)
    assert np.isfinite(dead.log_weight).all()
    assert alive.mode_probability[-1, 4] > 0.9  # the truth of this record


def test_without_feedthrough_the_mixture_is_the_gaussian():
    y, u = record(motor("mme", MOTOR), 60, missing=0.1)
    mixture, gaussian = (
        run(motor("mme", MOTOR, likelihood=kind), y, u) for kind in ("mixture", "gaussian")
    )
    # One density, computed in two ways: 60 sums of order 10.
    assert distance(mixture.mode_probability, gaussian.mode_probability) < 1e-9


def test_mixture_weights_count_successes_where_the_voltage_is_measured():
    plant = motor("mme", weight_floor=0.0)
    T = 100
    y, u = record(plant, T, rates=(0.5,), u=np.ones((T, 1)))
    found = run(plant, y, u).mode_probability
    worked = np.cumsum(y[:, 1] > 0.5)[:, None]
    failed = np.arange(1, T + 1)[:, None] - worked
    rates = np.array(RATES)
    counted = rates**worked * (1.0 - rates) ** failed
    counted /= counted.sum(axis=1, keepdims=True)
    # The speed adds a little, and the two voltages are ten deviations apart.
    assert np.abs(found - counted).mean() < 0.01


def test_the_gaussian_is_more_confident_than_the_count_of_successes():
    y, u = record(motor("mme"), 100, rates=(0.5,), u=np.ones((100, 1)))
    mixture, gaussian = (
        run(motor("mme", likelihood=kind, weight_floor=0.0), y, u).mode_probability
        for kind in ("mixture", "gaussian")
    )
    # Rates of 0.095 against 0.087 per sample: weights differ by percents on the way.
    assert np.abs(mixture - gaussian).max() > 0.02


def test_a_wholly_missing_sample_leaves_every_weight_as_it_is():
    y, u = record(motor("mme"), 20)
    y[[5, 11, 12]] = np.nan
    result = run(motor("mme"), y, u)
    for k in (5, 11, 12):
        np.testing.assert_array_equal(result.mode_probability[k], result.mode_probability[k - 1])
        np.testing.assert_array_equal(result.log_weight[k], result.log_weight[k - 1])
        assert result.status[k] == 1


def test_weights_do_not_depend_on_the_unit_of_a_measurement():
    scale = np.array([1e3, 1e-4])
    changed = {
        "C": (scale[:, None] * np.array(SENSED["C"])).tolist(),
        "D": (scale[:, None] * np.array(SENSED["D"])).tolist(),
        "R": (np.outer(scale, scale) * np.array(SENSED["R"])).tolist(),
    }
    y, u = record(motor("mme"), 40, missing=0.1)
    a, b = run(motor("mme"), y, u), run(motor("mme", SENSED | changed), scale * y, u)
    assert_agree(b, a, ("mode_probability", *ESTIMATES), ROUNDING)


def test_without_input_nothing_is_learnt_about_the_rate():
    plant = motor("mme", weight_floor=0.0, likelihood="gaussian")
    y = np.random.default_rng(2).standard_normal((30, 2))
    result = run(plant, y, np.zeros((30, 1)))
    # All hypotheses have one likelihood; five equal shares of one.
    np.testing.assert_allclose(result.mode_probability, 0.2, rtol=1e-14)


def test_one_hypothesis_of_a_bank_follows_its_own_modified_kalman_filter():
    y, u = record(motor("mme"), 30, missing=0.2)
    bank = run(motor("mme"), y, u)
    for i, rate in enumerate(RATES):
        alone = run(motor("mkf", SENSED, actuator=common(rate)), y, u)
        np.testing.assert_array_equal(bank.mode_state[:, i], alone.predicted_state)
        np.testing.assert_array_equal(bank.mode_filtered_state[:, i], alone.filtered_state)
