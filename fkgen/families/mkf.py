"""Modified Kalman filter: actuators that fail now and then, at a known rate.

Strandt, Schneider & Yaz, sec. 2: x[k+1] = A x + B g u + v, y = C x + D g u + w with g in {0, 1} of
known mean xi, the same g in both lines; several actuators with common, independent or correlated
faults.
"""

from __future__ import annotations

from fkgen.errors import DataError
from fkgen.families.family import Family, Table, built_by, proved_by
from fkgen.faults.actuator import read_actuator_faults
from fkgen.problem import Spec
from fkgen.problem.filter import Traits
from fkgen.problem.gate import GateOptions


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
    build=built_by(
        "lmmse.kalman:linear_filter",
        source="Strandt, Schneider & Yaz, eqs. (4), (9)-(13)",
        with_gain=True,
    ),
    proof=proved_by(
        "gaussian",
        "BATCH",
        "LAGGED",
        "OPTIMAL_GAIN",
        "RICCATI",
        "nonlinear:LINEARISED",
        theorems="mkf:IDENTITIES",
    ),
    traits=Traits(linear=True, nonlinear=True, hindsight=True),
    options=GateOptions,
    accepts={"actuator": read_actuator_faults},
    adopt=with_rate,
    starter="starter_mkf.toml",
)
