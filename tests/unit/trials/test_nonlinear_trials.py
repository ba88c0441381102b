"""Trials of plants with f and h: again in NumPy, errors on circles and rotations, consistency."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from counters import MEASUREMENT, PRIOR, PROCESS, normals
from equations import ATTITUDE, ROBOT, table

import fkgen
from fkgen.oracle.plants.equations import space_of, system_of
from fkgen.oracle.plants.manifold import Space
from fkgen.problem import Signal
from fkgen.study.comparisons.candidates import genie_of
from fkgen.trials.errors import error_signals, errors_of

Z = 4.5  # standard errors

CORRELATED = [[4e-4, 1e-4, 0.0], [1e-4, 9e-4, 0.0], [0.0, 0.0, 0.0]]
PLANTS = {
    "robot": ROBOT | {"Q": CORRELATED, "R": [[0.01, 5e-4], [5e-4, 4e-4]]},
    "attitude": ATTITUDE,
    "continuous": ATTITUDE
    | {"time": "continuous", "sample_time": "dt", "substeps": 2}
    | {"noises": [{"name": "n", "variance": "dt*1e-3"}]}
    | {"let": {"b": "[bx, by, bz]", "a": "rotate_back(q, [0, 0, 9.81])"}}
    | {"f": {"q": "[gx, gy, gz] - b + [n, 0, 0]", "bx": "-0.1*bx"}},
}

#: A target that is held in a region, seen from a place outside of it.
TRACKER = {
    "states": [{"name": name} for name in ("px", "vx", "py", "vy")],
    "outputs": [{"name": "range", "unit": "m"}, {"name": "bearing", "unit": "rad", "wrap": True}],
    "noises": [{"name": "ax", "variance": 0.01}, {"name": "ay", "variance": 0.01}],
    "R": [[0.25, 0.0], [0.0, 0.01**2]],
    "x0": [-60.0, 1.0, 40.0, -1.0],
    "P0": np.diag([4.0, 0.1, 4.0, 0.1]).tolist(),
    "let": {"east": "px + 60", "north": "py - 10"},
    "f": {
        "px": "px + vx",
        "vx": "0.95*vx - 0.01*east + ax",
        "py": "py + vy",
        "vy": "0.95*vy - 0.01*north + ay",
    },
    "h": {"range": "hypot(px, py)", "bearing": "atan2(py, px)"},
}
SENSOR = {"noise_factor": 25.0, "rows": [0], "problem": 1}
SENSOR |= {"gamma_rate": 0.9, "delta_nominal_rate": 0.7}
MODES = {
    "transition": [[0.9, 0.1], [0.3, 0.7]],
    "modes": [{}, {"R": [[25.0, 0.0], [0.0, 1e-3]], "h": {"range": "hypot(px, py) + 20"}}],
}


@cache
def tracker(family="ekf"):
    faults = {"imm": {"jump": MODES}, "one_step": {"sensor": SENSOR}, "genie": {"sensor": SENSOR}}
    sections = {"faults": faults[family]} if family in faults else {}
    return fkgen.Spec.from_dict(table(TRACKER, {}, family=family, **sections))


def again(spec, found, trial, params):
    """One trial by the oracle's functions, from the numbers of the counters."""
    T, seed, model = found.y.shape[1], found.request.seed, spec.model
    jump, sensor = spec.faults.jump, spec.faults.sensor
    modes = [None] if jump is None else jump.modes
    systems = [system_of(spec, T, params, mode) for mode in modes]
    if sensor is not None:
        systems = [systems[0].told(sensor.rows, found.gamma[trial], found.delta[trial])]
    u = np.broadcast_to(found.u, (T, model.nu))
    u = u * found.gamma[trial] if spec.faults.actuator is not None else u
    space, r = systems[0].space, systems[0].nw
    error = np.linalg.cholesky(model.P0.values()) @ normals(seed, trial, 0, PRIOR, space.ne)
    x = space.moved(systems[0].x0, error)
    states, measured = [], []
    for k in range(T):
        system = systems[0 if jump is None else found.mode[trial, k]]
        states.append(x)
        nominal = system_of(spec, T, params).R[k] if sensor is not None else system.R[k]
        v = np.linalg.cholesky(nominal) @ normals(seed, trial, k, MEASUREMENT, model.ny)
        if sensor is not None:
            v[list(sensor.rows)] *= np.sqrt(found.delta[trial, k])
        seen = system.measured(k, x, u[k]) + v
        measured.append(system.residual(seen, np.zeros(model.ny)))
        W, Q = system.noises(k)
        drawn = normals(seed, trial, k, PROCESS, space.ne + r)
        moved = np.array(system.step(k, x, u[k], np.sqrt(W) * drawn[space.ne :]))
        x = space.moved(moved, lower(Q) @ drawn[: space.ne])
    return np.array(states), np.array(measured)


def lower(Q):
    """The lower triangular root of a covariance whose last rows may be zero."""
    there = np.diag(Q) > 0.0
    root = np.zeros_like(Q)
    root[np.ix_(there, there)] = np.linalg.cholesky(Q[np.ix_(there, there)])
    return root


ACTUATOR = {"success_rate": [0.7, 0.5], "dependence": "independent"}
CASES = {
    **{name: table(plant, family="ekf") for name, plant in PLANTS.items()},
    "inputs fail": table(PLANTS["robot"], family="mkf", faults={"actuator": ACTUATOR}),
}


