"""Host filter and full compression filter: Lee & Lee, Theorems 2 and 3, without any inverse.

The compression filter is carried as a second Kalman filter that starts where the host is and takes
the compressed rows as well: d = x* - x, its estimate as a deviation from the host's, and its
covariance P*. Then the compressed measurement of the paper is Z = d with Hbar = 1 and the noise
(P*^-1 - P^-1)^-1, the update (25) copies (x + d, P*) into the host, and F^-1 and P^-1 never appear.
While there is no compression filter, d = 0 and P* = P.

Each set of groups that the host may have to accept has a filter of its own: two compressed
measurements share process noise, so no combination of them gives what the rows of both would have.
"""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import partial
from itertools import combinations

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    demand_finite,
    demand_positive,
    finite,
    propagate,
)
from fkgen.estimators.gaussian.rank import DIRECTION, QuadraticForm, quadratic_form, thresholds
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.windows import window
from fkgen.faults import SoftFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import column, congruence, diagonal, pack, split_packed, unpack
from fkgen.symbolic.ports import estimate_ports
from fkgen.symbolic.recursion import Phase, Recursion

Groups = tuple[int, ...]


def compression_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``compression_full`` and ``dfcf``."""
    count = len(_subsets(window.soft_faults(spec)))
    ports = *window.host_ports(spec), *_ports(spec, count), *window.window_ports(spec)
    design = window.Design(spec, ports)
    phases = _update(design), _closing(design), _predict(design)
    return design.recursion(source, phases)


def _ports(spec: Spec, count: int) -> tuple[Port, ...]:
    n = spec.model.nx
    shape = (count, n) if count > 1 else (n,)
    covariance = "error covariance of the estimate with the compressed rows"
    result: list[Port] = []
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        deviation = f"estimate of x[{k}] with the compressed rows minus that of the host"
        result += estimate_ports(
            f"{prefix}compression_",
            shape,
            (deviation, covariance),
            state="deviation",
            priors=("", "P"),
        )
    return tuple(result)


def _subsets(soft: SoftFaults) -> list[Groups]:
    """The groups that each compression filter takes."""
    groups = range(len(soft.groups))
    return [each for size in range(1, len(groups) + 1) for each in combinations(groups, size)]


def _rows(soft: SoftFaults, subset: Groups) -> tuple[int, ...]:
    """The rows of y of the host and of these groups."""
    return tuple(sorted((*soft.host, *(row for group in subset for row in soft.groups[group]))))


def _filters(design: window.Design, prefix: str = "") -> list[tuple[Groups, ca.SX, ca.SX]]:
    """(groups, d, packed P*) of every compression filter."""
    n, symbols = design.plant.nx, design.symbols
    deviation = ca.vertsplit(symbols[f"{prefix}compression_deviation"], n)
    covariance = split_packed(symbols[f"{prefix}compression_covariance"], n)
    return list(zip(_subsets(design.soft), deviation, covariance, strict=True))


def _update(design: window.Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    state, packed = symbols["predicted_state"], symbols["predicted_covariance"]
    priors = _filters(design, "predicted_")
    for covariance in (packed, *(P for _, _, P in priors)):
        demand_positive(builder, covariance)
    plant, whole, innovation = window.observed(builder, design)
    host = _host(design, builder, whole, innovation)
    correction = ca.SX.zeros(n) if host is None else host.mean
    filtered = builder.define("host_state", state + correction)
    deviations, covariances = [], []
    for at, (subset, d, P) in enumerate(priors):
        tag = f"_compression{at}" if at else "_compression"
        part = _part(whole, innovation, _rows(design.soft, subset), "compression filter")
        with builder.titled(f"filter with group {', '.join(map(str, subset))}"):
            found = condition(builder, (d, unpack(P, n)), part, tag=tag, form=design.form)
            deviations.append(builder.define(f"deviation{tag}", found.mean - correction))
        covariances.append(found.covariance)
    demand_finite(builder, ca.vertcat(filtered, *deviations))
    counted = window.collect(builder, symbols, design.soft)
    with builder.titled("results of the update"):
        builder.assign(
            {
                "filtered_state": filtered,
                "filtered_covariance": packed if host is None else host.covariance,
                "compression_deviation": ca.vertcat(*deviations),
                "compression_covariance": ca.vertcat(*covariances),
                **window.innovation_of_host(design, plant, innovation, host),
                **counted,
            }
        )
    return builder.phase()


def _host(
    design: window.Design, builder: PhaseBuilder, whole: Measurement, innovation: list[ca.SX]
) -> Conditioned | None:
    """The host conditioned on its rows (29), as a correction of its prediction."""
    rows, n = design.soft.host, design.plant.nx
    if not rows:
        return None
    prior = (ca.SX.zeros(n), unpack(design.symbols["predicted_covariance"], n))
    part, known = _part(whole, innovation, rows, "host"), [innovation[i] for i in rows]
    return condition(builder, prior, part, tag="_host", form=design.form, innovation=known)


def _part(
    whole: Measurement, innovation: list[ca.SX], rows: tuple[int, ...], filtering: str
) -> Measurement:
    """Some rows of the innovation of the host, as a measurement of a deviation from the host."""
    part = whole.only(rows)
    return replace(
        part,
        offset=ca.SX(len(rows), 1),
        y=column([innovation[i] for i in rows]),
        rows=tuple(f"{row}: {filtering}" for row in part.rows),
    )


def _closing(design: window.Design) -> Phase:
    """The test (50), (51) of every group, and the update of the host by what it accepts (25)."""
    n, builder, filters = design.plant.nx, PhaseBuilder(design.symbols), _filters(design)
    tests = [_test(design, builder, group) for group in range(len(design.soft.groups))]
    verdicts = []
    for group, test in enumerate(tests):
        excess = partial(operator.sub, test.value, test.looked_up)
        with builder.titled(f"verdict on group {group}"):
            flags = window.verdict_on(builder, design, group, f"_{group}", excess)
        verdicts.append((*flags, test.value, test.rank))
    takeovers = []
    for subset, d, P in filters:
        agreed = ca.SX(0.5 - len(subset))
        for group, (accepted, *_) in enumerate(verdicts):
            agreed += accepted if group in subset else -accepted
        title = f"the host takes over: group {', '.join(map(str, subset))}"
        takeovers.append(window.Takeover(title, agreed, d, P))

    def restarted(covariance: ca.SX) -> dict[str, ca.SX]:
        return {
            "compression_deviation": ca.SX.zeros(n * len(filters)),
            "compression_covariance": ca.vertcat(*[covariance] * len(filters)),
        }

    return window.closed(builder, design, verdicts, takeovers, restarted=restarted)


def _test(design: window.Design, builder: PhaseBuilder, group: int) -> QuadraticForm:
    """The statistic d' (P - P*)^+ d of a group, if it holds a measurement."""
    n, host = design.plant.nx, design.symbols["filtered_covariance"]
    _, d, P = _filters(design)[group]
    names = f"difference_{group}", f"shift_{group}", f"scale_{group}"
    for name, size in zip(names, (host.numel(), n, n), strict=True):
        builder.local(name, size, initial=0.0)
    with builder.titled(f"test of group {group}"):
        with builder.if_positive(design.symbols["collecting"][group] - 0.5):
            variances = column(diagonal(host))
            builder.assign(dict(zip(names, (host - P, d, variances), strict=True)))
        table = thresholds(design.soft.false_alarm, n)
        return quadratic_form(builder, names, n, DIRECTION[design.spec.code.scalar], table)


def _predict(design: window.Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    plant = bound(builder, design.plant, "ABQc")
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    state, covariance, _ = propagate(builder, plant, certain(symbols["u"]), filtered)
    filters = _filters(design)
    deviations = [plant.A @ d for _, d, _ in filters]
    covariances = [congruence(plant.A, unpack(P, n)) + pack(plant.Q) for _, _, P in filters]
    counted = window.count_down(builder, symbols, design.soft)
    guards = [finite(state, covariance), *map(finite, deviations, covariances)]
    with builder.titled("prediction of the next sample"):
        builder.assign(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                "predicted_compression_deviation": ca.vertcat(*deviations),
                "predicted_compression_covariance": ca.vertcat(*covariances),
                **counted,
            },
            guards,
        )
    return builder.phase()
