"""Full error-state compression filter beside a host that propagates: Lee & Lee, Theorem 2.

All rows may drift: they wait in the compression filter, and between the ends of windows the host
only propagates (Kerr 1980). It is ``dfcf`` without rows of the host; given some, it is ``dfcf``.
"""

from __future__ import annotations

from functools import partial

from fkgen.families.family import Family, built_by, proved_by
from fkgen.faults.soft import CompressionOptions, read_soft_faults
from fkgen.problem.filter import Traits

FAMILY = Family(
    name="compression_full",
    title="sensors that all drift slowly: compression filter beside a host that only propagates",
    build=built_by(
        "windows.compression:compression_filter",
        source="Lee & Lee, Theorem 2, eqs. (17)-(25), (50), (51), as a second Kalman filter",
    ),
    proof=proved_by(
        "compression",
        "WINDOWS",
        "REJECTED",
        "ACCEPTED",
        theorems="compression:COMPRESSION_IDENTITIES",
    ),
    traits=Traits(windows="full"),
    options=CompressionOptions,
    accepts={"soft": partial(read_soft_faults, host="optional")},
    starter="starter_compression_full.toml",
)
