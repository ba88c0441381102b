"""Compiled one-step and interacting filters against matrices, enumeration and known cases."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from imm_plants import KALMAN, PORTS
from plants import assert_agree, distance, random_model, run
from sensor_plants import with_modes
from sensor_specs import (
    EXACT,
    MATCHED,
    PROBLEMS,
    SCALAR,
    SWITCHING,
    TURN,
    centred,
    chain,
    plane,
    product,
    seen,
    sensed,
    shaken,
    textbook,
    varying,
)

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.enumeration import enumerate_modes
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw

BAYES = tuple(port for port in PORTS if port != "nis")

#: n, p, q, rows that fail, law.
PLANTS = {
    "1 state": (1, 1, 0, [0], "1"),
    "input": (2, 1, 1, [0], "3"),
    "one row of two": (2, 2, 1, [1], "zeros"),
    "two rows of three": (3, 3, 1, [0, 2], "4"),
    "more rows than states": (2, 3, 0, [0, 1, 2], "2"),
}
IID_NOISE = [[0.8, 0.2], [0.8, 0.2]]
STICKY = [[0.8, 0.2], [0.3, 0.7]]
TURNING = [[0.1, 0.9], [0.9, 0.1]]


def plant(name, which):
    n, p, q, rows, law = PLANTS[name]
    model = random_model(40 + 10 * n + p, n, p, q, direct=q > 0, correlated=True)
    return sensed(model, PROBLEMS[law] | {"rows": rows}, **SWITCHING[which])


def exact(spec, y, u):
    """Bayes' rule over all histories."""
    return enumerate_modes(LinearSystem.from_spec(spec, len(y)), SensorLaw.from_spec(spec), y, u)


def same_modes(result, expected):
    """Estimates of single modes, where a mode has a probability at all."""
    for prefix, law in (("mode_filtered", "mode"), ("mode", "predicted_mode")):
        possible = expected[f"{law}_probability"] > 0.0
        for what in ("state", "covariance"):
            port = f"{prefix}_{what}"
            assert distance(result[port][possible], expected[port][possible]) < EXACT, port


@pytest.mark.parametrize(
    ("name", "which"),
    [
        (name, which)
        for name in PLANTS
        for which in SWITCHING
        if which in MATCHED or name in {"input", "one row of two"}
    ],
)
def test_compiled_filters_are_the_matrix_filters(name, which):
    spec = plant(name, which)
    y, u, _ = seen(spec, 12, seed=len(name), missing=0.2)
    y[5] = np.nan
    result, expected = run(spec, y, u), textbook(spec, y, u)
    assert_agree(result, expected, PORTS, EXACT)
    if spec.filter.family == "imm":
        same_modes(result, {f.name: getattr(expected, f.name) for f in fields(expected)})


@pytest.mark.parametrize("which", ["one_step", "paper", "imm", "imm3"])
def test_a_plant_that_changes_in_every_sample_is_followed(which):
    spec = varying(PROBLEMS["4"] | {"rows": [1]}, **SWITCHING[which])
    params = shaken(10)
    y, u, _ = seen(spec, 10, missing=0.2, params=params)
    assert_agree(run(spec, y, u, params), textbook(spec, y, u, params), PORTS, EXACT)


@pytest.mark.parametrize("which", MATCHED)
@pytest.mark.parametrize("name", list(PLANTS))
def test_the_first_sample_is_bayes_rule(name, which):  # o
    spec = plant(name, which)
    y, u, _ = seen(spec, 2, seed=8)
    assert_agree(run(spec, y[:1], u[:1]), exact(spec, y[:1], u[:1]), BAYES, EXACT)


@pytest.mark.parametrize("which", ["one_step", "imm", "imm3"])
@pytest.mark.parametrize(
    ("kernel", "mode"), [(np.eye(4), j) for j in range(4)] + [(TURN, 0), (TURN, 3)]
)
def test_known_modes_make_the_kalman_filter_that_is_told_them(kernel, mode, which):  # m, n
    if which == "imm3" and kernel is TURN:
        pytest.skip("three modes cannot follow delta while gamma = 0")
    model = centred(random_model(44, 2, 1))
    spec = sensed(model, chain(kernel, np.eye(4)[mode]), **SWITCHING[which])
    y, u, modes = seen(spec, 10, seed=9, missing=0.2)
    result = run(spec, y, u)
    system, law = LinearSystem.from_spec(spec, 10), SensorLaw.from_spec(spec)
    told = batch_lmmse(with_modes(system, law, modes), y, u)
    assert_agree(result, told, KALMAN, EXACT)
    where = np.minimum(modes, 2) if which == "imm3" else modes
    wide = 3 if which == "imm3" else 4
    np.testing.assert_array_equal(result.mode_probability, np.eye(wide)[where])


@pytest.mark.exhaustive
def test_distances_from_bayes_rule_are_those_of_the_approximations():  # p
    law = product([[0.1, 0.9], [0.9, 0.1]], IID_NOISE)
    specs = {which: sensed(SCALAR, law, **SWITCHING[which]) for which in ("imm", "one_step")}
    found = dict.fromkeys(specs, 0.0)
    for seed in range(12):
        y, u, _ = seen(specs["imm"], 5, seed=seed)
        best = exact(specs["imm"], y, u).filtered_state[-1, 0]
        for which, spec in specs.items():
            found[which] += abs(run(spec, y).filtered_state[-1, 0] - best) / 12
    # Over 200 records 0.005 to 0.012 with mixing, 0.09 to 0.13 without.
    assert 1e-4 < found["imm"] < 0.02
    assert 0.05 < found["one_step"] < 0.2


