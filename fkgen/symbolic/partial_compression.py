"""The correlated partial error-state compression filter: Lee & Lee, Theorem 4.

Within a sample, in the order in which nothing is used twice: host update with its rows, maintenance
of Z, then compression of the other rows with the a posteriori host; at the end of a window the host
takes Z over, unless the test rejects it, and Z is discarded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import casadi as ca

from fkgen.errors import InternalError
from fkgen.spec import SoftFaults, Spec
from fkgen.symbolic.conditioning import PIVOTS_PER_LOG, condition
from fkgen.symbolic.decorrelation import Measurement, Row
from fkgen.symbolic.estimate import (
    bound,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.symbolic.interface import Kind, Port, Role, Status
from fkgen.symbolic.linalg import congruence, outer_lower, pack, sparse, unpack
from fkgen.symbolic.linear_filter import by_rows, from_rows
from fkgen.symbolic.partial_state import Compressed, PartialState, parts, partial_state
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import prior_of, state_ports, symbols_of
from fkgen.symbolic.rank import DIRECTION, thresholds
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.sequential import Fold, Form
from fkgen.symbolic.window import COUNTDOWN, collect, count_down, window_ports, window_start


@dataclass(frozen=True, slots=True, kw_only=True)
class _Filter:
    """What the phases are written from."""

    spec: Spec
    faults: SoftFaults
    plant: Plant
    symbols: dict[str, ca.SX]
    form: Form
    partial: PartialState

    @property
    def active(self) -> ca.SX:
        """1 if there was a Z before this sample, else 0."""
        return self.symbols["predicted_collecting"]

    @property
    def rows(self) -> tuple[int, ...]:
        """The compression group."""
        return self.faults.compressed

    def compressed(self, prefix: str = "") -> Compressed:
        """Z, R and S as ports hold them."""
        symbols, m = self.symbols, len(self.rows)
        return Compressed(
            symbols[f"{prefix}compressed_measurement"],
            symbols[f"{prefix}compressed_noise"],
            from_rows(symbols[f"{prefix}compressed_cross_covariance"], m),
        )


def partial_compression_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``cpcf``."""
    faults, plant = spec.faults.soft, plant_of(spec)
    if faults is None:
        raise InternalError(f"{spec.filter.family} without soft faults")
    ports = (
        *state_ports(spec),
        *window_ports(spec, faults),
        *_compressed_ports(plant.nx, len(faults.compressed)),
    )
    given = _Filter(
        spec=spec,
        faults=faults,
        plant=plant,
        symbols=symbols_of(spec, plant, ports),
        form=update_form(spec, plant, augmented=False),
        partial=partial_state(spec, plant, faults.compressed),
    )
    start = dict(zip(("state", "covariance"), prior_of(spec), strict=True))
    initial = {f"{of}_{what}": v for what, v in start.items() for of in ("predicted", "filtered")}
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial=initial | window_start(faults),
        update=_update(given),
        closing=_closing(given),
        predict=_predict(given),
        notes=(
            f"covariance update: {given.form} form",
            f"maintenance of the compressed measurement: {spec.filter.maintenance}",
        ),
    )


def _compressed_ports(n: int, m: int) -> tuple[Port, ...]:
    """Z, R and S after sample k and before sample k + 1."""
    port = partial(Port, role=Role.STATE)
    result: list[Port] = []
    for prefix, when in (("", ""), ("predicted_", " before sample k+1")):
        result += [
            port(
                name=f"{prefix}compressed_measurement",
                shape=(m,),
                meaning=f"Z = T1 e + V{when}, e = x minus the estimate of the host; 0 without one",
            ),
            port(
                name=f"{prefix}compressed_noise",
                shape=(m, m),
                symmetric=True,
                meaning=f"R: covariance of V{when}",
            ),
            port(
                name=f"{prefix}compressed_cross_covariance",
                shape=(m, n),
                meaning=f"S: covariance of V with e{when}",
            ),
        ]
    return tuple(result)


def _update(given: _Filter) -> Phase:
    script, symbols = Script(given.symbols), given.symbols
    demand_positive(script, symbols["predicted_covariance"], given.plant.nx)
    plant = bound(script, given.plant, "CDR")
    state, covariance = symbols["predicted_state"], symbols["predicted_covariance"]
    carried = _carried(script, given)
    if given.faults.host:
        state, covariance, carried = _by_host(script, given, plant, carried)
        state = script.let("host_state", state)
        covariance = script.let("host_covariance", covariance)
    carried = _compress(script, given, plant, (state, covariance, carried))
    demand_finite(script, ca.vertcat(state, carried.measurement))
    window = collect(script, symbols, given.faults)
    with script.titled("results of the update"):
        script.put(
            {
                "filtered_state": state,
                "filtered_covariance": covariance,
                **_stored(carried),
                **window,
            }
        )
    return script.phase()


