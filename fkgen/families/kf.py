"""Kalman filter: the family without faults, and the yardstick of the others.

One step corrects the prediction for sample k with y[k] and predicts sample k + 1 (Anderson & Moore
1979, sec. 3.1), with missing rows left out and time-varying models through run-time parameters.
"""

from __future__ import annotations

from fkgen.estimators.lmmse.kalman import linear_filter
from fkgen.families.family import Family
from fkgen.oracle.claims.gaussian import BATCH, RICCATI
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the Kalman filter of a spec."""
    source = "Anderson & Moore 1979, Optimal Filtering, sec. 3.1 and 6.5"
    return linear_filter(spec, source=source, with_gain=False)


FAMILY = Family(
    name="kf",
    title="Kalman filter, no faults: missing samples, time-varying models",
    build=build,
    closed_forms=(BATCH, RICCATI),
)
