"""The compiled filter that is told gamma and delta of every sample: a Kalman filter, no more."""

from __future__ import annotations

import numpy as np
import pytest
from plants import assert_agree, distance, generated, random_model, record, run, spec
from sensor_specs import (
    EXACT,
    PROBLEMS,
    SWITCHING,
    TURN,
    chain,
    plane,
    seen,
    sensed,
    shaken,
    varying,
)

import fkgen
from fkgen.backend.execute import Machine
from fkgen.errors import StepRefused
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw, gamma_delta
from fkgen.symbolic.interface import Status

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
MODEL = random_model(61, 2, 3, 1, direct=True, correlated=True)
INF, NAN = np.inf, np.nan


def genie(model, rows=None, **options):
    law = {} if rows is None else {"rows": rows}
    return sensed(model, law, family="genie", **options)


def told(T, *, factor=10.0, seed=2):
    """Indicators drawn at random, in any order."""
    rng = np.random.default_rng(seed)
    return {
        "gamma": rng.integers(0, 2, T).astype(float),
        "delta": np.where(rng.random(T) < 0.5, 1.0, factor),
    }


def kalman(system, faulty, params, y, u):
    """Yield x(k|k), P(k|k) of the loop that everyone writes, with G C, G D and T R T."""
    x, P = system.x0, system.P0
    for k in range(len(y)):
        G, scale = np.ones((2, system.ny))
        G[faulty], scale[faulty] = params["gamma"][k], np.sqrt(params["delta"][k])
        seen_rows = np.isfinite(y[k])
        H = (G[:, None] * system.C[k])[seen_rows]
        R = (scale[:, None] * system.R[k] * scale)[np.ix_(seen_rows, seen_rows)]
        nu = (y[k] - G * (system.C[k] @ x + system.D[k] @ u[k]))[seen_rows]
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        x, P = x + K @ nu, P - K @ H @ P
        yield x, P
        x = system.A[k] @ x + system.B[k] @ u[k]
        P = system.A[k] @ P @ system.A[k].T + system.Q[k]


@pytest.mark.parametrize("rows", [[0], [1, 2], [0, 1, 2]])
def test_the_filter_is_the_loop_that_everyone_writes(rows):
    plant, T = genie(MODEL, rows), 25
    params = told(T)
    y, u = record(plant, T, missing=0.2)
    result = run(plant, y, u, params)
    system = LinearSystem.from_spec(plant, T)
    for k, (x, P) in enumerate(kalman(system, rows, params, y, u)):
        assert distance(result.filtered_state[k], x) < EXACT
        assert distance(result.filtered_covariance[k], P) < EXACT


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_a_plant_that_changes_in_every_sample_is_followed(scalar):
    plant, T = varying({"rows": [1]}, family="genie", code={"scalar": scalar}), 10
    params = shaken(T) | told(T)
    y, u = record(plant, T, params=params, missing=0.2)
    system = LinearSystem.from_spec(plant, T, params)
    signal, noise = np.ones((2, T, 2))
    signal[:, 1], noise[:, 1] = params["gamma"], np.sqrt(params["delta"])
    known = LinearSystem(
        A=system.A, B=system.B, C=signal[:, :, None] * system.C, D=signal[:, :, None] * system.D,
        Q=system.Q, R=noise[:, :, None] * system.R * noise[:, None, :], x0=system.x0, P0=system.P0,
        rate=system.rate, fault_covariance=system.fault_covariance,
    )  # fmt: skip
    # Some hundred roundings of 6e-8 in float, as for kf.
    tolerance = EXACT if scalar == "double" else 1e-4
    assert_agree(run(plant, y, u, params), batch_lmmse(known, y, u), PORTS, tolerance)


def test_by_default_the_sensors_are_good_and_the_filter_is_the_kalman_filter():
    plant, healthy = genie(MODEL), spec(MODEL, family="kf")
    assert plant.defaults == {"gamma": 1.0, "delta": 1.0}
    y, u = record(plant, 30, missing=0.2)
    # Products with one are exact; the terms of a sum may come in another order.
    assert_agree(run(plant, y, u), run(healthy, y, u), PORTS, 1e-13)


