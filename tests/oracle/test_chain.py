"""Two translations of a fault section agree: the chain of filters, and that of the oracles."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from jump_plants import GILBERT, random_table, spec_of
from plants import assert_agree, motor, random_model, record, run
from sensor_specs import PROBLEMS, sensed, shaken, varying

from fkgen.faults import JumpFaults
from fkgen.faults.actuator import pattern_law
from fkgen.faults.chain import Mode, ModeChain
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, sensed_modes
from fkgen.oracle.textbook.jump import composite
from fkgen.problem import Matrix, evaluate

T = 3


def assert_same(chain: ModeChain, system: JumpSystem, parameters) -> None:
    """Every matrix of every mode at every sample, and the chain, to the last digits."""
    for k in range(T):
        for i, mode in enumerate(chain.modes):
            for letter in "ABCDQRc":
                found = getattr(mode, letter).values(parameters[k])
                expected = getattr(system, letter)[k, i].reshape(found.shape)
                # The oracle scales noise by its root, twice: some roundings of 1e-16.
                np.testing.assert_allclose(found, expected, rtol=1e-14, atol=0.0, err_msg=letter)
    np.testing.assert_allclose(chain.transition, system.transition, rtol=1e-15)
    np.testing.assert_allclose(chain.initial, system.initial, rtol=1e-15)


@pytest.mark.parametrize("rows", [[0], [1], [0, 1]])
@pytest.mark.parametrize("law", PROBLEMS)
def test_conditions_of_a_sensor_are_the_modes_of_the_oracle(law, rows):
    model = random_model(61, 3, 2, 1, direct=True, correlated=True)
    plant = sensed(model, PROBLEMS[law] | {"rows": rows})
    system = sensed_modes(LinearSystem.from_spec(plant, T), SensorLaw.from_spec(plant))
    assert_same(plant.faults.chain(plant.model), system, [{}] * T)


def test_conditions_of_a_plant_that_changes_are_the_modes_of_the_oracle():
    plant = varying(PROBLEMS["4"] | {"rows": [1]})
    params = shaken(T)
    at = [{name: values[k] for name, values in params.items()} for k in range(T)]
    system = sensed_modes(LinearSystem.from_spec(plant, T, params), SensorLaw.from_spec(plant))
    assert_same(plant.faults.chain(plant.model), system, at)


@pytest.mark.parametrize("seed", [71, 72, 73])
def test_modes_of_a_jumping_plant_are_those_of_the_oracle(seed):
    plant = spec_of(random_table(seed, 3, 2, 2, q=seed % 2, correlated=True))
    assert_same(plant.faults.chain(plant.model), JumpSystem.from_spec(plant, T), [{}] * T)


@pytest.mark.parametrize("losses", [{"arrival_rate": 0.7}, {"arrival_chain": GILBERT}])
def test_losses_are_the_modes_without_a_signal_of_the_oracle(losses):
    plant = spec_of(random_table(74, 2, 2, 2), **losses)
    jump = plant.faults.jump
    chain = jump.chain(plant.model).times(jump.channel)
    assert_same(chain, composite(JumpSystem.from_spec(plant, T)), [{}] * T)


def patterns_of(plant) -> ModeChain:
    """The patterns of inputs that work (1) or fail (0), as modes that are drawn anew."""
    model, faults = plant.model, plant.faults.actuator
    rates = [evaluate(rate, plant.defaults) for rate in faults.success_rate]
    rates *= 1 if len(rates) == model.nu else model.nu
    covariance = np.diag([rate * (1.0 - rate) for rate in rates])
    if faults.covariance is not None:
        covariance = faults.covariance.values()
    patterns, law = list(product((1.0, 0.0), repeat=model.nu)), pattern_law(rates, covariance)
    if faults.dependence == "common":
        patterns, law = [patterns[0], patterns[-1]], np.array([rates[0], 1.0 - rates[0]])
    elif faults.covariance is None:
        law = np.prod(np.where(np.array(patterns) > 0.0, rates, 1.0 - np.array(rates)), axis=1)
    modes = tuple(
        Mode(
            **{letter: getattr(model, letter) for letter in "ACQR"},
            B=Matrix.of(model.B.values() * pattern),
            D=Matrix.of(model.D.values() * pattern),
            c=model.c,
            d=model.d,
        )
        for pattern in patterns
    )
    return ModeChain(modes, (tuple(law.tolist()),) * len(modes), tuple(law.tolist()))


ACTUATORS = {
    "common": {"dependence": "common", "success_rate": 0.7},
    "independent": {"dependence": "independent", "success_rate": [0.7, 0.4]},
    "covariance": {"success_rate": [0.7, 0.4], "covariance": [[0.21, 0.1], [0.1, 0.24]]},
}


@pytest.mark.parametrize("dependence", ACTUATORS)
def test_patterns_of_inputs_have_the_moments_of_the_oracle(dependence):
    model = random_model(75, 2, 2, 2, direct=True)
    plant = motor(model=model, actuator=ACTUATORS[dependence])
    chain = patterns_of(plant)
    system, law = LinearSystem.from_spec(plant, 1), np.array(chain.initial)
    full = np.vstack([plant.model.B.values(), plant.model.D.values()])
    seen = [np.vstack([mode.B.values(), mode.D.values()]) / full for mode in chain.modes]
    gamma = np.array([each[0] for each in seen])
    assert all((each == each[0]).all() for each in seen)
    np.testing.assert_allclose(law @ gamma, system.rate[0], rtol=1e-8)
    centred = gamma - law @ gamma
    found = centred.T @ (law[:, np.newaxis] * centred)
    np.testing.assert_allclose(found, system.fault_covariance[0], atol=1e-8)  # a linear program


@pytest.mark.parametrize("dependence", list(ACTUATORS)[:2])
def test_actuators_that_fail_are_a_plant_that_jumps(dependence):
    """mkf is the LMMSE filter over the patterns of its inputs: two programs, one estimate."""
    model = random_model(76, 2, 2, 2, direct=True, correlated=True)
    plant = motor(model=model, actuator=ACTUATORS[dependence])
    chain = patterns_of(plant)
    jumping = JumpFaults(chain.transition, chain.initial, chain.modes).plain()
    other = plant.to_dict() | {"faults": {"jump": jumping}, "filter": {"family": "mjls_lmmse"}}
    y, u = record(plant, 40, missing=0.2)
    ports = ("filtered_state", "filtered_covariance", "predicted_state", "log_likelihood")
    assert_agree(run(type(plant).from_dict(other), y, u), run(plant, y, u), ports, 1e-12)
