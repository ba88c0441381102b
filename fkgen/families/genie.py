"""The genie-aided filter, a lower bound: it is told gamma and delta of every sample.

Sigalov & Oshman, sec. VI: no filter that has to find them out can be better. ``gamma`` (0 or 1) and
``delta`` (1 or the noise factor) are run-time parameters.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from fkgen.families.family import Family, Proof, Table
from fkgen.faults.sensor import read_sensor_faults
from fkgen.problem import Parameter, Spec
from fkgen.problem.filter import Traits
from fkgen.problem.gate import GateOptions

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the Kalman filter with C, D and R under the indicators."""
    from fkgen.estimators.lmmse.kalman import linear_filter

    return linear_filter(spec, source="Sigalov & Oshman, sec. VI; eq. (2)", with_gain=False)


def proof() -> Proof:
    """Those of the Kalman filter, whose C, D and R change from sample to sample."""
    from fkgen.oracle.claims.gaussian import BATCH, LAGGED, RICCATI
    from fkgen.oracle.claims.nonlinear import LINEARISED

    return Proof((BATCH, LAGGED, RICCATI, LINEARISED))


def without_law(table: Table, _: Spec) -> Table:
    """The same faults without their law, which one who is told them does not need."""
    sensor = table["faults"]["sensor"]
    return table | {"faults": {"sensor": {key: sensor[key] for key in ("noise_factor", "rows")}}}


FAMILY = Family(
    name="genie",
    title="genie-aided Kalman filter, told the sensor faults: a lower bound",
    build=build,
    proof=proof,
    traits=Traits(
        linear=True,
        exact=True,
        nonlinear=True,
        hindsight=True,
        told=(Parameter("gamma", 1.0), Parameter("delta", 1.0)),
    ),
    options=GateOptions,
    accepts={"sensor": partial(read_sensor_faults, law="optional")},
    adopt=without_law,
    starter="starter_genie.toml",
)
