"""Evaluate a recursion with CasADi: slow, exact, and the reference for the compiled code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.symbolic.interface import Kind
from fkgen.symbolic.packing import unpacked
from fkgen.symbolic.ports import PARAMETER
from fkgen.symbolic.recursion import Block, Condition, Recursion

Array = NDArray[np.float64]


class Interpreter:
    """One instance of a filter, stepped sample by sample.

    Every block is the same CasADi function that the back end lowers, evaluated in double.
    """

    def __init__(self, recursion: Recursion) -> None:
        self.recursion = recursion
        self._phases = [
            [_Ready(b, b.function(phase.symbols), b.threshold(phase.symbols)) for b in phase.blocks]
            for phase in recursion.phases
        ]
        self.reset()

    def reset(self) -> None:
        """Return to the prediction for sample 0."""
        self.values: dict[str, Array] = {
            port.name: np.array(self.recursion.initial.get(port.name, np.zeros(port.size)), float)
            for port in self.recursion.ports
        }

    def step(self, y: Array, u: Array, parameters: Mapping[str, float]) -> bool:
        """Update, then predict; False if a guard refused the sample (nothing changes then)."""
        values = dict(self.values)
        values |= {PARAMETER + name: np.array([value]) for name, value in parameters.items()}
        values |= {"y": y, "u": u}
        for phase, blocks in zip(self.recursion.phases, self._phases, strict=True):
            if phase.unless is not None and values[phase.unless][0] > 0.0:
                continue
            local = {v.name: np.full(v.size, v.initial or 0.0) for v in phase.variables}
            values |= local
            if not all(_evaluate(each, values) for each in blocks):
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
        rows: dict[str, list[Array]] = {port.name: [] for port in ports}
        for k in range(len(y)):
            self.step(y[k], u[k], {name: float(value[k]) for name, value in parameters.items()})
            for port in ports:
                value: Any = unpacked(port, self.values[port.name])
                if port.given:
                    value = np.where(self.values[port.given].reshape(port.shape) > 0, value, np.nan)
                rows[port.name].append(
                    np.where(np.isnan(y[k]), np.nan, value) if port.per_row else value
                )
        return {name: np.array(value) for name, value in rows.items()}


@dataclass(frozen=True, slots=True)
class _Ready:
    block: Block
    function: ca.Function
    threshold: ca.Function | None


def _evaluate(ready: _Ready, values: dict[str, Array]) -> bool:
    """Run one block on ``values``; False if a guard refuses."""
    block = ready.block
    arguments = [values[name] for name in block.reads]
    if block.when is not None:
        if not _present(block.when, values["y"]):
            return True
        if ready.threshold is not None and not float(ready.threshold.call(arguments)[0]) > 0.0:
            return True
    arrays = [np.asarray(value).ravel() for value in ready.function.call(arguments)]
    for guard, value in zip(block.guards, arrays[len(block.assign) :], strict=True):
        if not _holds(guard.kind, value):
            return False
    values |= dict(zip(block.assign, arrays, strict=False))
    return True


def _present(when: Condition, y: Array) -> bool:
    """Whether the rows that a block waits for are there."""
    here = ~np.isnan(y)
    return not when.present or bool(here.any() if when.row is None else here[when.row])


def _holds(kind: Kind, values: Array) -> bool:
    match kind:
        case Kind.POSITIVE:
            return bool(np.all(values > 0.0))
        case Kind.NONNEGATIVE:
            return bool(np.all(values >= 0.0))
        case Kind.FINITE:
            return bool(np.all(np.isfinite(values)))
