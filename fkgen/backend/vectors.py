"""Inputs and expected bits for the self-test that ships with the generated code."""

from __future__ import annotations

import numpy as np

from fkgen.backend.execute import Machine
from fkgen.backend.ir import CProgram, Vectors
from fkgen.errors import InternalError

SAMPLES = 6

#: At most so many samples before a closing, so that the self-test comes across one.
CLOSED_AFTER = 3


def self_test_vectors(program: CProgram) -> Vectors:
    """Run the program on a short record of short decimals, with missing rows."""
    machine = Machine(program)
    start = _start(program)
    for name, value in start:
        machine.ports[name] = [machine.real(value)]
    rng = np.random.default_rng(len(program.outputs))
    q, p = len(program.inputs), len(program.outputs)
    u = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, q)), 2)
    y = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, p)), 2)
    y[2] = np.nan
    y[4, 0] = np.nan
    parameters = dict(program.parameters)
    trace = []
    for k in range(SAMPLES):
        status = machine.step(tuple(u[k]), tuple(y[k]), parameters)
        if status.value < 0:
            raise InternalError(f"{program.name}: the self-test is refused: {status.meaning}")
        trace.append(tuple(float(v) for v in machine.ports["filtered_state"]))
    final = tuple((n, tuple(float(v) for v in values)) for n, values in machine.ports.items())
    rows = [tuple(tuple(float(v) for v in row) for row in signal) for signal in (u, y)]
    return Vectors(u=rows[0], y=rows[1], trace=tuple(trace), final=final, start=start)


def _start(program: CProgram) -> tuple[tuple[str, float], ...]:
    """A countdown that comes to its end within the self-test."""
    if program.closing is None:
        return ()
    name = f"predicted_{program.closing.unless}"
    return ((name, min(CLOSED_AFTER, dict(program.initial)[name][0])),)
