"""Ports that several families share, and the symbols of everything that a phase can read."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

import casadi as ca

from fkgen.problem import Model, Spec
from fkgen.symbolic.interface import Port, Role, triangle
from fkgen.symbolic.plant import Plant

#: Prefix of run-time parameters among the symbols: a parameter may be called ``u``.
PARAMETER = "params."

#: A port that the next sample needs, and one for the user alone.
carried, shown = partial(Port, role=Role.STATE), partial(Port, role=Role.OUTPUT)

Start = tuple[float, ...]
Priors = tuple[Literal["", "x"], Literal["", "P"]]


def estimate_ports(
    prefix: str,
    shape: tuple[int, ...],
    meanings: tuple[str, str],
    *,
    state: str = "state",
    priors: Priors = ("x", "P"),
    corrected: str = "",
    errors: int | None = None,
) -> tuple[Port, Port]:
    """An estimate of this shape, one or several, and its covariance; each starts as the prior.

    ``corrected`` is the prefix of what an update makes of it, ``errors`` the number of rows of the
    covariance, where it is not that of the estimate.
    """
    rows = shape[-1] if errors is None else errors
    names, square = (state, "covariance"), (*shape[:-1], rows, rows)
    twin = [corrected and f"{corrected}{name}" for name in names]
    vector = partial(carried, unit="x", prior=priors[0], corrected=twin[0])
    matrix = partial(carried, unit="xx", symmetric=True, prior=priors[1], corrected=twin[1])
    return (
        vector(f"{prefix}{state}", shape, meanings[0]),
        matrix(f"{prefix}covariance", square, meanings[1]),
    )


#: How factors are stored.
_FACTORS = "by columns: U D U' with U unit upper triangular; D in place of its diagonal"


def mode_factor_ports(ne: int, extras: Sequence[int]) -> tuple[Port, Port]:
    """Those of every mode one after the other, with ``extras`` numbers beside x once filtered."""
    own, joint = len(triangle(ne)), sum(len(triangle(ne + extra)) for extra in extras)
    twin = "" if any(extras) else "mode_filtered_factors"
    shape = (len(extras), own)
    later = (joint,) if any(extras) else shape
    return (
        carried("mode_factors", shape, f"factors of mode_covariance, {_FACTORS}", corrected=twin),
        carried("mode_filtered_factors", later, "the same of mode_filtered_covariance"),
    )


def factor_ports(ne: int, extra: int = 0) -> tuple[Port, Port]:
    """Factors of predicted and filtered covariance, of the latter with ``extra`` numbers beside."""
    own, joint = len(triangle(ne)), len(triangle(ne + extra))
    twin = "" if extra else "filtered_factors"
    beside = " with what y tells of beside x" if extra else ""
    return (
        carried("predicted_factors", (own,), f"factors of P(k+1|k), {_FACTORS}", corrected=twin),
        carried("filtered_factors", (joint,), f"factors of P(k|k){beside}, {_FACTORS}"),
    )


def state_ports(spec: Spec) -> tuple[Port, ...]:
    """Predicted and filtered state with their covariances."""
    predicted = "x(k+1|k): mean of the next state given y[0..k]", "P(k+1|k): its error covariance"
    filtered = "x(k|k): mean of the state given y[0..k]", "P(k|k): its error covariance"
    shape, errors = (spec.model.nx,), spec.model.ne
    return (
        *estimate_ports("predicted_", shape, predicted, corrected="filtered_", errors=errors),
        *estimate_ports("filtered_", shape, filtered, errors=errors),
    )


def mode_estimate_ports(spec: Spec, count: int, means: tuple[str, str]) -> tuple[Port, ...]:
    """Predicted and filtered state under each of several modes, with their covariances."""
    shape, covariance = (count, spec.model.nx), "its error covariance"
    later, errors = "mode_filtered_", spec.model.ne
    return (
        *estimate_ports("mode_", shape, (means[0], covariance), corrected=later, errors=errors),
        *estimate_ports(later, shape, (means[1], covariance), errors=errors),
    )


def twins(name: str, shape: tuple[int, ...], meaning: str, start: Start = ()) -> tuple[Port, Port]:
    """A number of sample k and its prediction; {of} and {k} in the meaning tell them apart."""
    now, later = (
        carried(of + name, shape, meaning.format(of=of, k=k), start=start, corrected=twin)
        for of, k, twin in (("", "k", ""), ("predicted_", "k+1", name))
    )
    return now, later


def innovation_ports(spec: Spec, *, given: str = "") -> tuple[Port, ...]:
    """Innovation, its covariance, and the two numbers that tell whether they fit.

    ``given`` is the port that says which rows count, where those that are present need not.
    """
    p = spec.model.ny
    covariance = "its covariance, of all rows, present or not"
    innovation = "y[k] minus its prediction; 0 where the row is missing"
    return (
        shown("innovation", (p,), innovation, unit="y", per_row=True, given=given),
        shown("innovation_covariance", (p, p), covariance, unit="yy", symmetric=True),
        shown("nis", (), "normalised innovation squared over the rows present"),
        shown("log_likelihood", (), "log density of the rows present given y[0..k-1]"),
    )


def prior_of(spec: Spec) -> tuple[Start, Start]:
    """x0, and P0 packed: what every prediction for sample 0 is; with the default parameters."""
    P0 = spec.model.P0.values(spec.defaults)
    state = tuple(float(v) for v in spec.model.x0.values(spec.defaults).ravel())
    return state, tuple(float(P0[i, j]) for i, j in triangle(spec.model.ne))


def prior_symbols(model: Model | Plant) -> dict[str, ca.SX]:
    """What the phase that starts a filter reads: mean and packed covariance of the prior."""
    return {"x": ca.SX.sym("x", model.nx), "P": ca.SX.sym("P", len(triangle(model.ne)))}


def prior_ports(model: Model) -> tuple[Port, ...]:
    """What the phase writes that computes the prior of the spec."""
    mean = shown("x", (model.nx,), "mean of the prior", unit="x")
    return mean, shown("P", (model.ne, model.ne), "its covariance", unit="xx", symmetric=True)


def symbols_of(spec: Spec, plant: Plant, ports: Sequence[Port]) -> dict[str, ca.SX]:
    """Symbols by name: parameters, ``u``, ``y`` and every port (packed, by rows)."""
    symbols = {PARAMETER + name: symbol for name, symbol in plant.parameters.items()}
    symbols["u"] = ca.SX.sym("u", spec.model.nu)
    symbols["y"] = ca.SX.sym("y", spec.model.ny)
    symbols |= {port.name: ca.SX.sym(port.name, port.size) for port in ports}
    return symbols
