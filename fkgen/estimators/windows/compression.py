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

from dataclasses import replace
from itertools import combinations

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    propagate,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Conditioned, condition, innovations
from fkgen.estimators.windows.window import (
    Pair,
    collect,
    count_down,
    of_the_host,
    window_end,
    window_outcomes,
    window_ports,
    window_start,
)
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import congruence, pack, unpack
from fkgen.symbolic.plant import plant_of
from fkgen.symbolic.ports import (
    estimate_ports,
    innovation_ports,
    prior_of,
    start_of,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion


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
    design = Pair(
        spec=spec,
        soft=soft,
        plant=plant,
        symbols=symbols_of(spec, plant, ports),
        form=update_form(spec, plant, augmented=False),
        subsets=subsets,
    )
    packed = prior_of(spec)[1]
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={
            **start_of(spec),
            "predicted_compression_covariance": packed * len(subsets),
            "compression_covariance": packed * len(subsets),
            **window_start(soft),
        },
        update=_update(design),
        closing=window_end(design),
        predict=_predict(design),
        form=design.form,
        outcomes=window_outcomes(spec),
    )


def _ports(n: int, count: int) -> tuple[Port, ...]:
    shape = (count, n) if count > 1 else (n,)
    covariance = "error covariance of the estimate with the compressed rows"
    result: list[Port] = []
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        deviation = f"estimate of x[{k}] with the compressed rows minus that of the host"
        meanings = deviation, covariance
        result += estimate_ports(f"{prefix}compression_", shape, meanings, state="deviation")
    return tuple(result)


def _update(design: Pair) -> Phase:
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
        with script.titled(f"filter with group {', '.join(map(str, subset))}"):
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
    design: Pair, script: Script, whole: Measurement, innovation: list[ca.SX]
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


def _predict(design: Pair) -> Phase:
    symbols, n = design.symbols, design.plant.nx
    script = Script(symbols)
    plant = bound(script, design.plant, "ABQ")
    filtered = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
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
