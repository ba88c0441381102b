"""Iterated extended Kalman filter: the update goes on to the most probable state.

Gauss and Newton's steps, each taken where it lowers the cost (Bell & Cathey 1993); time passes as
in ekf.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from fkgen.families.family import Family, built_by, proved_by
from fkgen.problem import Model, Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.filter import Options, Traits
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

SOURCE = "Jazwinski 1970, sec. 8.3; steps that lower the cost: Bell & Cathey 1993"

#: Gains that a sample may cost.
LARGEST = 20


@dataclass(frozen=True, slots=True)
class IteratedOptions(Options):
    """How often h is linearised."""

    iterations: int = 3

    @classmethod
    def read(cls, section: Section, _: object, __: Model) -> Self:
        """The number of gains."""
        return cls(section.count("iterations", 3, LARGEST, "gains"))


def check(spec: Spec) -> None:
    """Refuse a singular R, by whose inverse the cost weighs the rows."""
    if is_singular(spec.model.R.values(spec.defaults)):
        expected = "a positive definite R for the family iekf: its cost is r' R^-1 r; take ekf"
        raise Place(spec.file).entry("model").entry("R").error("a singular matrix", expected)


FAMILY = Family(
    name="iekf",
    title="iterated extended Kalman filter: the most probable state given y, by Gauss-Newton steps",
    build=built_by("nonlinear.iterated:iterated_filter", source=SOURCE),
    proof=proved_by("nonlinear", "ITERATED", "JOINT"),
    traits=Traits(nonlinear=True, looks="anew"),
    options=IteratedOptions,
    check=check,
    starter="starter_iekf.toml",
)
