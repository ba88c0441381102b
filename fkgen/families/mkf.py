"""Modified Kalman filter: actuators that fail now and then, at a known rate.

Strandt, Schneider & Yaz, sec. 2: x[k+1] = A x + B g u + v, y = C x + D g u + w with g in {0, 1} of
known mean xi, the same g in both lines; several actuators with common, independent or correlated
faults.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fkgen.errors import DataError
from fkgen.families.family import Family, Proof, Table
from fkgen.faults.actuator import read_actuator_faults
from fkgen.problem import Spec
from fkgen.problem.filter import Traits

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the modified Kalman filter of a spec."""
    from fkgen.estimators.lmmse.kalman import linear_filter

    source = "Strandt, Schneider & Yaz, eqs. (4), (9)-(13)"
    return linear_filter(spec, source=source, with_gain=True)


def proof() -> Proof:
    """The best linear estimate of the whole record, the optimal gain, the Riccati equation."""
    from fkgen.oracle.claims.gaussian import BATCH, OPTIMAL_GAIN, RICCATI
    from fkgen.oracle.theorems.mkf import IDENTITIES

    return Proof((BATCH, OPTIMAL_GAIN, RICCATI), IDENTITIES)


def with_rate(table: Table, _: Spec) -> Table:
    """The same faults, whose rate has to be known."""
    if table["faults"]["actuator"].get("success_rate"):
        return table
    raise DataError(
        "families",
        given="'mkf' for actuators whose rate is not stated",
        expected="faults.actuator.success_rate in the spec",
    )


FAMILY = Family(
    name="mkf",
    title="intermittent actuator faults at a known rate: modified Kalman filter",
    build=build,
    proof=proof,
    traits=Traits(linear=True),
    accepts={"actuator": read_actuator_faults},
    adopt=with_rate,
    starter="starter_mkf.toml",
)
