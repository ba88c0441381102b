"""The nonlinear textbook filters of a plant of matrices are those of matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensor_plants import any_law, inputs, plant

from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.gate import batch_gated
from fkgen.oracle.exact.hypotheses import textbook_mme
from fkgen.oracle.plants.actuator import LinearSystem, Plant, simulate
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.nonlinear import by_functions
from fkgen.oracle.plants.sensor import simulate_sensor
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented
from fkgen.oracle.textbook.nonlinear_modes import (
    Hypotheses,
    Modes,
    sensor_modes,
    textbook_bank,
    textbook_gpb1,
    textbook_interacting,
)
from fkgen.oracle.textbook.switching import interacting, textbook_imm, textbook_one_step

T = 12


def agree(found, expected, rtol=1e-11):
    """Every port of the expected result, relative to its largest entry."""
    for name, value in vars(expected).items():
        atol = rtol * np.nanmax(np.abs(value), initial=1.0)
        np.testing.assert_allclose(found[name], value, rtol=rtol, atol=atol, err_msg=name)


def case(seed, **options):
    rng = np.random.default_rng(seed)
    system = plant(rng, T=T, **{"n": 3, "p": 2, "q": 2, **options})
    system = replace(system, c=rng.standard_normal((T, system.nx)), d=rng.standard_normal((T, 2)))
    u = inputs(rng, system)
    y = simulate(system, u, rng, missing=0.2)
    y[5] = np.nan
    return system, y, u


FILTERS = (
    Extended,
    Iterated,
    lambda system: Iterated(system=system, iterations=1),
    Unscented,
    lambda system: Unscented(system=system, kappa=0.7),
)


@pytest.mark.parametrize("filter_of", FILTERS)
@pytest.mark.parametrize("prior", ["full", "certain"])
def test_without_faults_each_is_the_batch_estimate(filter_of, prior):
    system, y, u = case(1)
    if prior == "certain":  # in one state, and in the sum of two others
        a = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        system = replace(system, P0=a @ a.T)
    agree(filter_of(system=by_functions(system)).run(y, u), batch_lmmse(system, y, u), 1e-10)


@pytest.mark.parametrize("filter_of", [Extended, Unscented])
def test_rows_without_noise_that_say_the_same_are_taken_once(filter_of):
    system, y, u = case(2)
    twice = {name: np.repeat(getattr(system, name)[:, :1], 2, axis=1) for name in "CDd"}
    system = replace(system, **twice, R=np.zeros((T, 2, 2)))
    y = simulate(system, u, np.random.default_rng(3))
    found, expected = filter_of(system=by_functions(system)).run(y, u), batch_lmmse(system, y, u)
    for name in ("filtered_state", "filtered_covariance", "predicted_state", "nis"):
        np.testing.assert_allclose(found[name], getattr(expected, name), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("together", [False, True])
def test_a_gate_leaves_the_same_rows_out(together):
    system, y, u = case(4)
    y[3, 0] = 60.0
    y[8] += 30.0
    expected = batch_gated(system, y, u, 0.99, together=together)
    assert expected.rejected.sum() >= 3
    found = Extended(system=by_functions(system), gate=(0.99, together)).run(y, u)
    agree(found, expected, 1e-10)


def independent(system, rate):
    """Actuators that fail, each by itself, and are seen by y."""
    rates = np.broadcast_to(rate, (T, system.nu))
    variance = (rates * (1.0 - rates))[:, :, None] * np.eye(system.nu)
    return replace(system, rate=rates, fault_covariance=variance)


def test_random_inputs_that_y_tells_of_reach_the_prediction():
    system, y, u = case(5)
    system = independent(system, np.array([0.7, 0.4]))
    found = Extended(
        system=by_functions(system), rate=system.rate, fault_covariance=system.fault_covariance
    ).run(y, u)
    agree(found, batch_lmmse(system, y, u), 1e-10)


def test_noise_of_the_state_that_y_tells_of_reaches_the_prediction():
    system, y, u = case(12)
    S = np.random.default_rng(13).standard_normal((T, 3, 2))
    S *= 0.5 * np.sqrt(
        np.linalg.eigvalsh(system.Q)[:, :1, None] * np.linalg.eigvalsh(system.R)[:, :1, None]
    )
    system = replace(system, S=S / np.linalg.norm(S, axis=(1, 2), keepdims=True).max())
    found = Extended(system=by_functions(system)).run(y, u)
    agree(found, batch_lmmse(system, y, u), 1e-10)
    without = Extended(system=by_functions(replace(system, S=np.zeros(0)))).run(y, u)
    assert np.abs(found["predicted_state"] - without["predicted_state"]).max() > 1e-3


@pytest.mark.parametrize("likelihood", ["mixture", "gaussian"])
def test_the_bank_is_the_textbook_bank(likelihood):
    system, y, u = case(6)
    systems = [independent(system, rate) for rate in (0.2, 0.6, 0.9)]
    prior = np.array([0.5, 0.2, 0.3])
    options = {"weight_floor": 0.01, "likelihood": likelihood}
    filters = tuple(
        Extended(system=by_functions(s), rate=s.rate, fault_covariance=s.fault_covariance)
        for s in systems
    )
    bank = Hypotheses(filters=filters, prior=prior, one_rate=False, **options)
    agree(textbook_bank(bank, y, u), textbook_mme(systems, prior, y, u, **options), 1e-10)


def sensed(seed):
    rng = np.random.default_rng(seed)
    system, law = plant(rng, T=T), any_law(rng)
    u = inputs(rng, system)
    y, _ = simulate_sensor(system, law, u, rng)
    y[4, 1] = y[7] = np.nan
    return system, law, y, u


@pytest.mark.parametrize("modes", [4, 3])
def test_interacting_conditions_of_a_sensor_are_those_of_the_textbook(modes):
    system, law, y, u = sensed(7)
    found = textbook_interacting(sensor_modes(by_functions(system), law, modes=modes), y, u)
    agree(found, textbook_imm(system, law, y, u, modes=modes))


@pytest.mark.parametrize("reading", ["moment_matched", "weighted", "paper", "paper_nominal"])
def test_the_one_step_filter_is_that_of_the_textbook(reading):
    system, law, y, u = sensed(8)
    modes = sensor_modes(by_functions(system), law)
    expected = textbook_one_step(system, law, y, u, covariance=reading)
    agree(textbook_gpb1(modes, y, u, covariance=reading), expected)


def test_interacting_modes_of_the_plant_are_those_of_the_textbook():
    rng = np.random.default_rng(9)
    parts = [plant(rng, T=T) for _ in range(3)]
    transitions = rng.dirichlet(np.ones(3), size=(T, 3))
    initial = rng.dirichlet(np.ones(3))
    one = np.array([0.0, 1.0])
    stacked = {
        name: np.stack([getattr(part, name) for part in parts], axis=1) for name in Plant.VARYING
    }
    system = JumpSystem(
        **stacked, x0=parts[0].x0, P0=parts[0].P0, transitions=transitions, initial=initial,
        arrival=np.array([one, one]), arrival_initial=one,
    )  # fmt: skip
    y, u = rng.standard_normal((T, 2)), rng.standard_normal((T, 1))
    plants = [replace(part, x0=system.x0, P0=system.P0) for part in parts]
    modes = Modes.of([by_functions(part) for part in plants], transitions, initial)
    agree(textbook_interacting(modes, y, u), interacting(system, y, u))


def test_noises_of_affine_functions_add_up():
    """G Var(w) G' + Q, by derivatives and by points."""
    system, y, u = case(10)
    G = np.random.default_rng(11).standard_normal((3, 2))
    W = np.array([0.5, 2.0])
    functions = by_functions(system)

    def f(x, u, w, p):
        through = [G[i, 0] * w[0] + G[i, 1] * w[1] for i in range(3)]
        return [a + b for a, b in zip(functions.f(x, u, w, p), through, strict=True)]

    noisy = replace(functions, f=f, W=np.tile(W, (T, 1)))
    whole: LinearSystem = replace(system, Q=system.Q + G @ np.diag(W) @ G.T)
    for filter_of in FILTERS:
        agree(filter_of(system=noisy).run(y, u), batch_lmmse(whole, y, u), 1e-10)
