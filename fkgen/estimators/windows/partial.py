"""The correlated partial error-state compression filter: Lee & Lee, Theorem 4.

Within a sample, in the order in which nothing is used twice: host update with its rows, maintenance
of Z, then compression of the other rows with the a posteriori host; at the end of a window the host
takes Z over, unless the test rejects it, and Z is discarded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.decorrelation import Measurement, Row
from fkgen.estimators.gaussian.estimate import (
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.rank import DIRECTION, thresholds
from fkgen.estimators.gaussian.sequential import (
    PIVOTS_PER_LOG,
    SequentialUpdate,
    condition,
    innovations,
)
from fkgen.estimators.lmmse.kalman import from_rows
from fkgen.estimators.windows.partial_state import (
    Compressed,
    PartialFilter,
    PartialState,
    partial_state,
    parts,
)
from fkgen.estimators.windows.window import (
    COUNTDOWN,
    collect,
    count_down,
    of_the_host,
    reacquired,
    window_outcomes,
    window_ports,
    window_start,
)
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Port, Status
from fkgen.symbolic.linalg import column, congruence, pack, sparse, unpack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import carried, innovation_ports, start_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion


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
    if given.spec.filter.options.maintenance == "optimal":
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


def closing(given: PartialFilter) -> Phase:
    """The test (50), (51) and the host update (47); Z is discarded whatever comes of it."""
    script, symbols, n = Script(given.symbols), given.symbols, given.plant.nx
    state, covariance = symbols["filtered_state"], symbols["filtered_covariance"]
    taken, rank = _taken_over(script, given)
    accepted, rejected = _verdict(script, given, taken.nis, rank)
    names = {"closed_state": n, "closed_covariance": covariance.numel()}
    closed = [script.local(name, size) for name, size in names.items()]
    with script.titled("the host takes over"):
        script.put(dict(zip(names, (state, covariance), strict=True)))
        with script.where(accepted):
            moved = state + taken.mean[:n], parts(taken.covariance, n, given.partial.size)[0]
            script.put(dict(zip(names, moved, strict=True)))
    limit, known = given.spec.filter.options.reacquire, (taken.mean[:n], "closed_covariance")
    counted = reacquired(script, limit, ([accepted], [rejected]), known)
    with script.titled("results of the window"):
        collecting = symbols["collecting"]
        script.put(
            {
                "filtered_state": closed[0],
                "filtered_covariance": closed[1],
                "collecting": ca.SX(0),
                "test_statistic": taken.nis * collecting,
                "test_dof": rank * collecting,
                "fault_declared": rejected,
                **counted,
            },
            [finite(*closed)],
        )
    return script.phase(unless=COUNTDOWN)


def _taken_over(script: Script, given: PartialFilter) -> tuple[SequentialUpdate, ca.SX]:
    """(e, V) given that T1 e + V is Z, (47), and how many rows of Z say something.

    Rows of a group of which only others have begun say nothing, up to rounding of T1 P T1' + R.
    """
    n, partial, carried = given.plant.nx, given.partial, given.compressed()
    m, scalar, tag = partial.size, given.spec.code.scalar, "_taken"
    covariance = given.symbols["filtered_covariance"]
    prior = pack(carried.joint(covariance))
    taken = SequentialUpdate(
        script=script,
        rows=[
            Row(
                c=sparse(partial.measures()[i, :].T),
                innovation=carried.measurement[i],
                variance=ca.SX(0),
                of_y=ca.SX(m, 1),
            )
            for i in range(m)
        ],
        at=(),
        tag=tag,
        form=given.form,
        variance=script.let("size", congruence(partial.T1, unpack(covariance, n)) + carried.noise),
        rank_tolerance=DIRECTION[scalar],
        prior=ca.SX.zeros(n + m),
        covariance=prior,
        gain=None,
        pivots_per_log=PIVOTS_PER_LOG[scalar],
    )
    rank = script.local("rank", 1, 0.0)
    for i, row in enumerate(given.rows):
        with script.titled(f"row {i} of the compressed measurement, {given.plant.rows[row]}"):
            taken.update_row(i)
            with script.where(script.symbol(f"inverse{tag}_{i}")):
                script.put({"rank": rank + 1})
    return taken, rank


def _verdict(
    script: Script, given: PartialFilter, statistic: ca.SX, rank: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """(accepted, rejected) as 0 or 1: neither of them if there was no measurement."""
    accepted, rejected = (script.local(name, 1) for name in ("accepted", "rejected"))
    with script.titled("verdict"):
        script.put({"accepted": given.symbols["collecting"], "rejected": ca.SX(0)})
        if given.spec.filter.options.test:
            threshold = script.local("threshold", 1, 0.0)
            for below, value in enumerate(thresholds(given.faults.false_alarm, len(given.rows))):
                with script.where(rank - (below + 0.5)):
                    script.put({"threshold": ca.SX(value)})
            with script.where(statistic - threshold):
                script.put({"accepted": ca.SX(0), "rejected": ca.SX(1)})
    return accepted, rejected


def partial_compression_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``cpcf``."""
    faults, plant = spec.faults.soft, plant_of(spec)
    if faults is None:
        raise InternalError(f"{spec.filter.family} without soft faults")
    ports = (
        *state_ports(spec),
        *of_the_host(innovation_ports(spec)),
        *window_ports(spec, faults),
        *_compressed_ports(plant.nx, len(faults.compressed)),
    )
    given = PartialFilter(
        spec=spec,
        faults=faults,
        plant=plant,
        symbols=symbols_of(spec, plant, ports),
        form=update_form(spec, plant, augmented=False),
        partial=partial_state(spec, plant, faults.compressed),
    )
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial=start_of(spec) | window_start(faults),
        update=update(given),
        closing=closing(given),
        predict=_predict(given),
        form=given.form,
        notes=(f"maintenance of the compressed measurement: {spec.filter.options.maintenance}",),
        outcomes=window_outcomes(spec),
    )


def _compressed_ports(n: int, m: int) -> tuple[Port, ...]:
    """Z, R and S after sample k and before sample k + 1."""
    result: list[Port] = []
    for prefix, when in (("", ""), ("predicted_", " before sample k+1")):
        measurement = f"Z = T1 e + V{when}, e = x minus the estimate of the host; 0 without one"
        noise, cross = f"R: covariance of V{when}", f"S: covariance of V with e{when}"
        result += [
            carried(f"{prefix}compressed_measurement", (m,), measurement),
            carried(f"{prefix}compressed_noise", (m, m), noise, symmetric=True),
            carried(f"{prefix}compressed_cross_covariance", (m, n), cross),
        ]
    return tuple(result)


def _predict(given: PartialFilter) -> Phase:
    script, symbols = Script(given.symbols), given.symbols
    plant, n = bound(script, given.plant, "ABQ"), given.plant.nx
    carried, partial = given.compressed(), given.partial
    state = plant.A @ symbols["filtered_state"] + plant.B @ symbols["u"]
    joint = carried.joint(symbols["filtered_covariance"])
    moved = congruence(partial.transition(plant), joint) + pack(partial.noise(plant))
    covariance, cross, noise = parts(moved, n, partial.size)
    counted = count_down(script, symbols, given.faults)
    after = Compressed(partial.advance(plant) @ carried.measurement, noise, cross)
    with script.titled("prediction of the next sample"):
        script.put(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                **after.ports("predicted_"),
                **counted,
            },
            [finite(state, covariance), finite(after.measurement, after.noise)],
        )
    return script.phase()
