"""De-correlated full error-state compression filter beside a host filter: Lee & Lee, Theorem 3.

The host uses its rows at once. The other rows wait in a compression filter until the end of a
window, when a slow fault shows; the host takes them over, as if it had used them all along, or
rejects them.
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
    """Build host filter and compression filter of a spec."""
    from fkgen.estimators.windows.compression import compression_filter

    source = "Lee & Lee, Theorem 3, eqs. (28)-(36), (50), (51), as a second Kalman filter"
    return compression_filter(spec, source)


def proof() -> Proof:
    """The joint distribution of each window, rejected and accepted."""
    from fkgen.oracle.claims.compression import ACCEPTED, REJECTED, WINDOWS
    from fkgen.oracle.theorems.compression import COMPRESSION_IDENTITIES

    return Proof((WINDOWS, REJECTED, ACCEPTED), COMPRESSION_IDENTITIES)


FAMILY = Family(
    name="dfcf",
    title="sensors that drift slowly: host filter and compression filter",
    build=build,
    proof=proof,
    traits=Traits(windows="full"),
    options=CompressionOptions,
    accepts={"soft": partial(read_soft_faults, host="some")},
    starter="starter_dfcf.toml",
)
