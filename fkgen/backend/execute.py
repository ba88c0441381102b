"""Execute a C program in NumPy scalars of its own type: the bits that compiled code has to give.

Every number that a phase knows has a cell, and statements are functions of the cells and of the
indices of the loops around them. They are made once.
"""

from __future__ import annotations

import operator as arithmetic
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.backend import ir
from fkgen.backend.elementary import Elementary, Number
from fkgen.backend.fused.rounding import fma
from fkgen.backend.ir import Element, Operator, Space
from fkgen.errors import InternalError, UnfitError
from fkgen.symbolic.index import Index, entries, value
from fkgen.symbolic.interface import OUTSIDE, Kind, Status

Array = NDArray[np.float64]

ARITHMETIC: dict[Operator, Callable[..., Number]] = {
    Operator.ADD: arithmetic.add,
    Operator.SUB: arithmetic.sub,
    Operator.MUL: arithmetic.mul,
    Operator.DIV: arithmetic.truediv,
    Operator.FMA: fma,
    Operator.FMS: lambda a, b, c: fma(a, b, -c),
    Operator.FNMA: lambda a, b, c: fma(-a, b, c),
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

#: Row 0 of the last sample, where a filter has a gate that is to reject it.
OUTLIER = 1000.0

#: How near to a path from x0 the self-test is tried where equations have no values farther away.
NEARER = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-6)

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
        self.code: dict[int, _Code] = {}
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
        self,
        u: Sequence[float] | NDArray[np.floating],
        y: Sequence[float] | NDArray[np.floating],
        parameters: Mapping[str, float],
    ) -> Status:
        """Update, then predict; a refused sample changes nothing."""
        real, state = self.real, {name: list(values) for name, values in self.ports.items()}
        given = self._parameters(parameters)
        if any(map(self._is_outside, self.program.inputs, u)):
            return Status.INPUT_OUT_OF_RANGE
        outside = self.outside(y)
        for name, values in (("u", u), ("y", y), (OUTSIDE, outside)):
            given |= {Element(Space.INPUT, name, i): real(v) for i, v in enumerate(values)}
        present = [not (np.isnan(v) or out) for v, out in zip(y, outside, strict=True)]
        with np.errstate(all="ignore"):
            for phase in self.program.phases:
                if phase.unless is not None and state[phase.unless][0] > 0:
                    continue
                status = self._run(phase, given, state, present)
                if status is not Status.OK:
                    return status
        self.ports = state
        applies = (o.status for o in self.program.outcomes if max(state[o.port]) > o.level)
        seen = any(present) or any(outside)
        return next(applies, Status.OK) if seen else Status.SKIPPED

    def outside(self, y: Sequence[float] | NDArray[np.floating]) -> list[bool]:
        """Which rows of y are out of their ranges."""
        return [self._is_outside(row, v) for row, v in zip(self.program.outputs, y, strict=True)]

    def _is_outside(self, signal: ir.Signal, value: float) -> bool:
        """Whether a number is out of the range of its signal; NaN is not."""
        if signal.range is None:
            return False
        low, high = map(self.real, signal.range)
        return bool(self.real(value) < low or self.real(value) > high)

    def _run(
        self,
        phase: ir.Phase,
        given: Mapping[Any, Number],
        state: dict[str, list[Number]],
        present: list[bool],
    ) -> Status:
        """Run one phase on an instance, which it changes."""
        if id(phase) not in self.code:
            self.code[id(phase)] = _Code(self, phase)
        code = self.code[id(phase)]
        cells = code.cells.copy()
        for element, number in given.items():
            if (at := code.found(element)) is not None:
                cells[at] = number
        for name, base in code.bases(Space.SELF):
            cells[base : base + len(state[name])] = state[name]
        status = code.run(cells, {}, present) or Status.OK
        for name, base in code.bases(Space.NEXT):
            now = zip(state[name], cells[base : base + len(state[name])], strict=True)
            state[name][:] = [old if new is None else new for old, new in now]
        return status


#: A statement: it returns a status where it refuses.
_Statement = Callable[[list[Any], dict[str, int], list[bool]], Status | None]
_Getter = Callable[[list[Any], dict[str, int]], Any]


