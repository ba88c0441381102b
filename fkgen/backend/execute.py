"""Execute a C program in NumPy scalars of its own type: the bits that compiled code has to give."""

from __future__ import annotations

import operator as arithmetic
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fkgen.backend import ir
from fkgen.backend.elementary import Elementary, Number
from fkgen.backend.ir import Element, Operator, Space
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
    Operator.LT: lambda a, b: type(a)(a < b),
    Operator.LE: lambda a, b: type(a)(a <= b),
    Operator.IF_ELSE_ZERO: lambda condition, a: a if condition > 0 else type(a)(0),
}

HOLDS: dict[Kind, Callable[[Number], Any]] = {
    Kind.POSITIVE: lambda value: value > 0,
    Kind.NONNEGATIVE: lambda value: value >= 0,
    Kind.FINITE: np.isfinite,
}

#: Samples of the self-test.
SAMPLES = 6

#: In this sample row 0 is missing: C marks it as measured and gives NaN.
MARKED = 4

#: At most so many samples before a closing, so that the self-test comes across one.
CLOSED_AFTER = 3


class Machine:
    """One instance of a program, stepped without a compiler."""

    def __init__(self, program: ir.CProgram) -> None:
        self.program = program
        elementary = Elementary(program.scalar)
        self.use(elementary.real, elementary, ARITHMETIC)

    def use(
        self,
        real: Any,
        elementary: Callable[[Operator, list[Number]], Number],
        arithmetic: Mapping[Operator, Callable[..., Number]],
    ) -> None:
        """Start anew with other numbers than the program's: a constructor, functions, operators."""
        self.real, self.elementary, self.arithmetic = real, elementary, arithmetic
        self.start({})

    def start(self, parameters: Mapping[str, float]) -> None:
        """Start from the prior of the spec, with the parameters of sample 0."""
        program, real, initial = self.program, self.real, dict(self.program.initial)
        told = self._parameters({**dict(program.parameters), **parameters})
        prior = {
            name: [real(v) for v in values]
            for name, values in zip(("x", "P"), program.prior, strict=True)
        }
        if program.origin is not None:
            self._run(program.origin, told, prior, [])
        self.ports = {
            port.name: [real(v) for v in initial.get(port.name, (0.0,) * port.size)]
            if not port.prior
            else prior[port.prior] * (port.size // len(prior[port.prior]))
            for port in program.ports
        }
        if program.start is not None:
            given: dict[ir.Operand, Number] = {
                Element(Space.INPUT, name, i): value
                for name, values in prior.items()
                for i, value in enumerate(values)
            }
            self._run(program.start, {**told, **given}, self.ports, [])

    def _parameters(self, values: Mapping[str, float]) -> dict[ir.Operand, Number]:
        return {Element(Space.PARAMETER, name, None): self.real(v) for name, v in values.items()}

    def step(
        self, u: Sequence[float], y: Sequence[float], parameters: Mapping[str, float]
    ) -> Status:
        """Update, then predict; a refused sample changes nothing."""
        real, state = self.real, {name: list(values) for name, values in self.ports.items()}
        given = self._parameters(parameters)
        for name, values in (("u", u), ("y", y)):
            given |= {Element(Space.INPUT, name, i): real(v) for i, v in enumerate(values)}
        present = [not np.isnan(v) for v in y]
        with np.errstate(all="ignore"):
            for phase in self.program.phases:
                if phase.unless is not None and state[phase.unless][0] > 0:
                    continue
                status = self._run(phase, given, state, present)
                if status is not Status.OK:
                    return status
        self.ports = state
        applies = (o.status for o in self.program.outcomes if max(state[o.port]) > o.level)
        return next(applies, Status.OK) if any(present) else Status.SKIPPED

    def _run(
        self,
        phase: ir.Phase,
        given: Mapping[Any, Number],
        state: dict[str, list[Number]],
        present: list[bool],
    ) -> Status:
        """Run one phase on an instance, which it changes."""
        run = _Run(self, {**given, **dict(self._elements(phase, state))}, present)
        status = run.body(phase.body)
        for element, value in run.memory.items():
            if isinstance(element, Element) and element.space is Space.NEXT:
                state[element.name][element.index or 0] = value
        return status

    def _elements(
        self, phase: ir.Phase, state: Mapping[str, list[Number]]
    ) -> Iterator[tuple[Element, Number]]:
        """The instance that a phase reads, and its locals."""
        for port in self.program.ports:
            for i, value in enumerate(state.get(port.name, ())):
                yield Element(Space.SELF, port.name, i if port.shape else None), value
        for local in phase.locals:
            for i in range(local.size):
                place = i if local.size > 1 else None
                yield Element(Space.LOCAL, local.name, place), self.real(local.initial or 0.0)


@dataclass(slots=True)
class _Run:
    """One phase: what it reads and writes comes and goes with it."""

    machine: Machine
    memory: dict[ir.Operand, Number]
    present: list[bool]

    def body(self, body: ir.Body) -> Status:
        for node in body:
            status = self.statement(node)
            if status is not Status.OK:
                return status
        return Status.OK

    def statement(self, node: ir.Statement) -> Status:
        match node:
            case ir.Operate(target, operator, arguments):
                values = [self.value(argument) for argument in arguments]
                if operator.is_function:
                    self.memory[target] = self.machine.elementary(operator, values)
                else:
                    self.memory[target] = self.machine.arithmetic[operator](*values)
            case ir.Copy(to, value) | ir.Assign(to, value):
                self.memory[to] = self.value(value)
            case ir.Require(required, kind, status):
                if not all(HOLDS[kind](self.value(value)) for value in required):
                    return status
            case ir.IfPresent(row, body) if not isinstance(row, ir.RowArgument):
                if any(self.present) if row is None else self.present[row]:
                    return self.body(body)
            case ir.IfPositive(value, body):
                if self.value(value) > 0:
                    return self.body(body)
        return Status.OK

    def value(self, operand: ir.Operand) -> Number:
        if isinstance(operand, ir.Literal):
            return self.machine.real(operand.value)
        return self.memory[operand]


def self_test_vectors(program: ir.CProgram) -> ir.Vectors:
    """Run the program on a short record of short decimals, with missing rows."""
    machine = Machine(program)
    start = {}
    if program.closing is not None:  # a countdown that comes to its end within the self-test
        name = f"predicted_{program.closing.unless}"
        start[name] = min(CLOSED_AFTER, dict(program.initial)[name][0])
        machine.ports[name] = [machine.real(start[name])]
    rng = np.random.default_rng(len(program.outputs))
    q, p = len(program.inputs), len(program.outputs)
    u = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, q)), 2).tolist()
    y = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, p)), 2)
    y[2] = np.nan
    y[MARKED, 0] = np.nan
    trace = []
    for inputs, outputs in zip(u, y.tolist(), strict=True):
        status = machine.step(inputs, outputs, dict(program.parameters))
        if status.value < 0:
            raise InternalError(f"{program.name}: the self-test is refused: {status.meaning}")
        trace.append(_floats(machine.ports["filtered_state"]))
    return ir.Vectors(
        u=tuple(map(tuple, u)),
        y=tuple(map(tuple, y.tolist())),
        trace=tuple(trace),
        final=tuple((name, _floats(values)) for name, values in machine.ports.items()),
        start=tuple(start.items()),
    )


def _floats(values: Sequence[Number]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
