"""Trials of jumping plants: against the NumPy sampler, their laws, and filters on them."""

from __future__ import annotations

from itertools import product

import jump_plants as jm
import numpy as np
import pytest
from counters import FAULTS, MEASUREMENT, PRIOR, PROCESS, chosen, normals, uniforms
from scipy import stats

import fkgen
from fkgen.oracle.plants.jump import lasting_law
from fkgen.oracle.sampled import draw_record
from fkgen.study.comparisons.candidates import genie_of

Z = 4.5  # standard errors, as in test_simulation


def jumping(example, **jump):
    table = {**example, "faults": {"jump": example["faults"]["jump"] | jump}}
    return fkgen.Spec.from_dict(table)


@pytest.mark.parametrize("arrival", ["always", "unknown", "known"])
def test_measurements_are_distributed_as_those_of_the_numpy_sampler(arrival):
    channel = {} if arrival == "always" else {"arrival": arrival, "arrival_chain": jm.GILBERT}
    spec = jumping(jm.EXAMPLE_B, **channel)
    runs, T, rng = 1200, 4, np.random.default_rng(4)
    ours = fkgen.simulate(spec, runs, T, 9).y.reshape(runs, T)
    theirs = np.array([draw_record(spec, {}, np.zeros((T, 0)), rng)[0] for _ in range(runs)])[
        ..., 0
    ]
    lost = [np.isnan(each).mean() for each in (ours, theirs)]
    assert abs(lost[0] - lost[1]) < Z * 0.5 / np.sqrt(runs)  # within a record they are correlated
    assert (lost[0] > 0.0) == (arrival == "known")
    for k in range(T):
        pair = [each[np.isfinite(each[:, k]), k] for each in (ours, theirs)]
        assert stats.ks_2samp(*pair).pvalue > 1e-4
    ours, theirs = np.nan_to_num(ours), np.nan_to_num(theirs)
    for i, j in product(range(T), repeat=2):
        a, b = ours[:, i] * ours[:, j], theirs[:, i] * theirs[:, j]
        error = np.hypot(a.std(), b.std()) / np.sqrt(runs)
        assert abs(a.mean() - b.mean()) < Z * error


