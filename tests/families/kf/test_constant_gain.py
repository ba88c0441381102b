"""A constant gain is the limit of the Riccati recursion, and what it does is an observer."""

from __future__ import annotations

import numpy as np
import pytest
from plants import covariance, distance, random_model, spec
from scipy.stats import multivariate_normal

import fkgen

DIFFUSE = {"x0": [0.3, -0.2], "P0": [[4.0, 0.0], [0.0, 1.0]]}
WHITE = {"Q": [[1e-3, 0.0], [0.0, 1e-2]], "R": [[0.1]], **DIFFUSE}
TRACK = {"A": [[1.0, 0.1], [0.0, 1.0]], "C": [[1.0, 0.0]], **WHITE}
#: Three integrators in a row, of which only the last is moved by noise.
JERK = {
    "A": [[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]],
    "C": [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    "Q": np.diag([0.0, 0.0, 1e-2]).tolist(),
    "R": [[0.1, 0.02], [0.02, 0.3]],
    "x0": [0.0, 1.0, 0.0],
    "P0": np.eye(3).tolist(),
}
DRIVEN = random_model(8, 4, 3, 2, direct=True, correlated=True)
DRIVEN |= {"c": ["0.3*g", 0.1, 0.0, -0.2], "d": [0.5, 0.0, "g"]}
PLANTS = {
    "damped": {"A": [[0.95, 0.1], [0.0, 0.8]], "C": [[1.0, 0.0]], **WHITE},
    "alpha-beta": TRACK,
    "three integrators": JERK,
    "driven": DRIVEN,
    "unstable": {"A": [[1.2, 0.3], [0.0, 0.5]], "C": [[1.0, 0.0]], **WHITE},
    "without noise": TRACK | {"R": [[0.0]]},
}


def stationary(model, **options):
    parameters = {"g": 0.4} if "c" in model else {}
    return spec(model, parameters=parameters, gain="stationary", **options)


def limits(model):
    """P(k+1|k), S and K after many steps of the recursion from I."""
    A, C, Q, R = (np.array(model[letter], float) for letter in "ACQR")
    P = np.eye(len(A))
    for _ in range(20_000):
        S = C @ P @ C.T + R
        K = np.linalg.solve(S, C @ P).T
        E = np.eye(len(A)) - K @ C
        P = A @ (E @ P @ E.T + K @ R @ K.T) @ A.T + Q
    return P, S, K


def observer(model, y, u, g):
    """States, nis and log-likelihood of rows that are there."""
    _, S, K = limits(model)
    A, C = np.array(model["A"]), np.array(model["C"])
    x, rows = np.array(model["x0"], float), []
    for now, w, each in zip(y, u, g, strict=True):
        c, d = np.zeros(len(A)), np.zeros(len(C))
        if "c" in model:
            c, d = np.array([0.3 * each, 0.1, 0.0, -0.2]), np.array([0.5, 0.0, each])
            c, d = c + np.array(model["B"]) @ w, d + np.array(model["D"]) @ w
        at = np.flatnonzero(np.isfinite(now))
        nu = (now - C @ x - d)[at]
        filtered = x + K[:, at] @ nu
        x = A @ filtered + c
        some = S[np.ix_(at, at)]
        nis = nu @ np.linalg.solve(some, nu) if at.size else 0.0
        log = multivariate_normal.logpdf(nu, cov=some) if at.size else 0.0
        rows.append((filtered, x, nis, log))
    names = ("filtered_state", "predicted_state", "nis", "log_likelihood")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


def drawn(model, T=60):
    rng = np.random.default_rng(9)
    y = rng.standard_normal((T, len(model["C"]))).cumsum(axis=0) * 0.3
    y[rng.random(y.shape) < 0.25] = np.nan
    y[20:24] = np.nan
    q = len(model["B"][0]) if "B" in model else 0
    return y, rng.standard_normal((T, q)), rng.uniform(0.2, 0.6, T)


@pytest.mark.parametrize("name", PLANTS)
def test_the_filter_is_an_observer_with_the_limit_of_the_gain(name):
    model = PLANTS[name]
    y, u, g = drawn(model)
    params = {"g": g} if "c" in model else {}
    found = fkgen.build(stationary(model)).run(y, u if u.size else None, params)
    expected = observer(model, y, u, g)
    assert (found.status == np.isnan(y).all(axis=1)).all()  # SKIPPED is 1
    for port, values in expected.items():
        assert distance(found[port], values) <= 1e-9, port
    P, S, K = limits(model)
    assert distance(found.predicted_covariance[3], P) <= 1e-9
    assert distance(found.innovation_covariance[3], S) <= 1e-9
    # The last digits of P - K S K' are those that R loses in P.
    np.testing.assert_allclose(found.filtered_covariance[3], P - K @ S @ K.T, atol=1e-9 * P.max())


def test_its_gain_is_where_that_of_the_kalman_filter_goes():
    y = np.random.default_rng(2).standard_normal((400, 2))
    constant, varying = (fkgen.build(each).run(y) for each in (stationary(JERK), spec(JERK)))
    for port in ("filtered_state", "predicted_covariance", "filtered_covariance", "nis"):
        assert distance(constant[port][350:], varying[port][350:]) <= 1e-6


@pytest.mark.parametrize("by", ["row", "sample"])
def test_a_gate_leaves_rows_out_of_it_as_if_they_were_missing(by):
    y, u, g = drawn(DRIVEN)
    y[5::7, 1] += 40.0
    gated = fkgen.build(stationary(DRIVEN, gate=0.999, gate_by=by)).run(y, u, {"g": g})
    assert gated.rejected[5, 1] or np.isnan(y[5, 1])
    assert 0 < gated.rejected.sum() < y.size / 2
    kept = np.where(gated.rejected, np.nan, y)
    plain = fkgen.build(stationary(DRIVEN)).run(kept, u, {"g": g})
    for port in ("filtered_state", "predicted_state", "nis", "log_likelihood"):
        assert distance(gated[port], plain[port]) <= 1e-12, port


UNSEEN = TRACK | {"C": [[0.0, 1.0]]}
STILL = TRACK | {"Q": [[0.0, 0.0], [0.0, 0.0]]}


@pytest.mark.parametrize(
    ("model", "parameters", "what"),
    [
        (UNSEEN, {}, "stabilising"),
        (STILL, {}, "stabilising"),
        (TRACK | {"A": [[1.0, "dt"], [0.0, 1.0]]}, {"dt": 0.1}, "model.A that depends on dt"),
        (TRACK | {"R": [["r"]]}, {"r": 0.1}, "model.R that depends on r"),
    ],
)
def test_a_plant_without_such_a_gain_is_refused(model, parameters, what):
    with pytest.raises(fkgen.SpecError, match=what) as fault:
        spec(model, parameters=parameters, gain="stationary")
    assert fault.value.key == "filter.gain"
    assert "\n" not in str(fault.value)


def test_time_varying_is_what_the_filter_is_without_the_key():
    assert spec(TRACK, gain="time_varying") == spec(TRACK)
    table = stationary(TRACK).to_dict()
    assert table["filter"] == {"family": "kf", "gain": "stationary"}
    assert fkgen.Spec.from_dict(table) == stationary(TRACK)


def test_random_plants_come_to_rest_at_the_gain():
    rng = np.random.default_rng(12)
    for _ in range(4):
        n, p = int(rng.integers(1, 6)), int(rng.integers(1, 4))
        model = random_model(int(rng.integers(1000)), n, p) | {"Q": covariance(rng, n).tolist()}
        model["A"] = (1.03 * np.array(model["A"]) / 0.95).tolist()  # radius 1.03
        found = fkgen.build(stationary(model)).run(np.zeros((2, p)))
        assert distance(found.predicted_covariance[1], limits(model)[0]) <= 1e-9
