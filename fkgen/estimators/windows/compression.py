"""Host filter and full compression filter: Lee & Lee, Theorems 2 and 3, without any inverse.

The compression filter is carried as a second Kalman filter that starts where the host is and takes
the compressed rows as well: d = x* - x, its estimate as a deviation from the host's, and its
covariance P*. Then the compressed measurement of the paper is Z = d with Hbar = 1 and the noise
(P*^-1 - P^-1)^-1, the update (25) copies (x + d, P*) into the host, and F^-1 and P^-1 never appear.
While there is no compression filter, d = 0 and P* = P.

In factors P - P* is carried as well, as the covariance of d: with the gains K and K* of both
filters, and S* of the second, it becomes (1 - K C)(P - P*)(1 - K C)' + (K* - K) S* (K* - K)', and
A (P - P*) A' at the next sample. Only gains are subtracted, so float has the rank of double.

Each set of groups that the host may have to accept has a filter of its own: two compressed
measurements share process noise, so no combination of them gives what the rows of both would have.
"""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

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
    propagate_factors,
)
from fkgen.estimators.gaussian.rank import DIRECTION, QuadraticForm, quadratic_form, thresholds
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.gaussian.ud import (
    Factors,
    columns_of,
    packed_factors,
    seen_through,
    unpacked,
)
from fkgen.estimators.windows import window
from fkgen.faults import SoftFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.linalg import column, congruence, diagonal, pack, sparse, split_packed, unpack
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried, estimate_ports, factor_ports
from fkgen.symbolic.recursion import Phase, Recursion

Groups = tuple[int, ...]

#: A covariance, packed or in factors.
Held = ca.SX | Factors


def compression_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``compression_full`` and ``dfcf``."""
    count = len(_subsets(window.soft_faults(spec)))
    ports = *window.host_ports(spec), *_ports(spec, count), *window.window_ports(spec)
    n, tested = spec.model.ne, len(window.soft_faults(spec).groups)
    design = window.Design(spec, ports, _factor_ports(n, count), _removed_ports(n, tested))
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


def _factor_ports(n: int, count: int) -> tuple[Port, ...]:
    """Factors of all covariances, where they are carried so."""
    names = ("compression_", "predicted_compression_")
    shape, meaning = (count, len(triangle(n))), "factors of {}covariance, as those of P"
    beside = (carried(f"{name}factors", shape, meaning.format(name)) for name in names)
    return (*factor_ports(n), *beside)


def _removed_ports(n: int, count: int) -> tuple[Port, ...]:
    """Factors of P - P*, where covariances are carried so."""
    shape, meaning = (count, len(triangle(n))), "factors of what compressed rows remove of P at"
    return tuple(
        carried(f"{prefix}removed_factors", shape, f"{meaning} {when}")
        for when, prefix in (("k", ""), ("k+1", "predicted_"))
    )


def _subsets(soft: SoftFaults) -> list[Groups]:
    """The groups that each compression filter takes."""
    groups = range(len(soft.groups))
    return [each for size in range(1, len(groups) + 1) for each in combinations(groups, size)]


def _rows(soft: SoftFaults, subset: Groups) -> tuple[int, ...]:
    """The rows of y of the host and of these groups."""
    return tuple(sorted((*soft.host, *(row for group in subset for row in soft.groups[group]))))


def _filters(design: window.Design, prefix: str = "") -> list[tuple[Groups, ca.SX, Held]]:
    """(groups, d, P*) of every compression filter; P* is packed, or in factors."""
    n, symbols = design.plant.nx, design.symbols
    deviation = ca.vertsplit(symbols[f"{prefix}compression_deviation"], n)
    what = "factors" if design.order else "covariance"
    held = split_packed(symbols[f"{prefix}compression_{what}"], n)
    return list(zip(_subsets(design.soft), deviation, map(design.held, held), strict=True))


def _removed(design: window.Design, prefix: str = "") -> list[Factors]:
    """P - P* of every filter that is tested, where covariances are carried in factors."""
    if not design.order:
        return []
    packed = split_packed(design.symbols[f"{prefix}removed_factors"], design.plant.nx)
    return [Factors.of(each, design.order, design.plant.scalar) for each in packed]


def _removed_with(
    design: window.Design,
    rows: tuple[int, ...],
    before: tuple[Factors, Held],
    part: Measurement,
    gains: tuple[ca.SX | None, ca.SX],
) -> Factors:
    """P - P* after an update of both filters with their gains, that of the host for its rows."""
    removed, held = before
    own, whole = ca.SX(design.plant.nx, len(rows)), gains[1]
    if gains[0] is not None:
        own[:, [rows.index(row) for row in design.soft.host]] = gains[0]
    S = unpack(seen_through(part.C, unpacked(held, design.plant.nx)) + pack(part.R), len(rows))
    columns, weights = columns_of(S, design.plant.scalar)
    through = sparse(ca.SX.eye(design.plant.nx) - own @ part.C)
    return removed.moved(through, sparse((whole - own) @ columns), weights)


def _update(design: window.Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    state, own = symbols["predicted_state"], design.host("predicted")
    priors, before = _filters(design, "predicted_"), _removed(design, "predicted_")
    for held in (own, *(P for _, _, P in priors)):
        demand_positive(builder, held)
    plant, whole, innovation = window.observed(builder, design)
    host = _host(design, builder, whole, innovation)
    correction = ca.SX.zeros(n) if host is None else host.mean
    filtered = builder.define("host_state", state + correction)
    deviations, conditioned, removed = [], [], []
    for at, (subset, d, P) in enumerate(priors):
        tag = f"_compression{at}" if at else "_compression"
        part = _part(whole, innovation, _rows(design.soft, subset), "compression filter")
        with builder.titled(f"filter with group {', '.join(map(str, subset))}"):
            prior, gained = (d, unpacked(P, n)), at < len(before)  # those of one group come first
            found = condition(builder, prior, part, tag=tag, form=design.form, with_gain=gained)
            deviations.append(builder.define(f"deviation{tag}", found.mean - correction))
            if found.gain is not None:
                gains = None if host is None else host.gain, found.gain
                both, taken = (before[at], P), _rows(design.soft, subset)
                less = _removed_with(design, taken, both, part, gains)
                removed.append(less.named(builder, f"removed{tag}"))
        conditioned.append(found)
    demand_finite(builder, ca.vertcat(filtered, *deviations))
    counted = window.collect(builder, symbols, design.soft)
    with builder.titled("results of the update"):
        builder.assign(
            {
                "filtered_state": filtered,
                "filtered_covariance": (
                    symbols["predicted_covariance"] if host is None else host.covariance
                ),
                "compression_deviation": ca.vertcat(*deviations),
                "compression_covariance": ca.vertcat(*(each.covariance for each in conditioned)),
                **_factors(
                    ("filtered_", own if host is None else host.factors),
                    ("compression_", *(each.factors for each in conditioned)),
                    ("removed_", *removed),
                ),
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
    prior = (ca.SX.zeros(n), unpacked(design.host("predicted"), n))
    part, known = _part(whole, innovation, rows, "host"), [innovation[i] for i in rows]
    return condition(
        builder,
        prior,
        part,
        tag="_host",
        form=design.form,
        innovation=known,
        with_gain=bool(design.order),
    )


def _factors(*of: tuple[Any, ...]) -> dict[str, ca.SX]:
    """Ports of factors by prefix, if these are any."""
    return {
        f"{prefix}factors": packed_factors(held)
        for prefix, *held in of
        if held and isinstance(held[0], Factors)
    }


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

    def restarted(host: dict[str, ca.SX]) -> dict[str, ca.SX]:
        own = {f"compression_{of}": ca.repmat(held, len(filters)) for of, held in host.items()}
        if design.order:
            own["removed_factors"] = ca.SX.zeros(design.symbols["removed_factors"].numel())
        return {"compression_deviation": ca.SX.zeros(n * len(filters)), **own}

    return window.closed(builder, design, verdicts, takeovers, restarted=restarted)


def _test(design: window.Design, builder: PhaseBuilder, group: int) -> QuadraticForm:
    """The statistic d' (P - P*)^+ d of a group, if it holds a measurement."""
    n, host = design.plant.nx, design.symbols["filtered_covariance"]
    _, d, P = _filters(design)[group]
    tolerance, weights = DIRECTION[design.spec.code.scalar], None
    if isinstance(P, Factors):
        removed, tolerance = _removed(design)[group], DIRECTION["double"]
        given, weights = ca.vec(ca.densify(removed.in_rows()).T), removed.scale
    else:
        given = host - P
    names = f"difference_{group}", f"shift_{group}", f"scale_{group}"
    for name, size in zip(names, (given.numel(), n, n), strict=True):
        builder.local(name, size, initial=0.0)
    with builder.titled(f"test of group {group}"):
        with builder.if_positive(design.symbols["collecting"][group] - 0.5):
            variances = column(diagonal(host))
            builder.assign(dict(zip(names, (given, d, variances), strict=True)))
        table = thresholds(design.soft.false_alarm, n)
        return quadratic_form(builder, names, n, tolerance, table, weights=weights)


