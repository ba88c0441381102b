"""The compiled imm over modes of the plant, against matrices, histories, and filters it becomes."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from imm_plants import (
    BAYES,
    DENSE,
    EXACT,
    HOLES,
    KALMAN,
    PLANTS,
    PORTS,
    SINGLE,
    START,
    TURN,
    any_modes,
    by_histories,
    jumping,
    plant,
    seen,
    system_of,
    told,
)
from plants import PARAMETERS, VARYING, assert_agree, distance, random_model, run, spec
from sensor_specs import DENSE as SENSOR_KERNEL
from sensor_specs import chain, sensed

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.enumeration import enumerate_jumps
from fkgen.oracle.textbook.switching import interacting


def same_modes(result, expected):
    """Estimates of single modes, where a mode has a probability at all."""
    for port in SINGLE:
        law = "mode" if "filtered" in port else "predicted_mode"
        possible = expected[f"{law}_probability"] > 0.0
        assert distance(result[port][possible], expected[port][possible]) < EXACT, port


@pytest.mark.parametrize("name", list(PLANTS))
def test_compiled_filters_are_the_matrix_filters(name):
    jumps = plant(name)
    y, u = seen(jumps, 12, seed=len(name), missing=0.2)
    y[5] = np.nan
    result, expected = run(jumps, y, u), interacting(system_of(jumps, 12), y, u)
    assert_agree(result, expected, PORTS, EXACT)
    same_modes(result, {f.name: getattr(expected, f.name) for f in fields(expected)})


@pytest.mark.parametrize("name", list(PLANTS))
def test_the_first_sample_is_bayes_rule(name):
    jumps = plant(name)
    y, u = seen(jumps, 2, seed=8)
    assert_agree(
        run(jumps, y[:1], u[:1]), enumerate_jumps(system_of(jumps, 1), y[:1], u[:1]), BAYES, EXACT
    )


@pytest.mark.parametrize(
    ("name", "mode"), [("everything", 1), ("process noise", 2), ("measurement", 0)]
)
def test_a_known_first_mode_makes_two_samples_bayes_rule(name, mode):
    jumps = plant(name, initial=np.eye(3)[mode])
    y, u = seen(jumps, 2, seed=mode)
    assert_agree(run(jumps, y, u), enumerate_jumps(system_of(jumps, 2), y, u), BAYES, EXACT)


@pytest.mark.parametrize("start", range(3))
def test_known_modes_make_the_kalman_filter_that_is_told_them(start):
    jumps = plant("everything", transition=TURN, initial=np.eye(3)[start])
    y, u = seen(jumps, 12, seed=9, missing=0.2)
    path = (start + np.arange(13)) % 3
    known, inputs = told(system_of(jumps, 12), path, u)
    result = run(jumps, y, u)
    assert_agree(result, batch_lmmse(known, y, inputs), KALMAN, EXACT)
    np.testing.assert_array_equal(result.mode_probability, np.eye(3)[path[:-1]])


@pytest.mark.parametrize(("count", "transition"), [(1, "identity"), (2, "identity"), (4, "dense")])
def test_equal_modes_are_the_kalman_filter(count, transition):
    model = random_model(61, 3, 2, 1, direct=True, correlated=True)
    law = np.eye(count) if transition == "identity" else np.full((count, count), 1.0 / count)
    jumps = jumping(model, [{}] * count, transition=law, initial=[1.0 / count] * count)
    y, u = seen(jumps, 30, missing=0.2)
    assert_agree(run(jumps, y, u), run(spec(model), y, u), KALMAN, 1e-12)


def test_a_plant_that_changes_in_every_sample_is_followed():
    modes = [{}, {"A": [["exp(-dt)", 0.0], ["-dt", 1.0]], "c": ["dt", "sin(angle)"]}]
    modes += [{"C": [["tan(0.2*angle)", 1.0], [1.0, 0.0]], "Q": [["2*dt", 0.0], [0.0, "dt"]]}]
    jumps = jumping(VARYING, modes, parameters=PARAMETERS)
    rng = np.random.default_rng(3)
    params = {"dt": rng.uniform(0.05, 0.4, 12), "angle": rng.uniform(-1.0, 1.0, 12)}
    y, u = seen(jumps, 12, missing=0.2, params=params)
    expected = interacting(system_of(jumps, 12, params), y, u)
    assert_agree(run(jumps, y, u, params), expected, PORTS, EXACT)


def test_conditions_of_a_sensor_are_modes_of_the_plant():
    model = random_model(62, 2, 2, correlated=True)
    faulty = sensed(model, chain(SENSOR_KERNEL, [0.4, 0.1, 0.2, 0.3]))
    C, R = np.array(model["C"]), np.array(model["R"])
    modes = [{"C": g * C, "R": d * R} for g in (1.0, 0.0) for d in (1.0, 10.0)]
    jumps = jumping(model, modes, transition=SENSOR_KERNEL, initial=[0.4, 0.1, 0.2, 0.3])
    y, u = seen(jumps, 20, missing=0.2)
    assert_agree(run(jumps, y, u), run(faulty, y, u), (*PORTS, *SINGLE), 1e-12)


def test_the_order_of_the_modes_is_of_no_account():
    order = [2, 0, 1]
    model, modes = random_model(63, 2, 1), any_modes(63, 2, 1)
    here = jumping(model, modes, transition=HOLES)
    law, start = np.array(HOLES)[np.ix_(order, order)], np.array(START)[order]
    there = jumping(model, [modes[i] for i in order], transition=law, initial=start)
    y, u = seen(here, 20, missing=0.2)
    a, b = run(here, y, u), run(there, y, u)
    assert_agree(b, a, KALMAN, 1e-11)
    assert distance(b.mode_probability, a.mode_probability[:, order]) < 1e-11


def test_coordinates_of_the_state_are_of_no_account():
    T = np.array([[2.0, 1.0], [0.5, -3.0]])
    back = np.linalg.inv(T)
    change = {
        "A": lambda A: T @ A @ back,
        "C": lambda C: C @ back,
        "Q": lambda Q: T @ Q @ T.T,
        "P0": lambda P: T @ P @ T.T,
        "x0": lambda x: T @ x,
        "c": lambda c: T @ c,
    }
    model, modes = random_model(64, 2, 1), any_modes(64, 2, 1)

    def moved(table):
        same = {key: value for key, value in table.items() if key not in change}
        return same | {k: turn(np.array(table[k])) for k, turn in change.items() if k in table}

    here, there = jumping(model, modes), jumping(moved(model), [moved(mode) for mode in modes])
    y, u = seen(here, 20, missing=0.1)
    a, b = run(here, y, u), run(there, y, u)
    assert distance(b.filtered_state, a.filtered_state @ T.T) < EXACT
    assert distance(b.predicted_covariance, T @ a.predicted_covariance @ T.T) < EXACT
    assert distance(b.mode_probability, a.mode_probability) < EXACT


def test_a_mode_that_never_comes_does_no_harm():
    """Its own estimate would grow by 5 in every sample, unseen, and overflow after 220."""
    model = random_model(66, 1, 1)
    never = {"A": [[5.0]], "C": [[0.0]]}
    jumps = jumping(model, [{}, never], transition=np.eye(2), initial=[1.0, 0.0])
    y, u = seen(jumps, 400, missing=0.1)
    result = run(jumps, y, u)
    assert_agree(result, run(spec(model), y, u), KALMAN, 1e-12)
    assert np.isfinite(result.mode_covariance).all()


@pytest.mark.parametrize("letter", ["Q", "R"])
def test_a_variance_below_zero_in_any_mode_is_refused(letter):
    jumps = jumping(
        random_model(67, 1, 1),
        [{}, {letter: [["s"]]}, {letter: [["s + 1"]]}],
        parameters={"s": 1.0},
    )
    y, u = seen(jumps, 6)
    s = np.array([1.0, 2.0, -0.5, 0.5, -2.0, 1.0])
    result = run(jumps, y, u, {"s": s})
    np.testing.assert_array_equal(result.status < 0, s < 0.0)


def leaving(model, modes, law, start):
    """A plant whose mode drives the step that leaves its sample: pairs (mode before, mode)."""
    N = len(modes)
    pairs = [(i, j) for i in range(N) for j in range(N)]
    table = [
        {key: value for key, value in modes[i].items() if key in "ABQc"}
        | {key: value for key, value in modes[j].items() if key in "CDR"}
        for i, j in pairs
    ]
    kernel = [[law[j][m] if j == k else 0.0 for k, m in pairs] for _, j in pairs]
    first = [start[j] if i == 0 else 0.0 for i, j in pairs]
    return jumping(model, table, transition=kernel, initial=first)


def test_pairs_of_modes_make_the_other_timing():
    """Where mode k moves x[k] to x[k+1], as mjls_lmmse has it, two samples are Bayes' rule."""
    model, modes = random_model(65, 2, 1), any_modes(65, 2, 1)
    law, start = np.array(DENSE), np.eye(3)[1]
    jumps = leaving(model, modes, law, start)
    y, u = seen(jumps, 2)
    own = system_of(jumping(model, modes, transition=law, initial=start), 2)
    expected = by_histories(own, y, u, leaving=True)
    result = run(jumps, y, u)
    assert result.log_likelihood.sum() == pytest.approx(expected["log_likelihood"], rel=EXACT)
    for port in ("filtered_state", "filtered_covariance"):
        assert distance(result[port][-1], expected[port]) < EXACT, port
    into = by_histories(own, y, u)
    assert distance(result.filtered_state[-1], into["filtered_state"]) > 1e-3


def test_histories_are_followed_closely_but_not_exactly():
    jumps = plant("dynamics")
    errors = []
    for seed in range(12):
        y, u = seen(jumps, 5, seed=seed)
        best = enumerate_jumps(system_of(jumps, 5), y, u)
        found = run(jumps, y, u)
        sd = np.sqrt(np.diagonal(best.filtered_covariance[-1]))
        errors.append(np.abs((found.filtered_state[-1] - best.filtered_state[-1]) / sd).max())
    # In standard deviations of the best estimate; over 100 records 0.026.
    assert 1e-6 < np.mean(errors) < 0.05
