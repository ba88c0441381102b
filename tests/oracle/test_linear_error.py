"""The true error of linear filters: printed numbers, and the joint moments."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_plants import (
    ALTERNATING,
    any_law,
    example,
    inputs,
    plant,
    product_law,
)

from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.exact.uncertain import joint_moments
from fkgen.oracle.plants.sensor import simulate_sensor
from fkgen.oracle.textbook.linear_optimal import linear_optimal, true_covariance

RARE = np.array([[0.8, 0.2], [0.8, 0.2]])
DRIFTING = np.array([[0.9, 0.1], [0.3, 0.7]])  # E[delta] depends on time
EQUAL = np.array([[0.6, 0.4], [0.6, 0.4]])
BURSTS = np.array([[0.9, 0.1], [0.1, 0.9]])


def example_2(T, p=0.9, q=0.7, **options):
    rate = 1.0 - q * (1.0 - p)
    persistence = (1.0 - q * (1.0 - p**2)) / rate
    return FaultMoments.from_rates(rate, persistence, 0.8, T=T, noise_factor=10.0, **options)


TABLE = {
    "example 1": (
        -0.774835381917, 0.314557726039, 2.777777777778, 1.149300984290, 1.628476793487,
    ),
    "bursts": (-0.614767402986, 0.257267495853, 2.777777777778, 0.703120337617, 2.074657440161),
    "example 2": (
        -0.530981724312, 0.360707895602, 2.777777777778, 1.619967047108, 1.157810730670,
    ),
}  # fmt: skip


def stationary(moments, T):
    return linear_optimal(example(T), moments, np.zeros((T, 1)), None)


def moments_of(name, T):
    if name == "example 2":
        return example_2(T, rows=(0,))
    signal = {"example 1": ALTERNATING, "bursts": BURSTS}[name]
    return FaultMoments.from_law(product_law(signal, RARE), T)


@pytest.mark.parametrize("name", TABLE)
def test_gains_and_moments_settle_at_the_printed_values(name):
    result = stationary(moments_of(name, 200), 200)
    found = [
        getattr(result, port)[-1].item()
        for port in (
            "state_gain",
            "measurement_gain",
            "state_second_moment",
            "estimate_second_moment",
            "filtered_covariance",
        )
    ]
    np.testing.assert_allclose(found, TABLE[name], rtol=0, atol=6e-13)


def true_error(a_law, moments, T=200):
    result = stationary(moments, T)
    gains = result.state_gain, result.measurement_gain
    return true_covariance(example(T), a_law, gains)[-1, 0, 0]


@pytest.mark.parametrize(("signal", "error"), [(ALTERNATING, 1.9630847447), (BURSTS, 2.0561034465)])
def test_the_true_error_outside_lemma_2_is_the_printed_one(signal, error):
    a_law = product_law(signal, RARE)
    found = true_error(a_law, FaultMoments.from_law(a_law, 200))
    assert found == pytest.approx(error, abs=6e-11)


@pytest.mark.parametrize(
    ("nominal", "alternating", "second"),
    [(1.0, 2.25845390, 1.38840329), (0.8, 1.93659135, 1.15992829)],
)
def test_a_kalman_filter_that_ignores_lost_signals_has_the_printed_errors(
    nominal, alternating, second
):
    kalman = FaultMoments.from_rates(1.0, 1.0, nominal, T=200, rows=(0,), noise_factor=10.0)
    assert true_error(product_law(ALTERNATING, RARE), kalman) == pytest.approx(
        alternating, abs=6e-9
    )
    assert error_in_example_2(kalman) == pytest.approx(second, abs=6e-9)


def error_in_example_2(moments):
    """alpha = 0: all is well; alpha = 1: independent losses. The mean square error is the mean."""
    healthy = product_law(np.eye(2), RARE, initial=((1.0, 0.0), RARE[0]))
    losing = product_law([[0.9, 0.1]] * 2, RARE, initial=((0.9, 0.1), RARE[0]))
    return 0.3 * true_error(healthy, moments) + 0.7 * true_error(losing, moments)


def test_in_example_2_the_filter_knows_its_error():
    moments = example_2(200, rows=(0,))
    believed = stationary(moments, 200).filtered_covariance[-1, 0, 0]
    assert error_in_example_2(moments) == pytest.approx(believed, rel=1e-12)


def test_the_best_constant_p11_in_example_1_is_another_one():
    a_law = product_law(ALTERNATING, RARE)

    def error(p11):
        return true_error(
            a_law, FaultMoments.from_rates(0.5, p11, 0.8, T=200, rows=(0,), noise_factor=10.0)
        )

    found = {p11: error(p11) for p11 in (0.1, 0.4, 0.41, 0.42, 0.5)}
    assert min(found, key=found.get) == 0.41
    assert found[0.41] == pytest.approx(1.859372, abs=6e-7)
    assert found[0.1] == pytest.approx(1.9630847447, abs=6e-11)


@pytest.mark.parametrize("rows", [(0,), (0, 1)])
def test_the_true_error_of_any_gains_follows_from_the_joint_moments(rows):
    rng = np.random.default_rng(8)
    T, n, p = 5, 2, 2
    system, a_law = plant(rng, T=T), any_law(rng, rows=rows)
    u = inputs(rng, system)
    F1, F2 = rng.standard_normal((T, n, n)), rng.standard_normal((T, n, p))
    shift = rng.standard_normal((T, n))
    mean, covariance = joint_moments(system, FaultMoments.from_law(a_law, T), u)
    found = true_covariance(system, a_law, (F1, F2), u, shift)
    weights, constant = np.zeros((n, mean.size)), system.x0
    split = (T + 1) * n
    for k in range(T):
        weights, constant = F1[k] @ weights, F1[k] @ constant + shift[k]
        weights[:, split + k * p : split + (k + 1) * p] += F2[k]
        error = weights.copy()
        error[:, k * n : (k + 1) * n] -= np.eye(n)
        bias = error @ mean + constant
        expected = error @ covariance @ error.T + np.outer(bias, bias)
        np.testing.assert_allclose(found[k], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("rows", [(0,), (0, 1)])
def test_with_inputs_gains_and_offset_give_the_estimate_and_its_error(rows):
    rng = np.random.default_rng(9)
    T = 6
    system = plant(rng, T=T)
    a_law = product_law(EQUAL, DRIFTING, initial=(EQUAL[0], (0.5, 0.5)), rows=rows)
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, a_law, u, rng)
    result = linear_optimal(system, FaultMoments.from_law(a_law, T), y, u)
    x = system.x0
    for k in range(T):
        x = result.state_gain[k] @ x + result.measurement_gain[k] @ y[k] + result.offset[k]
        np.testing.assert_allclose(result.filtered_state[k], x, rtol=1e-11, atol=1e-11)
    gains = result.state_gain, result.measurement_gain
    error = true_covariance(system, a_law, gains, u, result.offset)
    np.testing.assert_allclose(error, result.filtered_covariance, rtol=1e-9, atol=1e-9)
