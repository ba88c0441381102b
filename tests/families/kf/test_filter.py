"""The compiled Kalman filter is the best linear estimate of the whole record."""

from __future__ import annotations

import numpy as np
import pytest
from plants import (
    MOTOR,
    PARAMETERS,
    VARYING,
    assert_agree,
    distance,
    motor,
    random_model,
    record,
    run,
    spec,
    system_of,
)

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.textbook.riccati import stationary_prediction_by_control

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

#: Two double computations of well-conditioned problems: some hundred roundings of 1e-16.
EXACT = 1e-9


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize(("n", "p", "q"), [(1, 1, 0), (2, 1, 1), (3, 2, 0), (4, 3, 2), (6, 4, 1)])
def test_dense_models_agree_with_the_joint_distribution(n, p, q, correlated, missing):
    model = random_model(10 * n + p, n, p, q, direct=q > 0, correlated=correlated)
    plant = spec(model, family="kf")
    y, u = record(plant, 9, missing=missing, seed=n)
    assert_agree(run(plant, y, u), batch_lmmse(system_of(plant, 9), y, u), PORTS, EXACT)


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_a_model_of_parameters_that_change_in_every_sample_agrees(scalar):
    plant = spec(VARYING, family="kf", parameters=PARAMETERS, code={"scalar": scalar})
    T = 10
    rng = np.random.default_rng(4)
    params = {"dt": rng.uniform(0.01, 0.4, T), "angle": rng.uniform(-3.0, 3.0, T)}
    y, u = record(plant, T, params=params, missing=0.2)
    expected = batch_lmmse(system_of(plant, T, params), y, u)
    # Some hundred roundings of 6e-8 in float; the likelihood divides by variances of 0.1.
    tolerance = EXACT if scalar == "double" else 1e-4
    assert_agree(run(plant, y, u, params), expected, PORTS, tolerance)


def test_parameters_that_are_left_out_keep_their_defaults():
    plant = spec(VARYING, family="kf", parameters=PARAMETERS)
    y, u = record(plant, 6)
    given = run(plant, y, u, PARAMETERS)
    np.testing.assert_array_equal(run(plant, y, u).predicted_state, given.predicted_state)


@pytest.mark.parametrize("family", ["kf", "mkf"])
@pytest.mark.parametrize("missing", [(0,), (2,), (0, 1), (1, 3)])
def test_a_missing_row_is_a_deleted_row_with_correlated_noise_too(missing, family):
    q = 2
    model = random_model(7, 3, 4, q, direct=True, correlated=True)
    kept = [i for i in range(4) if i not in missing]
    fewer = model | {
        "C": [model["C"][i] for i in kept],
        "D": [model["D"][i] for i in kept],
        "R": [[model["R"][i][j] for j in kept] for i in kept],
    }
    faults = {} if family == "kf" else {"actuator": {"success_rate": 0.6, "dependence": "common"}}
    whole, part = (spec(m, family=family, **faults) for m in (model, fewer))
    y, u = record(whole, 12)
    gaps = y.copy()
    gaps[:, list(missing)] = np.nan
    a, b = run(whole, gaps, u), run(part, y[:, kept], u)
    for port in (*PORTS[:4], "nis", "log_likelihood"):
        # The rows that are left take the same path with other zeros: rounding only.
        assert distance(a[port], b[port]) < 1e-12
    assert distance(a.innovation[:, kept], b.innovation) < 1e-12
    assert np.isnan(a.innovation[:, list(missing)]).all()


def test_a_wholly_missing_sample_is_a_prediction_with_nothing_learnt():
    plant = spec(random_model(3, 3, 2, 1), family="kf")
    y, u = record(plant, 5)
    y[2] = np.nan
    result = run(plant, y, u)
    np.testing.assert_array_equal(result.status, [0, 0, 1, 0, 0])
    np.testing.assert_array_equal(result.filtered_state[2], result.predicted_state[1])
    np.testing.assert_array_equal(result.filtered_covariance[2], result.predicted_covariance[1])
    assert result.nis[2] == 0.0
    assert result.log_likelihood[2] == 0.0
    A = np.array(plant.model.A.values())
    moved = A @ result.filtered_covariance[2] @ A.T + plant.model.Q.values()
    # One congruence in another order of summation.
    np.testing.assert_allclose(result.predicted_covariance[2], moved, rtol=1e-13)


@pytest.mark.parametrize(("n", "p"), [(2, 1), (4, 2), (6, 3)])
def test_the_covariance_comes_to_rest_at_the_riccati_solution(n, p):
    plant = spec(random_model(20 + n, n, p, correlated=True), family="kf")
    rest = run(plant, np.zeros((400, p)), keep=("predicted_covariance",)).predicted_covariance
    # 400 samples of a closed loop of radius below 0.95: 1e-9 of the start, squared, is left.
    assert distance(rest[-1], rest[-2]) < 1e-15
    m = plant.model
    P, radius = stationary_prediction_by_control(*(x.values() for x in (m.A, m.C, m.Q, m.R)))
    assert radius < 0.95
    # The Riccati solver orders an eigenvalue problem of size 2n: it keeps some 12 digits.
    assert distance(rest[-1], P) < EXACT


def test_sample_zero_corrects_the_prior_without_a_prediction_before_it():
    plant = motor("kf")
    first = run(plant, [[0.3]], [[1.0]])
    P0, R = np.array(MOTOR["P0"]), MOTOR["R"][0][0]
    gain = P0[:, 1] / (P0[1, 1] + R)
    # Two divisions by hand.
    np.testing.assert_allclose(first.filtered_state[0], 0.3 * gain, rtol=1e-14)
    assert first.innovation[0, 0] == 0.3


def test_the_input_of_a_sample_moves_the_next_prediction_not_this_one():
    plant = motor("kf")
    still, driven = (run(plant, np.zeros((1, 1)), [[u]]) for u in (0.0, 1.0))
    np.testing.assert_array_equal(still.filtered_state, driven.filtered_state)
    moved = driven.predicted_state[0] - still.predicted_state[0]
    np.testing.assert_array_equal(moved, np.ravel(MOTOR["B"]))


@pytest.mark.parametrize("update", ["short", "joseph", "ud"])
def test_all_forms_of_the_covariance_update_agree_on_a_benign_model(update):
    model = random_model(8, 4, 2, correlated=True)
    plant = spec(model, family="kf", code={"update": update})
    y, u = record(plant, 8, missing=0.2)
    assert_agree(run(plant, y, u), batch_lmmse(system_of(plant, 8), y, u), PORTS, EXACT)
