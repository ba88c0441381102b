"""Full error-state compression filter beside a host that propagates: Lee & Lee, Theorem 2.

All rows may drift: they wait in the compression filter, and between the ends of windows the host
only propagates (Kerr 1980). It is ``dfcf`` without rows of the host; given some, it is ``dfcf``.
"""

from __future__ import annotations

from fkgen.estimators.windows.compression import compression_filter
from fkgen.families.family import Family
from fkgen.oracle import COMPRESSION_IDENTITIES
from fkgen.oracle.claims.compression import ACCEPTED, REJECTED, WINDOWS
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build host and compression filter of a spec."""
    source = "Lee & Lee, Theorem 2, eqs. (17)-(25), (50), (51), as a second Kalman filter"
    return compression_filter(spec, source)


FAMILY = Family(
    name="compression_full",
    title="sensors that all drift slowly: compression filter beside a host that only propagates",
    build=build,
    closed_forms=(WINDOWS, REJECTED, ACCEPTED),
    theorems=COMPRESSION_IDENTITIES,
)
