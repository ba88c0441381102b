"""Kalman filter with the gain to which that of a constant plant goes, such as alpha and beta.

The gain comes from the stabilising solution of the Riccati equation at design time; what is left at
run time is the state. A row that is missing takes no part, the others keep their columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    demand_finite,
    finite,
    measurement_of,
    propagate,
)
from fkgen.estimators.gaussian.gate import (
    Gate,
    gate_notes,
    gate_outcomes,
    gate_ports,
    gate_results,
)
from fkgen.estimators.gaussian.sequential import condition
from fkgen.estimators.lmmse.jump import Array
from fkgen.estimators.lmmse.kalman import constant, innovation_results
from fkgen.estimators.lmmse.stationary import stabilising
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.linalg import pack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import carried, innovation_ports, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

NOTES = (
    "constant gain: covariances are those of the steady state, from sample 0 on, gaps or not",
    "rows of y that are missing take no part; those that are there keep their columns of the gain",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class AtRest:
    """The limits of the filter."""

    predicted: Array  # (n, n): P(k+1|k)
    filtered: Array  # (n, n): P(k|k)
    innovation: Array  # (p, p): S
    gain: Array  # (n, p): K of x(k|k)
    noise_gain: Array  # (n, p): from the innovation to the noise of the state

    @classmethod
    def of(cls, spec: Spec) -> AtRest:
        """Solve the Riccati equation."""
        A, C, Q, R, cross = (getattr(spec.model, letter).values() for letter in "ACQRS")
        P = stabilising(A, C, Q, R, cross)
        S = C @ P @ C.T + R
        inverse = np.linalg.pinv(S, hermitian=True)
        gain, noise_gain = P @ C.T @ inverse, cross @ inverse
        if np.abs(np.linalg.eigvals(A - (A @ gain + noise_gain) @ C)).max() >= 1.0:
            raise InternalError("a stationary gain that does not stabilise")
        rest = np.eye(len(A)) - gain @ C
        filtered = rest @ P @ rest.T + gain @ R @ gain.T
        limits = {"predicted": P, "filtered": filtered, "innovation": S}
        return cls(**limits, gain=gain, noise_gain=noise_gain)


def constant_gain_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``kf`` with ``gain = "stationary"``."""
    at_rest, plant = AtRest.of(spec), plant_of(spec)
    ports = (*state_ports(spec), *innovation_ports(spec), *gate_ports(spec))
    if plant.S.nnz():
        meaning = "E[w[k] | y[k]]: noise of the state that v[k] tells of"
        ports = (*ports, carried("noise_mean", (plant.nx,), meaning, unit="x"))
    symbols = symbols_of(spec, plant, ports)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        outcomes=gate_outcomes(spec),
        notes=(*NOTES, *gate_notes(spec)),
        update=_update(plant, symbols, at_rest, Gate.of(spec)),
        predict=_predict(plant, symbols, at_rest),
    )


def _packed(covariance: Array) -> ca.SX:
    return pack(ca.SX(ca.DM(covariance)))


def _update(plant: Plant, symbols: dict[str, ca.SX], at_rest: AtRest, gate: Gate | None) -> Phase:
    builder, prior = PhaseBuilder(symbols), symbols["predicted_state"]
    plant = bound(builder, plant, "CDd")
    nothing = (ca.SX(1, 1), ca.SX(1, 1))  # all that is random in y is in S
    measurement = measurement_of(
        replace(plant, noise_free=is_singular(at_rest.innovation)),
        y=symbols["y"],
        C=ca.SX(plant.ny, 1),
        offset=plant.C @ prior + plant.D @ symbols["u"] + plant.d,
        R=constant(at_rest.innovation),
    )
    found = condition(builder, nothing, measurement, form="short", gate=gate)
    used = found.innovation
    if found.rejected:
        used = used * (1 - ca.vertcat(*found.rejected))
    state = builder.define("corrected", prior + constant(at_rest.gain) @ used)
    demand_finite(builder, state)
    with builder.titled("results of the update"):
        results = {
            "filtered_state": state,
            "filtered_covariance": _packed(at_rest.filtered),
            **innovation_results(found),
            **gate_results(found.rejected),
        }
        if plant.S.nnz():
            results["noise_mean"] = constant(at_rest.noise_gain) @ used
        builder.assign(results)
    return builder.phase()


def _predict(plant: Plant, symbols: dict[str, ca.SX], at_rest: AtRest) -> Phase:
    builder = PhaseBuilder(symbols)
    plant = bound(builder, plant, "ABc")
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    state, _, _ = propagate(builder, plant, certain(symbols["u"]), filtered)
    if plant.S.nnz():
        state = state + symbols["noise_mean"]
    covariance = _packed(at_rest.predicted)
    with builder.titled("prediction of the next sample"):
        results = {"predicted_state": state, "predicted_covariance": covariance}
        builder.assign(results, [finite(state, covariance)])
    return builder.phase()
