"""Filters of random plants by equations, compiled: the oracle's numbers, the program's bits."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import random_equations
from plants import built, distance, generated
from random_equations import CASES
from toolchain import needs_compiler

from fkgen.backend.execute import Machine
from fkgen.families import family
from fkgen.symbolic.interpreter import Interpreter

pytestmark = needs_compiler()

#: Two double computations of some samples: roundings of 1e-16 that gains and exponents multiply.
EXACT = 1e-9
#: The same where the interpreter has exponentials and sines of libm in place of fkgen's own.
OWN = 1e-11
#: Of a computation in float.
FLOAT = 2e-3


@cache
def drawn(case, seed, scalar="double"):
    """A plant and a record of it."""
    plant = random_equations.spec(case, seed, scalar)
    return plant, random_equations.record(plant, seed=seed)


def expected(case, seed):
    """The ports that the oracle has, from the claim about plants by equations."""
    plant, record = drawn(case, seed)
    forms = (form.expected(plant, record) for form in family(plant.filter.family).closed_forms)
    found = [each for each in forms if each and len(each.get("filtered_state", ())) == 8]
    assert found
    return {name: value for each in found for name, value in each.items()}


def assert_is_the_oracles(case, seed, scalar="double", tolerance=EXACT):
    plant, record = drawn(case, seed, scalar)
    run = built(plant).run(record.y, record.u, record.parameters)
    assert not run.refused.any()
    for port, value in expected(case, seed).items():
        assert distance(run[port][: len(value)], value) < tolerance, port
    return run


@pytest.mark.parametrize("case", CASES)
def test_compiled_filters_of_random_plants_are_the_oracles(case):
    run = assert_is_the_oracles(case, 0)
    plant, record = drawn(case, 0)
    T = len(record.y)
    parameters = {name: np.broadcast_to(v, T) for name, v in record.parameters.items()}
    found = Interpreter(_recursion(plant)).run(record.y, record.u, parameters)
    for port, value in found.items():
        if "log_weight" not in port:
            assert distance(run[port], value) < OWN, port


def _recursion(plant):
    return family(plant.filter.family).build(plant)


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize(
    "case", ["ekf_attitude", "mkf_attitude", "mme_sensed", "imm_jump", "one_step", "genie"]
)
def test_compiled_bits_are_those_of_the_program(case, scalar):
    plant, record = drawn(case, 0, scalar)
    machine, compiled = Machine(generated(plant).program), built(plant)
    compiled.reset()
    for k, y in enumerate(record.y):
        now = {name: float(value[k]) for name, value in record.parameters.items()}
        status = machine.step(record.u[k], y, now)
        assert compiled.step(y, record.u[k], now).status == status.value
        for port, values in machine.ports.items():
            assert compiled.state(port).tobytes() == np.array(values).tobytes(), (port, k)
    assert_is_the_oracles(case, 0, scalar, EXACT if scalar == "double" else FLOAT)


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", CASES)
def test_more_compiled_filters_of_random_plants_are_the_oracles(case):
    for seed in range(1, 9):
        assert_is_the_oracles(case, seed)
