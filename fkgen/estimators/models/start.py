"""Where a chain begins: numbers, expressions of the parameters, or the law that it stays in."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.faults.chain import Channel, ModeChain
from fkgen.problem import Matrix, Spec
from fkgen.problem.probability import stationary_law
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, is_zero, total

#: Keeps 0/0 out of the ways on from a state that has none.
LEAST = {"double": 1e-290, "float": 1e-30}


def first_law(
    builder: PhaseBuilder,
    spec: Spec,
    chain: ModeChain | Channel,
    parameters: Mapping[str, ca.SX],
    name: str = "first_law",
) -> ca.SX:
    """The law of sample 0, (N, 1); where it depends on parameters it is named, and it has to be."""
    if chain.first is None:
        return ca.SX(ca.DM(chain.initial))
    if chain.first.stated:
        law = law_of(Matrix((chain.first.stated,)), parameters).T
    elif chain.law is None or not isinstance(chain, ModeChain):
        raise InternalError("a stationary law of a chain that does not depend on parameters")
    else:
        P = law_of(chain.law, parameters)
        law = _resting(P, np.array(chain.possible), LEAST[spec.code.scalar])
    named = builder.define(name, ca.densify(law))
    whole = ca.sum1(named)
    builder.demand(Kind.POSITIVE, [whole], Status.PARAMETER_OUT_OF_RANGE)
    return named / whole


def _resting(P: ca.SX, possible: NDArray[np.float64], least: float) -> ca.SX:
    """The stationary law of a chain: Grassmann, Taksar & Heyman 1985, without a subtraction.

    The last state is left out, its ways through are added to those of the others, and so on. A
    state without a way out leaves nothing to those before it. Where there are several laws it is
    NaN.
    """
    lasting = stationary_law(possible)
    recurrent = [] if lasting is None else np.flatnonzero(lasting).tolist()
    Q = {(i, j): P[a, b] for i, a in enumerate(recurrent) for j, b in enumerate(recurrent)}
    away: dict[int, ca.SX] = {}
    for s in range(len(recurrent) - 1, 0, -1):
        away[s] = total([Q[s, j] for j in range(s)])
        share = {j: Q[s, j] / ca.fmax(away[s], least) for j in range(s) if not is_zero(Q[s, j])}
        for i in (i for i in range(s) if not is_zero(Q[i, s])):
            Q |= {(i, j): Q[i, j] + Q[i, s] * part for j, part in share.items()}
    law = [ca.SX(1)]
    for s in range(1, len(recurrent)):
        into = total([each * Q[i, s] for i, each in enumerate(law)])
        parts = [*(away[s] * each for each in law), into]
        law = [part / total(parts) for part in parts]
    found = [ca.SX(0)] * P.shape[0]
    for state, each in zip(recurrent, law, strict=True):
        found[state] = each
    return column(found)
