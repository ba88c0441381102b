"""What a fault does: two runs of the compiled filter with one noise record."""

from __future__ import annotations

import numpy as np
import pytest
from effect_plants import MODELS, T, close, difference, missing_some, paper, profiles, varying
from plants import common, independent, random_model, spec

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.fault_effect import gains
from fkgen.profiles import pulse, ramp, step

MODES = ("both", "plant", "filter")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("seed", "direct"), [(11, False), (12, True)])
def test_kf_deviates_as_two_runs_do(mode, seed, direct):
    spec, params = varying(seed, direct=direct)
    sensor, anomaly = profiles(spec)
    u = np.random.default_rng(1).standard_normal(anomaly.shape)
    missing = missing_some(spec)
    y = np.where(missing, np.nan, 0.0)
    effect = fkgen.fault_effect(spec, sensor, anomaly, mode, T, params=params, u=u, y=y)
    state, error, innovation = difference(spec, (sensor, anomaly), mode, params, u, missing)
    close(effect.state_deviation, state, state)
    close(effect.error_deviation, error, state)
    close(effect.innovation_deviation, innovation, state)
    S = gains(LinearSystem.from_spec(spec, T, params), y=y).innovation
    for k in range(T):
        rows = ~missing[k]
        change = innovation[k][rows]
        expected = change @ np.linalg.solve(S[k][np.ix_(rows, rows)], change) if rows.any() else 0
        assert effect.noncentrality[k] == pytest.approx(expected, rel=1e-9, abs=1e-20)
    assert effect.kind == "exact"
    assert np.array_equal(effect.degrees, (~missing).sum(axis=1))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", MODELS)
def test_models_of_the_paper_deviate_as_two_runs_do(name, mode):
    spec = paper(name)
    sensor, anomaly = step(T, 5, [1.0, -2.0], stop=20), ramp(T, 3, [0.5], length=7)
    none = np.zeros((T, 2), bool)
    effect = fkgen.fault_effect(spec, sensor, anomaly, mode)
    found = difference(spec, (sensor, anomaly), mode, {}, np.ones((T, 1)), none)
    for value, expected in zip(
        (effect.state_deviation, effect.error_deviation, effect.innovation_deviation),
        found,
        strict=True,
    ):
        close(value, expected, 100.0)  # states of that size cancel in the two runs


ACTUATORS = {
    "common": common(0.7),
    "independent": independent([0.6, 0.9]),
    "covariance": {"success_rate": [0.5, 0.6], "covariance": [[0.25, 0.1], [0.1, 0.24]]},
    "certain": common(1.0),
}


@pytest.mark.parametrize(("faults", "direct"), [(name, name != "certain") for name in ACTUATORS])
def test_sensor_faults_under_mkf_deviate_as_two_runs_do(faults, direct):
    model = random_model(5, 3, 2, 2, direct=direct, correlated=True)
    found = spec(model, family="mkf", actuator=ACTUATORS[faults])
    sensor, anomaly = profiles(found)
    u = 3.0 * np.random.default_rng(2).standard_normal(anomaly.shape)
    missing = missing_some(found)
    y = np.where(missing, np.nan, 0.0)
    effect = fkgen.fault_effect(found, sensor, u=u, y=y)
    state, error, innovation = difference(found, (sensor, 0.0 * u), "both", {}, u, missing)
    close(effect.state_deviation, state, 10.0)
    close(effect.error_deviation, error, 10.0)
    close(effect.innovation_deviation, innovation, 10.0)
    run = fkgen.build(found).run(y, u)
    np.testing.assert_allclose(
        effect.state_sd**2, np.diagonal(run.filtered_covariance, axis1=1, axis2=2), rtol=1e-10
    )


def test_a_rate_that_is_a_parameter_may_change_with_time():
    found = spec(
        random_model(6, 2, 1, 1, direct=True),
        family="mkf",
        actuator=common("xi"),
        parameters={"xi": 0.7},
    )
    params = {"xi": np.linspace(0.2, 0.9, T)}
    sensor, _ = profiles(found)
    u = np.random.default_rng(2).standard_normal((T, 1))
    state, *_ = difference(found, (sensor, 0.0 * u), "both", params, u, np.zeros((T, 1), bool))
    close(fkgen.fault_effect(found, sensor, params=params, u=u).state_deviation, state, 10.0)


