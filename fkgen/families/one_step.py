"""One-step optimal filter: one Gaussian before every sample, the four sensor conditions in it.

Sigalov & Oshman, sec. III: given (gamma, delta) the correction is that of a Kalman filter; the four
are weighted by Bayes' rule (8) and reduced to one Gaussian again (GPB1). How the covariance (7) is
carried on is an option, because the paper's equation holds without faults only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

from fkgen.families.family import Family, Proof
from fkgen.faults import Faults
from fkgen.faults.sensor import read_sensor_faults
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Options, Traits
from fkgen.problem.table.section import Section

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion

CovarianceReading = Literal["moment_matched", "weighted", "paper", "paper_nominal"]
READINGS: tuple[CovarianceReading, ...] = ("moment_matched", "weighted", "paper", "paper_nominal")


@dataclass(frozen=True, slots=True)
class OneStepOptions(Options):
    """How (7), the covariance, is read."""

    covariance: CovarianceReading = "moment_matched"

    @classmethod
    def read(cls, section: Section, _: Faults, __: Model) -> Self:
        """The reading, by default the one that is right."""
        return cls(section.choice("covariance", READINGS, "moment_matched"))


def build(spec: Spec) -> Recursion:
    """Build the filter: four corrections of one prior, Bayes' rule, one Gaussian."""
    from fkgen.estimators.models.switching import one_step_optimal

    return one_step_optimal(spec)


def proof() -> Proof:
    """Matrix filters, one for each sensor condition, and exact Bayes as far as it reaches."""
    from fkgen.oracle.claims.sensor import ENUMERATION, ONE_STEP

    return Proof((ONE_STEP, ENUMERATION))


FAMILY = Family(
    name="one_step",
    title="sensors that lose their signal or gain noise: one-step optimal filter",
    build=build,
    proof=proof,
    traits=Traits(models="merged", densities=True),
    options=OneStepOptions,
    accepts={"sensor": read_sensor_faults},
    starter="starter_one_step.toml",
)
