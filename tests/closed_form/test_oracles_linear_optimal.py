"""The printed linear filter (23) against the batch, printed numbers and its true error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensor_plants import (
    ALTERNATING,
    STICKY,
    any_law,
    close,
    example,
    inputs,
    law,
    plant,
    product_law,
)

import fkgen
from fkgen.closed_form import (
    FaultMoments,
    batch_lmmse,
    batch_uncertain,
    joint_moments,
    linear_optimal,
    satisfies_lemma_2,
    simulate_sensor,
    true_covariance,
)
from fkgen.errors import DataError

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


def test_an_empty_record_has_an_empty_result():
    none = FaultMoments.from_rates(0.7, 0.9, 0.8, T=0, rows=(0,))
    assert none.persistence.shape == (0,)
    assert satisfies_lemma_2(np.eye(4), np.eye(4)[0], horizon=1) == (True, 0.0)


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
                     R=np.zeros((5, 2, 2)))  # fmt: skip
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


@pytest.mark.parametrize(
    ("signal", "start", "holds"),
    [
        (EQUAL, (0.6, 0.4), True),
        (EQUAL, (0.1, 0.9), True),
        (np.eye(2), (0.3, 0.7), True),
        (ABSORBING, (0.3, 0.7), True),
        (PERIODIC, (1.0, 0.0), True),
        (PERIODIC, (0.5, 0.5), False),
        (ALTERNATING, (0.5, 0.5), False),
        (BURSTS, (1.0, 0.0), False),
        ([[0.6, 0.4], [0.6 + 1e-9, 0.4 - 1e-9]], (0.5, 0.5), False),
    ],
)
def test_lemma_2_is_decided(signal, start, holds):
    a_law = product_law(signal, DRIFTING, initial=(start, (0.5, 0.5)))
    found, difference = satisfies_lemma_2(a_law.kernel, a_law.initial)
    assert found is holds
    assert (difference == pytest.approx(0.0, abs=1e-12)) is holds


def test_the_difference_of_lemma_2_in_example_1_is_that_of_two_lags():
    a_law = product_law(ALTERNATING, RARE)
    # 0.1 after one step, 0.1^2 + 0.9^2 after two.
    assert satisfies_lemma_2(a_law.kernel, a_law.initial)[1] == pytest.approx(0.82 - 0.1)


def test_lemma_2_can_hold_for_gamma_that_is_no_chain():
    # Problem 4: delta decides whether the sensor fails for good; all paths have p11 = 1.
    kernel = [[1, 0, 0, 0], [0, 1, 0, 0], [0.2, 0.1, 0.7, 0], [0, 0.5, 0.2, 0.3]]
    assert satisfies_lemma_2(np.array(kernel), np.full(4, 0.25))[0]


def test_a_violation_that_shows_late_is_found():
    # Three steps through gamma = 1, then out: lags one and two agree for the first samples.
    kernel = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0.5, 0, 0, 0.5]])
    assert not satisfies_lemma_2(kernel, np.array([1.0, 0.0, 0.0, 0.0]))[0]


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


def table(**sensor):
    one = [[1.0]]
    return {
        "name": "a",
        "filter": {"family": "linear_optimal"},
        "model": {"A": [[-0.8]], "C": one, "Q": one, "R": one, "x0": [0.0], "P0": [[0.0]]},
        "faults": {"sensor": {"noise_factor": 10.0, **sensor}},
    }


def test_moments_come_from_a_spec():
    numbers = {"gamma_rate": 0.93, "gamma_persistence": 0.94, "delta_nominal_rate": 0.8}
    stated = FaultMoments.from_spec(fkgen.Spec.from_dict(table(problem="moments", **numbers)), 4)
    np.testing.assert_allclose(stated.gamma, 0.93, rtol=1e-15)
    np.testing.assert_allclose(stated.persistence, [0.93, 0.94, 0.94, 0.94], rtol=1e-15)
    np.testing.assert_allclose(stated.delta, 2.8, rtol=1e-15)
    np.testing.assert_allclose(stated.root_delta, 0.8 + 0.2 * np.sqrt(10.0), rtol=1e-15)
    chained = FaultMoments.from_spec(
        fkgen.Spec.from_dict(table(problem=1, gamma_rate=0.93, delta_nominal_rate=0.8)), 4
    )
    np.testing.assert_allclose(chained.gamma, 0.93, rtol=1e-15)
    np.testing.assert_allclose(chained.persistence, 0.93, rtol=1e-14)
    np.testing.assert_allclose(chained.delta, 2.8, rtol=1e-15)


def test_p11_skips_samples_at_which_no_signal_is_possible():
    moments = FaultMoments.from_law(law(np.eye(4)[[2, 3, 0, 1]], [1, 0, 0, 0]), 5)
    np.testing.assert_array_equal(moments.gamma, [1, 0, 1, 0, 1])
    np.testing.assert_array_equal(moments.persistence, [1, 0, 1, 0, 1])
