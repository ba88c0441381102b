"""Unscented Kalman filter: moments of points that are sent through f and h.

Julier & Uhlmann 1997, with equal weights; drawn anew for y from the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from fkgen.families.family import Family, built_by, proved_by
from fkgen.problem import Model
from fkgen.problem.filter import Options, Traits
from fkgen.problem.table.section import Section

SOURCE = "Julier & Uhlmann 1997, sec. 3, with equal weights"


@dataclass(frozen=True, slots=True)
class UnscentedOptions(Options):
    """How far out the points lie; a centre among them if kappa is not 0."""

    kappa: float = 0.0

    @classmethod
    def read(cls, section: Section, _: object, __: Model) -> Self:
        """The share of the centre, in points."""
        expected = "0 (no point in the centre) or a positive number, such as 1.0"
        return cls(section.number("kappa", expected, lambda number: number >= 0.0, 0.0))


FAMILY = Family(
    name="ukf",
    title="unscented Kalman filter: points through f and h in place of derivatives",
    build=built_by("nonlinear.unscented:unscented_filter", source=SOURCE),
    proof=proved_by("nonlinear", "UNSCENTED", "JOINT"),
    traits=Traits(nonlinear=True, looks="spread"),
    options=UnscentedOptions,
    starter="starter_ukf.toml",
)
