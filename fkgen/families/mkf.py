"""Modified Kalman filter: actuators that fail now and then, at a known rate.

Strandt, Schneider & Yaz, sec. 2: x[k+1] = A x + B g u + v, y = C x + D g u + w with g in {0, 1} of
known mean xi, the same g in both lines; several actuators with common, independent or correlated
faults.
"""

from __future__ import annotations

from fkgen.estimators.lmmse.kalman import linear_filter
from fkgen.families.family import Family
from fkgen.oracle.claims.gaussian import BATCH, IDENTITIES, OPTIMAL_GAIN, RICCATI
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the modified Kalman filter of a spec."""
    source = "Strandt, Schneider & Yaz, eqs. (4), (9)-(13)"
    return linear_filter(spec, source=source, with_gain=True)


FAMILY = Family(
    name="mkf",
    title="intermittent actuator faults at a known rate: modified Kalman filter",
    build=build,
    closed_forms=(BATCH, OPTIMAL_GAIN, RICCATI),
    theorems=IDENTITIES,
)
