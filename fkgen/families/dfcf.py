"""De-correlated full error-state compression filter beside a host filter: Lee & Lee, Theorem 3.

The host uses its rows at once. The other rows wait in a compression filter until the end of a
window, when a slow fault shows; the host takes them over, as if it had used them all along, or
rejects them.
"""

from __future__ import annotations

from fkgen.estimators.windows.compression import compression_filter
from fkgen.families.family import Family
from fkgen.oracle import COMPRESSION_IDENTITIES
from fkgen.oracle.claims.compression import ACCEPTED, REJECTED, WINDOWS
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build host filter and compression filter of a spec."""
    source = "Lee & Lee, Theorem 3, eqs. (28)-(36), (50), (51), as a second Kalman filter"
    return compression_filter(spec, source)


FAMILY = Family(
    name="dfcf",
    title="sensors that drift slowly: host filter and compression filter",
    build=build,
    closed_forms=(WINDOWS, REJECTED, ACCEPTED),
    theorems=COMPRESSION_IDENTITIES,
)
