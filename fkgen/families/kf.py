"""Kalman filter: the family without faults, and the yardstick of the others.

One step corrects the prediction for sample k with y[k] and predicts sample k + 1 (Anderson & Moore
1979, sec. 3.1), with missing rows left out and time-varying models through run-time parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fkgen.families.family import Family, Proof
from fkgen.problem import Spec
from fkgen.problem.filter import Traits

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the Kalman filter of a spec."""
    from fkgen.estimators.lmmse.kalman import linear_filter

    source = "Anderson & Moore 1979, Optimal Filtering, sec. 3.1 and 6.5"
    return linear_filter(spec, source=source, with_gain=False)


def proof() -> Proof:
    """The best linear estimate of the whole record, and the Riccati equation."""
    from fkgen.oracle.claims.gaussian import BATCH, RICCATI

    return Proof((BATCH, RICCATI))


FAMILY = Family(
    name="kf",
    title="Kalman filter, no faults: missing samples, time-varying models",
    build=build,
    proof=proof,
    traits=Traits(linear=True),
    starter="starter_kf.toml",
)