class _Code:
    """One phase as functions of its cells."""

    def __init__(self, machine: Machine, phase: ir.Phase) -> None:
        self.machine = machine
        self.cells: list[Any] = []
        self._homes: dict[Any, int] = {}  # where arrays begin, and temporaries and constants are
        program = machine.program
        self._sizes = {port.name: port.size for port in program.ports}
        rows = len(program.outputs)
        self._sizes |= {"u": len(program.inputs), "y": rows, OUTSIDE: rows}
        self._sizes |= dict(zip(("x", "P"), map(len, program.prior), strict=True))
        for local in phase.locals:
            home = self._home((Space.LOCAL, local.name), local.size)
            values = local.values or (local.initial or 0.0,) * local.size
            self.cells[home : home + local.size] = map(machine.real, values)
        self.run = self._body(phase.body)

    def _home(self, key: Any, size: int = 1) -> int:
        if key not in self._homes:
            self._homes[key] = len(self.cells)
            self.cells += [None] * size
        return self._homes[key]

    def found(self, element: Element) -> int | None:
        """The cell of an element, if the phase has one."""
        home = self._homes.get((element.space, element.name))
        return None if home is None else home + int(value(element.index or 0, {}))

    def bases(self, space: Space) -> list[tuple[str, int]]:
        """The arrays of a space, and where they begin."""
        arrays = [(key, home) for key, home in self._homes.items() if isinstance(key, tuple)]
        return [(key[1], home) for key, home in arrays if key[0] is space]

    def _cell(self, operand: ir.Operand) -> tuple[int, Index | None]:
        """Where an operand is; what loops add to that."""
        match operand:
            case ir.Literal(number):
                home = self._home(f"{number!r}")
                self.cells[home] = self.machine.real(number)
                return home, None
            case Element(space, name, index):
                size = 1 if space is Space.PARAMETER else self._sizes.get(name, 1)
                home = self._home((space, name), size)
                return (home, index) if isinstance(index, Index) else (home + (index or 0), None)
        return self._home(operand), None

    def _getter(self, operand: ir.Operand) -> _Getter:
        home, index = self._cell(operand)
        if index is None:
            return lambda cells, _: cells[home]
        return lambda cells, variables: cells[home + index.at(variables)]

    def _setter(self, target: ir.Operand, get: _Getter) -> _Statement:
        home, index = self._cell(target)

        def put(cells: list[Any], variables: dict[str, int], _: list[bool]) -> None:
            at = home if index is None else home + index.at(variables)
            cells[at] = get(cells, variables)

        return put

    def _body(self, body: ir.Body) -> _Statement:
        steps = [self._statement(node) for node in body if not isinstance(node, ir.Heading)]

        def run(cells: list[Any], variables: dict[str, int], present: list[bool]) -> Status | None:
            for step in steps:
                if (status := step(cells, variables, present)) is not None:
                    return status
            return None

        return run

    def _statement(self, node: ir.Statement) -> _Statement:
        match node:
            case ir.Operate(target, operator, arguments):
                return self._setter(target, self._operation(operator, arguments))
            case ir.Copy(target, kept) | ir.Assign(target, kept):
                return self._setter(target, self._getter(kept))
            case ir.Require():
                return self._require(node)
            case ir.IfPresent() | ir.IfPositive():
                return self._condition(node)
            case ir.For():
                return self._loop(node)
            case ir.Product() | ir.Triangle():
                return self._of_matrices(node)
        raise InternalError(f"no execution of {node}")

    def _operation(self, operator: Operator, arguments: tuple[ir.Operand, ...]) -> _Getter:
        gets, machine = [self._getter(argument) for argument in arguments], self.machine
        if operator.is_function:
            return lambda cells, at: machine.elementary(operator, [get(cells, at) for get in gets])
        do, first = machine.arithmetic[operator], gets[0]
        if len(gets) == 1:
            return lambda cells, at: do(first(cells, at))
        if len(gets) > 2:
            return lambda cells, at: do(*[get(cells, at) for get in gets])
        second = gets[1]
        return lambda cells, at: do(first(cells, at), second(cells, at))

    def _require(self, node: ir.Require) -> _Statement:
        gets, holds = [self._getter(each) for each in node.values], HOLDS[node.kind]

        def run(cells: list[Any], variables: dict[str, int], _: list[bool]) -> Status | None:
            held = all(holds(get(cells, variables)) for get in gets)
            return None if held else node.status

        return run

    def _condition(self, node: ir.IfPresent | ir.IfPositive) -> _Statement:
        body = self._body(node.body)
        get = self._getter(node.value) if isinstance(node, ir.IfPositive) else None
        row = node.row if isinstance(node, ir.IfPresent) else None
        if isinstance(row, ir.RowArgument):
            raise InternalError("a row of a routine in a program")

        def run(cells: list[Any], variables: dict[str, int], present: list[bool]) -> Status | None:
            if get is not None:
                holds = get(cells, variables) > 0
            else:
                holds = any(present) if row is None else present[value(row, variables)]
            return body(cells, variables, present) if holds else None

        return run

    def _cells(self, element: Element, at: Mapping[str, Any]) -> NDArray[np.intp]:
        """The cells of an element for many values of indices."""
        array = self._cell(replace(element, index=0 if element.moves else element.index))[0]
        return array + np.broadcast_to(value(element.index or 0, at), at["i"].shape)

    def _by_element(self, operator: Operator, arguments: int) -> Callable[..., Any]:
        """An operation on arrays of numbers."""
        do = self.machine.arithmetic[operator]
        plain = self.machine.arithmetic is ARITHMETIC and operator not in ir.FUSED
        return do if plain else np.frompyfunc(do, arguments, 1)

    def _of_matrices(self, node: ir.OfMatrices) -> _Statement:
        return self._product(node) if isinstance(node, ir.Product) else self._triangle(node)

    def _triangle(self, node: ir.Triangle) -> _Statement:
        at = entries(node.size, node.size, lower=True)
        source, target = self._cells(node.source, at), self._cells(node.target, at)
        other = self._cells(node.target, {"i": at["j"], "j": at["i"]}) if node.mirrored else target

        def run(cells: list[Any], _: dict[str, int], __: list[bool]) -> Status | None:
            for a, b, c in zip(source, target, other, strict=True):
                cells[b] = cells[c] = cells[a]
            return None

        return run

    def _product(self, node: ir.Product) -> _Statement:
        at = entries(node.rows, node.columns, lower=node.lower)
        left, right = (
            [self._cells(element, {**at, "k": k}) for k in range(node.inner)]
            for element in (node.left, node.right)
        )
        target = self._cells(node.target, at)
        begin = None if node.start is None else self._cells(node.start, at)
        multiply, add = self._by_element(Operator.MUL, 2), self._by_element(node.adding, 2)
        together = self._by_element(node.adding, 3) if node.fused else add

        def run(cells: list[Any], _: dict[str, int], __: list[bool]) -> Status | None:
            now = np.array(cells, object)
            pairs = zip(left, right, strict=True)
            found = multiply(*(now[each] for each in next(pairs))) if begin is None else now[begin]
            for a, b in pairs:
                if node.fused:
                    found = together(now[a], now[b], found)
                else:
                    found = add(found, multiply(now[a], now[b]))
            for cell, each in zip(target, found, strict=True):
                cells[cell] = each
            return None

        return run

    def _loop(self, node: ir.For) -> _Statement:
        body, name = self._body(node.body), node.index

        def run(cells: list[Any], variables: dict[str, int], present: list[bool]) -> Status | None:
            for i in node.rounds(variables):
                variables[name] = i
                if (status := body(cells, variables, present)) is not None:
                    return status
            return None

        return run


