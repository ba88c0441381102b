"""Interacting multiple models over the conditions of a sensor, or over modes of the plant."""

from __future__ import annotations

from fkgen.estimators.models.interacting import interacting_models
from fkgen.families.family import Family
from fkgen.oracle.claims.caveats import three_modes
from fkgen.oracle.claims.sensor import ENUMERATION, IMM

FAMILY = Family(
    name="imm",
    title="modes of the sensor or of the plant that last: interacting multiple models",
    build=interacting_models,
    closed_forms=(IMM, ENUMERATION),
    caveats=three_modes,
)
