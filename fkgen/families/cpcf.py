"""Correlated partial error-state compression filter beside a host filter: Lee & Lee, Theorem 4.

Like ``dfcf``, but what waits for the end of a window is one compressed measurement of the states
that the waiting rows measure, and not an estimate of the whole state: less work and memory, and
some information lost.
"""

from __future__ import annotations

from fkgen.estimators.windows.partial import partial_compression_filter
from fkgen.families.family import Family
from fkgen.oracle import PARTIAL_IDENTITIES
from fkgen.oracle.claims.partial_compression import CONTRADICTED, HOST_ALONE, PRIMITIVE_NOISES
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build host filter and compression filter of a spec."""
    source = "Lee & Lee, Theorem 4, eqs. (28), (29), (37)-(47), (50), (51)"
    return partial_compression_filter(spec, source=source)


FAMILY = Family(
    name="cpcf",
    title="sensors that drift slowly, at less cost: host filter and partial compression filter",
    build=build,
    closed_forms=(PRIMITIVE_NOISES, CONTRADICTED, HOST_ALONE),
    theorems=PARTIAL_IDENTITIES,
)
