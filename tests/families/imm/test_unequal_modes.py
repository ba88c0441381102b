"""Modes with fewer states than the model: what they leave out is 0 in them, with no variance."""

from __future__ import annotations

import numpy as np
import pytest
from plants import distance
from scipy.stats import multivariate_normal

import fkgen

DT = 0.5
MODEL = {
    "A": [[1.0, DT, DT**2 / 2], [0.0, 1.0, DT], [0.0, 0.0, 0.9]],
    "B": [[0.1], [0.5], [0.2]],
    "C": [[1.0, 0.0, 0.0], [0.2, 1.0, 0.3]],
    "D": [[0.0], [0.4]],
    "Q": [[0.02, 0.01, 0.0], [0.01, 0.05, 0.02], [0.0, 0.02, 0.3]],
    "R": [[0.5, 0.1], [0.1, 0.4]],
    "c": [0.1, -0.2, 0.3],
    "x0": [1.0, -0.5, 2.0],
    "P0": [[2.0, 0.3, 0.2], [0.3, 1.0, 0.1], [0.2, 0.1, 0.7]],
    "states": [{"name": "p"}, {"name": "v"}, {"name": "a"}],
}
MODES = [
    {"states": ["v", "p"], "A": [[1.0, DT], [0.0, 0.95]], "Q": [[0.1, 0.0], [0.0, 0.2]]},
    {},
    {"states": ["v"], "c": [0.4], "C": [[0.3], [1.0]], "R": [[1.0, 0.0], [0.0, 2.0]]},
]
KEPT = [[0, 1], [0, 1, 2], [1]]
CHAIN = [[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.3, 0.2, 0.5]]
START = [0.5, 0.3, 0.2]


def table(modes=MODES, family="imm", **model):
    jump = {"transition": CHAIN, "initial": START, "modes": modes}
    return {
        "name": "plant",
        "model": MODEL | model,
        "faults": {"jump": jump},
        "filter": {"family": family},
    }


def own_matrices():
    """Every mode in its own size."""
    for kept, mode in zip(KEPT, MODES, strict=True):
        both = np.ix_(kept, kept)
        found = {x: np.array(MODEL[x]) for x in ("A", "B", "C", "D", "Q", "R", "c")}
        found |= {"A": found["A"][both], "Q": found["Q"][both], "C": found["C"][:, kept]}
        found |= {"B": found["B"][kept], "c": found["c"][kept]}
        yield found | {x: np.array(v) for x, v in mode.items() if x != "states"}


def interacting(y, u):
    """Blom & Bar-Shalom 1988 with estimates of three sizes, widened by zeros to be mixed."""
    plants, P = list(own_matrices()), np.array(CHAIN)
    x0, P0 = np.array(MODEL["x0"]), np.array(MODEL["P0"])
    x = [x0[k] for k in KEPT]
    S = [P0[np.ix_(k, k)] for k in KEPT]
    mu, rows = np.array(START), []
    for now, w in zip(y, u, strict=True):
        at, logs = np.flatnonzero(np.isfinite(now)), np.zeros(3)
        for i, each in enumerate(plants):
            C, R = each["C"][at], each["R"][np.ix_(at, at)]
            if at.size:
                nu, V = now[at] - C @ x[i] - each["D"][at] @ w, C @ S[i] @ C.T + R
                logs[i] = multivariate_normal.logpdf(nu, cov=V)
                K = S[i] @ C.T @ np.linalg.inv(V)
                x[i], S[i] = x[i] + K @ nu, S[i] - K @ V @ K.T
        mu = mu * np.exp(logs)
        likelihood = np.log(mu.sum())
        mu = mu / mu.sum()
        wide, wides = np.zeros((3, 3)), np.zeros((3, 3, 3))
        for i, kept in enumerate(KEPT):
            wide[i, kept] = x[i]
            wides[i][np.ix_(kept, kept)] = S[i]
        mean = mu @ wide
        apart = wide - mean
        covariance = np.einsum("i,iab->ab", mu, wides + apart[:, :, None] * apart[:, None, :])
        ahead = mu @ P
        for j, (kept, each) in enumerate(zip(KEPT, plants, strict=True)):
            share = mu * P[:, j] / ahead[j]
            mixed = share @ wide
            d = wide - mixed
            spread = np.einsum("i,iab->ab", share, wides + d[:, :, None] * d[:, None, :])
            x[j] = each["A"] @ mixed[kept] + each["B"] @ w + each["c"]
            S[j] = each["A"] @ spread[np.ix_(kept, kept)] @ each["A"].T + each["Q"]
        rows.append((mean, covariance, mu, likelihood if at.size else 0.0))
        mu = ahead
    names = ("filtered_state", "filtered_covariance", "mode_probability", "log_likelihood")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


