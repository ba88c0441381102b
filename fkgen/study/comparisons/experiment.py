"""Size and circumstances of a comparison, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

from fkgen.errors import DataError
from fkgen.problem.numbers import probability
from fkgen.trials.simulation import counted


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """Size and circumstances of a comparison.

    Attributes
    ----------
    runs, steps, seed : int
        M trials of T samples.
    skip : int
        Samples at the start of a trial that do not count.
    false_alarm : float
        Of the test of the innovation, for filters that declare nothing themselves.
    u, params, sensor, input, present
        As for `simulate`.
    """

    runs: int = 2000
    steps: int = 200
    seed: int = 0
    skip: int = 50
    false_alarm: float = 0.01
    u: ArrayLike | None = None
    params: Mapping[str, ArrayLike] | None = None
    sensor: ArrayLike | None = None
    input: ArrayLike | None = None
    present: ArrayLike | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that cannot be."""
        counted("runs", self.runs, least=2)
        counted("steps", self.steps)
        if not 0 <= self.skip < self.steps:
            expected = f"from 0 to {self.steps - 1}: some of the {self.steps} samples have to count"
            raise DataError("skip", given=str(self.skip), expected=expected)
        probability("false_alarm", self.false_alarm)
