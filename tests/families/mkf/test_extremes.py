"""Huge inputs, exact sensors, singular innovation covariances: against sixty digits and pinv."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from plants import MOTOR, SENSED, common, distance, motor, random_model, record, run, spec

#: The voltage sensor of (29) without noise: Om is singular where the input is zero or certain.
EXACT_SENSOR = SENSED | {"R": [[5e-6, 0.0], [0.0, 0.0]]}

#: A prior of the size of the covariance at rest.
SETTLED = SENSED | {"P0": [[1e-4, 0.0], [0.0, 1e-4]]}

RATE = 0.7


def paper(model, u, steps):
    """P[1..steps] by (12) as printed, in sixty digits."""
    A, B, C, D, Q, R, P = (
        mpmath.matrix([[mpmath.mpf(v) for v in row] for row in model[letter]])
        for letter in ("A", "B", "C", "D", "Q", "R", "P0")
    )
    rate = mpmath.mpf(RATE)
    N = mpmath.matrix([[rate * (1 - rate) * mpmath.mpf(u) ** 2]])
    found = []
    for _ in range(steps):
        Om = C * P * C.T + D * N * D.T + R
        L = A * P * C.T + B * N * D.T
        P = A * P * A.T + Q + B * N * B.T - L * Om**-1 * L.T
        found.append([[float(P[i, j]) for j in range(A.rows)] for i in range(A.rows)])
    return np.array(found)


@pytest.mark.parametrize("u", [1.0, 1e6, 1e9])
def test_huge_inputs_cost_no_digits_of_the_covariance(u):
    steps = 20
    with mpmath.workdps(60):
        exact = paper(SETTLED, u, steps)
    result = run(motor(model=SETTLED), np.zeros((steps, 2)), np.full((steps, 1), u))
    for k in range(steps):
        # Some hundred roundings of 1e-16; nine digits are asked for.
        assert distance(result.predicted_covariance[k], exact[k]) < 1e-13


@pytest.mark.parametrize(("u", "lost"), [(1e6, 1e-5), (1e9, 0.99)])
def test_the_printed_form_would_lose_those_digits(u, lost):
    # In double, (12) subtracts numbers that are s u^2 / W times their difference.
    with mpmath.workdps(60):
        exact = paper(SETTLED, u, 1)[0]
    A, B, C, D, Q, R, P = (np.array(SETTLED[m]) for m in ("A", "B", "C", "D", "Q", "R", "P0"))
    N = RATE * (1.0 - RATE) * np.array([[u**2]])
    L = A @ P @ C.T + B @ N @ D.T
    Om = C @ P @ C.T + D @ N @ D.T + R
    printed = A @ P @ A.T + Q + B @ N @ B.T - L @ np.linalg.inv(Om) @ L.T
    assert distance(printed, exact) > lost


def predictor(model, rates, y, u):
    """The one-step predictor in whole matrices, with a pseudo-inverse.

    The rank is decided on Om with unit diagonal. Returns xp[1..T], P[1..T], K, Om.
    """
    A, B, C, Q, R, P = (np.array(model[letter]) for letter in ("A", "B", "C", "Q", "R", "P0"))
    D, x = np.array(model["D"]), np.array(model["x0"])
    rows = []
    for k, xi in enumerate(rates):
        N = xi * (1.0 - xi) * np.outer(u[k], u[k])
        Om = C @ P @ C.T + D @ N @ D.T + R
        scale = np.sqrt(np.where(np.diag(Om) > 0.0, np.diag(Om), 1.0))
        inverse = np.linalg.pinv(Om / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
        K = (A @ P @ C.T + B @ N @ D.T) @ inverse
        nu = y[k] - C @ x - D @ (xi * u[k])
        x = A @ x + B @ (xi * u[k]) + K @ nu
        F, G = A - K @ C, B - K @ D
        P = F @ P @ F.T + G @ N @ G.T + Q + K @ R @ K.T
        rows.append((x, P, K, Om))
    return [np.array(column) for column in zip(*rows, strict=True)]


def assert_predictor(plant, model, rates, y, u, params=None):
    result = run(plant, y, u, params)
    state, covariance, gain, variance = predictor(model, rates, y, u)
    assert (result.status == 0).all()
    # A pseudo-inverse and matrices of condition 1e5.
    for port, expected in {
        "predicted_state": state,
        "predicted_covariance": covariance,
        "gain": gain,
        "innovation_covariance": variance,
    }.items():
        assert distance(result[port], expected) < 1e-9, port


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("q", [1, 2])
def test_the_predictor_of_the_specification_is_what_the_filter_computes(q, direct):
    model = random_model(51 + q, 3, 2, q, direct=direct, correlated=True)
    plant = spec(model, family="mkf", actuator=common(RATE))
    model = {"D": np.zeros((2, q)).tolist()} | model
    y, u = record(plant, 20)
    assert_predictor(plant, model, [RATE] * 20, y, u)


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("u", [0.0, 1.0, 1e6])
def test_an_exact_voltage_sensor_is_filtered_by_the_scaled_pseudo_inverse(rate, u):
    plant = spec(EXACT_SENSOR, family="mkf", parameters={"xi": 0.5}, actuator=common("xi"))
    T = 15
    inputs = np.full((T, 1), u)
    rng = np.random.default_rng(6)
    works = (rng.random((T, 1)) < rate).astype(float)
    y = np.hstack([0.01 * rng.standard_normal((T, 1)), works * u])
    assert_predictor(plant, EXACT_SENSOR, [rate] * T, y, inputs, {"xi": rate})


def test_an_input_that_comes_and_goes_changes_the_rank_from_sample_to_sample():
    plant = spec(EXACT_SENSOR, family="mkf", actuator=common(0.5))
    u = np.array([0.0, 1e6, 0.0, 1.0, 1e-3, 0.0, 1e6, 1e6, 0.0, 1.0])[:, None]
    works = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0])[:, None]
    y = np.hstack([0.01 * np.random.default_rng(7).standard_normal((10, 1)), works * u])
    assert_predictor(plant, EXACT_SENSOR, [0.5] * 10, y, u)


def test_an_input_of_a_million_does_not_drop_the_row_of_the_speed():
    plant = spec(EXACT_SENSOR, family="mkf", actuator=common(0.5))
    result = run(plant, [[0.02, 1e6]], [[1e6]])
    variance = result.innovation_covariance[0]
    # The voltage is 1e11 times as uncertain as the speed, in other units.
    assert variance[1, 1] / variance[0, 0] > 1e11
    P0 = np.array(MOTOR["P0"])
    # The gain of the speed alone: the rows are independent.
    np.testing.assert_allclose(
        result.filtered_gain[0, :, 0], P0[:, 1] / (P0[1, 1] + 5e-6), rtol=1e-12
    )


def test_an_exact_measurement_leaves_no_variance_and_is_reproduced():
    model = random_model(54, 3, 1) | {"C": [[1.0, 0.0, 0.0]], "R": [[0.0]]}
    plant = spec(model, family="kf")
    y, _ = record(plant, 20)
    result = run(plant, y)
    # Rounding of a number of order one.
    np.testing.assert_allclose(result.filtered_state[:, 0], y[:, 0], rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(result.filtered_covariance[:, 0, 0], 0.0, atol=1e-15)
    assert (result.filtered_covariance[:, 0, 0] >= 0.0).all()


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_an_exact_measurement_that_comes_twice_counts_once(scalar):
    model = random_model(55, 3, 2, correlated=True)
    row = [1.0, 0.5, -0.3]
    once = model | {"C": [row], "R": [[0.0]]}
    twice = model | {"C": [row, row], "R": [[0.0, 0.0], [0.0, 0.0]]}
    one, two = (spec(m, family="kf", code={"scalar": scalar}) for m in (once, twice))
    y, _ = record(one, 20)
    a, b = run(one, y), run(two, np.hstack([y, y]))
    assert (b.status == 0).all()
    # The second row is left out; the first takes the same path.
    for port in ("filtered_state", "filtered_covariance", "nis"):
        assert distance(b[port], a[port]) < (1e-12 if scalar == "double" else 1e-4)


def test_noise_common_to_two_sensors_leaves_their_difference_exact():
    model = random_model(56, 2, 2)
    model |= {"C": [[1.0, 0.0], [0.0, 1.0]], "R": [[0.3, 0.3], [0.3, 0.3]]}
    plant = spec(model, family="kf")
    y, _ = record(plant, 15)
    result = run(plant, y)
    difference = result.filtered_state @ [1.0, -1.0]
    # Rounding of numbers of order one.
    np.testing.assert_allclose(difference, y @ [1.0, -1.0], rtol=0.0, atol=1e-12)
