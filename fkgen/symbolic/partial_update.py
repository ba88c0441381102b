"""The update of the partial compression filter: host, maintenance, compression; Theorem 4."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.symbolic.conditioning import condition, innovations
from fkgen.symbolic.decorrelation import Measurement
from fkgen.symbolic.estimate import bound, demand_finite, demand_positive, measurement_of
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, congruence, pack, sparse, unpack
from fkgen.symbolic.linear_filter import from_rows
from fkgen.symbolic.partial_state import (
    Compressed,
    PartialFilter,
    PartialState,
    partial_state,
    parts,
)
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.recursion import Phase
from fkgen.symbolic.script import Script
from fkgen.symbolic.window import collect


@dataclass(frozen=True, slots=True)
class _Host:
    """The host after its rows of y, with Z as maintained, and how likely those rows were."""

    state: ca.SX
    covariance: ca.SX
    carried: Compressed
    nis: ca.SX
    log_likelihood: ca.SX


def update(given: PartialFilter) -> Phase:
    """Write the update of sample k: (29), (44) or its replacement, (45), (46)."""
    script, symbols, scalar = Script(given.symbols), given.symbols, given.spec.code.scalar
    state, covariance = symbols["predicted_state"], symbols["predicted_covariance"]
    demand_positive(script, covariance, given.plant.nx)
    plant = bound(script, given.plant, "CDR")
    offset = plant.D @ symbols["u"]
    y = measurement_of(plant, scalar=scalar, y=symbols["y"], C=plant.C, offset=offset, R=plant.R)
    innovation = innovations(script, state, y, "")
    host = _Host(state, covariance, _carried(script, given), ca.SX(0), ca.SX(0))
    if given.faults.host:
        host = _by_host(script, given, y, (innovation, host))
    after = replace(y, offset=offset + plant.C @ host.state).only(given.rows)
    compressed = _compress(script, given, plant, (after, host))
    demand_finite(script, ca.vertcat(host.state, compressed.measurement))
    window = collect(script, symbols, given.faults)
    with script.titled("results of the update"):
        script.put(
            {
                "filtered_state": host.state,
                "filtered_covariance": host.covariance,
                "innovation": column(innovation),
                "innovation_covariance": congruence(plant.C, unpack(covariance, plant.nx))
                + pack(plant.R),
                "nis": host.nis,
                "log_likelihood": host.log_likelihood,
                **compressed.ports(),
                **window,
            }
        )
    return script.phase()


def _carried(script: Script, given: PartialFilter) -> Compressed:
    """Z before this sample; zeros if there is none."""
    carried, assign = _locals(script, "carried_", given.compressed("predicted_"))
    with (
        script.titled("the compressed measurement, if there is one"),
        script.where(given.active),
    ):
        script.put(assign)
    return carried


def _by_host(
    script: Script, given: PartialFilter, y: Measurement, prior: tuple[list[ca.SX], _Host]
) -> _Host:
    """(29) for the host and (44), or its optimal replacement, for Z.

    Conditioning (e, V) on the rows of the host moves Z = T1 e + V by what it learns of both. The
    paper keeps V as it is, and with it R.
    """
    innovation, before = prior
    n, m, rows = given.plant.nx, len(given.rows), given.faults.host
    carried = before.carried
    found = condition(
        script,
        (ca.vertcat(before.state, ca.SX.zeros(m)), carried.joint(before.covariance)),
        replace(y, C=ca.horzcat(y.C, ca.SX(len(y.rows), m))).only(rows),
        form=given.form,
        innovation=[innovation[i] for i in rows],
    )
    state = found.mean[:n]
    covariance, cross, noise = parts(found.covariance, n, m)
    learnt = given.partial.T1 @ (state - before.state)
    if given.spec.filter.maintenance == "optimal":
        learnt = learnt + found.mean[n:]
    else:
        noise = carried.noise
    with script.titled("maintenance of the compressed measurement"):
        maintained = script.local("maintained", m, 0.0)
        with script.where(given.active):
            script.put({"maintained": carried.measurement - learnt})
    after = Compressed(maintained, noise, cross)
    return _Host(state, covariance, after, found.nis, found.log_likelihood)


def _compress(
    script: Script, given: PartialFilter, plant: Plant, known: tuple[Measurement, _Host]
) -> Compressed:
    """(46), row by row: V is corrected as if nothing were known of it but R."""
    measurement, host = known
    carried, partial = host.carried, partial_state(given.spec, plant, given.rows)
    with script.titled("whether a compressed measurement begins"):
        some, every = _beginnings(script, given)
    if partial.size > 1:
        carried, assign = _locals(script, "begun_", carried)
        script.put(assign)
        with script.where(some):
            script.put(_silent(partial, host.covariance).ports("begun_"))
    found = condition(
        script,
        (carried.measurement, unpack(carried.noise, partial.size)),
        replace(measurement, C=partial.phi, rank_tolerance=None),
        tag="_compressed",
        form="joseph",
        with_gain=True,
    )
    if found.gain is None:
        raise InternalError("a condition with gain, without one")
    cross = carried.cross - found.gain @ (partial.phi @ carried.cross)
    folded = Compressed(found.mean, found.covariance, cross)
    compressed, assign = _locals(script, "new_", folded)
    with script.titled("a compressed measurement begins"):
        script.put(assign)
        with script.where(every):
            script.put(_first(script, partial, measurement).ports("new_"))
    return compressed


def _beginnings(script: Script, given: PartialFilter) -> tuple[ca.SX, ca.SX]:
    """1 where there was no Z and now some rows of the group are there; the same for all of them."""
    fresh = script.let("fresh", 1 - given.active)
    some, every = script.local("begins", 1, 0.0), fresh
    for at, row in enumerate(given.rows):
        flag = script.local(f"begins_{at}", 1, 0.0)
        with script.when(row):
            script.put({"begins": fresh, f"begins_{at}": every})
        every = flag
    return some, every


def _silent(partial: PartialState, covariance: ca.SX) -> Compressed:
    """Z = 0, with V = -T1 e: rows that begin after others of their group replace it by and by."""
    m, P = partial.size, unpack(covariance, partial.T1.shape[1])
    return Compressed(ca.SX.zeros(m), congruence(partial.T1, P), -partial.T1 @ P)


def _first(script: Script, partial: PartialState, measurement: Measurement) -> Compressed:
    """(42): all rows of a group, scaled by phi; refused where that is singular."""
    determinant = ca.det(partial.phi)
    script.demand(Kind.POSITIVE, [determinant * determinant], Status.RESULT_NOT_FINITE)
    back = sparse(ca.inv(partial.phi))
    return Compressed(
        back @ (measurement.y - measurement.offset),
        congruence(back, measurement.R),
        ca.SX.zeros(*partial.T1.shape),
    )


def _locals(script: Script, prefix: str, values: Compressed) -> tuple[Compressed, dict[str, ca.SX]]:
    """Variables of this shape, zero to begin with, and what to assign them."""
    m = values.cross.shape[0]
    assign = values.ports(prefix)
    measurement, noise, cross = (
        script.local(name, value.numel(), 0.0) for name, value in assign.items()
    )
    return Compressed(measurement, noise, from_rows(cross, m)), assign
