"""The compiled imm beside `IMMEstimator` of filterpy, on records without gaps.

filterpy has no D, no offsets and no missing rows. Its `x_prior` and `P_prior` weigh predictions
with the probabilities before the step: they are not compared. Sample 0 corrects the prior, so
`update` comes before the first `predict`.
"""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from imm_plants import ALIKE, DENSE, HOLES, START, any_modes, jumping, seen, system_of
from plants import distance, random_model, run

#: Both sides round differently, some hundred times in a record.
AGREE = 1e-10

#: Turns of 0.2 rad per sample to the left and to the right beside straight motion.
RATES = (0.0, 0.2, -0.2)


def turning(rate, dt=1.0):
    """x, y and velocities along both: a coordinated turn."""
    if rate == 0.0:
        s, c = dt, 0.0
        spin = np.eye(2)
    else:
        s, c = np.sin(rate * dt) / rate, (1.0 - np.cos(rate * dt)) / rate
        spin = np.array(
            [[np.cos(rate * dt), -np.sin(rate * dt)], [np.sin(rate * dt), np.cos(rate * dt)]]
        )
    return np.block([[np.eye(2), np.array([[s, -c], [c, s]])], [np.zeros((2, 2)), spin]])


TARGET = {
    "A": turning(0.0),
    "C": np.eye(2, 4),
    "Q": 0.01 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1]], np.eye(2)),
    "R": np.diag([1.0, 2.0]),
    "x0": [0.0, 0.0, 10.0, 0.0],
    "P0": np.diag([4.0, 4.0, 1.0, 1.0]),
}
SPECS = {
    "turns": lambda: jumping(TARGET, [{"A": turning(rate)} for rate in RATES]),
    "noise": lambda: jumping(TARGET, [{"Q": f * TARGET["Q"]} for f in (1, 10, 100)], initial=START),
    "everything": lambda: jumping(
        random_model(71, 3, 2, 1, correlated=True),
        any_modes(71, 3, 2, 1, letters="ABCQR"),
        transition=ALIKE,
    ),
    "holes": lambda: jumping(
        random_model(72, 2, 1), any_modes(72, 2, 1, letters="ACQR"), transition=HOLES
    ),
    "uneven": lambda: jumping(
        TARGET, [{"A": turning(r), "R": (1 + 9 * abs(r)) * TARGET["R"]} for r in RATES],
        transition=DENSE, initial=[0.98, 0.01, 0.01],
    ),
}  # fmt: skip


def estimator(system):
    """filterpy's estimator, which is told the law of the first mode as that before ``update``."""
    filters = []
    for i in range(system.count):
        each = KalmanFilter(system.nx, system.ny, dim_u=system.B.shape[-1])
        each.x, each.P = system.x0[:, np.newaxis].copy(), system.P0.copy()
        each.F, each.H, each.B = system.A[0, i], system.C[0, i], system.B[0, i]
        each.Q, each.R = system.Q[0, i], system.R[0, i]
        filters.append(each)
    imm = IMMEstimator(filters, system.initial, system.transition)
    imm.cbar = system.initial.copy()
    return imm


def by_filterpy(system, y, u):
    imm, rows = estimator(system), []
    for k, sample in enumerate(y):
        imm.update(sample[:, np.newaxis])
        row = {
            "filtered_state": imm.x[:, 0].copy(),
            "filtered_covariance": imm.P.copy(),
            "mode_probability": imm.mu.copy(),
            "predicted_mode_probability": imm.cbar.copy(),
            "mode_filtered_state": np.array([f.x[:, 0] for f in imm.filters]),
            "mode_filtered_covariance": np.array([f.P for f in imm.filters]),
        }
        imm.predict(u[k][:, np.newaxis] if u.shape[1] else None)
        row["mode_state"] = np.array([f.x[:, 0] for f in imm.filters])
        row["mode_covariance"] = np.array([f.P for f in imm.filters])
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.parametrize("name", list(SPECS))
def test_compiled_interacting_models_are_those_of_filterpy(name):
    spec = SPECS[name]()
    y, u = seen(spec, 40, seed=len(name))
    result, expected = run(spec, y, u), by_filterpy(system_of(spec, 40), y, u)
    for port, value in expected.items():
        assert distance(result[port], value) < AGREE, port


def test_the_combined_prediction_of_filterpy_is_that_of_the_modes_before_the_step():
    """Why `x_prior` is not compared: its weights are Pr(mode at k), not Pr(mode at k + 1)."""
    spec = SPECS["turns"]()
    y, u = seen(spec, 10)
    result, imm = run(spec, y, u), estimator(system_of(spec, 10))
    for sample in y:
        imm.update(sample[:, np.newaxis])
        imm.predict()
    states = result.mode_state[-1]
    np.testing.assert_allclose(imm.x_prior[:, 0], result.mode_probability[-1] @ states, rtol=1e-9)
    mixed = result.predicted_mode_probability[-1] @ states
    np.testing.assert_allclose(result.predicted_state[-1], mixed, rtol=1e-9)
    assert np.abs(imm.x_prior[:, 0] - result.predicted_state[-1]).max() > 1e-3


def test_a_missing_sample_tells_nothing_about_the_mode_but_moves_the_probabilities_of_filterpy():
    """A missing sample leaves Pr(mode at k | y[0..k-1]); filterpy weighs by densities at zero."""
    spec = SPECS["uneven"]()
    system, (y, u) = system_of(spec, 2), seen(spec, 2)
    y[1] = np.nan
    imm = estimator(system)
    imm.update(y[0][:, np.newaxis])
    after_first = imm.mu.copy()
    imm.predict()
    imm.update(None)
    by_hand = np.zeros(3)  # the chain alone
    for before, held in enumerate(after_first):
        for after in range(3):
            by_hand[after] += held * system.transition[before][after]
    result = run(spec, y, u)
    np.testing.assert_allclose(result.mode_probability[1], by_hand, rtol=1e-12)
    assert np.abs(imm.mu - by_hand).max() > 1e-3
