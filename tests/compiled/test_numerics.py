"""Digits that survive in float and in double, and what a step costs."""

from __future__ import annotations

import re

import numpy as np
import pytest
from plants import MOTOR, built, generated, motor, random_model, record, run, spec

from fkgen.backend.ir import Operator

#: A tracked position, P0 / R = 1e8: what makes short covariance updates lose all digits in float.
TRACK = {
    "A": [[0.99, 0.1], [0.0, 0.95]],
    "C": [[1.0, 0.0]],
    "Q": [[1e-4, 0.0], [0.0, 1e-4]],
    "R": [[1e-2]],
    "x0": [0.0, 0.0],
    "P0": [[1e6, 0.0], [0.0, 1e6]],
}


def track(scalar, **model):
    return spec(TRACK | model, family="kf", code={"scalar": scalar})


def test_float_survives_a_prior_of_a_hundred_million_over_twenty_thousand_steps():
    y, _ = record(track("double"), 20000, missing=0.1)
    single, double = (run(track(scalar), y) for scalar in ("float", "double"))
    assert (single.status >= 0).all()
    variances = np.diagonal(single.filtered_covariance, axis1=1, axis2=2)
    assert variances.min() > 0.0
    determinant = np.linalg.det(single.filtered_covariance.astype(float))
    assert determinant.min() > 0.0
    # A step rounds by 6e-8; a variance forgets within tens of steps: 1e-5, and ten times that for
    # the start, where 1e6 is subtracted from 1e6.
    error = np.abs(single.filtered_covariance - double.filtered_covariance)
    assert (error[50:] / np.abs(double.filtered_covariance[50:])).max() < 1e-4
    # Numbers of order one are rounded by 6e-8 in every step and forgotten within tens of steps.
    np.testing.assert_allclose(single.filtered_state[50:], double.filtered_state[50:], atol=1e-4)


def test_the_first_correction_in_float_leaves_the_variance_of_the_measurement():
    first = run(track("float"), [[1.0]]).filtered_covariance[0]
    # 1e6 R / (1e6 + R) in 24 bits; the short form would leave zero.
    assert first[0, 0] == pytest.approx(1e-2, rel=1e-6)


def test_double_survives_a_prior_of_a_trillion():
    P0 = [[1e10, 0.0], [0.0, 1e10]]
    plant = track("double", P0=P0)
    y, _ = record(plant, 2000)
    result = run(plant, y)
    # What is left of the prior after some samples is 1e-12 of it.
    mild = run(track("double", P0=[[1e6, 0.0], [0.0, 1e6]]), y)
    np.testing.assert_allclose(
        result.filtered_covariance[200:], mild.filtered_covariance[200:], rtol=1e-6
    )
    assert result.filtered_covariance[0, 0, 0] == pytest.approx(1e-2, rel=1e-9)
    assert np.linalg.det(result.filtered_covariance).min() > 0.0


def test_the_form_of_the_update_follows_the_digits_at_stake():
    variances = {"mild": 1.0, "wide": 1e5, "extreme": 1e10}
    models = {name: track("double", P0=[[v, 0.0], [0.0, v]]) for name, v in variances.items()}
    models["float"] = track("float", P0=[[1.0, 0.0], [0.0, 1.0]])
    notes = {name: generated(model).files["plant.h"] for name, model in models.items()}
    forms = {name: re.search(r"Covariance update: (\w+) form", t)[1] for name, t in notes.items()}
    assert forms == {"float": "ud", "extreme": "ud", "wide": "joseph", "mild": "short"}


def diagonal(model):
    """The model with a diagonal R."""
    return model | {"R": np.diag(np.diag(model["R"])).tolist()}


LIMITS = {
    "motor": (motor("kf"), 50),
    "n6p3": (spec(random_model(91, 6, 3), family="kf"), 1250),
    "n15p6": (spec(random_model(92, 15, 6), family="kf"), 16500),
}


@pytest.mark.parametrize("name", list(LIMITS))
def test_a_step_costs_no_more_than_it_should(name):
    plant, limit = LIMITS[name]
    source = generated(plant)
    assert 0 < source.program.flops <= limit
    printed = re.search(r"Cost of one step[^:]*: (\d+) floating", source.files["plant.h"])
    assert int(printed[1]) == source.program.flops


@pytest.mark.exhaustive
def test_fifteen_states_and_six_measurements_build_and_filter():
    plant = LIMITS["n15p6"][0]
    y, u = record(plant, 50, missing=0.1)
    result = run(plant, y, u)
    assert (result.status >= 0).all()
    assert np.linalg.eigvalsh(result.filtered_covariance).min() > 0.0


def test_the_printed_cost_is_what_stands_in_the_file():
    source = generated(motor("kf"))
    text = source.files["plant.c"]
    body = text[text.index("plant_correct(") : text.index("plant_init(")]
    values = re.findall(r" = ([^;]+);", re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL))
    binary = sum(len(re.findall(r" [-+*/] ", value)) for value in values)
    assert binary + sum(value[0] == "-" and value[1] not in "0123456789" for value in values) == (
        source.program.flops
    )


def test_zeros_and_ones_of_a_model_cost_nothing():
    n = 4
    model = random_model(93, n, 1) | {
        "A": np.eye(n).tolist(),
        "C": [[1.0, *[0.0] * (n - 1)]],
        "Q": np.diag([0.1, 0.0, 0.0, 0.0]).tolist(),
        "x0": [0.0] * n,
    }
    plant = spec(model, family="kf", code={"update": "short"})
    operations = generated(plant).program.operations
    # Prediction: one addition, for the one entry of Q. Update: n corrections of the state and
    # n (n + 1) / 2 of the covariance, one product each; the gain, the quadratic form and -0.5 (..).
    assert operations[Operator.MUL] <= n + n * (n + 1) // 2 + n + 3
    assert operations[Operator.DIV] == 1
    assert operations[Operator.ADD] <= 1 + n + 4


def test_a_row_costs_one_division():
    operations = generated(LIMITS["n6p3"][0]).program.operations
    assert operations[Operator.DIV] == 3


def test_a_sparse_model_costs_less_than_a_dense_one():
    dense = random_model(94, 6, 3)
    banded = np.triu(np.tril(np.array(dense["A"]), 1), -1)
    radius = np.abs(np.linalg.eigvals(banded)).max()
    sparse = dense | {"A": (0.9 * banded / radius).tolist()}
    costs = [generated(spec(m, family="kf")).program.flops for m in (sparse, dense)]
    assert costs[0] < 0.8 * costs[1]


def test_covariances_come_out_symmetric_to_the_bit():
    plant = spec(random_model(95, 5, 3, correlated=True), family="kf")
    result = built(plant).run(record(plant, 30, missing=0.2)[0])
    for port in ("filtered_covariance", "predicted_covariance", "innovation_covariance"):
        np.testing.assert_array_equal(result[port], np.swapaxes(result[port], 1, 2))


def test_a_long_run_of_missing_samples_stays_finite_and_symmetric():
    plant = motor("kf", MOTOR)
    result = run(plant, np.full((20000, 1), np.nan), np.ones((20000, 1)))
    assert (result.status == 1).all()
    A, Q = plant.model.A.values(), plant.model.Q.values()
    P = result.predicted_covariance[-1]
    # The Lyapunov equation of a stable plant, within rounding.
    np.testing.assert_allclose(A @ P @ A.T + Q, P, rtol=1e-12)
