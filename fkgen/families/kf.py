"""Kalman filter: the family without faults, which the others are compared with.

One step corrects the prediction for sample k with y[k] and predicts sample k + 1 (Anderson & Moore
1979, sec. 3.1), with missing rows left out and time-varying models through run-time parameters.
"""

from __future__ import annotations

from fkgen.families.family import Family, built_by, proved_by
from fkgen.problem.filter import Traits
from fkgen.problem.gate import GateOptions

FAMILY = Family(
    name="kf",
    title="Kalman filter, no faults: missing samples, time-varying models",
    build=built_by(
        "lmmse.kalman:linear_filter",
        source="Anderson & Moore 1979, Optimal Filtering, sec. 3.1 and 6.5",
        with_gain=False,
    ),
    proof=proved_by("gaussian", "BATCH", "RICCATI"),
    traits=Traits(linear=True),
    options=GateOptions,
    starter="starter_kf.toml",
)