@pytest.fixture(scope="module")
def run():
    rng = np.random.default_rng(3)
    y, u = 2.0 * rng.standard_normal((50, 2)), rng.standard_normal((50, 1))
    y[rng.random(y.shape) < 0.2] = np.nan
    return y, u, fkgen.build(fkgen.Spec.from_dict(table())).run(y, u)


def test_it_is_the_interacting_filter_of_estimates_of_different_sizes(run):
    y, u, found = run
    for port, values in interacting(y, u).items():
        assert distance(found[port], values) <= 1e-9, port


def test_what_a_mode_leaves_out_is_zero_in_it_at_every_sample(run):
    for i, kept in enumerate(KEPT):
        left = [state for state in range(3) if state not in kept]
        assert not run[2].mode_filtered_state[:, i, left].any()
        assert not run[2].mode_filtered_covariance[:, i, left].any()
        assert not run[2].mode_state[:, i, left].any()
    motor = fkgen.build(fkgen.Spec.from_dict(table()))
    given = {"x0": [3.0, 4.0, 5.0], "P0": np.diag([1.0, 2.0, 3.0]) + 0.1}
    for x, P in ((MODEL["x0"], MODEL["P0"]), given.values()):
        motor.reset(x0=x, P0=P)
        start = motor.snapshot()
        for i, kept in enumerate(KEPT):
            both, has = np.ix_(kept, kept), np.isin(range(3), kept)
            np.testing.assert_array_equal(start.mode_state[i], has * np.array(x))
            np.testing.assert_array_equal(start.mode_covariance[i][both], np.array(P)[both])
            assert not start.mode_covariance[i][~has].any()


def test_states_may_be_listed_in_any_order_and_are_written_back():
    spec = fkgen.Spec.from_dict(table())
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    listed = [MODES[0] | {"states": ["p", "v"]}, *MODES[1:]]
    assert fkgen.Spec.from_dict(table(listed)) == spec


def test_a_continuous_plant_forgets_what_a_mode_leaves_out():
    spec = fkgen.Spec.from_dict(
        table([{"states": ["p", "v"]}, {}, {}], time="continuous", sample_time=0.1)
    )
    A = spec.faults.jump.modes[0].A.values()
    assert not A[2].any()
    assert not A[:, 2].any()
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec


@pytest.mark.parametrize(
    ("mode", "key"),
    [
        ({"states": ["p", "x"]}, "faults.jump.modes[0].states[1]"),
        ({"states": ["p", "p"]}, "faults.jump.modes[0].states[1]"),
        ({"states": [3]}, "faults.jump.modes[0].states[0]"),
        ({"states": []}, "faults.jump.modes[0].states"),
        ({"states": "p"}, "faults.jump.modes[0].states"),
        ({"states": ["p"], "A": MODEL["A"]}, "faults.jump.modes[0].A"),
        ({"states": ["p"], "c": MODEL["c"]}, "faults.jump.modes[0].c"),
    ],
)
def test_states_that_are_not_there_are_refused_where_they_stand(mode, key):
    with pytest.raises(fkgen.SpecError) as fault:
        fkgen.Spec.from_dict(table([mode, {}, {}]))
    assert fault.value.key == key
    assert "\n" not in str(fault.value)


def test_other_families_say_that_they_do_not_take_them():
    with pytest.raises(fkgen.SpecError, match="only imm has modes with fewer") as fault:
        fkgen.Spec.from_dict(table(family="mjls_lmmse"))
    assert fault.value.key == "faults.jump.modes[0].states"