def _stored(compressed: Compressed, prefix: str = "") -> dict[str, ca.SX]:
    """Values of the ports."""
    return {
        f"{prefix}compressed_measurement": compressed.measurement,
        f"{prefix}compressed_noise": compressed.noise,
        f"{prefix}compressed_cross_covariance": by_rows(compressed.cross),
    }


def _locals(script: Script, prefix: str, values: Compressed) -> tuple[Compressed, dict[str, ca.SX]]:
    """Variables of this shape, zero to begin with, and what to assign them."""
    m = values.cross.shape[0]
    assign = _stored(values, prefix)
    measurement, noise, cross = (
        script.local(name, value.numel(), 0.0) for name, value in assign.items()
    )
    return Compressed(measurement, noise, from_rows(cross, m)), assign


def _carried(script: Script, given: _Filter) -> Compressed:
    """Z before this sample; zeros if there is none."""
    carried, assign = _locals(script, "carried_", given.compressed("predicted_"))
    with script.titled("the compressed measurement, if there is one"):
        with script.where(given.active):
            script.put(assign)
    return carried


def _by_host(
    script: Script, given: _Filter, plant: Plant, carried: Compressed
) -> tuple[ca.SX, ca.SX, Compressed]:
    """(29) for the host and (44), or its optimal replacement, for Z.

    Conditioning (e, V) on the rows of the host moves Z = T1 e + V by what it learns of both. The
    paper keeps V as it is, and with it R.
    """
    n, m, symbols = plant.nx, len(given.rows), given.symbols
    measurement = measurement_of(
        plant,
        scalar=given.spec.code.scalar,
        y=symbols["y"],
        C=ca.horzcat(plant.C, ca.SX(plant.ny, m)),
        offset=plant.D @ symbols["u"],
        R=plant.R,
    ).only(given.faults.host)
    state = symbols["predicted_state"]
    prior = ca.vertcat(state, ca.SX.zeros(m)), carried.joint(symbols["predicted_covariance"])
    found = condition(script, prior, measurement, form=given.form)
    covariance, cross, noise = parts(found.covariance, n)
    learnt = given.partial.T1 @ (found.mean[:n] - state)
    if given.spec.filter.maintenance == "optimal":
        learnt = learnt + found.mean[n:]
    else:
        noise = carried.noise
    with script.titled("maintenance of the compressed measurement"):
        maintained = script.local("maintained", m, 0.0)
        with script.where(given.active):
            script.put({"maintained": carried.measurement - learnt})
    return found.mean[:n], covariance, Compressed(maintained, noise, cross)


def _compress(
    script: Script, given: _Filter, plant: Plant, host: tuple[ca.SX, ca.SX, Compressed]
) -> Compressed:
    """(46), row by row: V is corrected as if nothing were known of it but R."""
    state, covariance, carried = host
    partial = partial_state(given.spec, plant, given.rows)
    measurement = measurement_of(
        plant,
        scalar=given.spec.code.scalar,
        y=given.symbols["y"],
        C=plant.C,
        offset=plant.D @ given.symbols["u"] + plant.C @ state,
        R=plant.R,
    ).only(given.rows)
    with script.titled("whether a compressed measurement begins"):
        some, every = _beginnings(script, given)
    if partial.size > 1:
        carried = _replaced(script, "begun_", carried, _silent(partial, covariance), some)
    found = condition(
        script,
        (carried.measurement, unpack(carried.noise, partial.size)),
        replace(measurement, C=partial.phi, rank_tolerance=None),
        tag="_compressed",
        form="joseph",
        with_gain=True,
    )
    gain = ca.SX(partial.size, partial.size) if found.gain is None else found.gain
    cross = carried.cross - gain @ (partial.phi @ carried.cross)
    folded = Compressed(found.mean, found.covariance, cross)
    with script.titled("a compressed measurement begins"):
        first = _first(script, partial, measurement)
        return _replaced(script, "new_", folded, first, every)


def _beginnings(script: Script, given: _Filter) -> tuple[ca.SX, ca.SX]:
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
    """(42): all rows of a group, scaled by phi."""
    back = inverse_of(script, partial.phi)
    return Compressed(
        back @ (measurement.y - measurement.offset),
        congruence(back, measurement.R),
        ca.SX.zeros(*partial.T1.shape),
    )


def inverse_of(script: Script, phi: ca.SX) -> ca.SX:
    """The inverse of phi, which must not be singular for the parameters of this sample."""
    if phi.is_constant():
        return phi
    determinant = ca.det(phi)
    script.demand(Kind.POSITIVE, [determinant * determinant], Status.PARAMETER_OUT_OF_RANGE)
    return script.name_entries("inverse_phi", sparse(ca.inv(phi)))


