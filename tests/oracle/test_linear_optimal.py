"""The printed linear filter (23) against the batch, printed numbers and its true error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensor_plants import (
    ALTERNATING,
    STICKY,
    close,
    example,
    inputs,
    plant,
    product_law,
)

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.moments import FaultMoments, satisfies_lemma_2
from fkgen.oracle.exact.uncertain import batch_uncertain, joint_moments
from fkgen.oracle.textbook.linear_optimal import linear_optimal

PORTS = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation",
    "innovation_covariance",
)
RARE = np.array([[0.8, 0.2], [0.8, 0.2]])
DRIFTING = np.array([[0.9, 0.1], [0.3, 0.7]])  # E[delta] depends on time
ABSORBING = np.array([[1.0, 0.0], [0.3, 0.7]])
EQUAL = np.array([[0.6, 0.4], [0.6, 0.4]])
PERIODIC = np.array([[0.0, 1.0], [1.0, 0.0]])
BURSTS = np.array([[0.9, 0.1], [0.1, 0.9]])


def example_2(T, p=0.9, q=0.7, **options):
    rate = 1.0 - q * (1.0 - p)
    persistence = (1.0 - q * (1.0 - p**2)) / rate
    return FaultMoments.from_rates(rate, persistence, 0.8, T=T, noise_factor=10.0, **options)


def lemma_2_moments(name, T, rows):
    chains = {
        "independent": (EQUAL, (0.6, 0.4)),
        "independent after a sure start": (EQUAL, (1.0, 0.0)),
        "constant": (np.eye(2), (0.7, 0.3)),
        "absorbing": (ABSORBING, (0.2, 0.8)),
        "periodic": (PERIODIC, (1.0, 0.0)),
    }
    if name in chains:
        signal, start = chains[name]
        a_law = product_law(signal, DRIFTING, initial=(start, (0.5, 0.5)), rows=rows)
        assert satisfies_lemma_2(a_law.kernel, a_law.initial)[0]
        return FaultMoments.from_law(a_law, T)
    if name == "varying rate":
        rate = np.random.default_rng(1).uniform(0.1, 0.9, T)
        return FaultMoments.from_rates(rate, rate, 0.8, T=T, rows=rows, noise_factor=10.0)
    p, q = {"example 2": (0.9, 0.7), "example 2, p = 0.2, q = 0.5": (0.2, 0.5)}[name]
    return example_2(T, p, q, rows=rows)


PROCESSES = (
    "independent",
    "independent after a sure start",
    "varying rate",
    "constant",
    "absorbing",
    "periodic",
    "example 2",
    "example 2, p = 0.2, q = 0.5",
)


def without_mean(system):
    return replace(system, x0=0.0 * system.x0)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("name", PROCESSES)
def test_under_lemma_2_the_printed_filter_is_the_batch(name, gaps):
    rng = np.random.default_rng(3)
    T = 8
    system = without_mean(plant(rng, T=T, n=3, q=0))
    moments = lemma_2_moments(name, T, rows=(0, 1))
    y = 3.0 * rng.standard_normal((T, 2))
    if gaps:
        y[1, 0] = y[4] = y[6, 1] = np.nan
    # Rounding of covariances, some 1e-13, relative to E[x x'] of about ten times the error.
    close(
        linear_optimal(system, moments, y, None),
        batch_uncertain(system, moments, y, None),
        PORTS,
        rtol=1e-9,
    )


@pytest.mark.parametrize("rows", [(0,), (1,), (0, 1)])
@pytest.mark.parametrize("name", ["independent", "varying rate"])
def test_inputs_and_a_mean_are_allowed_for_independent_gamma(name, rows):
    rng = np.random.default_rng(4)
    T = 8
    system, moments = plant(rng, T=T), lemma_2_moments(name, T, rows)
    u, y = inputs(rng, system), 3.0 * rng.standard_normal((T, 2))
    y[2, 1] = y[5, 0] = np.nan
    close(
        linear_optimal(system, moments, y, u),
        batch_uncertain(system, moments, y, u),
        PORTS,
        rtol=1e-9,
    )


@pytest.mark.parametrize("name", ["constant", "absorbing", "example 2"])
@pytest.mark.parametrize("change", ["x0", "u"])
def test_inputs_and_a_mean_are_refused_for_dependent_gamma(name, change):
    rng = np.random.default_rng(5)
    system = plant(rng, T=4)
    u = np.zeros((4, 1))
    linear_optimal(without_mean(system), lemma_2_moments(name, 4, (0, 1)), np.zeros((4, 2)), u)
    if change == "u":
        system, u = without_mean(system), u + 1.0
    with pytest.raises(DataError, match="x0 and u"):
        linear_optimal(system, lemma_2_moments(name, 4, (0, 1)), np.zeros((4, 2)), u)


def largest_difference(a, b):
    return np.abs(a.filtered_covariance - b.filtered_covariance).max()


def test_a_row_that_never_fails_needs_independent_gamma():
    # Its signal is not multiplied by gamma_i: what it says of gamma_k x_k has weight E[gamma_k].
    rng = np.random.default_rng(6)
    system, y = without_mean(plant(rng, T=6, q=0)), np.zeros((6, 2))
    for name, wrong in (("constant", True), ("absorbing", True), ("independent", False)):
        moments = lemma_2_moments(name, 6, (0,))
        difference = largest_difference(
            linear_optimal(system, moments, y, None), batch_uncertain(system, moments, y, None)
        )
        assert difference > 1e-3 if wrong else difference < 1e-9


@pytest.mark.parametrize("signal", [ALTERNATING, BURSTS, STICKY])
def test_without_lemma_2_the_printed_filter_is_not_the_batch(signal):
    a_law = product_law(signal, RARE)
    assert not satisfies_lemma_2(a_law.kernel, a_law.initial)[0]
    moments, y = FaultMoments.from_law(a_law, 12), np.zeros((12, 1))
    printed = linear_optimal(example(12), moments, y, None)
    assert largest_difference(printed, batch_uncertain(example(12), moments, y, None)) > 1e-3


@pytest.mark.parametrize("name", ["constant", "absorbing", "example 2"])
def test_the_rate_in_place_of_p11_is_seen(name):
    rng = np.random.default_rng(7)
    system, moments = without_mean(plant(rng, T=6, q=0)), lemma_2_moments(name, 6, (0, 1))
    y = np.zeros((6, 2))
    wrong = replace(moments, gamma_pair=np.outer(moments.gamma, moments.gamma))
    difference = largest_difference(
        linear_optimal(system, wrong, y, None), batch_uncertain(system, moments, y, None)
    )
    # In example 2 both differ by 0.002 only.
    assert difference > 1e-5


def test_the_first_row_updates_the_prior_without_a_time_update():
    rng = np.random.default_rng(10)
    system = without_mean(plant(rng, T=1, p=1, q=0))
    moments = FaultMoments.from_rates(0.7, 0.9, 0.8, T=1, rows=(0,), noise_factor=10.0)
    result = linear_optimal(system, moments, np.array([[2.0]]), None)
    H, P0 = system.C[0], system.P0
    gain = 0.7 * P0 @ H.T / (0.7 * H @ P0 @ H.T + 2.8 * system.R[0])
    np.testing.assert_allclose(result.measurement_gain[0], gain, rtol=1e-13)
    np.testing.assert_allclose(result.state_gain[0], np.eye(2) - 0.7 * gain @ H, rtol=1e-13)
    np.testing.assert_allclose(result.filtered_state[0], 2.0 * gain[:, 0], rtol=1e-13)


@pytest.mark.parametrize("noise", [1.0, 0.6])
def test_without_lost_signals_the_filter_is_the_kalman_filter(noise):
    rng = np.random.default_rng(11)
    system = without_mean(plant(rng, T=8, q=0))
    moments = FaultMoments.from_rates(1.0, 1.0, noise, T=8, rows=(0, 1), noise_factor=10.0)
    y = rng.standard_normal((8, 2))
    noisy = replace(system, R=(noise + 10.0 * (1.0 - noise)) * system.R)
    close(linear_optimal(system, moments, y, None), batch_lmmse(noisy, y, None), PORTS, rtol=1e-9)


def nahi(system, rate, y):
    """Optimal recursive estimation with uncertain observation, independent gamma."""
    x, P, S = system.x0, system.P0, system.P0
    for k in range(system.length):
        H, R = system.C[k], system.R[k]
        noise = R + rate * (1.0 - rate) * H @ S @ H.T
        K = rate * P @ H.T @ np.linalg.inv(rate**2 * H @ P @ H.T + noise)
        x, P = x + K @ (y[k] - rate * H @ x), P - rate * K @ H @ P
        yield x, P
        A, Q = system.A[k], system.Q[k]
        x, P, S = A @ x, A @ P @ A.T + Q, A @ S @ A.T + Q


def test_for_independent_gamma_the_filter_is_nahis():
    rng = np.random.default_rng(12)
    system = without_mean(plant(rng, T=8, q=0))
    moments = FaultMoments.from_rates(0.4, 0.4, 1.0, T=8, rows=(0, 1))
    y = rng.standard_normal((8, 2))
    result = linear_optimal(system, moments, y, None)
    for k, (x, P) in enumerate(nahi(system, 0.4, y)):
        np.testing.assert_allclose(result.filtered_state[k], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(result.filtered_covariance[k], P, rtol=1e-9, atol=1e-9)


def test_a_sensor_that_never_works_has_no_gain():
    system = without_mean(plant(np.random.default_rng(13), T=4, q=0))
    moments = FaultMoments.from_rates(0.0, 0.0, 1.0, T=4, rows=(0, 1))
    result = linear_optimal(system, moments, np.ones((4, 2)), None)
    np.testing.assert_array_equal(result.measurement_gain, 0.0)
    np.testing.assert_array_equal(result.estimate_second_moment, 0.0)


def test_a_singular_innovation_is_no_obstacle():
    rng = np.random.default_rng(14)
    system = without_mean(plant(rng, T=5, p=1, q=0))
    double = replace(system, C=np.repeat(system.C, 2, axis=1), D=np.ones((5, 2, 0)),
                     d=np.zeros((5, 2)), R=np.zeros((5, 2, 2)))  # fmt: skip
    y = np.repeat(rng.standard_normal((5, 1)), 2, axis=1)
    moments = lemma_2_moments("absorbing", 5, (0, 1))
    close(
        linear_optimal(double, moments, y, None),
        batch_uncertain(double, moments, y, None),
        ("filtered_state", "filtered_covariance"),
        rtol=1e-8,
    )


def test_second_moments_cancel_where_the_state_grows():
    T = 200
    growing = replace(example(T), A=np.full((T, 1, 1), 1.1), P0=np.eye(1))
    healthy = FaultMoments.from_rates(1.0, 1.0, 1.0, T=T, rows=(0,))
    covariance = linear_optimal(growing, healthy, np.zeros((T, 1)), None).filtered_covariance
    # The stationary value 0.6394799353 lasts while 1.1^(2 k) round-offs are small beside it.
    assert covariance[50, 0, 0] == pytest.approx(0.6394799353, rel=1e-9)
    assert abs(covariance[199, 0, 0] - 0.6394799353) > 0.01


def test_the_error_is_orthogonal_to_all_measurements():
    rng = np.random.default_rng(15)
    T, n, p = 6, 2, 2
    system, moments = without_mean(plant(rng, T=T, q=0)), lemma_2_moments("absorbing", T, (0, 1))
    _, covariance = joint_moments(system, moments, None)
    result = linear_optimal(system, moments, np.zeros((T, p)), None)
    split = (T + 1) * n
    weights = np.zeros((n, covariance.shape[0]))
    for k in range(T):
        weights = result.state_gain[k] @ weights
        weights[:, split + k * p : split + (k + 1) * p] += result.measurement_gain[k]
        error = weights.copy()
        error[:, k * n : (k + 1) * n] -= np.eye(n)
        cross = (error @ covariance)[:, split : split + (k + 1) * p]
        np.testing.assert_allclose(cross, 0.0, atol=1e-11 * np.abs(covariance).max())


@pytest.mark.parametrize("name", ["A", "C", "Q", "R", "P0"])
def test_an_error_of_a_thousandth_is_seen(name):
    rng = np.random.default_rng(16)
    system, moments = without_mean(plant(rng, T=5, q=0)), lemma_2_moments("example 2", 5, (0, 1))
    y = rng.standard_normal((5, 2))
    wrong = replace(system, **{name: 1.001 * getattr(system, name)})
    a, b = linear_optimal(wrong, moments, y, None), batch_uncertain(system, moments, y, None)
    # A thousandth of one ingredient moves some entry by more than a millionth.
    assert largest_difference(a, b) > 1e-6