@pytest.mark.parametrize("name", [*CASES, "imm", "one_step"])
def test_a_trial_is_what_the_functions_make_of_the_same_numbers(name):
    spec = fkgen.Spec.from_dict(CASES[name]) if name in CASES else tracker(name)
    T, rng = 30, np.random.default_rng(3)
    u = rng.normal(size=(T, spec.model.nu)) if spec.model.nu else None
    params = {"dt": rng.uniform(0.05, 0.2, T)} if spec.parameters else {}
    found = fkgen.simulate(spec, 3, T, 2**33 + 5, u, params=params)
    for trial in range(3):
        x, y = again(spec, found, trial, params)
        np.testing.assert_allclose(found.state[trial], x, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found.y[trial], y, rtol=1e-11, atol=1e-11)
    if name == "imm":
        assert set(np.unique(found.mode)) == {0, 1}
    if name == "robot":  # the bearing left (-pi, pi] on the way
        assert np.abs(found.y[..., 1]).max() <= np.pi


def test_trials_of_functions_do_not_depend_on_their_company():
    spec = tracker("imm")
    whole, part = fkgen.simulate(spec, 9, 30, 5), fkgen.simulate(spec, 3, 12, 5, first=4)
    for name in ("y", "state", "mode"):
        assert np.array_equal(getattr(whole, name)[4:7, :12], getattr(part, name))


def test_errors_are_the_shortest_on_circles_and_rotations():
    states = (Signal("a"), Signal("h", wrap=True), Signal("q", manifold="SO3"), Signal("b"))
    space, rng = Space(("line", "circle", "SO3", "line")), np.random.default_rng(1)
    assert space_of(states) == space
    truth = rng.normal(size=(40, 7)) * [1.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    truth[:, 2:6] /= np.linalg.norm(truth[:, 2:6], axis=1, keepdims=True)
    turns = rng.normal(size=(40, 6)) * [1.0, 4.0, 1.0, 1.0, 1.0, 1.0]
    estimate = np.array([space.moved(*pair) for pair in zip(truth, turns, strict=True)])
    estimate[:5] = [space.moved(x, 1e-10 * rng.normal(size=6)) for x in truth[:5]]
    expected = [space.minus(*pair) for pair in zip(truth, estimate, strict=True)]
    found = errors_of(states, truth, estimate)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    assert np.abs(truth - estimate)[:, 1].max() > np.pi > np.abs(found[:, 1]).max()
    names = [each.name for each in error_signals(states)]
    assert names == ["a", "h", "q[x]", "q[y]", "q[z]", "b"]


def test_a_lost_signal_without_a_value_is_its_noise():
    plant = TRACKER | {
        "h": {"range": "sqrt(px)", "bearing": "atan2(py, px)"},
        "x0": [60.0, 0, 9, 0],
    }
    plant |= {"f": TRACKER["f"] | {"vx": "0.95*vx - 3 + ax"}}
    faults = {"sensor": SENSOR | {"gamma_rate": 0.0}}
    spec = fkgen.Spec.from_dict(table(plant, {}, family="one_step", faults=faults))
    found = fkgen.simulate(spec, 4, 60, 1)
    assert (found.state[:, -1, 0] < 0.0).all()
    assert np.isfinite(found.y).all()
    working = fkgen.Spec.from_dict(table(plant, {}, family="ekf"))
    with pytest.raises(fkgen.DataError, match="overflow at sample"):
        fkgen.simulate(working, 4, 60, 1)


def consistent(row, allowed):
    return abs(row.nees.value - 1.0) < max(allowed, Z * row.nees.error)


def test_a_tracker_is_consistent_and_filters_are_compared_on_it():
    found = fkgen.compare(tracker(), runs=60, steps=150, skip=0)
    assert {row.label for row in found.rows} == {"ekf", "iekf", "ukf"}
    assert found.row("ekf").relative.value == 1.0
    for row in found.rows:
        assert consistent(row, 0.05), row
        assert abs(row.nis.value - 1.0) < Z * row.nis.error


@pytest.mark.exhaustive
def test_the_mean_nees_of_a_tracker_is_within_a_twentieth_of_one():
    spec = tracker()
    found = fkgen.compare(spec, ("ekf", "iekf", "ukf"), runs=200, steps=500, skip=0, seed=1)
    for row in found.rows:
        assert abs(row.nees.value - 1.0) < 0.05, row


@pytest.mark.parametrize("family", ["imm", "one_step"])
def test_one_who_is_told_modes_or_faults_does_better_and_knows_how_well(family):
    spec = tracker(family)
    assert genie_of(spec).filter.family == ("ekf" if family == "imm" else "genie")
    found = fkgen.compare(spec, (family, "ekf"), runs=60, steps=150)
    assert consistent(found.genie, 0.05)
    assert 1.0 < found.row(family).relative.value < found.row("ekf").relative.value
    assert found.row("ekf").nees.value > 1.5


def test_an_attitude_is_scored_by_its_rotation_vector():
    quiet = ATTITUDE | {"P0": np.diag([1e-3] * 3 + [1e-4] * 3).tolist()}
    quiet |= {"R": np.diag([0.2] * 3).tolist(), "Q": np.diag([1e-5] * 3 + [1e-7] * 3).tolist()}
    spec = fkgen.Spec.from_dict(table(quiet, family="ekf"))
    found = fkgen.compare(spec, ("ekf",), runs=60, steps=60, skip=0, u=[0.3, -0.2, 0.1])
    row = found.row("ekf")
    assert list(row.rmse) == ["q[x]", "q[y]", "q[z]", "bx", "by", "bz"]
    assert consistent(row, 0.1), row
