"""One-step optimal filter: one Gaussian before every sample, the four sensor conditions in it.

Sigalov & Oshman, sec. III: given (gamma, delta) the correction is that of a Kalman filter; the four
are weighted by Bayes' rule (8) and reduced to one Gaussian again (GPB1). How the covariance (7) is
carried on is an option, because the paper's equation holds without faults only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, get_args

from fkgen.families.family import Family, built_by, proved_by
from fkgen.faults import Faults
from fkgen.faults.sensor import read_sensor_faults
from fkgen.problem import Model
from fkgen.problem.filter import Options, Traits
from fkgen.problem.table.section import Section

CovarianceReading = Literal["moment_matched", "weighted", "paper", "paper_nominal"]


@dataclass(frozen=True, slots=True)
class OneStepOptions(Options):
    """How (7), the covariance, is read."""

    covariance: CovarianceReading = "moment_matched"

    @classmethod
    def read(cls, section: Section, _: Faults, __: Model) -> Self:
        """The reading, by default the one that is right."""
        return cls(section.choice("covariance", get_args(CovarianceReading), "moment_matched"))


FAMILY = Family(
    name="one_step",
    title="sensors that lose their signal or gain noise: one-step optimal filter",
    build=built_by("models.one_step:one_step_optimal"),
    proof=proved_by(
        "sensor",
        "ONE_STEP",
        "ENUMERATION",
        "nonlinear:LINEARISED_ONE_STEP",
        theorems="gaussian:MIXTURE_IDENTITIES",
    ),
    traits=Traits(models="merged", densities=True, nonlinear=True),
    options=OneStepOptions,
    accepts={"sensor": read_sensor_faults},
    starter="starter_one_step.toml",
)
