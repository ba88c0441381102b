"""Linear optimal filter for measurements that may carry no signal or more noise.

Sigalov & Oshman, sec. V: the best linear filter in terms of E[gamma], p11 and E[delta] (Nahi 1969
and Hadidi & Schwartz 1979 are special cases), exact under Lemma 2; with ``form = "augmented"`` the
best linear filter for any Markov gamma (Costa 1994).
"""

from __future__ import annotations

from fkgen.estimators.lmmse.jump import jump_filter
from fkgen.estimators.lmmse.lemma2 import uncertain_filter
from fkgen.families.family import Family
from fkgen.oracle.claims.caveats import lemma_2
from fkgen.oracle.claims.sensor import LEMMA_2_FORM, LINEAR_BATCH, LINEAR_IDENTITIES
from fkgen.problem import Spec
from fkgen.symbolic.recursion import Recursion


def build(spec: Spec) -> Recursion:
    """Build the filter in the form of the spec."""
    if spec.filter.form == "augmented":
        return jump_filter(spec, "Costa 1994; Sigalov & Oshman, sec. V without Lemma 2")
    return uncertain_filter(spec, "Sigalov & Oshman, sec. V, eqs. (19)-(23), covariance form")


FAMILY = Family(
    name="linear_optimal",
    title="sensors that lose their signal or gain noise: linear optimal filter",
    build=build,
    closed_forms=(LEMMA_2_FORM, LINEAR_BATCH),
    theorems=LINEAR_IDENTITIES,
    caveats=lemma_2,
)
