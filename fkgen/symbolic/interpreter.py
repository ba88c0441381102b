"""Evaluate a recursion: slow, exact, and the reference for the compiled code.

Blocks are evaluated by CasADi. Loops run here, in the same order as in C; NumPy does the operations
of the CasADi functions inside, and takes all rounds at once where their order does not matter.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.symbolic.index import At, Target, Whole, entries, name_of, value
from fkgen.symbolic.interface import Kind
from fkgen.symbolic.ports import PARAMETER
from fkgen.symbolic.recursion import (
    Block,
    Condition,
    Loop,
    OfMatrices,
    Part,
    Phase,
    Product,
    Recursion,
    Triangle,
)

Array = NDArray[np.float64]

#: What NumPy does for each operation that CasADi knows.
_OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_NEG: operator.neg,
    ca.OP_FABS: np.abs,
    ca.OP_FMAX: np.fmax,
    ca.OP_FMIN: np.fmin,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_INV: lambda a: 1.0 / a,
    ca.OP_LT: lambda a, b: np.less(a, b) * 1.0,
    ca.OP_LE: lambda a, b: np.less_equal(a, b) * 1.0,
    ca.OP_IF_ELSE_ZERO: lambda condition, a: np.where(np.asarray(condition) > 0, a, 0.0),
    **{getattr(ca, f"OP_{name.upper()}"): getattr(np, name) for name in ("sqrt", "exp", "log")},
}


class Interpreter:
    """One instance of a filter, stepped sample by sample.

    Every block is the same CasADi function that the back end lowers, evaluated in double.
    """

    def __init__(self, recursion: Recursion) -> None:
        self.recursion = recursion
        self._phases = [
            (phase, [_prepared(block, phase) for block in phase.blocks])
            for phase in recursion.phases
        ]
        self.reset()

    def reset(self, parameters: Mapping[str, float] | None = None) -> None:
        """Return to the prediction for sample 0, which may have other parameters than defaults."""
        start = dict(self.recursion.initial)
        if parameters:
            start |= self.recursion.begun(self.recursion.spec.defaults | dict(parameters))
        self.values: dict[str, Array] = {
            port.name: np.array(start.get(port.name, np.zeros(port.size)), float)
            for port in self.recursion.ports
        }

    def step(self, y: Array, u: Array, parameters: Mapping[str, float]) -> bool:
        """Update, then predict; False if a guard refused the sample (nothing changes then)."""
        values = {name: array.copy() for name, array in self.values.items()}
        values |= {PARAMETER + name: np.array([value]) for name, value in parameters.items()}
        values |= {"y": y, "u": u}
        for phase, blocks in self._phases:
            if phase.unless is not None and values[phase.unless][0] > 0.0:
                continue
            values |= {
                v.name: np.array(v.values or [v.initial or 0.0] * v.size) for v in phase.variables
            }
            with np.errstate(all="ignore"):
                if not all(run(values) for run in blocks):
                    return False
        self.values = {name: values[name] for name in self.values}
        return True

    def run(
        self,
        y: Array,
        u: Array,
        parameters: Mapping[str, Array],
        *,
        keep: Sequence[str] | None = None,
    ) -> dict[str, Array]:
        """Filter a record; ports by name, (T, ...), NaN in innovations of missing rows."""
        ports = [p for p in self.recursion.ports if keep is None or p.name in keep]
        rows: dict[str, list[NDArray[np.floating]]] = {port.name: [] for port in ports}
        for k in range(len(y)):
            self.step(y[k], u[k], {name: float(value[k]) for name, value in parameters.items()})
            for port in ports:
                rows[port.name].append(port.shown(self.values, y[k]))
        return {name: np.array(value) for name, value in rows.items()}


def _prepared(block: Part, phase: Phase) -> Callable[[dict[str, Array]], bool]:
    """What runs a block or a loop on values; False if a guard refuses."""
    if isinstance(block, Loop):
        nest = _Nest(block, phase)
        return lambda values: nest.run(values, {})
    if isinstance(block, OfMatrices):
        return _multiplied(block) if isinstance(block, Product) else _copied(block)
    function, threshold = block.function(phase.symbols), block.threshold(phase.symbols)
    return lambda values: _evaluate(block, function, threshold, values)


def _evaluate(
    block: Block, function: ca.Function, threshold: ca.Function | None, values: dict[str, Array]
) -> bool:
    """Run one block on ``values``; False if a guard refuses."""
    arguments = [values[name_of(place)] for place in block.reads]
    if not _any_row(block.when, values, {}):
        return True
    if threshold is not None and not float(threshold.call(arguments)[0]) > 0.0:
        return True
    arrays = [np.asarray(value).ravel() for value in function.call(arguments)]
    guarded = arrays[len(block.assign) :]
    if not all(_HOLDS[g.kind](v).all() for g, v in zip(block.guards, guarded, strict=True)):
        return False
    for target, found in zip(block.assign, arrays, strict=False):
        _put(target, found[0] if isinstance(target, At) else found, values, {})
    return True


def _multiplied(product: Product) -> Callable[[dict[str, Array]], bool]:
    """What computes every entry as one chain, all of them side by side."""
    at = entries(product.rows, product.columns, lower=product.lower)

    def places(place: At, k: int = 0) -> Any:
        return value(place.index, {**at, "k": k})

    begin, target, to = product.start, product.target, places(product.target)
    factors = [
        [(each.name, places(each, k)) for each in (product.left, product.right)]
        for k in range(product.inner)
    ]

    def run(values: dict[str, Array]) -> bool:
        terms = (operator.mul(*(values[name][i] for name, i in each)) for each in factors)
        found = next(terms) if begin is None else values[begin.name][places(begin)]
        for term in terms:
            found = found - term if product.less else found + term
        values[target.name][to] = found
        return True

    return run


def _copied(triangle: Triangle) -> Callable[[dict[str, Array]], bool]:
    """What copies the entries on and below the diagonal, then those above it."""
    at = entries(triangle.size, triangle.size, lower=True)
    source, target = triangle.source, triangle.target
    ways = [at, {"i": at["j"], "j": at["i"]}] if triangle.mirrored else [at]
    of, to = value(source.index, at), [value(target.index, way) for way in ways]

    def run(values: dict[str, Array]) -> bool:
        for each in to:
            values[target.name][each] = values[source.name][of]
        return True

    return run


def _any_row(
    when: Condition | None, values: Mapping[str, Array], variables: Mapping[str, Any]
) -> bool:
    """Whether the row of y that a condition asks for is present."""
    if when is None or not when.present:
        return True
    here = ~np.isnan(values["y"])
    return bool(np.any(here if when.row is None else here[value(when.row, variables)]))


def _put(
    target: Target, found: Array, values: dict[str, Array], variables: Mapping[str, Any]
) -> None:
    if isinstance(target, At):
        values[target.name][value(target.index, variables)] = found
    else:
        values[target] = found


class _Operations:
    """The operations of a CasADi function of scalars, for numbers or arrays of them."""

    def __init__(self, function: ca.Function, reads: Sequence[Target]) -> None:
        self.loads: list[tuple[int, str, Whole]] = []
        self.steps: list[tuple[Callable[..., Any], int, list[int]]] = []
        self.outputs = [[-1] * function.nnz_out(i) for i in range(function.n_out())]
        work: dict[int, int] = {}
        cells = count(1)
        constants = {0: np.float64(0.0)}
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            source, target = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                self.outputs[target[0]][target[1]] = work[source[0]]
                continue
            arguments = [work[i] for i in source] if code in _OPERATIONS else []
            cell = work[target[0]] = next(cells)
            if code == ca.OP_CONST:
                constants[cell] = np.float64(function.instruction_constant(k))
            elif code == ca.OP_INPUT:
                place = reads[source[0]]
                at = place if isinstance(place, At) else At(place, source[1])
                self.loads.append((cell, at.name, at.index))
            elif code in _OPERATIONS:
                self.steps.append((_OPERATIONS[code], cell, arguments))
            else:
                raise InternalError(f"no NumPy for CasADi operation {code}")
        self.cells = [constants.get(cell) for cell in range(next(cells))]
        self.outputs = [[max(cell, 0) for cell in each] for each in self.outputs]

    def __call__(self, values: Mapping[str, Array], variables: Mapping[str, Any]) -> list[Any]:
        """The outputs, where variables of loops have these values."""
        cells = self.cells.copy()
        for cell, name, index in self.loads:
            cells[cell] = values[name][value(index, variables)]
        for operation, cell, arguments in self.steps:
            cells[cell] = operation(*[cells[i] for i in arguments])
        return [[cells[i] for i in each] for each in self.outputs]


@dataclass(slots=True)
class _Step:
    """A block inside of loops."""

    block: Block
    function: _Operations
    threshold: _Operations | None

    def run(self, values: dict[str, Array], variables: Mapping[str, Any]) -> bool:
        """Run it on ``values``; False if a guard refuses."""
        if not _runs(self.block.when, self.threshold, values, variables):
            return True
        found = self.function(values, variables)
        guarded = found[len(self.block.assign) :]
        for guard, checked in zip(self.block.guards, guarded, strict=True):
            if not all(np.all(_HOLDS[guard.kind](each)) for each in checked):
                return False
        for target, each in zip(self.block.assign, found, strict=False):
            new = each[0] if isinstance(target, At) else np.array(each)
            _put(target, new, values, variables)
        return True


class _Nest:
    """A loop, and what is in it."""

    def __init__(self, loop: Loop, phase: Phase) -> None:
        self.loop, self.is_parallel = loop, loop.is_parallel
        self.threshold = _threshold(loop, phase)
        self.body = [_inside(each, phase) for each in loop.body]

    def run(self, values: dict[str, Array], variables: Mapping[str, Any]) -> bool:
        """Run it on ``values``; False if a guard refuses."""
        loop = self.loop
        if not _runs(loop.when, self.threshold, values, variables):
            return True
        rounds: Any = range(value(loop.begin, variables), value(loop.end, variables))
        if self.is_parallel and len(rounds) > 0:
            rounds = [np.arange(rounds.start, rounds.stop)]
        return all(
            each.run(values, {**variables, loop.index: i}) for i in rounds for each in self.body
        )


def _inside(part: Part, phase: Phase) -> _Nest | _Step:
    """A part of a loop."""
    match part:
        case Loop():
            return _Nest(part, phase)
        case Block():
            function = _Operations(part.function(phase.symbols), part.reads)
            return _Step(part, function, _threshold(part, phase))
    raise InternalError(f"a statement about whole matrices in a loop: {part.title}")


def _threshold(block: Block | Loop, phase: Phase) -> _Operations | None:
    function = block.threshold(phase.symbols)
    return None if function is None else _Operations(function, block.reads)


def _runs(
    when: Condition | None,
    threshold: _Operations | None,
    values: Mapping[str, Array],
    variables: Mapping[str, Any],
) -> bool:
    """Whether the condition of a block or loop holds."""
    if not _any_row(when, values, variables):
        return False
    return threshold is None or bool(threshold(values, variables)[0][0] > 0.0)


_HOLDS: dict[Kind, Callable[[Array], NDArray[np.bool_]]] = {
    Kind.POSITIVE: lambda values: values > 0.0,
    Kind.NONNEGATIVE: lambda values: values >= 0.0,
    Kind.FINITE: np.isfinite,
}
