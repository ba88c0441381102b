"""C leaves out tests that follow from others: held against the interpreter, which makes them all.

Members of the instance, y and u are drawn up to the ends of the range, so that every number that is
tested is beyond it some time.
"""

from __future__ import annotations

import numpy as np
import pytest
import sensor_specs
import spread
from mutants import recursion

from fkgen.backend import ir
from fkgen.backend.execute import Machine
from fkgen.backend.lower import lower
from fkgen.symbolic.interface import Kind
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.recursion import Block

SPECS = spread.specs() | sensor_specs.every()
FEW = ("kf", "mkf", "mme_gaussian", "imm", "dfcf")
CASES = [pytest.param(name, marks=() if name in FEW else pytest.mark.exhaustive) for name in SPECS]
#: Powers of ten that members of an instance are multiplied by.
POWERS = (0, 0, 0, 0, 150, 300, 307, 308)


def finite_tests(phases, guards):
    return sum(len(each) for phase in phases for each in guards(phase))


def in_program(phase):
    return (n.values for n in ir.every(ir.Require, phase.body) if n.kind is Kind.FINITE)


def in_recursion(phase):
    blocks = (block for block in phase.blocks if isinstance(block, Block))
    found = (guard for block in blocks for guard in block.guards)
    return (guard.values.nz for guard in found if guard.kind is Kind.FINITE)


@pytest.mark.parametrize("name", CASES)
def test_a_sample_is_refused_with_and_without_them(name):
    whole = recursion(SPECS[name])
    program, rng = lower(whole), np.random.default_rng(5)
    interpreter, machine = Interpreter(whole), Machine(program)
    start = {port: np.array(values) for port, values in interpreter.values.items()}
    kept, made = finite_tests(program.phases, in_program), finite_tests(whole.phases, in_recursion)
    assert kept < made
    outcomes = set()
    p, q = len(program.outputs), len(program.inputs)
    for _ in range(60):
        with np.errstate(over="ignore"):
            state, y, u = drawn(start, p, q, rng)
        interpreter.values = dict(state)
        machine.ports = {port.name: list(state[port.name]) for port in program.ports}
        taken = interpreter.step(y, u, dict(program.parameters))
        status = machine.step(u, y, dict(program.parameters))
        assert taken == (status.value >= 0)
        outcomes.add(status)
    assert len(outcomes) > 1


def drawn(start, p, q, rng):
    state = {port: values.copy() for port, values in start.items()}
    for port in rng.choice([*state], 2):
        far = 10.0 ** rng.choice(POWERS, state[port].shape)
        state[port] = np.nan_to_num((state[port] + rng.integers(0, 2)) * far)
    y, u = (np.nan_to_num(rng.standard_normal(n) * 10.0 ** rng.choice(POWERS, n)) for n in (p, q))
    y[rng.random(p) < 0.4] = np.nan
    return state, y, u