def _predict(design: window.Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    builder = PhaseBuilder(symbols)
    plant = bound(builder, design.plant, "ABQc")
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    filters, factors = _filters(design), {}
    deviations, none = [plant.A @ d for _, d, _ in filters], (ca.SX(n, 0), ca.SX(0, 1))
    if design.order:
        state, *moved = _moved_factors(design, builder, plant, filtered)
        covariance, *covariances = (each.covariance() for each in moved)
        factors = _factors(("predicted_", moved[0]), ("predicted_compression_", *moved[1:]))
        removed = (each.moved(plant.A, *none) for each in _removed(design))
        factors |= _factors(("predicted_removed_", *removed))
    else:
        state, covariance, _ = propagate(builder, plant, certain(symbols["u"]), filtered)
        held = [P for _, _, P in filters if not isinstance(P, Factors)]
        covariances = [congruence(plant.A, unpack(P, n)) + pack(plant.Q) for P in held]
    counted = window.count_down(builder, symbols, design.soft)
    guards = [finite(state, covariance), *map(finite, deviations, covariances)]
    with builder.titled("prediction of the next sample"):
        builder.assign(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                "predicted_compression_deviation": ca.vertcat(*deviations),
                "predicted_compression_covariance": ca.vertcat(*covariances),
                **factors,
                **counted,
            },
            guards,
        )
    return builder.phase()


def _moved_factors(
    design: window.Design, builder: PhaseBuilder, plant: Plant, filtered: Posterior
) -> tuple[Any, ...]:
    """The predicted state, and factors of the host and of every compression filter."""
    held = [design.host("filtered"), *(P for _, _, P in _filters(design))]
    inputs, state, moved = certain(design.symbols["u"]), None, []
    for at, each in enumerate(each for each in held if isinstance(each, Factors)):
        found = propagate_factors(plant, inputs, filtered, each)
        state = found[0] if state is None else state
        with builder.titled("factors of the next covariance"):
            moved.append(found[1].named(builder, f"next_factors_{at}"))
    return state, *moved