@pytest.mark.parametrize("mode", MODES)
def test_input_faults_under_mkf_are_the_mean_over_lost_commands(mode):
    found = spec(random_model(7, 2, 2, 1, direct=True), family="mkf", actuator=common(0.6))
    anomaly, u = profiles(found)[1], np.ones((T, 1))
    effect = fkgen.fault_effect(found, input=anomaly, mode=mode, u=u)
    assert effect.kind == "mean"
    told = u if mode == "plant" else u + anomaly
    reached = u if mode == "filter" else u + anomaly
    # The filter is linear in y, and y in the commands that arrive: the mean of y gives the mean.
    (x_before, y_before), (x_after, y_after) = (on_average(found, each) for each in (u, reached))
    built = fkgen.build(found)
    before, after = built.run(y_before, u), built.run(y_after, told)
    change = after.filtered_state - before.filtered_state
    close(effect.state_deviation, change, 10.0)
    close(effect.error_deviation, x_after - x_before - change, 10.0)
    close(effect.innovation_deviation, after.innovation - before.innovation, 10.0)


def on_average(spec, u):
    """Mean of x and y over noise and lost commands."""
    system = LinearSystem.from_spec(spec, T)
    x = np.zeros((T + 1, system.nx))
    x[0] = system.x0
    for k in range(T):
        x[k + 1] = system.A[k] @ x[k] + system.B[k] @ (system.rate[k] * u[k])
    arrived = system.rate * u
    y = np.einsum("kij,kj->ki", system.C, x[:T]) + np.einsum("kij,kj->ki", system.D, arrived)
    return x[:T], y


def test_genie_deviates_as_two_runs_do():
    model = random_model(8, 2, 2, 1)
    found = spec(model, family="genie", sensor={"noise_factor": 4.0, "rows": [0]})
    rng = np.random.default_rng(9)
    params = {"gamma": (rng.random(T) < 0.7).astype(float), "delta": rng.choice([1.0, 4.0], T)}
    sensor, _ = profiles(found)
    y = rng.standard_normal((T, 2))
    built, u = fkgen.build(found), np.ones((T, 1))
    before, after = (built.run(each, u, params) for each in (y, y + sensor))
    effect = fkgen.fault_effect(found, sensor, params=params)
    close(effect.state_deviation, after.filtered_state - before.filtered_state, 10.0)
    close(effect.innovation_deviation, after.innovation - before.innovation, 10.0)


@pytest.mark.parametrize("form", ["lemma2", "augmented"])
def test_linear_optimal_deviates_by_the_same_whatever_the_record_is(form):
    law = {"problem": 1, "gamma_rate": 0.8, "delta_nominal_rate": 0.7, "noise_factor": 5.0}
    model = random_model(10, 2, 1, 1) | {"x0": [1.0, 2.0]}
    found = spec(model, family="linear_optimal", sensor=law, form=form)
    sensor, anomaly = profiles(found)
    u = np.ones((T, 1))
    state, error, innovation = difference(
        found, (sensor, 0.0 * anomaly), "both", {}, u, np.zeros((T, 1), bool)
    )
    effect = fkgen.fault_effect(found, sensor, u=u)
    assert effect.kind == "exact"
    close(effect.state_deviation, state, 10.0)
    close(effect.error_deviation, error, 10.0)
    close(effect.innovation_deviation, innovation, 10.0)


