"""The yardstick: a Kalman filter that is told gamma and delta of every sample.

Sigalov & Oshman, sec. VI: no filter that has to find them out can be better. ``gamma`` (0 or 1) and
``delta`` (1 or the noise factor) are run-time parameters.
"""

from __future__ import annotations

from fkgen.errors import InternalError
from fkgen.estimators.lmmse.kalman import linear_filter
from fkgen.families.family import Family
from fkgen.oracle.claims.gaussian import BATCH, RICCATI
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the Kalman filter with C, D and R under the indicators."""
    if spec.faults.sensor is None:
        raise InternalError("genie without sensor faults")
    return linear_filter(spec, source="Sigalov & Oshman, sec. VI; eq. (2)", with_gain=False)


FAMILY = Family(
    name="genie",
    title="Kalman filter that is told the sensor faults: the yardstick",
    build=build,
    closed_forms=(BATCH, RICCATI),
)
