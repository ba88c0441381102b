"""De-correlated full error-state compression filter beside a host filter: Lee & Lee, Theorem 3.

The host uses its rows at once. The other rows wait in a compression filter until the end of a
window, when a slow fault shows; the host takes them over, as if it had used them all along, or
rejects them.
"""

from __future__ import annotations

from functools import partial

from fkgen.families.family import Family, built_by, proved_by
from fkgen.faults.soft import CompressionOptions, read_soft_faults
from fkgen.problem.filter import Traits

FAMILY = Family(
    name="dfcf",
    title="sensors that drift slowly: host filter and compression filter",
    build=built_by(
        "windows.compression:compression_filter",
        source="Lee & Lee, Theorem 3, eqs. (28)-(36), (50), (51), as a second Kalman filter",
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
    accepts={"soft": partial(read_soft_faults, host="some")},
    starter="starter_dfcf.toml",
)