@pytest.mark.parametrize("which", MATCHED)
def test_problem_1_is_a_case_of_problem_3_and_that_of_problem_4(which):  # q
    g, d = 0.7, 0.8
    row = [g * d, g * (1 - d), (1 - g) * d, (1 - g) * (1 - d)]
    laws = (
        PROBLEMS["1"],
        product([[1 - g, g]] * 2, [[d, 1 - d]] * 2),
        {"problem": 4, "kernel": [row] * 4},
    )
    model = random_model(42, 2, 1)
    specs = [sensed(model, law, **SWITCHING[which]) for law in laws]
    y, u, _ = seen(specs[0], 20, missing=0.1)
    first = run(specs[0], y, u)
    for other in specs[1:]:
        # Probabilities differ by the rounding of their products.
        assert_agree(run(other, y, u), first, PORTS, 1e-12)


@pytest.mark.parametrize("name", ["1 state", "more rows than states"])
def test_equal_rows_of_the_kernel_leave_nothing_to_mix(name):  # r
    imm, one_step = plant(name, "imm"), plant(name, "one_step")
    y, u, _ = seen(imm, 20, missing=0.2)
    # Another order of summation.
    assert_agree(run(imm, y, u), run(one_step, y, u), PORTS, 1e-11)


@pytest.mark.parametrize(
    ("delta", "initial", "lumpable"),
    [(IID_NOISE, (0.5, 0.8), True), (STICKY, (0.5, 0.6), False), (IID_NOISE, (0.5, 0.3), False)],
    ids=["noise without memory", "noise with memory", "another start"],
)
def test_three_modes_are_four_where_noise_has_no_memory_only(delta, initial, lumpable):  # s
    law = product(TURNING, delta, initial=initial, rows=[0])
    three, four = (sensed(plane(), law, **SWITCHING[which]) for which in ("imm3", "imm"))
    y, u, _ = seen(four, 20, missing=0.1)
    a, b = run(three, y, u), run(four, y, u)
    if not lumpable:
        assert np.abs(a.filtered_state - b.filtered_state).max() > 1e-4
        return
    assert_agree(a, b, KALMAN, 1e-11)
    silent = b.mode_probability[:, 2:].sum(axis=1)
    assert distance(a.mode_probability[:, 2], silent) < 1e-11


@pytest.mark.parametrize("which", MATCHED)
def test_noise_of_one_size_makes_a_product_law_of_it_of_no_account(which):  # t
    laws = [product(STICKY, delta, initial=(0.5, 0.8)) for delta in (STICKY, TURNING)]
    specs = [sensed(plane(), law | {"noise_factor": 1.0}, **SWITCHING[which]) for law in laws]
    y, u, _ = seen(specs[0], 20)
    assert_agree(*(run(spec, y, u) for spec in specs), KALMAN, 1e-11)


def test_noise_of_one_size_still_splits_modes_if_it_is_tied_to_the_signal_at_first():  # t
    start = [0.5, 0.0, 0.0, 0.5]
    laws = [
        {**product(STICKY, delta), "initial": start, "noise_factor": 1.0}
        for delta in (STICKY, TURNING)
    ]
    differ = {}
    for which in MATCHED:
        specs = [sensed(plane(), law, **SWITCHING[which]) for law in laws]
        y, u, _ = seen(specs[0], 20)
        states = [run(spec, y, u).filtered_state for spec in specs]
        differ[which] = np.abs(states[0] - states[1]).max()
    assert differ["imm"] > 1e-6
    assert differ["one_step"] < 1e-12


@pytest.mark.parametrize("which", MATCHED)
def test_sensors_that_see_no_state_say_nothing_of_state_or_signal(which):  # u
    gamma, rate = np.array(STICKY), 0.3
    law = product(STICKY, TURNING, initial=(rate, 0.6))
    spec = sensed(plane(C=np.zeros((2, 2))), law, **SWITCHING[which])
    y, u, _ = seen(spec, 15)
    result = run(spec, y, u)
    np.testing.assert_array_equal(result.filtered_state, 0.0)
    # Pr(gamma = 1) follows its own chain, in the order (0, 1), whatever y says about the noise.
    for p in result.mode_probability:
        assert p[:2].sum() == pytest.approx(rate, rel=1e-12)
        rate = np.array([1 - rate, rate]) @ gamma[:, 1]


@pytest.mark.parametrize("which", list(SWITCHING))
def test_the_other_sign_of_all_measurements_is_the_other_sign_of_the_state(which):  # v
    spec = sensed(plane(), PROBLEMS["4"], **SWITCHING[which])
    y, u, _ = seen(spec, 15, missing=0.2)
    here, there = run(spec, y, u), run(spec, -y, u)
    np.testing.assert_array_equal(there.filtered_state, -here.filtered_state)
    for port in ("mode_probability", "filtered_covariance", "log_likelihood"):
        np.testing.assert_array_equal(there[port], here[port])
