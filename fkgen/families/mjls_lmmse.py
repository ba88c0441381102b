"""Best linear filter of a plant that jumps between modes, whose samples may be lost.

Costa 1994: linear in y, at a cost that does not grow with time; Sun, Zhao & Yin: losses detected by
a test, a rejected sample replaced by its prediction.
"""

from __future__ import annotations

from fkgen.estimators.lmmse.jump import jump_filter
from fkgen.estimators.lmmse.stationary import stationary_filter
from fkgen.families.family import Family
from fkgen.oracle.claims.jump import PATHS, TEXTBOOK
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion

SOURCE = "Costa 1994, sec. III; Costa, Fragoso & Marques 2005, sec. 5.4; Nahi 1969, eq. (13)"


def build(spec: Spec) -> Recursion:
    """Build the filter with the gain of the spec."""
    if spec.filter.gain == "stationary":
        return stationary_filter(spec, SOURCE)
    return jump_filter(spec, SOURCE)


FAMILY = Family(
    name="mjls_lmmse",
    title="plants that jump between modes, samples that are lost: best linear filter, loss tests",
    build=build,
    closed_forms=(PATHS, TEXTBOOK),
)
