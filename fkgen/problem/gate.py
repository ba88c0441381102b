"""Options of the linear filters: a gate for innovations, and a lag of estimates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

from fkgen.problem.filter import Options, Traits
from fkgen.problem.model import Model
from fkgen.problem.table.section import Section

GateBy = Literal["row", "sample"]

#: Samples by which an estimate may lag, each of which costs memory and time.
MAX_LAG = 200


@dataclass(frozen=True, slots=True)
class GateOptions(Options):
    """What an innovation may be; with a gate, gains depend on y."""

    gate: float | None = None  # Probability that what is normal passes, in (0, 1); None: all passes
    gate_by: GateBy | None = None  # Row by row, or all rows of a sample together
    lag: int | None = None  # Samples by which a second estimate lags, with hindsight of them

    @classmethod
    def read(cls, section: Section, _: object, __: Model) -> Self:
        """The gate and the lag, if there are any."""
        return cls(*read_gate(section), read_lag(section))

    def adapted(self, traits: Traits) -> Traits:
        """Not linear in y if something is left out."""
        return traits if self.gate is None else replace(traits, linear=False)


def read_gate(section: Section) -> tuple[float | None, GateBy | None]:
    """Probability and mode of a gate."""
    if "gate" not in section:
        if "gate_by" in section:
            expected = "gate = the probability that a normal row passes, such as 0.9999"
            raise section.error("gate", "nothing (the key is missing) beside gate_by", expected)
        return None, None
    expected = "a probability between 0 and 1, both excluded, such as 0.9999"
    gate = section.number("gate", expected, lambda number: 0.0 < number < 1.0)
    return gate, section.choice("gate_by", get_args(GateBy), "row")


def read_lag(section: Section) -> int | None:
    """The samples of a lag."""
    return section.count("lag", 1, MAX_LAG, "samples") if "lag" in section else None
