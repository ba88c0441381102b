"""Ports that several families share, and the symbols of everything that a phase can read."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from fkgen.problem import Spec
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant

#: Prefix of run-time parameters among the symbols: a parameter may be called ``u``.
PARAMETER = "params."


def state_ports(spec: Spec) -> tuple[Port, ...]:
    """Predicted and filtered state with their covariances."""
    n = spec.model.nx
    square = (n, n)
    return (
        Port(
            name="predicted_state",
            unit="x",
            shape=(n,),
            role=Role.STATE,
            meaning="x(k+1|k): mean of the next state given y[0..k]",
        ),
        Port(
            name="predicted_covariance",
            unit="xx",
            shape=square,
            role=Role.STATE,
            symmetric=True,
            meaning="P(k+1|k): its error covariance",
        ),
        Port(
            name="filtered_state",
            unit="x",
            shape=(n,),
            role=Role.STATE,
            meaning="x(k|k): mean of the state given y[0..k]",
        ),
        Port(
            name="filtered_covariance",
            unit="xx",
            shape=square,
            role=Role.STATE,
            symmetric=True,
            meaning="P(k|k): its error covariance",
        ),
    )


def innovation_ports(spec: Spec) -> tuple[Port, ...]:
    """Innovation, its covariance, and the two numbers that tell whether they fit."""
    p = spec.model.ny
    return (
        Port(
            name="innovation",
            unit="y",
            shape=(p,),
            role=Role.OUTPUT,
            per_row=True,
            meaning="y[k] minus its prediction; 0 where the row is missing",
        ),
        Port(
            name="innovation_covariance",
            unit="yy",
            shape=(p, p),
            role=Role.OUTPUT,
            symmetric=True,
            meaning="its covariance, of all rows, present or not",
        ),
        Port(
            name="nis",
            shape=(),
            role=Role.OUTPUT,
            meaning="normalised innovation squared over the rows present",
        ),
        Port(
            name="log_likelihood",
            shape=(),
            role=Role.OUTPUT,
            meaning="log density of the rows present given y[0..k-1]",
        ),
    )


def prior_of(spec: Spec) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """x0, and P0 packed: what every prediction for sample 0 is."""
    P0 = spec.model.P0.values()
    state = tuple(float(v) for v in spec.model.x0.values().ravel())
    return state, tuple(float(P0[i, j]) for i, j in triangle(spec.model.nx))


def symbols_of(spec: Spec, plant: Plant, ports: Sequence[Port]) -> dict[str, ca.SX]:
    """Symbols by name: parameters, ``u``, ``y`` and every port (packed, by rows)."""
    symbols = {PARAMETER + name: symbol for name, symbol in plant.parameters.items()}
    symbols["u"] = ca.SX.sym("u", spec.model.nu)
    symbols["y"] = ca.SX.sym("y", spec.model.ny)
    symbols |= {port.name: ca.SX.sym(port.name, port.size) for port in ports}
    return symbols
