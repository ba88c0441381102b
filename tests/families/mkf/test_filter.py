"""The compiled modified Kalman filter: best linear estimates, optimal gains, reductions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import (
    MOTOR,
    SENSED,
    assert_agree,
    common,
    distance,
    independent,
    motor,
    random_model,
    record,
    run,
    spec,
    system_of,
)

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.textbook.riccati import constant_input_noise, stationary_prediction_by_control

STATES = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
PORTS = (*STATES, "innovation", "innovation_covariance", "nis", "log_likelihood")

#: Two double computations of well-conditioned problems: some hundred roundings of 1e-16.
EXACT = 1e-9

#: The same arithmetic with a few terms in another order.
ROUNDING = 1e-12

RATES = [0.7, 0.4]
CORRELATED = {"success_rate": RATES, "covariance": [[0.21, 0.1], [0.1, 0.24]]}
FAULTS = {
    "common": common(0.7),
    "independent": independent(RATES),
    "correlated": CORRELATED,
    "one_certain": independent([1.0, 0.4]),
}


def faulty(seed, n, p, q, actuator, **options):
    model = random_model(seed, n, p, q, **options)
    return spec(model, family="mkf", actuator=actuator)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("faults", list(FAULTS))
def test_two_actuators_agree_with_the_joint_distribution(faults, direct, missing):
    plant = faulty(5, 3, 2, 2, FAULTS[faults], direct=direct, correlated=True)
    y, u = record(plant, 9, missing=missing)
    assert_agree(run(plant, y, u), batch_lmmse(system_of(plant, 9), y, u), PORTS, EXACT)


@pytest.mark.parametrize(("n", "p", "q"), [(1, 1, 1), (4, 2, 3), (6, 3, 1)])
def test_larger_plants_agree_with_the_joint_distribution(n, p, q):
    plant = faulty(n, n, p, q, independent(0.6), direct=True)
    y, u = record(plant, 8, missing=0.2)
    assert_agree(run(plant, y, u), batch_lmmse(system_of(plant, 8), y, u), PORTS, EXACT)


@pytest.mark.parametrize("direct", [False, True])
def test_rates_that_change_in_every_sample_agree_with_the_joint_distribution(direct):
    model = random_model(11, 3, 2, 2, direct=direct)
    parameters = {"xi": 0.5, "eta": 0.8}
    plant = spec(model, family="mkf", parameters=parameters, actuator=independent(["xi", "xi*eta"]))
    T = 9
    params = {"xi": np.linspace(0.0, 1.0, T), "eta": np.linspace(0.9, 0.1, T)}
    y, u = record(plant, T, params=params, missing=0.2)
    expected = batch_lmmse(system_of(plant, T, params), y, u)
    assert_agree(run(plant, y, u, params), expected, PORTS, EXACT)


@pytest.mark.parametrize("direct", [False, True])
def test_a_correlation_that_changes_with_a_parameter_agrees(direct):
    model = random_model(12, 2, 2, 2, direct=direct)
    actuator = {
        "success_rate": ["xi", 0.5],
        "covariance": [["xi*(1 - xi)", "0.1*xi*(1 - xi)"], ["0.1*xi*(1 - xi)", 0.25]],
    }
    plant = spec(model, family="mkf", parameters={"xi": 0.5}, actuator=actuator)
    params = {"xi": np.linspace(0.2, 0.9, 8)}
    y, u = record(plant, 8, params=params)
    expected = batch_lmmse(system_of(plant, 8, params), y, u)
    assert_agree(run(plant, y, u, params), expected, PORTS, EXACT)


@pytest.mark.parametrize("faults", list(FAULTS))
def test_the_covariance_comes_to_rest_at_the_riccati_solution(faults):
    plant = faulty(6, 3, 2, 2, FAULTS[faults], direct=True, correlated=True)
    u = np.array([0.7, -1.3])
    result = run(plant, np.zeros((400, 2)), np.tile(u, (400, 1)))
    system = system_of(plant, 1)
    Q, R, S = constant_input_noise(system, u)
    P, radius = stationary_prediction_by_control(system.A[0], system.C[0], Q, R, S)
    assert radius < 0.95  # 400 samples leave 1e-17 of the start
    # The Riccati solver orders an eigenvalue problem of size 2n: it keeps some 12 digits.
    assert distance(result.predicted_covariance[-1], P) < EXACT
    K = (system.A[0] @ P @ system.C[0].T + S) @ np.linalg.inv(system.C[0] @ P @ system.C[0].T + R)
    assert distance(result.gain[-1], K) < EXACT


def test_rate_one_is_the_kalman_filter():
    model = random_model(2, 3, 2, 2, direct=True)
    certain = spec(model, family="mkf", actuator=common(1.0))
    plain = spec(model, family="kf")
    y, u = record(plain, 12, missing=0.2)
    assert_agree(run(certain, y, u), run(plain, y, u), PORTS, ROUNDING)


def test_rate_zero_is_the_kalman_filter_without_input():
    model = random_model(2, 3, 2, 2, direct=True)
    never = spec(model, family="mkf", actuator=common(0.0))
    plain = spec(model, family="kf")
    y, u = record(plain, 12, missing=0.2)
    assert_agree(run(never, y, u), run(plain, y, 0.0 * u), PORTS, ROUNDING)


@pytest.mark.parametrize(("rate", "scale"), [(0.0, 0.0), (1.0, 1.0)])
def test_a_run_time_rate_of_zero_or_one_is_the_kalman_filter_too(rate, scale):
    model = random_model(2, 2, 2, 1, direct=True)
    given = spec(model, family="mkf", parameters={"xi": 0.5}, actuator=common("xi"))
    plain = spec(model, family="kf")
    y, u = record(plain, 12, missing=0.2)
    assert_agree(run(given, y, u, {"xi": rate}), run(plain, y, scale * u), PORTS, ROUNDING)


def test_one_actuator_fails_commonly_or_independently_alike():
    model = random_model(3, 3, 2, 1, direct=True)
    one, other = (spec(model, family="mkf", actuator=f(0.6)) for f in (common, independent))
    assert one == other


def test_a_covariance_of_equal_entries_is_common_and_a_diagonal_one_independent():
    model = random_model(4, 3, 2, 2, direct=True)
    s = 0.7 * (1.0 - 0.7)
    twins = {
        "common": (common(0.7), [[s, s], [s, s]]),
        "independent": (independent(0.7), [[s, 0.0], [0.0, s]]),
    }
    y, u = record(spec(model, family="mkf", actuator=common(0.7)), 10)
    for named, entries in twins.values():
        stated = {"success_rate": [0.7, 0.7], "covariance": entries}
        a, b = (run(spec(model, family="mkf", actuator=each), y, u) for each in (named, stated))
        assert_agree(a, b, PORTS, ROUNDING)


def test_common_and_independent_faults_of_two_actuators_differ():
    model = random_model(4, 3, 2, 2, direct=True)
    a, b = (spec(model, family="mkf", actuator=f(0.7)) for f in (common, independent))
    y, u = record(a, 10)
    # The cross terms of N are of the size of N.
    assert distance(run(a, y, u).predicted_covariance, run(b, y, u).predicted_covariance) > 1e-3


@pytest.mark.parametrize("direct", [False, True])
def test_rates_xi_and_one_minus_xi_have_one_covariance_and_two_means(direct):
    model = random_model(9, 3, 2, 1, direct=direct)
    a, b = (spec(model, family="mkf", actuator=common(rate)) for rate in (0.25, 0.75))
    y, u = record(a, 10)
    one, other = run(a, y, u), run(b, y, u)
    # 0.25 and 0.75 are exact, so xi (1 - xi) is the same number.
    np.testing.assert_array_equal(one.predicted_covariance, other.predicted_covariance)
    np.testing.assert_array_equal(one.gain, other.gain)
    assert distance(one.predicted_state, other.predicted_state) > 1e-3


@pytest.mark.parametrize("direct", [False, True])
def test_without_input_the_covariance_does_not_depend_on_the_rate(direct):
    model = random_model(9, 3, 2, 2, direct=direct)
    y, u = np.ones((8, 2)), np.zeros((8, 2))
    results = [run(spec(model, family="mkf", actuator=common(r)), y, u) for r in (0.2, 0.5)]
    np.testing.assert_array_equal(*(r.predicted_covariance for r in results))
    np.testing.assert_array_equal(*(r.predicted_state for r in results))


def test_without_feedthrough_the_gain_is_A_times_the_filter_gain():
    plant = faulty(13, 4, 2, 2, independent(0.7))
    y, u = record(plant, 8, missing=0.2)
    result = run(plant, y, u)
    A = plant.model.A.values()
    # One product with A.
    np.testing.assert_allclose(result.gain, A @ result.filtered_gain, rtol=1e-13, atol=1e-15)


def test_with_feedthrough_the_gain_gets_its_share_of_B():
    plant = faulty(14, 3, 2, 1, common(0.7), direct=True)
    y, u = record(plant, 8)
    result, m = run(plant, y, u), plant.model
    N = 0.21 * u[:, :, None] * u[:, None, :]
    extra = m.B.values() @ N @ m.D.values().T @ np.linalg.inv(result.innovation_covariance)
    found = result.gain - m.A.values() @ result.filtered_gain
    assert distance(found, extra) < EXACT


@pytest.mark.parametrize("faults", list(FAULTS))
def test_any_other_gain_costs_d_om_d_more(faults):
    plant = faulty(15, 3, 2, 2, FAULTS[faults], direct=True, correlated=True)
    T = 6
    y, u = record(plant, T)
    result, system = run(plant, y, u), system_of(plant, T)
    rng = np.random.default_rng(1)
    P = np.concatenate([system.P0[None], result.predicted_covariance[:-1]])
    for k in range(T):
        Q, R, S = constant_input_noise(system, u[k], k)
        A, C = system.A[k], system.C[k]
        d = rng.standard_normal((3, 2))
        other = result.gain[k] + d
        F = A - other @ C
        cross = other @ S.T
        # (9) for any gain, written out by hand.
        cost = F @ P[k] @ F.T + Q - cross - cross.T + other @ R @ other.T
        excess = cost - result.predicted_covariance[k]
        assert distance(excess, d @ result.innovation_covariance[k] @ d.T) < EXACT


@pytest.mark.parametrize("model", [MOTOR, SENSED], ids=["speed", "speed_and_voltage"])
def test_the_scale_of_the_input_is_a_matter_of_units(model):
    c = 1e3
    scaled = model | {key: (np.array(model[key]) / c).tolist() for key in {"B", "D"} & model.keys()}
    y, u = record(motor(model=model), 30, missing=0.1)
    a, b = run(motor(model=model), y, u), run(motor(model=scaled), y, c * u)
    # B / c rounds once.
    assert_agree(a, b, PORTS, ROUNDING)
    assert distance(a.gain, b.gain) < ROUNDING


def test_the_scale_of_a_measurement_is_a_matter_of_units():
    scale = np.array([1e3, 1e-4])
    changed = {
        "C": (scale[:, None] * np.array(SENSED["C"])).tolist(),
        "D": (scale[:, None] * np.array(SENSED["D"])).tolist(),
        "R": (np.outer(scale, scale) * np.array(SENSED["R"])).tolist(),
    }
    one, other = motor(model=SENSED), motor(model=SENSED | changed)
    y, u = record(one, 30, missing=0.1)
    a, b = run(one, y, u), run(other, scale * y, u)
    assert_agree(a, b, (*STATES, "nis"), ROUNDING)
    present = ~np.isnan(y)
    shift = -(present * np.log(scale)).sum(axis=1)
    # log_likelihood is of order 10.
    np.testing.assert_allclose(b.log_likelihood - a.log_likelihood, shift, atol=1e-11)


def test_a_fault_covariance_off_by_a_thousandth_is_seen():
    plant = faulty(5, 3, 2, 2, FAULTS["common"], direct=True)
    y, u = record(plant, 9)
    system = system_of(plant, 9)
    wrong = batch_lmmse(replace(system, fault_covariance=1.001 * system.fault_covariance), y, u)
    # A thousandth of one covariance is a million times the tolerance of these tests.
    assert distance(run(plant, y, u).predicted_covariance, wrong.predicted_covariance) > 1e-6
