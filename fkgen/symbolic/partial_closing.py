"""The end of a window of the partial compression filter: test (50), (51), host update (47)."""

from __future__ import annotations

import casadi as ca

from fkgen.symbolic.conditioning import PIVOTS_PER_LOG
from fkgen.symbolic.decorrelation import Row
from fkgen.symbolic.estimate import finite
from fkgen.symbolic.linalg import congruence, pack, sparse, unpack
from fkgen.symbolic.partial_state import PartialFilter, parts
from fkgen.symbolic.rank import DIRECTION, thresholds
from fkgen.symbolic.recursion import Phase
from fkgen.symbolic.script import Script
from fkgen.symbolic.sequential import Fold
from fkgen.symbolic.window import COUNTDOWN, reacquired


def closing(given: PartialFilter) -> Phase:
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
            moved = state + fold.mean[:n], parts(fold.covariance, n, given.partial.size)[0]
            script.put(dict(zip(names, moved, strict=True)))
    limit, known = given.spec.filter.reacquire, (fold.mean[:n], "closed_covariance")
    counted = reacquired(script, limit, ([accepted], [rejected]), known)
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


def _taken_over(script: Script, given: PartialFilter) -> tuple[Fold, ca.SX]:
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
    script: Script, given: PartialFilter, statistic: ca.SX, rank: ca.SX
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
