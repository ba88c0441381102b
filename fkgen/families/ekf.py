"""Extended Kalman filter: kf about the estimate of a plant with functions f and h.

h is linearised at x(k|k-1), f at x(k|k) (Anderson & Moore 1979, sec. 8.2); attitudes are corrected
by errors in body axes (Sola 2017, sec. 6).
"""

from __future__ import annotations

from fkgen.families.family import Family, built_by, proved_by
from fkgen.problem.filter import Traits
from fkgen.problem.gate import GateOptions

SOURCE = "Anderson & Moore 1979, Optimal Filtering, sec. 8.2"

FAMILY = Family(
    name="ekf",
    title="extended Kalman filter: functions f and h in place of matrices, no faults",
    build=built_by("lmmse.kalman:linear_filter", source=SOURCE, with_gain=False),
    proof=proved_by(
        "nonlinear", "EXTENDED", "JOINT", "gaussian:LAGGED", theorems="gaussian:GAUSSIAN_IDENTITIES"
    ),
    traits=Traits(nonlinear=True, correlated=True, hindsight=True),
    options=GateOptions,
    starter="starter_ekf.toml",
)
