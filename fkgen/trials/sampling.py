"""The plant as it happens: drawn faults and noise in, measurements and the next state out.

The counterpart of a recursion: what a family estimates is generated here. Faults are drawn in two
ways. *Coins* fall anew in every sample: actuators that work, packets that arrive. One *chain* of
conditions is Markov: sensor conditions, modes of the plant. Both reach the plant as numbers, so
that a sample is straight-line code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Port, Role, Status
from fkgen.symbolic.linalg import column, is_zero, sparse
from fkgen.symbolic.plant import Plant, mode_plants, plant_of
from fkgen.symbolic.ports import PARAMETER
from fkgen.symbolic.recursion import Phase
from fkgen.trials.conditions import Conditions, conditions_of, demanded, probabilities_of

#: A pivot below this share of its diagonal entry is the rounding of a zero.
NEGLIGIBLE = 1e-14
#: Keeps the quotient of two zeros at zero.
_TINY = 1e-300


def lower_root(covariance: ca.SX) -> ca.SX:
    """Lower triangular L with L L' = covariance, for semidefinite matrices too.

    The column of a pivot that is zero, or rounding beside its diagonal entry, is zero. Expressions
    need no branch for that.
    """
    n = covariance.shape[0]
    left, root = ca.SX(covariance), ca.SX(n, n)
    for j in range(n):
        pivot = _pivot(left[j, j], covariance[j, j])
        if is_zero(pivot):
            continue
        root[j, j] = ca.sqrt(pivot)
        below = [i for i in range(j + 1, n) if not is_zero(left[i, j])]
        for i in below:
            root[i, j] = left[i, j] * root[j, j] / (pivot + _TINY)
        for i in below:
            for k in (k for k in below if k <= i):
                left[i, k] = left[i, k] - root[i, j] * root[k, j]
    return sparse(root)


def _pivot(left: ca.SX, whole: ca.SX) -> ca.SX:
    """What is left of a diagonal entry, or zero if that is rounding."""
    if left.is_constant() and whole.is_constant():
        return left if float(left) > NEGLIGIBLE * float(whole) else ca.SX(0)
    if ca.is_equal(left, whole):
        return left
    return ca.fmax(left - NEGLIGIBLE * whole, 0)


#: What a phase reads besides parameters; none of it is kept by the sampler.
INPUTS = ("x", "u", "w", "v", "coin", "indicator", "hypothesis")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """One plant with its faults, ready to be lowered."""

    spec: Spec
    conditions: Conditions
    ports: tuple[Port, ...]  # ``state``, ``measurement`` and ``threshold``: what phases write
    start: Phase  # x[0] = x0 + root(P0) w
    law: Phase  # the probabilities of the Bernoulli variables
    measure: Phase  # y[k] from x[k], u[k], v[k] and the faults
    move: Phase  # x[k+1] from the same and w[k]


def sampling_of(spec: Spec) -> Sampling:
    """Write the phases of a spec, which must not leave open how its faults come about."""
    jump = spec.faults.jump
    plants = (plant_of(spec),) if jump is None else mode_plants(spec, jump.modes)
    plant = plants[0]
    conditions = conditions_of(spec)
    symbols = _symbols(spec, plant, conditions)
    thresholds, law = _law(spec, plant, conditions, symbols)
    return Sampling(
        spec=spec,
        conditions=conditions,
        ports=_ports(spec, thresholds),
        start=_start(spec, symbols),
        law=law,
        measure=_measure(plants, conditions, symbols),
        move=_move(plants, conditions, symbols),
    )


def _ports(spec: Spec, thresholds: int) -> tuple[Port, ...]:
    sizes = {
        "state": (spec.model.nx, "x[k]"),
        "measurement": (spec.model.ny, "y[k]"),
        "threshold": (thresholds, "probabilities at which coins fall, summed up"),
    }
    return tuple(
        Port(name=name, shape=(size,), role=Role.STATE, meaning=meaning)
        for name, (size, meaning) in sizes.items()
        if size
    )


def _symbols(spec: Spec, plant: Plant, conditions: Conditions) -> dict[str, ca.SX]:
    n, p, q = plant.nx, plant.ny, plant.nu
    sizes = {
        "x": n,
        "u": q,
        "w": n,
        "v": p,
        "coin": conditions.coins,
        "indicator": len(conditions.indicators[0]) if conditions.indicators else 0,
        "hypothesis": len(conditions.prior),
        "state": n,
        "measurement": p,
        "threshold": sum(len(draw.patterns) - 1 for draw in conditions.draws),
    }
    symbols = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    named = {item.name for item in spec.stated_parameters}
    return symbols | {PARAMETER + k: s for k, s in plant.parameters.items() if k in named}


def _start(spec: Spec, symbols: Mapping[str, ca.SX]) -> Phase:
    script = Script(symbols)
    x0, root = ca.SX(spec.model.x0.values()), lower_root(ca.SX(spec.model.P0.values()))
    script.put({"state": x0 + root @ symbols["w"]})
    return script.phase()


def _law(
    spec: Spec, plant: Plant, conditions: Conditions, symbols: Mapping[str, ca.SX]
) -> tuple[int, Phase]:
    script = Script(symbols)
    thresholds: list[ca.SX] = []
    for patterns in probabilities_of(spec, plant, conditions, symbols["hypothesis"]):
        script.demand(Kind.NONNEGATIVE, demanded(patterns), Status.PARAMETER_OUT_OF_RANGE)
        total = ca.SX(0)
        for probability in patterns:
            total = total + probability
            thresholds.append(total)
    if thresholds:
        script.put({"threshold": column(thresholds)})
    return len(thresholds), script.phase()


def _measure(
    plants: tuple[Plant, ...], conditions: Conditions, symbols: Mapping[str, ca.SX]
) -> Phase:
    script, indicator = Script(symbols), symbols["indicator"]
    u = conditions.driven(symbols["u"], symbols["coin"])
    signal, deviation = conditions.sensors(plants[0].ny, indicator)
    for plant in plants:
        _demand_variances(script, plant.R)
    C = conditions.moving([plant.C for plant in plants], indicator)
    D = conditions.moving([plant.D for plant in plants], indicator)
    root = conditions.moving(_roots([plant.R for plant in plants]), indicator)
    y = signal * (C @ symbols["x"] + D @ u) + deviation * (root @ symbols["v"])
    script.put({"measurement": y})
    script.demand(Kind.FINITE, _entries(symbols["measurement"]), Status.RESULT_NOT_FINITE)
    return script.phase()


def _move(
    plants: tuple[Plant, ...],
    conditions: Conditions,
    symbols: Mapping[str, ca.SX],
) -> Phase:
    script, indicator = Script(symbols), symbols["indicator"]
    u = conditions.driven(symbols["u"], symbols["coin"])
    for plant in plants:
        _demand_variances(script, plant.Q)
    A = conditions.moving([plant.A for plant in plants], indicator)
    B = conditions.moving([plant.B for plant in plants], indicator)
    root = conditions.moving(_roots([plant.Q for plant in plants]), indicator)
    x = A @ symbols["x"] + B @ u + root @ symbols["w"]
    script.put({"state": x + conditions.moving([plant.c for plant in plants], indicator)})
    script.demand(Kind.FINITE, _entries(symbols["state"]), Status.RESULT_NOT_FINITE)
    return script.phase()


def _roots(covariances: list[ca.SX]) -> list[ca.SX]:
    """One root for each; what is the same matrix has the same root."""
    if all(covariance is covariances[0] for covariance in covariances):
        return [lower_root(covariances[0])]
    return [lower_root(covariance) for covariance in covariances]


def _demand_variances(script: Script, covariance: ca.SX) -> None:
    """Refuse parameters with which a variance is negative."""
    diagonal = sparse(ca.diag(covariance))
    script.demand(Kind.NONNEGATIVE, _entries(diagonal), Status.PARAMETER_OUT_OF_RANGE)


def _entries(column_of: ca.SX) -> list[ca.SX]:
    return [column_of[i] for i in range(column_of.numel())]
