"""Inputs that work now and then: u reaches the plant as gamma .* u with a random gamma in {0, 1}.

Strandt, Schneider & Yaz, eqs. (1), (3), and their extension to several actuators. The part of
gamma that is not its mean is carried as r extra components of the state while y is processed,
because the same gamma stands in x[k+1] and in y[k]: conditioning (x, gamma - xi) on y gives (11)
and (12) without subtracting large numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.faults import ActuatorFaults
from fkgen.problem import Spec
from fkgen.symbolic.lifting.expressions import lift, lift_expression
from fkgen.symbolic.linalg import is_zero, sparse
from fkgen.symbolic.plant import Plant


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuation:
    """What reaches the plant; r = 0 if nothing is random."""

    mean: ca.SX  # (q,), xi .* u
    through: ca.SX  # (q, r), input per unit of deviation of gamma from its mean
    covariance: ca.SX  # (r, r), of the deviations

    @property
    def size(self) -> int:
        """Number r of random components."""
        return int(self.through.shape[1])


def certain(u: ca.SX) -> Actuation:
    """Inputs that always work."""
    return Actuation(mean=u, through=ca.SX(u.numel(), 0), covariance=ca.SX(0, 0))


def rates_of(faults: ActuatorFaults, plant: Plant) -> list[ca.SX]:
    """Success rates of a spec as SX, one (common) or q."""
    return [lift_expression(rate, plant.parameters) for rate in faults.success_rate]


def intermittent(faults: ActuatorFaults, rates: list[ca.SX], u: ca.SX, plant: Plant) -> Actuation:
    """Inputs with the given success rates; components without variance are left out."""
    variances = [sparse(rate * (1 - rate)) for rate in rates]
    common = faults.dependence == "common"
    mean = (rates[0] if common else ca.vertcat(*rates)) * u
    through = u if common else ca.diag(u)
    covariance = variances[0] if common else ca.diag(ca.vertcat(*variances))
    if faults.covariance is not None:
        covariance = lift(faults.covariance, plant.parameters)
    kept = [i for i in range(through.shape[1]) if not is_zero(covariance[i, i])]
    if not kept:
        return certain(mean)
    return Actuation(mean=mean, through=through[:, kept], covariance=sparse(covariance[kept, kept]))


def actuation_of(spec: Spec, plant: Plant, u: ca.SX) -> Actuation:
    """What reaches the plant of a spec."""
    faults = spec.faults.actuator
    return certain(u) if faults is None else intermittent(faults, rates_of(faults, plant), u, plant)
