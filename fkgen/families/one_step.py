"""One-step optimal filter (GPB1): one Gaussian before every sample, four conditions in it."""

from __future__ import annotations

from fkgen.estimators.models.one_step import one_step_optimal
from fkgen.families.family import Family
from fkgen.oracle.claims.sensor import ENUMERATION, ONE_STEP

FAMILY = Family(
    name="one_step",
    title="sensors that lose their signal or gain noise: one-step optimal filter",
    build=one_step_optimal,
    closed_forms=(ONE_STEP, ENUMERATION),
)