def trial_again(spec, seed, trial, u):
    """One trial by NumPy from the same numbers: states and measurements."""
    faults, model = spec.faults.jump, spec.model
    channel = np.array(faults.arrival_chain)
    laws = np.kron(faults.initial, lasting_law(channel)), np.kron(faults.transition, channel)
    x = model.x0.values()[:, 0]
    x = x + np.linalg.cholesky(model.P0.values()) @ normals(seed, trial, 0, PRIOR, model.nx)
    states, measured, condition = [], [], None
    for k in range(len(u)):
        law = laws[0] if condition is None else laws[1][condition]
        condition = chosen(law, uniforms(seed, trial, k, FAULTS, 1)[0])
        mode, arrived = faults.modes[condition // 2], condition % 2
        A, B, C, D, Q, R, c = (getattr(mode, letter).values({}) for letter in "ABCDQRc")
        v = np.linalg.cholesky(R) @ normals(seed, trial, k, MEASUREMENT, model.ny)
        states.append(x)
        measured.append(arrived * (C @ x + D @ u[k]) + v)
        w = np.linalg.cholesky(Q) @ normals(seed, trial, k, PROCESS, model.nx)
        x = A @ x + B @ u[k] + c[:, 0] + w
    return np.array(states), np.array(measured)


def test_a_trial_is_what_numpy_makes_of_the_same_numbers():
    table = jm.random_table(3, 3, 2, 2, q=2, offsets=True, correlated=True)
    spec = jumping(table, arrival="unknown", arrival_chain=jm.GILBERT)
    u = np.random.default_rng(2).standard_normal((40, 2))
    found = fkgen.simulate(spec, 4, 40, 11, u)
    for m in range(4):
        x, y = trial_again(spec, 11, m, u)
        np.testing.assert_allclose(found.state[m], x, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found.y[m], y, rtol=1e-11, atol=1e-11)
    assert len(np.unique(found.mode)) == 3
    assert not found.arrival.all()


#: Position and velocity; or those and an acceleration; or velocity alone.
UNEQUAL = {
    "name": "target",
    "model": {
        "A": [[1.0, 0.5, 0.1], [0.0, 1.0, 0.5], [0.0, 0.0, 0.9]],
        "B": [[0.1], [0.5], [0.2]],
        "C": [[1.0, 0.0, 0.2], [0.2, 1.0, 0.3]],
        "Q": [[0.02, 0.01, 0.0], [0.01, 0.05, 0.02], [0.0, 0.02, 0.3]],
        "R": [[0.5, 0.1], [0.1, 0.4]],
        "c": [0.1, -0.2, 0.3],
        "x0": [1.0, -0.5, 2.0],
        "P0": [[2.0, 0.3, 0.2], [0.3, 1.0, 0.1], [0.2, 0.1, 0.7]],
        "states": [{"name": name} for name in "pva"],
    },
    "faults": {
        "jump": {
            "transition": [[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.3, 0.2, 0.5]],
            "initial": [0.5, 0.3, 0.2],
            "modes": [
                {"states": ["p", "v"], "A": [[0.9, 0.5], [0.0, 0.95]]},
                {},
                {"states": ["v"], "C": [[0.3], [1.0]], "R": [[1.0, 0.0], [0.0, 2.0]]},
            ],
        }
    },
    "filter": {"family": "imm"},
}
HELD = [[0, 1], [0, 1, 2], [1]]


def test_what_a_mode_leaves_out_is_zero_in_it_and_the_mode_of_a_sample_drives_the_step_into_it():
    spec, table = fkgen.Spec.from_dict(UNEQUAL), UNEQUAL["model"]
    u = np.random.default_rng(2).standard_normal((300, 1))
    found = fkgen.simulate(spec, 3, 300, 11, u)
    A, B, C, Q, R, c = (np.array(table[letter]) for letter in "ABCQRc")
    for m in range(3):
        path = found.mode[m]
        x = np.array(table["x0"])
        x = x + np.linalg.cholesky(np.array(table["P0"])) @ normals(11, m, 0, PRIOR, 3)
        for k, mode in enumerate(path):
            kept, mine = HELD[mode], UNEQUAL["faults"]["jump"]["modes"][mode]
            both = np.ix_(kept, kept)
            if k:
                w = np.linalg.cholesky(Q[both]) @ normals(11, m, k - 1, PROCESS, 3)[kept]
                moved = np.array(mine.get("A", A[both])) @ x[kept] + B[kept] @ u[k - 1] + c[kept]
                x = np.zeros(3)
                x[kept] = moved + w
            else:
                x[[i for i in range(3) if i not in kept]] = 0.0
            v = np.linalg.cholesky(np.array(mine.get("R", R))) @ normals(11, m, k, MEASUREMENT, 2)
            np.testing.assert_allclose(found.state[m, k], x, rtol=1e-11, atol=1e-11)
            y = np.array(mine.get("C", C[:, kept])) @ x[kept] + v
            np.testing.assert_allclose(found.y[m, k], y, rtol=1e-11, atol=1e-11)
    assert set(found.mode.ravel()) == {0, 1, 2}
    assert (found.mode[:, 0] != 1).any()  # a trial that begins with states left out


def test_modes_with_fewer_states_follow_their_chain_in_both_samplers():
    spec, jump = fkgen.Spec.from_dict(UNEQUAL), UNEQUAL["faults"]["jump"]
    mode = fkgen.simulate(spec, 4000, 12, 2, 0.0).mode.astype(int)
    kernel, start = np.array(jump["transition"]), np.array(jump["initial"])
    first = np.bincount(mode[:, 0], minlength=3) / 4000
    assert (np.abs(first - start) < Z * np.sqrt(start * (1 - start) / 4000)).all()
    counts = np.bincount((3 * mode[:, :-1] + mode[:, 1:]).ravel(), minlength=9).reshape(3, 3)
    total = counts.sum(axis=1, keepdims=True)
    assert (np.abs(counts - total * kernel) <= Z * np.sqrt(total * kernel * (1 - kernel))).all()
    rng, T = np.random.default_rng(4), 4
    ours = fkgen.simulate(spec, 1200, T, 9, 0.0).y.reshape(1200, 2 * T)
    theirs = [draw_record(spec, {}, np.zeros((T, 1)), rng)[0].ravel() for _ in range(1200)]
    for i in range(2 * T):
        assert stats.ks_2samp(ours[:, i], np.array(theirs)[:, i]).pvalue > 1e-4


def test_who_is_told_the_mode_knows_what_it_leaves_out_and_which_step_leads_into_the_next():
    told, table = genie_of(fkgen.Spec.from_dict(UNEQUAL)).model, UNEQUAL["model"]
    for now, after in product(range(3), repeat=2):
        values = {f"in_mode_{i}": float(i == now) for i in range(3)}
        values |= {f"into_mode_{i}": float(i == after) for i in range(3)}
        mine, kept = UNEQUAL["faults"]["jump"]["modes"][after], HELD[after]
        both, A, Q = np.ix_(kept, kept), np.zeros((3, 3)), np.zeros((3, 3))
        A[both] = mine.get("A", np.array(table["A"])[both])
        A[:, [i for i in range(3) if i not in HELD[now]]] = 0.0
        Q[both] = np.array(table["Q"])[both]
        np.testing.assert_array_equal(told.A.values(values), A)
        np.testing.assert_array_equal(told.Q.values(values), Q)
        C, seen = np.zeros((2, 3)), HELD[now]
        C[:, seen] = UNEQUAL["faults"]["jump"]["modes"][now].get("C", np.array(table["C"])[:, seen])
        np.testing.assert_array_equal(told.C.values(values), C)


@pytest.mark.parametrize("time", ["discrete", "continuous"])
def test_filters_of_modes_with_fewer_states_are_consistent_with_their_trials(time):
    table = UNEQUAL
    if time == "continuous":
        jump = UNEQUAL["faults"]["jump"]
        modes = [{"states": ["p", "v"]}, {}, {"states": ["v"]}]
        model = UNEQUAL["model"] | {"time": "continuous", "sample_time": 0.2}
        model |= {"A": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -0.5, -1.0]]}
        table = UNEQUAL | {"model": model, "faults": {"jump": jump | {"modes": modes}}}
    found = fkgen.compare(fkgen.Spec.from_dict(table), ["imm"], runs=400, steps=60, u=0.3)
    for row in (found.genie, *found.rows):
        assert abs(row.nis.value - 1.0) < 4.0 * row.nis.error + 0.02 * (row is not found.genie)
    assert abs(found.genie.nees.value - 1.0) < 4.0 * found.genie.nees.error
    assert found.row("imm").relative.value > 1.0


