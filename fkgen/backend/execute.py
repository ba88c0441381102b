"""Execute a C program in NumPy scalars of its own type: the bits that compiled code has to give."""

from __future__ import annotations

import operator as arithmetic
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fkgen.backend.elementary import Elementary, Number
from fkgen.backend.ir import (
    Assign,
    Copy,
    CProgram,
    Element,
    IfPositive,
    IfPresent,
    Literal,
    Operand,
    Operate,
    Operator,
    Phase,
    Require,
    RowArgument,
    Space,
    Statement,
    Temp,
    Vectors,
)
from fkgen.errors import InternalError
from fkgen.symbolic.interface import Kind, Status

ARITHMETIC: dict[Operator, Callable[..., Number]] = {
    Operator.ADD: arithmetic.add,
    Operator.SUB: arithmetic.sub,
    Operator.MUL: arithmetic.mul,
    Operator.DIV: arithmetic.truediv,
    Operator.NEG: arithmetic.neg,
    Operator.ABS: abs,
    Operator.MAX: lambda a, b: max(b, a),
    Operator.MIN: lambda a, b: min(b, a),
}

#: Samples of the self-test.
SAMPLES = 6

#: At most so many samples before a closing, so that the self-test comes across one.
CLOSED_AFTER = 3

Key = tuple[Space, str, int | None]


class Machine:
    """One instance of a program, stepped without a compiler."""

    def __init__(self, program: CProgram) -> None:
        self.program = program
        elementary = Elementary(program.scalar)
        self.use(elementary.real, elementary, ARITHMETIC)

    def use(
        self,
        real: Any,
        elementary: Callable[[Operator, list[Number]], Number],
        arithmetic: Mapping[Operator, Callable[..., Number]],
    ) -> None:
        """Compute with other numbers than the program's: a constructor, functions, operators."""
        self.real, self.elementary, self.arithmetic = real, elementary, arithmetic
        self.reset()

    def reset(self) -> None:
        """As ``_init`` does."""
        initial = dict(self.program.initial)
        self.ports = {
            port.name: [self.real(v) for v in initial.get(port.name, (0.0,) * port.size)]
            for port in self.program.ports
        }

    def step(
        self, u: Sequence[float], y: Sequence[float], parameters: Mapping[str, float]
    ) -> Status:
        """Update, then predict; a refused sample changes nothing."""
        memory: dict[Key, Number] = {
            (Space.PARAMETER, name, None): self.real(v) for name, v in parameters.items()
        }
        for name, values in (("u", u), ("y", y)):
            memory |= {(Space.INPUT, name, i): self.real(v) for i, v in enumerate(values)}
        present = [not np.isnan(v) for v in y]
        state = {name: list(values) for name, values in self.ports.items()}
        with np.errstate(all="ignore"):
            for phase in self.program.phases:
                if phase.unless is not None and state[phase.unless][0] > 0:
                    continue
                status = _Run(self, memory, present, state).phase(phase)
                if status is not Status.OK:
                    return status
        self.ports = state
        return self._outcome() if any(present) else Status.SKIPPED

    def _outcome(self) -> Status:
        """The status of a sample that was used, or rejected by a test."""
        for outcome in self.program.outcomes:
            if max(self.ports[outcome.port]) > outcome.level:
                return outcome.status
        return Status.OK


class _Run:
    """One phase: temporaries and locals come and go with it."""

    def __init__(
        self,
        machine: Machine,
        memory: dict[Key, Number],
        present: list[bool],
        state: dict[str, list[Number]],
    ) -> None:
        self.machine, self.memory, self.present = machine, dict(memory), present
        self.now, self.state = {k: list(v) for k, v in state.items()}, state
        self.temps: dict[int, Number] = {}

    def phase(self, phase: Phase) -> Status:
        for local in phase.locals:
            for i in range(local.size):
                key = (Space.LOCAL, local.name, i if local.size > 1 else None)
                self.memory[key] = self.machine.real(local.initial or 0.0)
        return self.body(phase.body)

    def body(self, body: tuple[Statement, ...]) -> Status:
        for node in body:
            status = self.statement(node)
            if status is not Status.OK:
                return status
        return Status.OK

    def statement(self, node: Statement) -> Status:
        match node:
            case Operate(target, operator, arguments):
                self.temps[target.index] = self.operate(operator, arguments)
            case Copy(target, value):
                self.temps[target.index] = self.value(value)
            case Assign(target, value):
                self.assign(target, self.value(value))
            case Require(values, kind, status):
                holds = all(_holds(kind, self.value(value)) for value in values)
                return Status.OK if holds else status
            case IfPresent(row, body) if not isinstance(row, RowArgument):
                if any(self.present) if row is None else self.present[row]:
                    return self.body(body)
            case IfPositive(value, body):
                if self.value(value) > 0:
                    return self.body(body)
        return Status.OK

    def assign(self, target: Element, value: Number) -> None:
        if target.space is Space.NEXT:
            self.state[target.name][target.index or 0] = value
        else:
            self.memory[target.space, target.name, target.index] = value

    def value(self, operand: Operand) -> Number:
        match operand:
            case Temp(index):
                return self.temps[index]
            case Literal(value):
                return self.machine.real(value)
            case Element(Space.SELF, name, index):
                return self.now[name][index or 0]
            case Element(Space.NEXT, name, index):
                return self.state[name][index or 0]
            case Element(space, name, index):
                return self.memory[space, name, index]
        raise InternalError(f"no operand: {operand!r}")

    def operate(self, operator: Operator, arguments: tuple[Operand, ...]) -> Number:
        values = [self.value(argument) for argument in arguments]
        if operator.is_function:
            return self.machine.elementary(operator, values)
        return self.machine.arithmetic[operator](*values)


def _holds(kind: Kind, value: Number) -> bool:
    match kind:
        case Kind.POSITIVE:
            return bool(value > 0)
        case Kind.NONNEGATIVE:
            return bool(value >= 0)
        case Kind.FINITE:
            return bool(np.isfinite(value))


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