def test_without_a_signal_nothing_is_learnt():
    plant = genie(plane())
    y, u = record(plant, 6)
    result = run(plant, 1e6 * y, u, {"gamma": np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])})
    for k in (1, 2, 4):
        np.testing.assert_array_equal(result.filtered_state[k], result.predicted_state[k - 1])
        np.testing.assert_array_equal(
            result.filtered_covariance[k], result.predicted_covariance[k - 1]
        )
        assert result.status[k] == 0
        assert result.log_likelihood[k] < -1e9  # but the noise has been seen


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("gamma", v) for v in (0.5, -1.0, 2.0, 1.0 + 1e-6, 1e-6, -1e-6, 1e30)),
        *(("delta", v) for v in (0.0, 0.5, -1.0, 5.0, 9.9, 10.1, 100.0, -1e30)),
    ],
)
def test_an_indicator_with_another_value_is_refused_and_nothing_changes(name, value, scalar):
    found = fkgen.build(genie(plane(), code={"scalar": scalar}))
    for _ in range(3):
        found.step([0.1, -0.2])
    before = found.snapshot()
    for y in ([0.1, 0.2], [NAN, NAN]):
        with pytest.raises(StepRefused) as caught:
            found.step(y, None, {name: value})
        assert caught.value.status == -4
        assert caught.value.name == "PLANT_PARAMETER_OUT_OF_RANGE"
        assert found.snapshot() == before
    for gamma in (0.0, 1.0):
        for delta in (1.0, 10.0):
            assert found.step([0.1, 0.2], None, {"gamma": gamma, "delta": delta}).status == 0


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("name", ["gamma", "delta"])
def test_the_program_refuses_indicators_that_are_no_numbers_too(name, value):
    machine = Machine(generated(genie(plane())).program)  # Python would not let them through
    given = {"gamma": 1.0, "delta": 1.0} | {name: value}
    assert machine.step([], [0.1, 0.2], given) is Status.PARAMETER_OUT_OF_RANGE


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("factor", [1.0 / 3.0, 1e-9, 1e12])
def test_every_factor_is_a_legal_delta_in_the_type_of_the_filter(factor, scalar):
    model = {"A": [[0.9]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "x0": [0.0], "P0": [[1.0]]}
    plant = sensed(model, {"noise_factor": factor}, family="genie", code={"scalar": scalar})
    params = {"delta": np.array([1.0, factor, factor, 1.0])}
    assert (run(plant, np.ones((4, 1)), None, params).status == 0).all()


def test_a_refused_sample_leaves_the_rest_of_a_record_as_if_it_were_not_there():
    plant, T = genie(plane()), 12
    params, (y, u) = told(T), record(plant, T)
    broken = {**params, "gamma": params["gamma"].copy()}
    broken["gamma"][5] = 0.3
    with_it = run(plant, y, u, broken)
    fewer = {name: np.delete(values, 5) for name, values in params.items()}
    without = run(plant, np.delete(y, 5, axis=0), np.delete(u, 5, axis=0), fewer)
    np.testing.assert_array_equal(with_it.status, np.where(np.arange(T) == 5, -4, 0))
    for port in without.ports:
        np.testing.assert_array_equal(np.delete(with_it[port], 5, axis=0), without[port])


@pytest.mark.parametrize("which", ["imm", "one_step"])
@pytest.mark.parametrize("start", [0, 1])
def test_a_filter_that_knows_how_modes_turn_is_the_genie(start, which):
    law = chain(TURN, np.eye(4)[start], rows=[1])
    plant = sensed(plane(), law, **SWITCHING[which])
    y, u, modes = seen(plant, 20, missing=0.2)
    gamma, delta = gamma_delta(SensorLaw.from_spec(plant), modes)
    expected = run(genie(plane(), [1]), y, u, {"gamma": gamma, "delta": delta})
    # One of four weights is one, the others zero: sums of zeros and another order.
    assert_agree(run(plant, y, u), expected, PORTS, 1e-11)


def test_who_is_told_the_faults_is_nearer_than_who_has_to_find_them_out():
    law = PROBLEMS["3"] | {"rows": [0]}
    weighs, knows = sensed(plane(), law), genie(plane(), [0])
    y, u, modes = seen(weighs, 2000)
    gamma, delta = gamma_delta(SensorLaw.from_spec(weighs), modes)
    best = run(knows, y, u, {"gamma": gamma, "delta": delta})
    error = run(weighs, y, u).filtered_state - best.filtered_state
    ratio = best.filtered_covariance.trace(axis1=1, axis2=2).mean()
    # What is lost is real, and the mean covariance of the filter that weighs says so.
    lost = run(weighs, y, u).filtered_covariance.trace(axis1=1, axis2=2).mean() - ratio
    assert (error**2).sum(axis=1).mean() == pytest.approx(lost, rel=0.2)
    assert lost > 0.0
