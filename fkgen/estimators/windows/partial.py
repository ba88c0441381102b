"""The correlated partial error-state compression filter: Lee & Lee, Theorem 4.

Within a sample, in the order in which nothing is used twice: host update with its rows, maintenance
of Z, then compression of the other rows with the a posteriori host; at the end of a window the host
takes Z over, unless the test rejects it, and Z is discarded.

Z = T1 e + V moves with the error e of the host as one linear system. V is carried like further
states: its covariance R and its cross-covariance S with e are blocks of one joint covariance, which
is symmetric and positive by construction. The transformation (38) never leaves the coordinates of
the user, because e^1 = T1 e and F12 e^2 = (T1 F - F11 T1) e.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.decorrelation import Measurement, Row
from fkgen.estimators.gaussian.estimate import bound, demand_finite, demand_positive, finite
from fkgen.estimators.gaussian.rank import DIRECTION, thresholds
from fkgen.estimators.gaussian.rows import SequentialUpdate
from fkgen.estimators.gaussian.sequential import (
    PIVOTS_PER_LOG,
    Conditioned,
    condition,
)
from fkgen.estimators.lmmse.kalman import constant
from fkgen.estimators.windows import window
from fkgen.faults.partial_state import measured_states, similarity, typical_deviation
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Port, Status
from fkgen.symbolic.linalg import (
    by_rows,
    congruence,
    from_rows,
    pack,
    sparse,
    unpack,
)
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried
from fkgen.symbolic.recursion import Phase, Recursion


@dataclass(frozen=True, slots=True)
class Compressed:
    """Z = T1 e + V, with Cov(V) = R and E[V e'] = S."""

    measurement: ca.SX  # (m,), Z
    noise: ca.SX  # R, packed
    cross: ca.SX  # (m, n), S

    def joint(self, covariance: ca.SX) -> ca.SX:
        """Covariance (n + m, n + m) of (e, V); ``covariance`` is that of e, packed."""
        m, n = self.cross.shape
        return ca.blockcat(unpack(covariance, n), self.cross.T, self.cross, unpack(self.noise, m))

    def ports(self, prefix: str = "") -> dict[str, ca.SX]:
        """What the ports (or variables) of this prefix hold of it."""
        return {
            f"{prefix}compressed_measurement": self.measurement,
            f"{prefix}compressed_noise": self.noise,
            f"{prefix}compressed_cross_covariance": by_rows(self.cross),
        }


def parts(joint: ca.SX, n: int, m: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Covariance of e (packed), S, and R (packed) of a packed joint covariance of (e, V)."""
    whole = unpack(joint, n + m)
    return pack(whole[:n, :n]), whole[n:, :n], pack(whole[n:, n:])


@dataclass(frozen=True, slots=True)
class PartialState:
    """The part T1 x of the state that rows of y measure as phi T1 x, (37)."""

    T1: ca.SX  # (m, n)
    first: ca.SX  # (n, m), the first columns of the inverse of T, (38)
    rest: ca.SX  # (n, n), what e^2 contributes to e: identity minus ``first`` T1
    phi: ca.SX  # (m, m)

    def advance(self, plant: Plant) -> ca.SX:
        """F11 of (39)."""
        return sparse(self.T1 @ plant.A @ self.first)


def partial_state(spec: Spec, plant: Plant) -> PartialState:
    """Find T1, phi and T for the compression group of a spec, (37)-(39)."""
    n, which = plant.nx, list(window.soft_faults(spec).compressed)
    stated = spec.model.C.values(spec.defaults)[which]
    deviation = typical_deviation(spec.model, spec.defaults)
    measured = list(measured_states(stated, deviation))
    T1 = similarity(stated, deviation)[: len(which)]
    inverse = np.linalg.inv(T1[:, measured])
    first, rest = np.zeros((n, len(which))), np.eye(n)
    first[measured] = inverse
    rest[measured] -= inverse @ T1
    rest[:, measured] = 0.0
    C1 = plant.C[which, :]
    phi = ca.SX.eye(len(which))
    if not (np.array_equal(T1, stated) and C1.is_constant()):
        phi = sparse(C1[:, measured] @ constant(inverse))
    return PartialState(constant(T1), constant(first), constant(rest), phi)


class PartialDesign(window.Design):
    """What the phases are written from."""

    def __init__(self, spec: Spec) -> None:
        rows = window.soft_faults(spec).compressed
        own = _compressed_ports(spec.model.nx, len(rows))
        super().__init__(spec, (*window.host_ports(spec), *window.window_ports(spec), *own))
        self.rows = rows  # the compression group
        self.partial = partial_state(spec, self.plant)
        self.active = self.symbols["predicted_collecting"]  # 1 if there was a Z before, else 0

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
    given = PartialDesign(spec)
    notes = (f"maintenance of the compressed measurement: {spec.filter.options.maintenance}",)
    return given.recursion(source, (update(given), closing(given), _predict(given)), notes=notes)


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


def update(given: PartialDesign) -> Phase:
    """Write the update of sample k: (29), (44) or its replacement, (45), (46)."""
    builder, symbols, found = PhaseBuilder(given.symbols), given.symbols, None
    state, covariance = symbols["predicted_state"], symbols["predicted_covariance"]
    demand_positive(builder, covariance)
    plant, y, innovation = window.observed(builder, given)
    compressed = _carried(builder, given)
    if given.soft.host:
        found, compressed = _by_host(builder, given, y, (innovation, compressed))
        state, covariance = found.mean, found.covariance
    after = replace(y, offset=y.offset + plant.C @ state).only(given.rows)
    compressed = _compress(builder, given, plant, (after, covariance, compressed))
    demand_finite(builder, ca.vertcat(state, compressed.measurement))
    counted = window.collect(builder, symbols, given.soft)
    with builder.titled("results of the update"):
        builder.assign(
            {
                "filtered_state": state,
                "filtered_covariance": covariance,
                **window.innovation_of_host(given, plant, innovation, found),
                **compressed.ports(),
                **counted,
            }
        )
    return builder.phase()


def _carried(builder: PhaseBuilder, given: PartialDesign) -> Compressed:
    """Z before this sample; zeros if there is none."""
    carried, assign = _locals(builder, "carried_", given.compressed("predicted_"))
    title = "the compressed measurement, if there is one"
    with builder.titled(title), builder.if_positive(given.active):
        builder.assign(assign)
    return carried


def _by_host(
    builder: PhaseBuilder,
    given: PartialDesign,
    y: Measurement,
    known: tuple[list[ca.SX], Compressed],
) -> tuple[Conditioned, Compressed]:
    """(29) for the host and (44), or its optimal replacement, for Z.

    Conditioning (e, V) on the rows of the host moves Z = T1 e + V by what it learns of both. The
    paper keeps V as it is, and with it R.
    """
    innovation, carried = known
    state, packed = given.symbols["predicted_state"], given.symbols["predicted_covariance"]
    n, m, rows = given.plant.nx, len(given.rows), given.soft.host
    found = condition(
        builder,
        (ca.vertcat(state, ca.SX.zeros(m)), carried.joint(packed)),
        replace(y, C=ca.horzcat(y.C, ca.SX(len(y.rows), m))).only(rows),
        form=given.form,
        innovation=[innovation[i] for i in rows],
    )
    covariance, cross, noise = parts(found.covariance, n, m)
    learnt = given.partial.T1 @ (found.mean[:n] - state)
    if given.spec.filter.options.maintenance == "optimal":
        learnt = learnt + found.mean[n:]
    else:
        noise = carried.noise
    with builder.titled("maintenance of the compressed measurement"):
        maintained = builder.local("maintained", m, 0.0)
        with builder.if_positive(given.active):
            builder.assign({"maintained": carried.measurement - learnt})
    host = replace(found, mean=found.mean[:n], covariance=covariance)
    return host, Compressed(maintained, noise, cross)


def _compress(
    builder: PhaseBuilder,
    given: PartialDesign,
    plant: Plant,
    known: tuple[Measurement, ca.SX, Compressed],
) -> Compressed:
    """(46), row by row: V is corrected as if nothing were known of it but R."""
    measurement, covariance, carried = known
    partial, m = partial_state(given.spec, plant), len(given.rows)
    with builder.titled("whether a compressed measurement begins"):
        some, every = _beginnings(builder, given)
    if m > 1:
        carried, assign = _locals(builder, "begun_", carried)
        builder.assign(assign)
        with builder.if_positive(some):
            builder.assign(_silent(partial, covariance).ports("begun_"))
    found = condition(
        builder,
        (carried.measurement, unpack(carried.noise, m)),
        replace(measurement, C=partial.phi, rank_tolerance=None),
        tag="_compressed",
        form="joseph",
        with_gain=True,
    )
    if found.gain is None:
        raise InternalError("a condition with gain, without one")
    cross = carried.cross - found.gain @ (partial.phi @ carried.cross)
    folded = Compressed(found.mean, found.covariance, cross)
    compressed, assign = _locals(builder, "new_", folded)
    with builder.titled("a compressed measurement begins"):
        builder.assign(assign)
        with builder.if_positive(every):
            builder.assign(_first(builder, partial, measurement).ports("new_"))
    return compressed


def _beginnings(builder: PhaseBuilder, given: PartialDesign) -> tuple[ca.SX, ca.SX]:
    """1 where there was no Z and now some rows of the group are there; the same for all of them."""
    fresh = builder.define("fresh", 1 - given.active)
    some, every = builder.local("begins", 1, 0.0), fresh
    for at, row in enumerate(given.rows):
        flag = builder.local(f"begins_{at}", 1, 0.0)
        with builder.if_present(row):
            builder.assign({"begins": fresh, f"begins_{at}": every})
        every = flag
    return some, every


def _silent(partial: PartialState, covariance: ca.SX) -> Compressed:
    """Z = 0, with V = -T1 e: rows that begin after others of their group replace it by and by."""
    P = unpack(covariance, partial.T1.shape[1])
    zero = ca.SX.zeros(partial.T1.shape[0])
    return Compressed(zero, congruence(partial.T1, P), -partial.T1 @ P)


def _first(builder: PhaseBuilder, partial: PartialState, measurement: Measurement) -> Compressed:
    """(42): all rows of a group, scaled by phi; refused where that is singular."""
    determinant = ca.det(partial.phi)
    builder.demand(Kind.POSITIVE, [determinant * determinant], Status.RESULT_NOT_FINITE)
    back = sparse(ca.inv(partial.phi))
    return Compressed(
        back @ (measurement.y - measurement.offset),
        congruence(back, measurement.R),
        ca.SX.zeros(*partial.T1.shape),
    )


def _locals(
    builder: PhaseBuilder, prefix: str, values: Compressed
) -> tuple[Compressed, dict[str, ca.SX]]:
    """Variables of this shape, zero to begin with, and what to assign them."""
    m = values.cross.shape[0]
    assign = values.ports(prefix)
    measurement, noise, cross = (
        builder.local(name, value.numel(), 0.0) for name, value in assign.items()
    )
    return Compressed(measurement, noise, from_rows(cross, m)), assign


def closing(given: PartialDesign) -> Phase:
    """The test (50), (51) and the host update (47); Z is discarded whatever comes of it."""
    builder, n, m = PhaseBuilder(given.symbols), given.plant.nx, len(given.rows)
    taken, rank = _taken_over(builder, given)

    def excess() -> ca.SX:
        threshold = builder.local("threshold", 1, 0.0)
        for below, value in enumerate(thresholds(given.soft.false_alarm, m)):
            with builder.if_positive(rank - (below + 0.5)):
                builder.assign({"threshold": ca.SX(value)})
        return taken.nis - threshold

    with builder.titled("verdict"):
        accepted, rejected = window.verdict_on(builder, given, 0, "", excess)
    title, collecting = "the host takes over", given.symbols["collecting"]
    takeover = window.Takeover(title, accepted, taken.mean[:n], parts(taken.covariance, n, m)[0])
    verdict = accepted, rejected, taken.nis * collecting, rank * collecting
    return window.closed(builder, given, [verdict], [takeover], title=title)


def _taken_over(builder: PhaseBuilder, given: PartialDesign) -> tuple[SequentialUpdate, ca.SX]:
    """(e, V) given that T1 e + V is Z, (47), and how many rows of Z say something.

    Rows of a group of which only others have begun say nothing, up to rounding of T1 P T1' + R.
    """
    n, m, T1, carried = given.plant.nx, len(given.rows), given.partial.T1, given.compressed()
    scalar, tag = given.spec.code.scalar, "_taken"
    covariance = given.symbols["filtered_covariance"]
    prior, none = pack(carried.joint(covariance)), ca.SX.zeros(n + m)
    measures = ca.horzcat(T1, ca.SX.eye(m))
    taken = SequentialUpdate(
        builder=builder,
        rows=[
            Row(sparse(measures[i, :].T), carried.measurement[i], ca.SX(0), ca.SX(m, 1))
            for i in range(m)
        ],
        at=(),
        tag=tag,
        form=given.form,
        variance=builder.define("size", congruence(T1, unpack(covariance, n)) + carried.noise),
        rank_tolerance=DIRECTION[scalar],
        prior=none,
        covariance=prior,
        gain=None,
        pivots_per_log=PIVOTS_PER_LOG[scalar],
    )
    rank = builder.local("rank", 1, 0.0)
    for i, row in enumerate(given.rows):
        with builder.titled(f"row {i} of the compressed measurement, {given.plant.rows[row]}"):
            taken.update_row(i)
            with builder.if_positive(builder.symbol(f"inverse{tag}_{i}")):
                builder.assign({"rank": rank + 1})
    return taken, rank


def _predict(given: PartialDesign) -> Phase:
    builder, symbols = PhaseBuilder(given.symbols), given.symbols
    plant, n, m = bound(builder, given.plant, "ABQc"), given.plant.nx, len(given.rows)
    carried, partial, T1 = given.compressed(), given.partial, given.partial.T1
    # Of (e, V): V+ = F11 V - F12 e^2 - G1 w, eq. (D2).
    moved, noise = T1 @ plant.A, T1 @ plant.Q
    step = [[plant.A, ca.SX(n, m)], [-(moved @ partial.rest), moved @ partial.first]]
    Q = ca.blockcat([[plant.Q, -noise.T], [-noise, noise @ T1.T]])
    state = plant.A @ symbols["filtered_state"] + plant.B @ symbols["u"] + plant.c
    joint = carried.joint(symbols["filtered_covariance"])
    later = congruence(sparse(ca.blockcat(step)), joint) + pack(Q)
    covariance, cross, noise = parts(later, n, m)
    counted = window.count_down(builder, symbols, given.soft)
    after = Compressed(partial.advance(plant) @ carried.measurement, noise, cross)
    with builder.titled("prediction of the next sample"):
        builder.assign(
            {
                "predicted_state": state,
                "predicted_covariance": covariance,
                **after.ports("predicted_"),
                **counted,
            },
            [finite(state, covariance), finite(after.measurement, after.noise)],
        )
    return builder.phase()
