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

from dataclasses import dataclass, replace
from itertools import combinations

import casadi as ca

from fkgen.errors import InternalError
from fkgen.spec import SoftFaults, Spec
from fkgen.symbolic.actuation import certain
from fkgen.symbolic.conditioning import Conditioned, condition, innovations
from fkgen.symbolic.decorrelation import Measurement
from fkgen.symbolic.estimate import (
    bound,
    demand_finite,
    demand_positive,
    estimated,
    finite,
    measurement_of,
    propagate,
    update_form,
)
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linalg import column, congruence, pack, unpack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.rank import DIRECTION, QuadraticForm, quadratic_form, thresholds
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.sequential import Form
from fkgen.symbolic.window import (
    COUNTDOWN,
    collect,
    count_down,
    of_the_host,
    reacquired,
    window_ports,
    window_start,
)

Groups = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Design:
    """The pair of filters: sizes, symbols, and which groups each compression filter takes."""

    spec: Spec
    soft: SoftFaults
    plant: Plant
    symbols: dict[str, ca.SX]
    form: Form
    subsets: tuple[Groups, ...]

    def rows(self, subset: Groups) -> tuple[int, ...]:
        """The rows of y of the host and of these groups."""
        return tuple(sorted((*self.soft.host, *(r for g in subset for r in self.soft.groups[g]))))

    def filters(self, prefix: str = "") -> list[tuple[ca.SX, ca.SX]]:
        """(d, packed P*) of every compression filter."""
        n = self.plant.nx
        deviation = ca.vertsplit(self.symbols[f"{prefix}compression_deviation"], n)
        covariance = self.symbols[f"{prefix}compression_covariance"]
        return list(zip(deviation, ca.vertsplit(covariance, n * (n + 1) // 2), strict=True))


def compression_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion of ``compression_full`` and ``dfcf``."""
    plant, soft = plant_of(spec), spec.faults.soft
    if soft is None:
        raise InternalError("a compression filter without soft faults")
    count = len(soft.groups)
    subsets = tuple(s for size in range(1, count + 1) for s in combinations(range(count), size))
    ports = (
        *state_ports(spec),
        *of_the_host(innovation_ports(spec)),
        *_ports(plant.nx, len(subsets)),
        *window_ports(spec, soft),
    )
    design = _Design(
        spec=spec,
        soft=soft,
        plant=plant,
        symbols=symbols_of(spec, plant, ports),
        form=update_form(spec, plant, augmented=False),
        subsets=subsets,
    )
    x0, packed = prior_of(spec)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={
            **{f"{of}_state": x0 for of in ("predicted", "filtered")},
            **{f"{of}_covariance": packed for of in ("predicted", "filtered")},
            "predicted_compression_covariance": packed * len(subsets),
            "compression_covariance": packed * len(subsets),
            **window_start(soft),
        },
        update=_update(design),
        closing=_closing(design),
        predict=_predict(design),
        notes=(f"covariance update: {design.form} form",),
    )


def _ports(n: int, count: int) -> tuple[Port, ...]:
    stacked = (count,) if count > 1 else ()
    result = []
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        result += [
            Port(
                name=f"{prefix}compression_deviation",
                shape=(*stacked, n),
                role=Role.STATE,
                meaning=f"estimate of x[{k}] with the compressed rows minus that of the host",
            ),
            Port(
                name=f"{prefix}compression_covariance",
                shape=(*stacked, n, n),
                role=Role.STATE,
                symmetric=True,
                meaning="error covariance of the estimate with the compressed rows",
            ),
        ]
    return tuple(result)


def _update(design: _Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    script = Script(symbols)
    state, packed = symbols["predicted_state"], symbols["predicted_covariance"]
    priors = design.filters("predicted_")
    for covariance in (packed, *(P for _, P in priors)):
        demand_positive(script, covariance, n)
    plant = bound(script, design.plant, "CDR")
    whole = measurement_of(
        plant,
        scalar=design.spec.code.scalar,
        y=symbols["y"],
        C=plant.C,
        offset=plant.D @ symbols["u"],
        R=plant.R,
    )
    innovation = innovations(script, state, whole, "")
    host = _host(design, script, whole, innovation)
    correction = ca.SX.zeros(n) if host is None else host.mean
    filtered = script.let("host_state", state + correction)
    deviations, covariances = [], []
    for at, (subset, (d, P)) in enumerate(zip(design.subsets, priors, strict=True)):
        tag = f"_compression{at}" if at else "_compression"
        part = _part(whole, innovation, design.rows(subset), "compression filter")
        found = condition(script, (d, unpack(P, n)), part, tag=tag, form=design.form)
        deviations.append(script.let(f"deviation{tag}", found.mean - correction))
        covariances.append(found.covariance)
    demand_finite(script, ca.vertcat(filtered, *deviations))
    counted = collect(script, symbols, design.soft)
    with script.titled("results of the update"):
        script.put(
            {
                "filtered_state": filtered,
                "filtered_covariance": packed if host is None else host.covariance,
                "compression_deviation": ca.vertcat(*deviations),
                "compression_covariance": ca.vertcat(*covariances),
                "innovation": ca.vertcat(*innovation),
                "innovation_covariance": congruence(plant.C, unpack(packed, n)) + pack(plant.R),
                "nis": ca.SX(0) if host is None else host.nis,
                "log_likelihood": ca.SX(0) if host is None else host.log_likelihood,
                **counted,
            }
        )
    return script.phase()


def _host(
    design: _Design, script: Script, whole: Measurement, innovation: list[ca.SX]
) -> Conditioned | None:
    """The host conditioned on its rows (29), as a correction of its prediction."""
    if not design.soft.host:
        return None
    n = design.plant.nx
    prior = (ca.SX.zeros(n), unpack(design.symbols["predicted_covariance"], n))
    part = _part(whole, innovation, design.soft.host, "host")
    known = [innovation[i] for i in design.soft.host]
    return condition(script, prior, part, tag="_host", form=design.form, innovation=known)


def _part(
    whole: Measurement, innovation: list[ca.SX], rows: tuple[int, ...], filtering: str
) -> Measurement:
    """Some rows of the innovation of the host, as a measurement of a deviation from the host."""
    at = list(rows)
    return replace(
        whole,
        C=whole.C[at, :],
        offset=ca.SX(len(at), 1),
        R=whole.R[at, at],
        y=ca.vertcat(*(innovation[i] for i in at)),
        rows=tuple(f"{whole.rows[i]}: {filtering}" for i in at),
        at=rows,
    )


def _predict(design: _Design) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    script = Script(symbols)
    plant = bound(script, design.plant, "ABQ")
    filtered = estimated(symbols["filtered_state"], symbols["filtered_covariance"])
    state, covariance, _ = propagate(plant, certain(symbols["u"]), filtered)
    deviations, covariances = [], []
    for d, P in design.filters():
        deviations.append(plant.A @ d)
        covariances.append(congruence(plant.A, unpack(P, n)) + pack(plant.Q))
    counted = count_down(script, symbols, design.soft)
    guards = [finite(state, covariance)]
    guards += [finite(d, P) for d, P in zip(deviations, covariances, strict=True)]
    with script.titled("prediction of the next sample"):
        script.put(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                "predicted_compression_deviation": ca.vertcat(*deviations),
                "predicted_compression_covariance": ca.vertcat(*covariances),
                **counted,
            },
            guards,
        )
    return script.phase()


def _closing(design: _Design) -> Phase:
    """The test (50), (51) of every group, and the update of the host by what it accepts (25)."""
    symbols, n, soft = design.symbols, design.plant.nx, design.soft
    script = Script(symbols)
    tests = [_test(design, script, g) for g in range(len(soft.groups))]
    verdicts = [_verdict(design, script, g, test) for g, test in enumerate(tests)]
    accepted, rejected = ([v[i] for v in verdicts] for i in (0, 1))
    host = {"state": symbols["filtered_state"], "covariance": symbols["filtered_covariance"]}
    state = script.local("closed_state", n)
    covariance = script.local("closed_covariance", n * (n + 1) // 2)
    script.put({"closed_state": host["state"], "closed_covariance": host["covariance"]})
    for subset, (d, P) in zip(design.subsets, design.filters(), strict=True):
        groups = ", ".join(str(g) for g in subset)
        with script.titled(f"the host takes over: group {groups}"):
            agreed = ca.SX(0.5 - len(subset))
            for g, flag in enumerate(accepted):
                agreed += flag if g in subset else -flag
            with script.where(agreed):
                script.put({"closed_state": host["state"] + d, "closed_covariance": P})
    limit, last = design.spec.filter.reacquire, design.filters()[-1][0]
    results = reacquired(script, limit, (accepted, rejected), (last, "closed_covariance"))
    with script.titled("results of the window"):
        count = len(design.subsets)
        script.put(
            {
                "filtered_state": state,
                "filtered_covariance": covariance,
                "compression_deviation": ca.SX.zeros(n * count),
                "compression_covariance": ca.vertcat(*[covariance] * count),
                "collecting": ca.SX.zeros(len(soft.groups)),
                "test_statistic": ca.vertcat(*(test.value for test in tests)),
                "test_dof": ca.vertcat(*(test.rank for test in tests)),
                "fault_declared": ca.vertcat(*rejected),
                **results,
            },
            [finite(state, covariance)],
        )
    return script.phase(unless=COUNTDOWN)


def _test(design: _Design, script: Script, group: int) -> QuadraticForm:
    """The statistic d' (P - P*)^+ d of a group, if it holds a measurement."""
    n, scalar = design.plant.nx, design.spec.code.scalar
    host = design.symbols["filtered_covariance"]
    d, P = design.filters()[group]
    names = f"difference_{group}", f"shift_{group}", f"scale_{group}"
    packed = n * (n + 1) // 2
    for name, size in zip(names, (packed, n, n), strict=True):
        script.local(name, size, initial=0.0)
    with script.titled(f"test of group {group}"):
        with script.where(design.symbols["collecting"][group] - 0.5):
            variances = column([host[i * (i + 3) // 2] for i in range(n)])
            script.put(dict(zip(names, (host - P, d, variances), strict=True)))
        table = thresholds(design.soft.false_alarm, n)
        return quadratic_form(script, names, n, DIRECTION[scalar], table)


def _verdict(
    design: _Design, script: Script, group: int, test: QuadraticForm
) -> tuple[ca.SX, ca.SX]:
    """(accepted, rejected) as 0 or 1: neither of them if there was no measurement."""
    names = f"accepted_{group}", f"rejected_{group}"
    accepted, rejected = (script.local(name, 1) for name in names)
    collecting = design.symbols["collecting"][group]
    with script.titled(f"verdict on group {group}"):
        script.put({names[0]: collecting, names[1]: ca.SX(0)})
        if design.spec.filter.test:
            with script.where(test.value - test.looked_up):
                script.put({names[0]: ca.SX(0), names[1]: ca.SX(1)})
    return accepted, rejected
