"""Kalman filter: the family without faults, which the others are compared with.

One step corrects the prediction for sample k with y[k] and predicts sample k + 1 (Anderson & Moore
1979, sec. 3.1), with missing rows left out and time-varying models through run-time parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Self, get_args

from fkgen.families.family import Family, built_by, demand_stationary, proved_by
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Traits
from fkgen.problem.gate import GateOptions, read_gate, read_lag
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

if TYPE_CHECKING:
    from fkgen.symbolic.recursion import Recursion

Gain = Literal["time_varying", "stationary"]

SOURCE = "Anderson & Moore 1979, Optimal Filtering, sec. 3.1 and 6.5"
CONSTANT = "Anderson & Moore 1979, Optimal Filtering, sec. 4.4"


@dataclass(frozen=True, slots=True)
class KalmanOptions(GateOptions):
    """A gate, and a gain that follows the covariance (None) or is that of the steady state."""

    gain: Literal["stationary"] | None = None

    @classmethod
    def read(cls, section: Section, _: object, __: Model) -> Self:
        """The gate, and the gain."""
        gain: Gain = section.choice("gain", get_args(Gain), "time_varying")
        stationary: Literal["stationary"] | None = "stationary" if gain == "stationary" else None
        return cls(*read_gate(section), read_lag(section), stationary)

    def adapted(self, traits: Traits) -> Traits:
        """Not optimal for the samples of a record if the gain is that of the steady state."""
        varying = self.gain is None
        linear = traits.linear and varying and self.gate is None
        return replace(traits, linear=linear, hindsight=varying)


def build(spec: Spec) -> Recursion:
    """Build the filter with the gain that the spec asks for."""
    if spec.filter.option("gain", None) == "stationary":
        return built_by("lmmse.constant_gain:constant_gain_filter", source=CONSTANT)(spec)
    return built_by("lmmse.kalman:linear_filter", source=SOURCE, with_gain=False)(spec)


def check(spec: Spec) -> None:
    """Refuse a stationary gain that does not exist."""
    if spec.filter.option("gain", None) != "stationary":
        return
    at, model = Place(spec.file).entry("filter").entry("gain"), spec.model
    for letter in "ACQRS":
        if not getattr(model, letter).is_constant:
            moving = ", ".join(sorted(getattr(model, letter).names))
            raise at.error(
                f"'stationary' with a model.{letter} that depends on {moving}",
                "constant A, C, Q, R and S; use gain = 'time_varying'",
            )
    demand_stationary(at, *(getattr(model, letter).values() for letter in "ACQRS"))


FAMILY = Family(
    name="kf",
    title="Kalman filter, no faults: missing samples, time-varying models",
    build=build,
    proof=proved_by(
        "gaussian",
        "BATCH",
        "LAGGED",
        "RICCATI",
        "CONSTANT_GAIN",
        theorems="gaussian:GAUSSIAN_IDENTITIES",
    ),
    traits=Traits(linear=True, exact=True, correlated=True, hindsight=True),
    options=KalmanOptions,
    check=check,
    starter="starter_kf.toml",
)
