"""Evaluate a recursion with CasADi: slow, exact, and the reference for the compiled code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.symbolic.interface import Kind
from fkgen.symbolic.ports import PARAMETER
from fkgen.symbolic.recursion import Block, Recursion

Array = NDArray[np.float64]


class Interpreter:
    """One instance of a filter, stepped sample by sample.

    Every block is the same CasADi function that the back end lowers, evaluated in double.
    """

    def __init__(self, recursion: Recursion) -> None:
        self.recursion = recursion
        self._phases = [
            (p, [(b, b.function(p.symbols), b.threshold(p.symbols)) for b in p.blocks])
            for p in recursion.phases
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
        values = dict(self.values)
        values |= {PARAMETER + name: np.array([value]) for name, value in parameters.items()}
        values |= {"y": y, "u": u}
        for phase, blocks in self._phases:
            if phase.unless is not None and values[phase.unless][0] > 0.0:
                continue
            values |= {v.name: np.full(v.size, v.initial or 0.0) for v in phase.variables}
            if not all(_evaluate(*each, values) for each in blocks):
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


def _evaluate(
    block: Block, function: ca.Function, threshold: ca.Function | None, values: dict[str, Array]
) -> bool:
    """Run one block on ``values``; False if a guard refuses."""
    arguments = [values[name] for name in block.reads]
    if block.when is not None and block.when.present:
        here = ~np.isnan(values["y"])
        if not np.any(here if block.when.row is None else here[block.when.row]):
            return True
    if threshold is not None and not float(threshold.call(arguments)[0]) > 0.0:
        return True
    arrays = [np.asarray(value).ravel() for value in function.call(arguments)]
    guarded = arrays[len(block.assign) :]
    if not all(_HOLDS[g.kind](v).all() for g, v in zip(block.guards, guarded, strict=True)):
        return False
    values |= dict(zip(block.assign, arrays, strict=False))
    return True


_HOLDS: dict[Kind, Callable[[Array], NDArray[np.bool_]]] = {
    Kind.POSITIVE: lambda values: values > 0.0,
    Kind.NONNEGATIVE: lambda values: values >= 0.0,
    Kind.FINITE: np.isfinite,
}