def test_modes_and_arrivals_are_independent_chains():
    spec = jumping(jm.EXAMPLE_A, arrival="unknown", arrival_chain=jm.GILBERT)
    drawn, faults = fkgen.simulate(spec, 400, 300, 2), spec.faults.jump
    mode, arrived = drawn.mode.astype(int), drawn.arrival.astype(int)
    for path, law in ((mode, faults.transition), (arrived, jm.GILBERT)):
        kernel = np.array(law)
        count = len(kernel)
        pairs = (count * path[:, :-1] + path[:, 1:]).ravel()
        counts = np.bincount(pairs, minlength=count**2).reshape(count, count)
        total = counts.sum(axis=1, keepdims=True)
        assert (np.abs(counts - total * kernel) <= Z * np.sqrt(total * kernel * (1 - kernel))).all()
    law = lasting_law(np.array(jm.GILBERT))
    assert abs(arrived[:, 0].mean() - law[1]) < Z * np.sqrt(law[0] * law[1] / 400)
    together = arrived[mode == 2].mean() - arrived.mean()
    assert abs(together) < 0.03  # 0.5 over the root of some thousand independent stretches
    assert drawn.gamma is None
    assert drawn.delta is None


def test_without_a_channel_nothing_is_lost():
    drawn = fkgen.simulate(jumping(jm.EXAMPLE_A), 2, 5)
    assert drawn.arrival is None
    assert np.isfinite(drawn.y).all()


@pytest.mark.exhaustive
def test_filters_are_as_good_as_the_tables_say():
    """Section 4, example S, p = .85: llr .4528, imm that knows no gamma .4442, fault-free .4115."""
    spec = jumping(jm.EXAMPLE_S, arrival="unknown", arrival_rate=0.85)
    table = spec.to_dict() | {"filter": {"family": "mjls_lmmse", "detector": "llr"}}
    found = fkgen.compare(fkgen.Spec.from_dict(table), ("imm", "mjls_lmmse"), runs=300, steps=300)
    for label, value in (("imm", 0.4442), ("mjls_lmmse", 0.4528)):
        rmse = found.row(label).rmse["x0"]
        assert abs(rmse.value - value) < 4.0 * np.hypot(rmse.error, 0.001), label
        assert found.row(label).detected.value > 0.99  # P_D 1
        assert found.row(label).false_alarms.value < 1e-3  # P_FA .0000
    assert abs(found.genie.nees.value - 1.0) < 4.0 * found.genie.nees.error
    assert abs(found.genie.nis.value - 1.0) < 4.0 * found.genie.nis.error
    free = fkgen.compare(jumping(jm.EXAMPLE_S), ("mjls_lmmse", "kf"), runs=300, steps=300)
    rmse = free.row("mjls_lmmse").rmse["x0"]
    assert abs(rmse.value - 0.4115) < 4.0 * np.hypot(rmse.error, 0.0007)
    assert free.recommended == "mjls_lmmse"


def test_what_is_known_to_be_lost_is_missing_for_everyone():
    spec = jumping(jm.EXAMPLE_S, arrival="known", arrival_rate=0.7)
    found = fkgen.compare(spec, ("mjls_lmmse", "imm"), runs=200, steps=120)
    for row in (found.genie, *found.rows):
        # both estimators are exact or nearly so: section 4 has NEES of imm and LMMSE near one
        assert abs(row.nis.value - 1.0) < max(4.0 * row.nis.error, 0.05)
        assert abs(row.nees.value - 1.0) < max(4.0 * row.nees.error, 0.05)
    assert found.row("imm").relative.value <= found.row("mjls_lmmse").relative.value
