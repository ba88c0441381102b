"""The batch estimate under sensor faults against enumeration, simulation and special cases."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

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
    with_modes,
)

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse, joint_distribution
from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.exact.uncertain import batch_uncertain, joint_moments, joint_uncertain
from fkgen.oracle.plants.sensor import simulate_sensor

PORTS = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation_covariance",
    "nis",
    "log_likelihood",
)
RARE = np.array([[0.8, 0.2], [0.8, 0.2]])


def stacked(joint):
    mean = np.concatenate([joint.state_mean.ravel(), joint.measurement_mean.ravel()])
    size = joint.state_root.shape[-1]
    root = np.vstack([joint.state_root.reshape(-1, size), joint.measurement_root.reshape(-1, size)])
    return mean, root @ root.T


def enumerated(system, a_law, u):
    """Mean and covariance of all states and measurements: a mixture over 4^T histories."""
    first, second = 0.0, 0.0
    for modes in product(range(4), repeat=system.length):
        weight = a_law.initial[modes[0]]
        for i, j in pairwise(modes):
            weight *= a_law.kernel[i, j]
        mean, covariance = stacked(joint_distribution(with_modes(system, a_law, modes), u))
        first += weight * mean
        second += weight * (covariance + np.outer(mean, mean))
    return first, second - np.outer(first, first)


def scale(covariance):
    return np.abs(covariance).max()


@pytest.mark.parametrize("rows", [(0,), (1,), (0, 1)])
@pytest.mark.parametrize("T", [1, 2, 4])
def test_joint_moments_equal_an_enumeration_of_all_histories(rows, T):
    rng = np.random.default_rng(10 * T + len(rows))
    system, a_law = plant(rng, T=T), any_law(rng, rows=rows)
    u = inputs(rng, system)
    mean, covariance = enumerated(system, a_law, u)
    moments = FaultMoments.from_law(a_law, T)
    # 256 histories are summed, and means subtracted: some hundred units of round-off.
    atol = 1e-12 * scale(covariance)
    for found in (
        joint_moments(system, moments, u),
        stacked(joint_uncertain(system, moments, u)),
    ):
        np.testing.assert_allclose(found[0], mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found[1], covariance, rtol=0, atol=atol)


@pytest.mark.parametrize("gaps", [False, True])
def test_the_estimates_are_the_projection_on_the_enumerated_moments(gaps):
    rng = np.random.default_rng(2)
    T, n, p = 4, 2, 2
    system, a_law = plant(rng, T=T), any_law(rng, rows=(1,))
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, a_law, u, rng)
    if gaps:
        y[1, 0] = y[2] = np.nan
    result = batch_uncertain(system, FaultMoments.from_law(a_law, T), y, u)
    mean, covariance = enumerated(system, a_law, u)
    split = (T + 1) * n
    for k in range(T):
        known = split + np.flatnonzero(np.isfinite(y[: k + 1]))
        gain = covariance[:, known] @ np.linalg.inv(covariance[np.ix_(known, known)])
        estimate = mean + gain @ (y.ravel()[known - split] - mean[known])
        error = covariance - gain @ covariance[known]
        for ahead, name in enumerate(["filtered", "predicted"]):
            at = slice((k + ahead) * n, (k + ahead + 1) * n)
            # Condition numbers of some hundred.
            np.testing.assert_allclose(
                getattr(result, f"{name}_state")[k], estimate[at], rtol=1e-10, atol=1e-10
            )
            np.testing.assert_allclose(
                getattr(result, f"{name}_covariance")[k], error[at, at], rtol=1e-10, atol=1e-10
            )
        if k + 1 < T:
            at = slice(split + (k + 1) * p, split + (k + 2) * p)
            np.testing.assert_allclose(
                result.innovation[k + 1], y[k + 1] - estimate[at], rtol=1e-10, atol=1e-10
            )
            np.testing.assert_allclose(
                result.innovation_covariance[k + 1], error[at, at], rtol=1e-10, atol=1e-10
            )


def test_joint_moments_equal_those_of_simulated_records():
    rng = np.random.default_rng(3)
    T, runs = 4, 4000
    system, a_law = plant(rng, T=T, n=1, p=2), any_law(rng, rows=(0,), factor=4.0)
    u = inputs(rng, system)
    mean, covariance = joint_moments(system, FaultMoments.from_law(a_law, T), u)
    y = np.array([simulate_sensor(system, a_law, u, rng)[0].ravel() for _ in range(runs)])
    centred = y - mean[T + 1 :]
    squares = centred[:, :, None] * centred[:, None, :]
    for found, expected in ((centred, 0.0), (squares, covariance[T + 1 :, T + 1 :])):
        # 44 different numbers: one beyond 4.5 standard errors turns up once in 3000 seeds.
        error = found.std(axis=0) / np.sqrt(runs)
        assert (np.abs(found.mean(axis=0) - expected) < 4.5 * error).all()
    # That sees the part of the correlation in time that a wrong law would bring.
    other = FaultMoments.from_law(replace(a_law, kernel=np.tile(a_law.initial, (4, 1))), T)
    wrong = joint_moments(system, other, u)[1][T + 1 :, T + 1 :]
    error = squares.std(axis=0) / np.sqrt(runs)
    assert (np.abs(squares.mean(axis=0) - wrong) > 6.0 * error).any()


def test_a_healthy_sensor_is_the_batch_without_faults():
    rng = np.random.default_rng(4)
    system = plant(rng, T=6)
    u, y = inputs(rng, system), rng.standard_normal((6, 2))
    y[3, 1] = np.nan
    healthy = FaultMoments.from_law(law(np.eye(4), np.eye(4)[0]), 6)
    close(batch_uncertain(system, healthy, y, u), batch_lmmse(system, y, u), PORTS)


def test_noise_alone_is_the_batch_with_the_mean_noise():
    rng = np.random.default_rng(5)
    system = plant(rng, T=6)
    u, y = inputs(rng, system), rng.standard_normal((6, 2))
    noisy = product_law(
        np.eye(2), [[0.7, 0.3], [0.4, 0.6]], initial=((1, 0), (0.9, 0.1)), rows=(0, 1)
    )
    moments = FaultMoments.from_law(noisy, 6)
    assert np.ptp(moments.delta) > 0.1
    expected = batch_lmmse(replace(system, R=moments.delta[:, None, None] * system.R), y, u)
    close(batch_uncertain(system, moments, y, u), expected, PORTS)


def test_a_sensor_that_never_works_leaves_the_prior():
    rng = np.random.default_rng(6)
    system = plant(rng, T=4)
    u, y = inputs(rng, system), rng.standard_normal((4, 2))
    dead = FaultMoments.from_law(law(np.eye(4), np.eye(4)[2], rows=(0, 1)), 4)
    without = batch_lmmse(system, np.full_like(y, np.nan), u)
    close(batch_uncertain(system, dead, y, u), without, PORTS[:4])


def test_known_modes_are_the_batch_of_the_plant_that_they_make():
    rng = np.random.default_rng(7)
    system, turn = plant(rng, T=6), np.eye(4)[[2, 0, 3, 1]]
    u, y = inputs(rng, system), rng.standard_normal((6, 2))
    a_law = law(turn, np.eye(4)[0])
    modes = [0, 2, 3, 1, 0, 2]
    expected = batch_lmmse(with_modes(system, a_law, modes), y, u)
    close(batch_uncertain(system, FaultMoments.from_law(a_law, 6), y, u), expected, PORTS)


def test_a_constant_unknown_gamma_makes_the_measurements_dependent():
    T = 3
    moments = FaultMoments.from_law(product_law(np.eye(2), RARE, initial=((0.6, 0.4), RARE[0])), T)
    np.testing.assert_allclose(moments.gamma_pair, 0.6, rtol=1e-15)
    np.testing.assert_allclose(moments.persistence, [0.6, 1.0, 1.0], rtol=1e-15)


@pytest.mark.parametrize(
    ("signal", "error"),
    [(ALTERNATING, 1.8552094753), (np.array([[0.9, 0.1], [0.1, 0.9]]), 2.0530840567)],
)
def test_the_error_settles_at_the_printed_value(signal, error):
    T = 80
    moments = FaultMoments.from_law(product_law(signal, RARE), T)
    result = batch_uncertain(example(T), moments, np.zeros((T, 1)), None)
    # Ten printed digits; what is left of the start is below 0.8^160 = 3e-16.
    assert result.filtered_covariance[-1, 0, 0] == pytest.approx(error, abs=6e-11)


def test_an_exact_measurement_given_twice_counts_once():
    rng = np.random.default_rng(8)
    one = replace(plant(rng, T=5, p=1), R=np.zeros((5, 1, 1)))
    twofold = {name: np.repeat(getattr(one, name), 2, axis=1) for name in "CDd"}
    two = replace(one, **twofold, R=np.zeros((5, 2, 2)))
    u, y = inputs(rng, one), rng.standard_normal((5, 1))
    once, twice = (
        batch_uncertain(
            system, FaultMoments.from_law(product_law(STICKY, RARE, rows=rows), 5), record, u
        )
        for system, rows, record in ((one, (0,), y), (two, (0, 1), np.repeat(y, 2, axis=1)))
    )
    close(twice, once, ("filtered_state", "filtered_covariance", "predicted_covariance", "nis"))


@pytest.mark.parametrize("name", ["gamma", "gamma_pair", "delta", "root_delta"])
def test_an_error_of_a_thousandth_is_seen(name):
    rng = np.random.default_rng(9)
    system, a_law = plant(rng, T=5), any_law(rng, rows=(1,))
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, a_law, u, rng)
    moments = FaultMoments.from_law(a_law, 5)
    right = batch_uncertain(system, moments, y, u)
    wrong = replace(moments, **{name: 1.001 * getattr(moments, name)})
    moved = batch_uncertain(system, wrong, y, u).filtered_state - right.filtered_state
    # A thousandth of one ingredient moves some estimate by more than a millionth.
    assert np.abs(moved).max() > 1e-6


def test_moments_that_no_process_has_are_refused():
    # p11 = 0.1 with E[gamma] = 1/2 at all lags: the sample mean would have a negative variance.
    moments = FaultMoments.from_rates(0.5, 0.1, 0.8, T=8, rows=(0,))
    with pytest.raises(DataError, match="moments of gamma"):
        batch_uncertain(example(8), moments, np.zeros((8, 1)), None)


def test_moments_of_another_number_of_samples_are_refused():
    moments = FaultMoments.from_rates(0.5, 0.5, 1.0, T=3, rows=(0,))
    with pytest.raises(DataError, match="3 samples"):
        batch_uncertain(example(4), moments, np.zeros((4, 1)), None)


@pytest.mark.parametrize("change", [{"rate": 0.5}, {"fault_covariance": 0.2}])
def test_faulty_actuators_are_refused(change):
    system = plant(np.random.default_rng(11), T=3)
    failing = replace(
        system,
        **{name: np.full_like(getattr(system, name), value) for name, value in change.items()},
    )
    moments = FaultMoments.from_rates(0.5, 0.5, 1.0, T=3, rows=(0,))
    with pytest.raises(DataError, match="actuators"):
        joint_moments(failing, moments, np.zeros((3, 1)))
