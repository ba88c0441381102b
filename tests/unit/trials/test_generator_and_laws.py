"""Simulation: the generator by its known answers, a trial by NumPy, laws by their frequencies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import product
from statistics import NormalDist

import numpy as np
import plants
import pytest
from counters import FAULTS, MEASUREMENT, PRIOR, PROCESS, chosen, normals, philox, uniforms
from scipy import special, stats
from toolchain import C_COMPILERS, each

import fkgen
from fkgen.faults.actuator import pattern_law
from fkgen.oracle.sampled import draw_record
from fkgen.runtime import blocks
from fkgen.trials.sampler import sampler as sampler_of

KERNEL = [[0.7, 0.1, 0.2, 0.0], [0.3, 0.6, 0.0, 0.1], [0.5, 0.0, 0.4, 0.1], [0.0, 0.2, 0.3, 0.5]]
SENSOR = {"noise_factor": 9.0, "rows": [1], "problem": 4, "kernel": KERNEL}
Z = 4.5  # standard errors: some thirty comparisons with fixed seeds, none of which may fail

#: Random123, tests/kat_vectors: philox4x32 with 10 rounds; counter, key, words.
KNOWN = [
    ((0,) * 4, (0,) * 2, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((2**32 - 1,) * 4, (2**32 - 1,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.fixture(scope="module")
def plant():
    return plants.spec(plants.random_model(3, 3, 2, 2, direct=True, correlated=True))


@pytest.fixture(scope="module")
def sensor():
    model = plants.random_model(3, 3, 2, correlated=True)
    return plants.spec(model, family="imm", sensor=SENSOR)


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_the_generator_gives_the_known_answers(plant, counter, key, words):
    assert sampler_of(plant).block(counter, key) == words
    assert tuple(philox(counter, key)) == words


def test_normal_numbers_are_quantiles(plant):
    sampler, ends = sampler_of(plant), 2.0 ** -np.arange(2.0, 53.0)
    at = np.concatenate([np.random.default_rng(1).random(3000), ends, 1.0 - ends])
    ours = np.array([sampler.quantile(p) for p in at])
    # AS 241 promises 1e-16 relative; evaluating it, and ndtri, rounds a dozen times
    np.testing.assert_allclose(ours, special.ndtri(at), rtol=4e-15, atol=1e-16)
    np.testing.assert_allclose(ours, [NormalDist().inv_cdf(p) for p in at], rtol=4e-15, atol=1e-16)


def test_noise_is_the_quantile_of_its_counter_bit_for_bit():
    white = {"A": [[0.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "x0": [0.0], "P0": [[1.0]]}
    spec = plants.spec(white)
    state, quantile = fkgen.simulate(spec, 3, 100, 9).state[..., 0], sampler_of(spec).quantile
    for m in range(3):
        chances = [uniforms(9, m, 0, PRIOR, 1)[0]]
        chances += [uniforms(9, m, k, PROCESS, 1)[0] for k in range(99)]
        assert state[m].tolist() == [quantile(chance) for chance in chances]


def trial_again(spec, seed, trial, u, params):
    """One trial by NumPy: states, measurements and conditions."""
    T, model, faults = len(u), spec.model, spec.faults.sensor
    at = [{n: float(v[k % len(v)]) for n, v in params.items()} for k in range(T)]
    x = model.x0.values()[:, 0] + np.linalg.cholesky(model.P0.values()) @ normals(
        seed, trial, 0, PRIOR, model.nx
    )
    states, measured, modes = [], [], []
    for k in range(T):
        A, B, C, D, Q, R = (getattr(model, letter).values(at[k]) for letter in "ABCDQR")
        signal = deviation = np.ones(model.ny)
        if faults is not None:
            law = faults.kernel[modes[-1]] if modes else faults.initial
            chance = uniforms(seed, trial, k, FAULTS, 1)[0]
            modes.append(chosen(law, chance))
            struck = np.isin(np.arange(model.ny), faults.rows)
            signal = np.where(struck & (modes[-1] >= 2), 0.0, 1.0)
            deviation = np.where(struck & (modes[-1] % 2 == 1), faults.noise_factor**0.5, 1.0)
        v = np.linalg.cholesky(R) @ normals(seed, trial, k, MEASUREMENT, model.ny)
        states.append(x)
        measured.append(signal * (C @ x + D @ u[k]) + deviation * v)
        w = np.linalg.cholesky(Q) @ normals(seed, trial, k, PROCESS, model.nx)
        x = A @ x + B @ u[k] + w
    return np.array(states), np.array(measured), modes


def test_a_trial_is_what_numpy_makes_of_the_same_numbers(sensor):
    varying = plants.spec(plants.VARYING, parameters=plants.PARAMETERS)
    rng, T, seed = np.random.default_rng(2), 40, 2**40 + 7
    given = {"dt": rng.uniform(0.05, 0.2, T), "angle": [0.4]}
    for spec, u, params in (
        (varying, rng.standard_normal((T, 1)), given),
        (sensor, np.zeros((T, 0)), {}),
    ):
        told = u if u.size else None
        found = fkgen.simulate(spec, 3, T, seed, told, params=params)
        for m in range(3):
            x, y, modes = trial_again(spec, seed, m, u, params)
            np.testing.assert_allclose(found.state[m], x, rtol=1e-11, atol=1e-11)
            np.testing.assert_allclose(found.y[m], y, rtol=1e-11, atol=1e-11)
            assert spec is varying or found.mode[m].tolist() == modes


def test_a_trial_does_not_depend_on_its_company(sensor, monkeypatch):
    whole = fkgen.simulate(sensor, 9, 30, 5)
    part = fkgen.simulate(sensor, 3, 12, 5, first=4)
    monkeypatch.setattr(blocks, "cores", lambda: 1)
    monkeypatch.setattr("fkgen.trials.simulation.BLOCK", 1)
    alone = fkgen.simulate(sensor, 9, 30, 5)
    for name in ("y", "state", "mode", "gamma", "delta"):
        assert np.array_equal(getattr(whole, name)[4:7, :12], getattr(part, name))
        assert np.array_equal(getattr(whole, name), getattr(alone, name))
    assert not np.array_equal(whole.y, fkgen.simulate(sensor, 9, 30, 6).y)


@pytest.mark.compiled
@pytest.mark.parametrize("compiler", each(C_COMPILERS))
def test_another_process_and_another_compiler_draw_the_same_bits(sensor, compiler, tmp_path):
    code = (
        "import sys, json, fkgen; spec = fkgen.Spec.from_dict(json.loads(sys.argv[1]));"
        "print(fkgen.simulate(spec, 2, 300, 5, first=7).y.tobytes().hex())"
    )
    chosen_by = {"FKGEN_CC": " ".join(C_COMPILERS[compiler]), "FKGEN_CACHE": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(sensor.to_dict())],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **chosen_by},
    )
    here = fkgen.simulate(sensor, 2, 300, 5, first=7).y
    assert done.stdout.strip() == here.tobytes().hex()


@pytest.mark.parametrize("family", ["kf", "mkf", "imm"])
def test_measurements_are_distributed_as_those_of_the_numpy_sampler(family, plant, sensor):
    faults = {"success_rate": [0.6, 0.9], "dependence": "independent"}
    mkf = plants.spec(plants.random_model(3, 3, 2, 2, direct=True), family="mkf", actuator=faults)
    spec = {"kf": plant, "mkf": mkf, "imm": sensor}[family]
    runs, T, rng = 1200, 4, np.random.default_rng(8)
    u = np.ones((T, spec.model.nu))
    ours = fkgen.simulate(spec, runs, T, 11, u if u.size else None).y.reshape(runs, -1)
    theirs = np.array([draw_record(spec, {}, u, rng)[0] for _ in range(runs)]).reshape(runs, -1)
    for column in range(ours.shape[1]):
        assert stats.ks_2samp(ours[:, column], theirs[:, column]).pvalue > 1e-4
    # second moments of pairs, across time too: each has its own standard error
    for i, j in product(range(ours.shape[1]), repeat=2):
        a, b = ours[:, i] * ours[:, j], theirs[:, i] * theirs[:, j]
        error = np.hypot(a.std(), b.std()) / np.sqrt(runs)
        assert abs(a.mean() - b.mean()) < Z * error


def test_modes_follow_the_kernel_and_the_impossible_never_happens(sensor):
    mode = fkgen.simulate(sensor, 400, 500, 3).mode.astype(int)
    counts = np.bincount((4 * mode[:, :-1] + mode[:, 1:]).ravel(), minlength=16).reshape(4, 4)
    kernel, total = np.array(KERNEL), counts.sum(axis=1, keepdims=True)
    assert (counts[kernel == 0.0] == 0).all()
    deviation = np.sqrt(total * kernel * (1.0 - kernel))
    assert (np.abs(counts - total * kernel) <= Z * deviation).all()
    first, law = np.bincount(mode[:, 0], minlength=4), np.array(sensor.faults.sensor.initial)
    assert (np.abs(first - 400 * law) <= Z * np.sqrt(400 * law * (1 - law))).all()


def test_moments_are_those_stated_at_every_lag():
    law = {
        "problem": "moments",
        "gamma_rate": 0.6,
        "gamma_persistence": 0.8,
        "delta_nominal_rate": 0.7,
    }
    spec = plants.spec(
        plants.random_model(1, 1, 1) | {"x0": [0.0]},
        family="linear_optimal",
        sensor={"noise_factor": 4.0} | law,
    )
    drawn = fkgen.simulate(spec, 20000, 6, 4)
    runs = len(drawn.y)
    assert abs(drawn.gamma[:, 3].mean() - 0.6) < Z * np.sqrt(0.24 / runs)
    assert abs((drawn.delta == 1.0).mean() - 0.7) < Z * np.sqrt(0.21 / drawn.delta.size)
    for lag in range(1, 6):
        given = drawn.gamma[drawn.gamma[:, 0] == 1.0, lag]
        assert abs(given.mean() - 0.8) < Z * np.sqrt(0.16 / given.size)


@pytest.mark.parametrize("q", [2, 3])
@pytest.mark.parametrize("dependence", ["common", "independent", "covariance"])
def test_actuators_have_the_stated_moments(q, dependence):
    rate = np.array([0.7, 0.5, 0.8][:q])
    covariance = np.diag(rate * (1.0 - rate))
    covariance[0, 1] = covariance[1, 0] = 0.1
    faults = {"dependence": dependence, "success_rate": list(rate)}
    if dependence == "covariance":
        faults = {"success_rate": list(rate), "covariance": covariance}
    if dependence == "common":
        faults, covariance = plants.common(0.7), np.full((q, q), 0.21)
        rate = np.full(q, 0.7)
    if dependence == "independent":
        covariance = np.diag(rate * (1.0 - rate))
    spec = plants.spec(plants.random_model(5, 2, 1, q), family="mkf", actuator=faults)
    gamma = fkgen.simulate(spec, 300, 200, 6, 1.0).gamma.reshape(-1, q)
    error = 0.5 / np.sqrt(len(gamma))
    np.testing.assert_allclose(gamma.mean(axis=0), rate, atol=Z * error)
    np.testing.assert_allclose(np.cov(gamma.T), covariance, atol=Z * error)
    assert set(np.unique(gamma)) == {0.0, 1.0}


def test_a_joint_law_has_its_moments_or_there_is_none():
    rate, q = np.array([0.7, 0.5, 0.8]), 3
    covariance = np.diag(rate * (1.0 - rate)) + 0.05 * (1.0 - np.eye(q))
    law = pattern_law(rate, covariance)
    patterns = np.array(list(product((1.0, 0.0), repeat=q)))
    np.testing.assert_allclose(law @ patterns, rate, atol=1e-9)
    pairs = (patterns * law[:, None]).T @ patterns - np.outer(rate, rate)
    np.testing.assert_allclose(pairs, covariance, atol=1e-9)
    against = 0.25 * np.eye(q) - 0.2 * (1.0 - np.eye(q))  # three that all differ from each other
    assert pattern_law([0.5] * q, against) is None


def test_rates_may_change_with_a_parameter():
    spec = plants.motor(actuator=plants.common("rate"), parameters={"rate": 0.5})
    rate = np.repeat([0.0, 1.0, 0.3], 50)
    gamma = fkgen.simulate(spec, 500, 150, 2, 1.0, params={"rate": rate}).gamma[:, :, 0]
    assert (gamma[:, :50] == 0.0).all()
    assert (gamma[:, 50:100] == 1.0).all()
    assert abs(gamma[:, 100:].mean() - 0.3) < Z * np.sqrt(0.21 / gamma[:, 100:].size)


def consistency(spec, found, params=None):
    """Means of NEES / n and NIS / p with their standard errors over trials."""
    run = fkgen.build(spec).run_batch(
        found.y,
        found.u if spec.model.nu else None,
        params,
        keep=("filtered_state", "filtered_covariance", "nis"),
    )
    e = (found.state - run.filtered_state)[..., None]
    nees = (e * np.linalg.solve(run.filtered_covariance, e)).sum(axis=(2, 3)) / spec.model.nx
    each = np.array([nees.mean(axis=1), run.nis.mean(axis=1) / spec.model.ny])
    return each.mean(axis=1), each.std(axis=1) / np.sqrt(each.shape[1])


@pytest.mark.parametrize("family", ["kf", "mkf", "genie", "imm", "mme"])
def test_filters_are_consistent_on_what_is_drawn(family, plant, sensor):
    specs = {
        "kf": plant,
        "mkf": plants.spec(
            plants.random_model(3, 3, 2, 2, direct=True),
            family="mkf",
            actuator=plants.independent([0.6, 0.9]),
        ),
        "genie": plants.spec(
            plants.random_model(3, 3, 2, correlated=True), family="genie", sensor=SENSOR
        ),
        "imm": sensor,
        "mme": plants.motor("mme"),
    }
    spec = specs[family]
    found = fkgen.simulate(spec, 600, 60, 21, 1.0 if spec.model.nu else None)
    told = {"gamma": found.gamma, "delta": found.delta} if family == "genie" else None
    mean, error = consistency(spec, found, told)
    # imm and mme approximate: their measures are those of section 3.4, near one
    allowed = np.maximum(Z * error, 0.05 if family in {"imm", "mme"} else 0.0)
    assert (np.abs(mean - 1.0) < allowed).all(), (mean, error)


def test_soft_faults_are_added(plant):
    u, bias = np.ones((20, 2)), np.zeros((20, 2))
    bias[5:] = [1.0, 0.0]
    clean = fkgen.simulate(plant, 2, 20, 1, u)
    np.testing.assert_array_equal(fkgen.simulate(plant, 2, 20, 1, u, sensor=bias).y, clean.y + bias)
    moved = fkgen.simulate(plant, 2, 20, 1, u, input=bias)
    np.testing.assert_array_equal(moved.y, fkgen.simulate(plant, 2, 20, 1, u + bias).y)
    np.testing.assert_array_equal(moved.u, u)
    np.testing.assert_array_equal(moved.state[:, :6], clean.state[:, :6])
