"""Full error-state compression filter beside a host that propagates: Lee & Lee, Theorem 2.

All rows may drift: they wait in the compression filter, and between the ends of windows the host
only propagates (Kerr 1980). It is ``dfcf`` without rows of the host; given some, it is ``dfcf``.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from fkgen.families.family import Family, Proof
from fkgen.faults.soft import CompressionOptions, read_soft_faults
from fkgen.problem import Spec
from fkgen.problem.filter import Traits

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build host and compression filter of a spec."""
    from fkgen.estimators.windows.compression import compression_filter

    source = "Lee & Lee, Theorem 2, eqs. (17)-(25), (50), (51), as a second Kalman filter"
    return compression_filter(spec, source)


def proof() -> Proof:
    """The joint distribution of each window, rejected and accepted."""
    from fkgen.oracle.claims.compression import ACCEPTED, REJECTED, WINDOWS
    from fkgen.oracle.theorems.compression import COMPRESSION_IDENTITIES

    return Proof((WINDOWS, REJECTED, ACCEPTED), COMPRESSION_IDENTITIES)


FAMILY = Family(
    name="compression_full",
    title="sensors that all drift slowly: compression filter beside a host that only propagates",
    build=build,
    proof=proof,
    traits=Traits(windows="full"),
    options=CompressionOptions,
    accepts={"soft": partial(read_soft_faults, host="optional")},
    starter="starter_compression_full.toml",
)
