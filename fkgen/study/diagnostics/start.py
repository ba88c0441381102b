"""Does the filter keep its digits from the prior on: the recursion in float beside that in double.

Both run, statement by statement, over one record that is drawn from the spec: the start from the
prior, with its vague covariances, is where float loses most, and no bound at rest shows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from fkgen.backend import ir
from fkgen.backend.elementary import Number
from fkgen.backend.execute import ARITHMETIC, HOLDS, Machine, self_test_vectors
from fkgen.backend.ir import Element, Space
from fkgen.backend.lower import lower, unfit_spec
from fkgen.errors import UnfitError
from fkgen.families import family
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec
from fkgen.problem.code import Scalar
from fkgen.study.diagnostics.subject import Array, Subject
from fkgen.trials.errors import error_sizes, errors_of

SAMPLES = 1000

#: y (T, p), u (T, q), and parameters by name, (T,) each.
_Record = tuple[Array, Array, dict[str, Array]]

#: Share of a standard deviation that rounding may take without anybody noticing, and beyond which
#: the estimate is another one.
_SMALL, _LOST = 0.1, 1.0


def start(model: Subject) -> None:
    """Run the self-test; hold the filter in float against itself in double, from the prior on."""
    try:
        self_test_vectors(lower(family(model.spec.filter.family).build(model.spec)))
    except UnfitError as unfit:
        remedy = unfit_spec(model.spec, unfit).expected
        model.add("start.unfit", what=unfit.what, scalar=model.spec.code.scalar, remedy=remedy)
    if not model.is_float:
        return
    record = _drawn(model.spec)
    found = _estimates(model.spec, "float", record)
    exact = _estimates(model.spec, "double", record)
    alike = exact.accepted & found.accepted
    refused = np.flatnonzero(exact.accepted & ~found.accepted)
    if refused.size:
        model.add("start.refused", refused.size, samples=SAMPLES, first=int(refused[0]))
    below = (found.variance < np.minimum(exact.variance, 0.0)).any(axis=1)
    negative = np.flatnonzero(alike & below)
    if negative.size:
        model.add("start.negative", negative.size, samples=SAMPLES, first=int(negative[0]))
    deviation = np.sqrt(np.maximum(exact.variance, 0.0))
    states = model.spec.model.states
    apart = np.abs(errors_of(states, found.state, exact.state))
    off = np.maximum(apart - 2.0 * error_sizes(states, _spacing(exact.state)), 0.0)
    shares = np.divide(off, deviation, out=np.zeros_like(off), where=deviation > 0.0)
    shares[~alike] = 0.0
    at, worst = np.unravel_index(int(np.argmax(shares)), shares.shape)
    share = float(shares[at, worst])
    model.values["float_start_to_sd"] = share
    code = "start.lost" if share > _LOST else "start.off" if share > _SMALL else "start"
    if code != "start" or not refused.size:
        model.add(code, share, name=model.states[worst], at=int(at), samples=SAMPLES)


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """Filtered states (T, n) and their variances (T, ne), and which samples were accepted, (T,)."""

    state: Array
    variance: Array
    accepted: Any


def _spacing(values: Array) -> Array:
    """Units in the last place of float."""
    return np.spacing(np.abs(values).astype(np.float32)).astype(float)


def _drawn(spec: Spec) -> _Record:
    """A record of the plant: y, u and parameters."""
    rng = np.random.default_rng(20130905)
    u = rng.normal(size=(SAMPLES, spec.model.nu))
    stated = {each.name: np.full(SAMPLES, each.default) for each in spec.stated_parameters}
    with np.errstate(all="ignore"):
        y, parameters = draw_record(spec, stated, u, rng)
    return y, u, parameters


def _estimates(spec: Spec, scalar: Scalar, record: _Record) -> _Estimates:
    """Run the filter of a spec in one scalar type over a record."""
    asked = spec.code.ports
    ports = None if asked is None else (*asked, "filtered_covariance")
    code = replace(spec.code, scalar=scalar, ports=ports)
    replay = Replay(lower(family(spec.filter.family).build(replace(spec, code=code))))
    y, u, parameters = record
    n, ne = spec.model.nx, spec.model.ne
    diagonal = [i * (i + 3) // 2 for i in range(ne)]
    state, variance, accepted = np.zeros((SAMPLES, n)), np.zeros((SAMPLES, ne)), []
    # what float rounds of y is no defect of the filter: both are given the same numbers
    measured = y.astype(np.float32).astype(float)
    driven = u.astype(np.float32).astype(float)
    for k in range(SAMPLES):
        told = {name: float(values[k]) for name, values in parameters.items()}
        accepted.append(replay.step(driven[k], measured[k], told))
        state[k] = replay.port("filtered_state")
        variance[k] = np.array(replay.port("filtered_covariance"))[diagonal]
    return _Estimates(state, variance, np.array(accepted, bool))


class Replay:
    """A program with its operands numbered: what `Machine` does, in a tenth of the time."""

    def __init__(self, program: ir.CProgram) -> None:
        machine = Machine(program)
        self._program, self._real, self._elementary = program, machine.real, machine.elementary
        self._places: dict[ir.Operand, int] = {}
        self._memory: list[Number] = []
        self._phases = [(phase, self._code(phase.body)) for phase in program.phases]
        for name, values in machine.ports.items():
            for place, value in zip(self._of_port(Space.SELF, name), values, strict=True):
                self._memory[place] = value

    def port(self, name: str) -> list[Number]:
        """A port as it is stored."""
        return [self._memory[place] for place in self._of_port(Space.SELF, name)]

    def step(self, u: Array, y: Array, parameters: Mapping[str, float]) -> bool:
        """Update, then predict; False if the sample is refused, which changes nothing."""
        before = list(self._memory)
        for name, values in (("u", u), ("y", y)):
            for i, value in enumerate(values):
                self._memory[self._place(Element(Space.INPUT, name, i))] = self._real(value)
        for name, number in parameters.items():
            self._memory[self._place(Element(Space.PARAMETER, name, None))] = self._real(number)
        present = (~np.isnan(y)).tolist()
        with np.errstate(all="ignore"):
            for phase, code in self._phases:
                if phase.unless is not None and self.port(phase.unless)[0] > 0:
                    continue
                for local in phase.locals:
                    for i in range(local.size):
                        at = Element(Space.LOCAL, local.name, i if local.size > 1 else None)
                        self._memory[self._place(at)] = self._real(local.initial or 0.0)
                if not self._run(code, present):
                    self._memory[: len(before)] = before
                    return False
                for kept, new in self._results(phase):
                    self._memory[kept] = self._memory[new]
        return True

    def _place(self, operand: ir.Operand) -> int:
        """Where an operand is, from its first use on."""
        if operand not in self._places:
            self._places[operand] = len(self._memory)
            number = operand.value if isinstance(operand, ir.Literal) else 0.0
            self._memory.append(self._real(number))
        return self._places[operand]

    def _of_port(self, space: Space, name: str) -> list[int]:
        port = next(each for each in self._program.ports if each.name == name)
        indices = range(port.size) if port.shape else [None]
        return [self._place(Element(space, name, i)) for i in indices]

    @cache  # noqa: B019 - lives as long as what it caches
    def _results(self, phase: ir.Phase) -> list[tuple[int, int]]:
        """Places of members, and of what the phase makes of them."""
        targets = {node.target for node in ir.every(ir.Assign, phase.body)}
        written = [each for each in targets if each.space is Space.NEXT]
        return [(self._place(replace(e, space=Space.SELF)), self._place(e)) for e in written]

    def _code(self, body: ir.Body) -> list[_Step]:
        return [step for node in body for step in self._steps(node)]

    def _steps(self, node: ir.Statement) -> Iterator[_Step]:
        """A statement as: a function or a kind, where the result goes, where arguments are."""
        match node:
            case ir.Operate(target, operator, arguments):
                places = [self._place(argument) for argument in arguments]
                function = ARITHMETIC.get(operator) or partial(_called, self._elementary, operator)
                yield function, self._place(target), places
            case ir.Copy(target, value) | ir.Assign(target, value):
                yield _same, self._place(target), [self._place(value)]
            case ir.Require(values, kind, _):
                yield HOLDS[kind], None, [self._place(value) for value in values]
            case ir.IfPresent(row, inner):
                yield None, row, self._code(inner)
            case ir.IfPositive(value, inner):
                yield _positive, self._place(value), self._code(inner)

    def _run(self, code: list[_Step], present: list[bool]) -> bool:
        memory = self._memory
        for function, target, places in code:
            if function is None:
                here = any(present) if target is None else present[target]
                if here and not self._run(places, present):
                    return False
            elif function is _positive:
                if memory[target] > 0 and not self._run(places, present):
                    return False
            elif target is None:
                if not all(function(memory[place]) for place in places):
                    return False
            elif len(places) == 2:
                memory[target] = function(memory[places[0]], memory[places[1]])
            else:
                memory[target] = function(*[memory[place] for place in places])
        return True


_Step = tuple[Any, Any, Any]


def _same(value: Number) -> Number:
    return value


def _positive(value: Number) -> bool:
    return bool(value > 0)


def _called(elementary: Any, operator: ir.Operator, *arguments: Number) -> Number:
    return elementary(operator, list(arguments))