def self_test_vectors(program: ir.CProgram) -> ir.Vectors:
    """Run the program on a short record of short decimals, with missing rows.

    Equations may have no values there: then near a path from x0, and nearer.

    Raises
    ------
    UnfitError
        If the filter refuses a sample of every record; the first one.
    """
    refused: list[UnfitError] = []
    for u, y in _short_records(program):
        try:
            return _vectors(program, u, y)
        except UnfitError as unfit:
            refused.append(unfit)
    raise refused[0]


def _short_records(program: ir.CProgram) -> Iterator[tuple[Array, Array]]:
    """Inputs and measurements of the self-test, those that are tried first come first."""
    rng = np.random.default_rng(len(program.outputs))
    q, p = len(program.inputs), len(program.outputs)
    u = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, q)), 2)
    y = np.round(rng.uniform(-1.0, 1.0, (SAMPLES, p)), 2)
    y[2] = np.nan
    y[MARKED, 0] = np.nan
    last = np.zeros((SAMPLES, p))
    last[-1, 0] = OUTLIER if any(port.flags for port in program.ports) else 0.0
    yield _ranged(program, u, np.where(last > 0.0, last, y))
    for scale in NEARER:
        for level, path in program.paths:
            near = _short(level + scale * u), _short(np.array(path) + scale * y + last)
            yield _ranged(program, *near)


def _ranged(program: ir.CProgram, u: Array, y: Array) -> tuple[Array, Array]:
    """The same within the ranges of signals, but for one row of the last sample."""
    for signals, values in ((program.inputs, u), (program.outputs, y)):
        for i, signal in enumerate(signals):
            if signal.range is not None:
                values[:, i] = np.clip(values[:, i], *signal.range)
    for i, row in reversed([*enumerate(program.outputs)]):
        if row.range is not None:
            low, high = row.range
            y[-1, i] = high + (high - low)
            break
    return u, y


def _short(values: Array) -> Array:
    return np.array([[float(f"{value:.6g}") for value in row] for row in values]).reshape(
        values.shape
    )


def _vectors(program: ir.CProgram, u: Array, y: Array) -> ir.Vectors:
    machine = Machine(program)
    start = {}
    if program.closing is not None:  # a countdown that comes to its end within the self-test
        name = f"predicted_{program.closing.unless}"
        start[name] = min(CLOSED_AFTER, dict(program.initial)[name][0])
        machine.ports[name] = [machine.real(start[name])]
    trace: list[tuple[float, ...]] = []
    for inputs, outputs in zip(u.tolist(), y.tolist(), strict=True):
        status = machine.step(inputs, outputs, dict(program.parameters))
        if status.value < 0:
            what = f"sample {len(trace)} of the self-test is refused: {status.meaning}"
            raise UnfitError(program.name, what)
        trace.append(_floats(machine.ports["filtered_state"]))
    return ir.Vectors(
        u=tuple(map(tuple, u.tolist())),
        y=tuple(map(tuple, y.tolist())),
        trace=tuple(trace),
        final=tuple((name, _floats(values)) for name, values in machine.ports.items()),
        start=tuple(start.items()),
    )


def _floats(values: Sequence[Number]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