def _replaced(
    script: Script, prefix: str, usual: Compressed, other: Compressed, positive: ca.SX
) -> Compressed:
    """The ``other`` one where ``positive`` is, else the usual one."""
    result, assign = _locals(script, prefix, usual)
    script.put(assign)
    with script.where(positive):
        script.put(_stored(other, prefix))
    return result


def _predict(given: _Filter) -> Phase:
    script, symbols = Script(given.symbols), given.symbols
    plant, n = bound(script, given.plant, "ABQ"), given.plant.nx
    carried, partial = given.compressed(), given.partial
    state = plant.A @ symbols["filtered_state"] + plant.B @ symbols["u"]
    joint = carried.joint(symbols["filtered_covariance"])
    moved = congruence(partial.transition(plant), joint) + pack(partial.noise(plant))
    covariance, cross, noise = parts(moved, n)
    counted = count_down(script, symbols, given.faults)
    after = Compressed(partial.advance(plant) @ carried.measurement, noise, cross)
    with script.titled("prediction of the next sample"):
        script.put(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                **_stored(after, "predicted_"),
                **counted,
            },
            [finite(state, covariance), finite(after.measurement, after.noise)],
        )
    return script.phase()


def _closing(given: _Filter) -> Phase:
    """The test (50), (51) and the host update (47); Z is discarded whatever comes of it."""
    script, symbols, n = Script(given.symbols), given.symbols, given.plant.nx
    state, covariance = symbols["filtered_state"], symbols["filtered_covariance"]
    fold, rank = _taken_over(script, given)
    accepted, rejected = _verdict(script, given, fold.nis, rank)
    names = {"closed_state": n, "closed_covariance": covariance.numel()}
    closed = [script.local(name, size) for name, size in names.items()]
    with script.titled("the host takes over"):
        script.put(dict(zip(names, (state, covariance), strict=True)))
        with script.where(accepted):
            moved = state + fold.mean[:n], parts(fold.covariance, n)[0]
            script.put(dict(zip(names, moved, strict=True)))
    counted = {}
    with script.titled("results of the window"):
        collecting = symbols["collecting"]
        script.put(
            {
                "filtered_state": closed[0],
                "filtered_covariance": closed[1],
                "collecting": ca.SX(0),
                "test_statistic": fold.nis * collecting,
                "test_dof": rank * collecting,
                "fault_declared": rejected,
                **counted,
            },
            [finite(*closed)],
        )
    return script.phase(unless=COUNTDOWN)


def _taken_over(script: Script, given: _Filter) -> tuple[Fold, ca.SX]:
    """(e, V) given that T1 e + V is Z, (47), and how many rows of Z say something.

    Rows of a group of which only others have begun say nothing, up to rounding of T1 P T1' + R.
    """
    n, partial, carried = given.plant.nx, given.partial, given.compressed()
    m, scalar, tag = partial.size, given.spec.code.scalar, "_taken"
    covariance = given.symbols["filtered_covariance"]
    prior = pack(carried.joint(covariance))
    start = {f"mean{tag}": ca.SX.zeros(n + m), f"covariance{tag}": prior}
    fold = Fold(
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
        mean=ca.SX.zeros(n + m),
        covariance=prior,
        gain=None,
        determinant=[ca.SX(1)] * -(-m // PIVOTS_PER_LOG[scalar]),
        symbols={name: script.local(name, value.numel()) for name, value in start.items()},
    )
    script.put(start)
    rank = script.local("rank", 1, 0.0)
    for i, row in enumerate(given.rows):
        with script.titled(f"row {i} of the compressed measurement, {given.plant.rows[row]}"):
            fold.take(i)
            with script.where(script.symbol(f"inverse{tag}_{i}")):
                script.put({"rank": rank + 1})
    return fold, rank


def _verdict(
    script: Script, given: _Filter, statistic: ca.SX, rank: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """(accepted, rejected) as 0 or 1: neither of them if there was no measurement."""
    accepted, rejected = (script.local(name, 1) for name in ("accepted", "rejected"))
    with script.titled("verdict"):
        script.put({"accepted": given.symbols["collecting"], "rejected": ca.SX(0)})
        if given.spec.filter.test:
            threshold = script.local("threshold", 1, 0.0)
            for below, value in enumerate(thresholds(given.faults.false_alarm, len(given.rows))):
                with script.where(rank - (below + 0.5)):
                    script.put({"threshold": ca.SX(value)})
            with script.where(statistic - threshold):
                script.put({"accepted": ca.SX(0), "rejected": ca.SX(1)})
    return accepted, rejected
