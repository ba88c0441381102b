"""Kim's smoother against every sequence of modes, each with its joint Gaussian."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from toolchain import needs_compiler

import fkgen

pytestmark = needs_compiler()

LEVEL = 1e-9
PLANT = {
    "A": [[1.0, 0.3], [0.0, 0.9]],
    "B": [[0.2], [0.5]],
    "C": [[1.0, 0.4]],
    "Q": [[0.02, 0.0], [0.0, 0.1]],
    "R": [[0.3]],
    "c": [0.1, -0.1],
    "x0": [0.5, -0.2],
    "P0": [[1.0, 0.2], [0.2, 0.8]],
}
MODES = [{}, {"A": [[0.8, -0.2], [0.1, 0.7]], "Q": [[0.4, 0.1], [0.1, 0.5]], "c": [0.4, 0.3]}]


def built(name, family, modes=None, transition=None, faults=None):
    if modes:
        faults = {"jump": {"modes": modes, "transition": transition, "initial": [0.6, 0.4]}}
    table = {"name": f"kim_{name}", "model": PLANT, "filter": {"family": family}}
    return fkgen.build(fkgen.Spec.from_dict(table | {"faults": faults or {}}))


def joint(y, u, modes, sequence):
    """Mean and covariance (T n) of all states, and the log density of y, of one sequence."""
    own = [{key: np.array((PLANT | mode)[key], float) for key in PLANT} for mode in modes]
    T, n = len(y), 2
    means, G = [np.array(PLANT["x0"])], np.zeros((T * n, T * n))
    G[:n, :n] = np.eye(n)
    law = np.zeros_like(G)
    law[:n, :n] = PLANT["P0"]
    for k in range(1, T):  # the mode of sample k drives the step into it
        m, now, then = own[sequence[k]], slice(n * k, n * k + n), slice(n * k - n, n * k)
        means.append(m["A"] @ means[-1] + m["B"] @ u[k - 1] + m["c"])
        G[now] = m["A"] @ G[then]
        G[now, now] += np.eye(n)
        law[now, now] = m["Q"]
    rows = [k for k in range(T) if np.isfinite(y[k, 0])]
    H = np.zeros((len(rows), T * n))
    for i, k in enumerate(rows):
        H[i, n * k : n * k + n] = own[sequence[k]]["C"]
    mean, P = np.concatenate(means), G @ law @ G.T
    S = H @ P @ H.T + np.diag([own[sequence[k]]["R"][0, 0] for k in rows])
    e = y[rows, 0] - H @ mean
    K = np.linalg.solve(S, H @ P).T
    density = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    return mean + K @ e, P - K @ H @ P, density


def enumerated(y, u, modes, transition):
    """Exact means (T, n) and covariances given all of the record."""
    found, weights = [], []
    for sequence in product(range(len(modes)), repeat=len(y)):
        chances = [transition[i][j] for i, j in pairwise(sequence)]
        chance = [0.6, 0.4][sequence[0]] * np.prod(chances)
        if chance > 0.0:
            mean, P, density = joint(y, u, modes, sequence)
            found.append((mean, P))
            weights.append(np.log(chance) + density)
    weights = np.exp(np.array(weights) - max(weights))
    weights /= weights.sum()
    mean = sum(w * m for w, (m, _) in zip(weights, found, strict=True))
    spread = sum(
        w * (P + np.outer(m - mean, m - mean)) for w, (m, P) in zip(weights, found, strict=True)
    )
    T = len(y)
    blocks = [spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(T)]
    return mean.reshape(T, 2), np.array(blocks)


def drawn(T, seed=5):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(size=(T, 1)), axis=0), rng.normal(size=(T, 1))


def test_modes_that_never_change_are_smoothed_exactly():
    y, u = drawn(9)
    y[4] = np.nan
    modes = [{}, MODES[1] | {"R": [[2.0]]}]
    transition = [[1.0, 0.0], [0.0, 1.0]]
    found = built("still", "imm", modes, transition).smooth(y, u)
    mean, spread = enumerated(y, u, modes, transition)
    np.testing.assert_allclose(found.state, mean, rtol=LEVEL, atol=LEVEL)
    np.testing.assert_allclose(found.covariance, spread, rtol=LEVEL, atol=LEVEL)
    assert found.approximate is True


def test_one_step_back_to_a_sample_that_says_nothing_of_its_mode_is_exact():
    """Either way of reading the transition matrix is another number here."""
    y, u = drawn(2)
    y[0] = np.nan
    transition = [[0.9, 0.1], [0.5, 0.5]]
    found = built("pair", "imm", MODES, transition).smooth(y, u)
    mean, spread = enumerated(y, u, MODES, transition)
    np.testing.assert_allclose(found.state, mean, rtol=LEVEL, atol=LEVEL)
    np.testing.assert_allclose(found.covariance, spread, rtol=LEVEL, atol=LEVEL)


def test_modes_that_change_seldom_are_smoothed_nearly():
    """The approximation costs a tenth of what hindsight gains at most."""
    y, u = drawn(9)
    transition = [[0.97, 0.03], [0.05, 0.95]]
    filter_ = built("seldom", "imm", MODES, transition)
    mean, _ = enumerated(y, u, MODES, transition)
    off = np.abs(filter_.smooth(y, u).state - mean).max()
    assert off < 0.1 * np.abs(filter_.run(y, u).filtered_state - mean).max()


SENSOR = {"sensor": {"noise_factor": 9.0, "problem": 2}}


@pytest.mark.parametrize("family", ["imm", "one_step"])
def test_modes_that_are_all_the_same_are_smoothed_as_kf_is(family):
    y, u = drawn(40)
    y[7] = np.nan
    faults = {"sensor": SENSOR["sensor"] | {"joint": [1.0, 0.0, 0.0, 0.0]}}
    found = built(f"sure_{family}", family, faults=faults).smooth(y, u)
    expected = built("plain", "kf").smooth(y, u)
    np.testing.assert_allclose(found.state, expected.state, rtol=LEVEL, atol=LEVEL)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=LEVEL, atol=LEVEL)


def test_one_step_is_smoothed_exactly_back_from_the_first_row():
    y, u = drawn(2)
    y[0] = np.nan
    law = [0.5, 0.1, 0.3, 0.1]
    faults = {"sensor": SENSOR["sensor"] | {"joint": law}}
    found = built("first", "one_step", faults=faults).smooth(y, u)
    modes = [{"C": [[g, 0.4 * g]], "R": [[0.3 * d]]} for g, d in product((1.0, 0.0), (1.0, 9.0))]
    parts = [joint(y, u, modes, (0, j)) for j in range(4)]
    weights = law * np.exp([density for _, _, density in parts])
    mean = np.average([each for each, _, _ in parts], axis=0, weights=weights)
    np.testing.assert_allclose(found.state, mean.reshape(2, 2), rtol=LEVEL, atol=LEVEL)


def test_held_samples_and_laws_with_parameters_are_smoothed():
    table = {
        "name": "kim_law",
        "model": PLANT,
        "parameters": {"stay": {"default": 0.9, "min": 0.0, "max": 1.0}},
        "faults": {
            "jump": {
                "modes": MODES,
                "transition": [["stay", "1 - stay"], [0.5, 0.5]],
                "initial": [0.6, 0.4],
            }
        },
        "filter": {"family": "imm"},
    }
    filter_ = fkgen.build(fkgen.Spec.from_dict(table))
    y, u = drawn(2)
    y[0] = np.nan
    found = filter_.smooth(y, u, {"stay": [0.7, 0.2]})
    mean, _ = enumerated(y, u, MODES, [[0.7, 0.3], [0.5, 0.5]])
    np.testing.assert_allclose(found.state, mean, rtol=LEVEL, atol=LEVEL)
    held = np.insert(y, 1, 3.0, axis=0), np.insert(u, 1, np.nan, axis=0)
    with_held = filter_.smooth(*held, {"stay": [0.7, 0.7, 0.2]})
    np.testing.assert_array_equal(with_held.state[[0, 2]], found.state)
    np.testing.assert_array_equal(with_held.state[1], found.state[0])


def test_modes_of_unequal_size_have_no_smoother():
    modes = [{"states": ["x_0"]}, {}]
    model = PLANT | {"states": [{"name": "x_0"}, {"name": "x_1"}]}
    transition = [[0.9, 0.1], [0.1, 0.9]]
    faults = {"jump": {"modes": modes, "transition": transition, "initial": [0.5, 0.5]}}
    table = {"name": "kim_unequal", "model": model, "faults": faults}
    filter_ = fkgen.build(fkgen.Spec.from_dict(table | {"filter": {"family": "imm"}}))
    with pytest.raises(fkgen.DataError, match=r"unequal size.*expected modes with matrices"):
        filter_.smooth(*drawn(3))
