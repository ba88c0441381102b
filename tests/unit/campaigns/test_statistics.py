"""Statistics of a campaign against brute force: simulate, filter, and NumPy over whole arrays."""

from __future__ import annotations

import json
import math

import numpy as np
import plants
import pytest
from scipy.stats import chi2
from sensor_specs import SCALAR

import fkgen
from fkgen.study.campaigns import block

MODEL = {
    "A": [[1.0, 0.1], [0.0, 0.95]],
    "C": [[1.0, 0.0], [0.5, 1.0]],
    "Q": [[0.001, 0.0], [0.0, 0.01]],
    "R": [[0.04, 0.01], [0.01, 0.09]],
    "x0": [0.0, 1.0],
    "P0": [[1.0, 0.0], [0.0, 0.0]],  # one direction has no variance at sample 0
}
SENSOR = {
    "noise_factor": 10.0,
    "problem": 3,
    "gamma_chain": [[0.8, 0.2], [0.3, 0.7]],
    "delta_chain": [[0.9, 0.1], [0.4, 0.6]],
}
RATIOS = ("bias", "nees", "nis", "coverage", "calibration", "delay", "false_alarm", "detected")
RATIOS += ("sensor_nis", "whiteness", "predicted")


def spec_of(filter_, model=MODEL, **sections):
    return fkgen.Spec.from_dict({"name": "tried", "model": model, "filter": filter_, **sections})


def jumping():
    modes = [{"Q": MODEL["Q"]}, {"A": [[1.0, 0.1], [0.0, 0.5]]}]
    jump = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5], "modes": modes}
    return spec_of({"family": "imm"}, faults={"jump": jump})


THREE = {
    "A": [[0.9, 0.1, 0.0], [0.0, 0.95, 0.1], [-0.2, 0.0, 0.8]],
    "C": [[1.0, 0.5, 0.0], [0.0, 1.0, -1.0]],
    "Q": [[0.1, 0.05, 0.02], [0.05, 0.2, -0.1], [0.02, -0.1, 0.3]],
    "R": [[0.04, 0.01], [0.01, 0.09]],
    "x0": [0.0, 1.0, 0.0],
    "P0": [[1.0, 0.5, 0.2], [0.5, 2.0, 0.3], [0.2, 0.3, 0.5]],
}
CASES = {
    "kf": lambda: spec_of({"family": "kf"}),
    "three states": lambda: spec_of({"family": "kf"}, THREE),
    "float": lambda: spec_of({"family": "kf"}, code={"scalar": "float"}),
    "sensor": lambda: spec_of({"family": "imm"}, SCALAR, faults={"sensor": SENSOR}),
    "three modes": lambda: spec_of(
        {"family": "imm", "modes": 3}, SCALAR, faults={"sensor": SENSOR}
    ),
    "jump": jumping,
}


def ratio(a, b):
    """A ratio of means over trials (M, ...), and its standard error."""
    a, b = np.broadcast_arrays(np.asarray(a, float), np.asarray(b, float))
    trials = len(a)
    with np.errstate(invalid="ignore", divide="ignore"):
        value = a.sum(axis=0) / b.sum(axis=0)
        influence = (a - value * b) / b.mean(axis=0)
    return value, influence.std(axis=0, ddof=1) / math.sqrt(trials)


def brute_force(spec, trials, steps, seed):
    """Every statistic, from the arrays of all trials."""
    drawn = fkgen.simulate(spec, trials, steps, seed)
    run = fkgen.build(spec.whole).run_batch(drawn.y)
    e = drawn.state - run.filtered_state
    P = np.asarray(run.filtered_covariance, float)
    n, p = e.shape[2], drawn.y.shape[2]
    rank = np.linalg.matrix_rank(P, tol=1e-12, hermitian=True)
    weighted = np.einsum("mti,mtij,mtj->mt", e, np.linalg.pinv(P, rcond=1e-9, hermitian=True), e)
    sigma = np.sqrt(np.diagonal(P, axis1=2, axis2=3))
    z = run.innovation / np.sqrt(np.diagonal(run.innovation_covariance, axis1=2, axis2=3))
    z = np.asarray(z, float)
    inside = np.stack([np.abs(e) <= k * sigma for k in (1, 2, 3)], axis=3)
    found = {
        "bias": ratio(e.mean(axis=1), 1.0),
        "nees": ratio(weighted.sum(axis=1), rank.sum(axis=1)),
        "nis": ratio(run.nis.sum(axis=1, dtype=float), np.full(trials, steps * p)),
        "coverage": ratio(inside.mean(axis=1), 1.0),
        "sensor_nis": ratio((z**2).sum(axis=1), np.full((trials, p), steps)),
        "whiteness": ratio((z[:, 1:] * z[:, :-1]).sum(axis=1), np.full((trials, p), steps - 1)),
    }
    square, error = ratio((e**2).mean(axis=1), np.ones((trials, n)))
    found["rmse"] = np.sqrt(square), error / (2.0 * np.sqrt(square))
    if not spec.faults.plain():
        alarms = (run.nis > chi2.ppf(0.99, p)).sum(axis=1)
        found["false_alarm"] = ratio(alarms, np.full(trials, steps))
    if "mode_probability" in run.ports:
        found |= of_modes(np.asarray(run.mode_probability, float), drawn.mode)
    if spec.faults.sensor is not None:
        alarm = run.mode_probability[..., 0] < 0.5
        found |= of_faults(drawn.mode != 0, alarm)
    return found


