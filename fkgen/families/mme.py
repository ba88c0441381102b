"""Multiple model estimation (MMAE) of an unknown fault rate: a bank of modified Kalman filters."""

from __future__ import annotations

from fkgen.estimators.models.bank import multiple_model_bank
from fkgen.families.family import Family
from fkgen.oracle.claims.gaussian import IDENTITIES, MME_BATCH, MME_TEXTBOOK

FAMILY = Family(
    name="mme",
    title="unknown actuator fault rate: a bank of modified Kalman filters, one per hypothesis",
    build=multiple_model_bank,
    closed_forms=(MME_TEXTBOOK, MME_BATCH),
    theorems=IDENTITIES,
)
