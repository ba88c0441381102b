"""Ports that several families share, and the symbols of everything that a phase can read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from fkgen.problem import Spec
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant

#: Prefix of run-time parameters among the symbols: a parameter may be called ``u``.
PARAMETER = "params."


def carried(
    name: str, shape: tuple[int, ...], meaning: str, *, unit: str = "", symmetric: bool = False
) -> Port:
    """A port that the next sample needs."""
    return Port(
        name=name, shape=shape, role=Role.STATE, meaning=meaning, unit=unit, symmetric=symmetric
    )


def shown(
    name: str, shape: tuple[int, ...], meaning: str, *, unit: str = "", symmetric: bool = False
) -> Port:
    """A port for the user alone."""
    port = carried(name, shape, meaning, unit=unit, symmetric=symmetric)
    return replace(port, role=Role.OUTPUT)


def estimate_ports(
    prefix: str, shape: tuple[int, ...], meanings: tuple[str, str], *, state: str = "state"
) -> tuple[Port, Port]:
    """An estimate of this shape, one or several, and its covariance."""
    square = (*shape, shape[-1])
    return (
        carried(f"{prefix}{state}", shape, meanings[0], unit="x"),
        carried(f"{prefix}covariance", square, meanings[1], unit="xx", symmetric=True),
    )


def state_ports(spec: Spec) -> tuple[Port, ...]:
    """Predicted and filtered state with their covariances."""
    shape = (spec.model.nx,)
    predicted = "x(k+1|k): mean of the next state given y[0..k]", "P(k+1|k): its error covariance"
    filtered = "x(k|k): mean of the state given y[0..k]", "P(k|k): its error covariance"
    return (
        *estimate_ports("predicted_", shape, predicted),
        *estimate_ports("filtered_", shape, filtered),
    )


def innovation_ports(spec: Spec) -> tuple[Port, ...]:
    """Innovation, its covariance, and the two numbers that tell whether they fit."""
    p = spec.model.ny
    covariance = "its covariance, of all rows, present or not"
    innovation = "y[k] minus its prediction; 0 where the row is missing"
    return (
        replace(shown("innovation", (p,), innovation, unit="y"), per_row=True),
        shown("innovation_covariance", (p, p), covariance, unit="yy", symmetric=True),
        shown("nis", (), "normalised innovation squared over the rows present"),
        shown("log_likelihood", (), "log density of the rows present given y[0..k-1]"),
    )


def prior_of(spec: Spec) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """x0, and P0 packed: what every prediction for sample 0 is."""
    P0 = spec.model.P0.values()
    state = tuple(float(v) for v in spec.model.x0.values().ravel())
    return state, tuple(float(P0[i, j]) for i, j in triangle(spec.model.nx))


def start_of(spec: Spec) -> dict[str, tuple[float, ...]]:
    """Start values of `state_ports`: the prior."""
    state, covariance = prior_of(spec)
    start = {f"{of}_state": state for of in ("predicted", "filtered")}
    return start | {f"{of}_covariance": covariance for of in ("predicted", "filtered")}


def symbols_of(spec: Spec, plant: Plant, ports: Sequence[Port]) -> dict[str, ca.SX]:
    """Symbols by name: parameters, ``u``, ``y`` and every port (packed, by rows)."""
    symbols = {PARAMETER + name: symbol for name, symbol in plant.parameters.items()}
    symbols["u"] = ca.SX.sym("u", spec.model.nu)
    symbols["y"] = ca.SX.sym("y", spec.model.ny)
    symbols |= {port.name: ca.SX.sym(port.name, port.size) for port in ports}
    return symbols