def of_modes(probability, mode):
    trials, steps, count = probability.shape
    hits, sums, total = (np.zeros((trials, count, 10)) for _ in range(3))
    for m in range(trials):
        for k in range(steps):
            for i in range(count):
                b = min(int(10 * probability[m, k, i]), 9)
                total[m, i, b] += 1
                sums[m, i, b] += probability[m, k, i]
                hits[m, i, b] += i == min(mode[m, k], count - 1)
    return {"calibration": ratio(hits, total), "predicted": ratio(sums, total)}


def of_faults(fault, alarm):
    counts = np.zeros((len(fault), 5))
    for m, (f, a) in enumerate(zip(fault.tolist(), alarm.tolist(), strict=True)):
        k, steps = 0, len(f)
        counts[m, :2] = f.count(False), sum(said for bad, said in zip(f, a, strict=True) if not bad)
        while k < steps:
            if not f[k]:
                k += 1
                continue
            end = f.index(False, k) if False in f[k:] else steps
            if k > 0:
                counts[m, 2] += 1
                if any(a[k:end]):
                    counts[m, 3] += 1
                    counts[m, 4] += a[k:end].index(True)
            k = end
    healthy, alarms, onsets, caught, waited = counts.T
    pairs = {"delay": (waited, caught), "detected": (caught, onsets)}
    return {key: ratio(*each) for key, each in (pairs | {"false_alarm": (alarms, healthy)}).items()}


@pytest.mark.parametrize("case", CASES)
def test_every_statistic_is_that_of_numpy(case, monkeypatch):
    monkeypatch.setattr(block, "_SAMPLES", 1000)  # several blocks, and a smaller last one
    spec, tolerance = CASES[case](), 1e-4 if case == "float" else 1e-9
    found = fkgen.montecarlo(spec, 101, 40, seed=3)
    assert found.trials == 101
    expected = brute_force(spec, 101, 40, 3)
    for key, (value, error) in expected.items():
        given = getattr(found, key)
        assert np.shape(given.value) == np.shape(given.standard_error) == np.shape(value), key
        np.testing.assert_allclose(given.value, value, rtol=tolerance, atol=1e-12, err_msg=key)
        np.testing.assert_allclose(
            given.standard_error, error, rtol=100 * tolerance, atol=1e-12, err_msg=key
        )
    for key in {*RATIOS} - {*expected}:
        assert not np.isfinite(getattr(found, key).value).any(), key
    facts = json.loads(found.to_json())
    assert facts["rmse"]["value"] == found.rmse.value.tolist()
    assert facts["verdicts"] == found.verdicts


def test_inputs_and_parameters_reach_plant_and_filter():
    model = plants.random_model(2, 1, 1, 1) | {"R": [["r"]]}
    spec = plants.spec(model, parameters={"r": 0.5})
    u, r = np.linspace(0.0, 5.0, 30)[:, None], np.linspace(0.1, 2.0, 30)
    drawn = fkgen.simulate(spec, 20, 30, 1, u, params={"r": r})
    run = fkgen.build(spec).run_batch(drawn.y, u, {"r": r})
    rmse = np.sqrt(((drawn.state - run.filtered_state) ** 2).mean(axis=(0, 1)))
    found = fkgen.montecarlo(spec, 20, 30, 1, u=u, params={"r": r})
    np.testing.assert_allclose(found.rmse.value, rmse, rtol=1e-12)
    each = u + np.arange(20.0)[:, None, None]
    drawn = fkgen.simulate(spec, 20, 30, 1, each, params={"r": 0.3})
    run = fkgen.build(spec).run_batch(drawn.y, each, {"r": 0.3})
    bias = (drawn.state - run.filtered_state).mean(axis=(0, 1))
    found = fkgen.montecarlo(spec, 20, 30, 1, u=each, params={"r": 0.3})
    np.testing.assert_allclose(found.bias.value, bias, rtol=1e-10)


def test_a_parameter_of_plant_and_filter_has_a_default_in_each():
    """The filter is told the plant's only where the caller says so, which tells both."""
    model = plants.random_model(2, 1, 1) | {"R": [["r"]]}
    spec, truth = (plants.spec(model, parameters={"r": r}) for r in (0.7, 2.0))
    for params in (None, {"r": 0.3}):
        drawn = fkgen.simulate(truth, 20, 30, 1, params=params)
        run = fkgen.build(spec).run_batch(drawn.y, params=params)
        found = fkgen.montecarlo(spec, 20, 30, 1, truth=truth, params=params)
        np.testing.assert_allclose(found.nis.value, run.nis.mean(), rtol=1e-12)
        rmse = np.sqrt(((drawn.state - run.filtered_state) ** 2).mean(axis=(0, 1)))
        np.testing.assert_allclose(found.rmse.value, rmse, rtol=1e-12)
    swept = fkgen.sweep(spec, {"parameters.r": [2.0]}, 20, 30, 1).cells[0]
    assert swept.to_json() == fkgen.montecarlo(spec, 20, 30, 1, truth=truth).to_json()


def test_angles_count_by_the_shortest_way():
    states = [{"name": "a", "wrap": True}]
    model = {"A": [[1.0]], "C": [[1.0]], "Q": [[0.5]], "R": [[0.1]], "x0": [3.0], "P0": [[1.0]]}
    model |= {"states": states, "outputs": [{"name": "b", "wrap": True}]}
    spec = spec_of({"family": "ekf"}, model)
    found = fkgen.montecarlo(spec, 50, 100)
    drawn = fkgen.simulate(spec, 50, 100)
    run = fkgen.build(spec).run_batch(drawn.y)
    e = np.angle(np.exp(1j * (drawn.state - run.filtered_state)))
    np.testing.assert_allclose(found.rmse.value, np.sqrt((e**2).mean(axis=(0, 1))), rtol=1e-12)