@pytest.mark.parametrize("family", ["kf", "mkf"])
def test_rows_without_noise_are_taken_as_exact(family):
    model = random_model(9, 3, 2, 1) | {"R": [[0.0, 0.0], [0.0, 0.5]]}
    faults = {"actuator": common(0.8)} if family == "mkf" else {}
    found = spec(model, family=family, **faults)
    sensor, anomaly = profiles(found)
    missing = missing_some(found)
    y, u = np.where(missing, np.nan, 0.0), np.ones((T, 1))
    effect = fkgen.fault_effect(found, sensor, u=u, y=y)
    state, error, _ = difference(found, (sensor, 0.0 * anomaly), "both", {}, u, missing)
    # without noise a gain is as large as 1/eps allows and digits go with it
    np.testing.assert_allclose(effect.state_deviation, state, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(effect.error_deviation, error, rtol=0.0, atol=1e-9)


def test_a_float_filter_is_answered_in_double():
    model = random_model(14, 2, 1)
    fault = step(T, 3, [1.0])
    single, double = (
        fkgen.fault_effect(spec(model, code={"scalar": scalar, "update": "joseph"}), fault)
        for scalar in ("float", "double")
    )
    assert single.state_deviation.dtype == np.float64
    assert np.array_equal(single.state_deviation, double.state_deviation)


MISTAKES = {
    "an actuator fault with the sign of a wrong readback": ("_SIGN", {"plant": -1.0}),
    "lost commands as variances, not deviations": ("square_root", lambda N: N),
    "lost commands forgotten": ("square_root", lambda N: 0.0 * N),
    "lost commands of one input in the other": ("square_root", lambda N: N[:, ::-1] ** 0.5),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_show(mistake, monkeypatch):
    found = spec(random_model(5, 3, 2, 2, direct=True), family="mkf", actuator=independent(0.6))
    sensor, anomaly = profiles(found)
    u = 3.0 * np.random.default_rng(2).standard_normal(anomaly.shape)

    def error():
        return fkgen.fault_effect(found, sensor, anomaly, "plant", u=u).error_deviation

    right = error()
    monkeypatch.setattr(
        f"fkgen.study.effects.fault_effect.{MISTAKES[mistake][0]}", MISTAKES[mistake][1]
    )
    assert np.abs(error() - right).max() > 1e-3 * np.abs(right).max()


def test_paired_runs_of_a_bank_of_one_agree_with_the_recursion_of_its_filter():
    model = random_model(12, 2, 1, 1)
    bank = spec(model, family="mme", actuator={"dependence": "common"}, hypotheses=[1.0])
    single = spec(model, family="mkf", actuator=common(1.0))
    sensor, u = step(T, 6, [2.0]), np.ones((T, 1))
    paired = fkgen.fault_effect(bank, sensor, u=u, runs=8)
    exact = fkgen.fault_effect(single, sensor, u=u)
    assert paired.kind == "paired"
    assert paired.runs == 8
    close(paired.state_deviation, exact.state_deviation, 10.0)
    close(paired.innovation_deviation, exact.innovation_deviation, 10.0)
    assert paired.standard_error.max() < 1e-13
    off = paired.noncentrality - exact.noncentrality
    assert np.abs(off).max() < 3.0 * np.sqrt(exact.noncentrality.max())


@pytest.mark.parametrize("mode", MODES)
def test_paired_input_faults_lose_the_same_commands(mode):
    model = random_model(12, 2, 1, 1)
    bank = spec(model, family="mme", actuator={"dependence": "common"}, hypotheses=[0.6, 0.6])
    anomaly, u = step(T, 6, [2.0]), np.ones((T, 1))
    paired = fkgen.fault_effect(bank, input=anomaly, mode=mode, u=u, runs=300)
    exact = fkgen.fault_effect(
        spec(model, family="mkf", actuator=common(0.6)), input=anomaly, mode=mode, u=u
    )
    off = np.abs(paired.state_deviation - exact.state_deviation)
    assert np.all(off <= 5.0 * paired.standard_error + 1e-12)
    if mode == "both":
        assert np.abs(paired.error_deviation).max() < np.abs(paired.state_deviation).max() / 3


def test_imm_lets_less_of_a_large_sensor_fault_through_than_of_a_small_one():
    law = {"problem": 3, "noise_factor": 100.0}
    chains = {"gamma_chain": [[0.9, 0.1], [0.02, 0.98]], "delta_chain": [[0.95, 0.05], [0.3, 0.7]]}
    found = spec(random_model(13, 2, 1), family="imm", sensor=law | chains)
    small, large = (
        fkgen.fault_effect(found, pulse(30, 20, [a]), runs=64).state_deviation[20] / a
        for a in (0.1, 100.0)
    )
    assert np.abs(large).max() < 0.3 * np.abs(small).max()
    again = fkgen.fault_effect(found, pulse(30, 20, [0.1]), runs=64).state_deviation[20] / 0.1
    assert np.array_equal(small, again)
