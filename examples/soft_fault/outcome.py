"""What one filter did to all runs: errors and reported deviations by the second, verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import simulation as sim
from simulation import Floats

import fkgen


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def __format__(self, form: str) -> str:
        return f"{self.value:{form or '.3f'}} +- {self.error:{form or '.3f'}}"

    @property
    def z(self) -> float:
        """The number in units of its standard error."""
        return self.value / self.error if self.error else 0.0


def mean(each: Floats) -> Estimate:
    """Mean over runs (M,)."""
    return Estimate(float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))))


def rate(flags: Floats) -> Estimate:
    """Share of ones, with the error of a binomial."""
    p = float(np.mean(flags))
    return Estimate(p, float(np.sqrt(p * (1.0 - p) / np.size(flags))))


@dataclass(frozen=True)
class Outcome:
    """One filter over all runs, at whole seconds.

    Attributes
    ----------
    error : (M, S) ndarray
        Position minus its estimate after everything at that second, m.
    variance : (M, S) ndarray
        What the filter reports of it.
    statistic, dof, declared : (M, S) ndarray
        Of the tests; dof 0 where none is made.
    """

    error: Floats
    variance: Floats
    statistic: Floats
    dof: Floats
    declared: Floats

    @classmethod
    def of(cls, compiled: fkgen.CompiledFilter, runs: sim.Runs) -> Outcome:
        """Filter runs in C."""
        tests = ("test_statistic", "test_dof", "fault_declared")
        found = compiled.run_batch(
            runs.measured,
            keep=[
                name
                for name in ("filtered_state", "filtered_covariance", *tests)
                if name in compiled.ports
            ],
        )
        seconds = slice(None, None, sim.EVERY)
        error = (runs.state - found.filtered_state)[:, seconds, 0]
        nothing = np.zeros(error.shape, np.float32)
        verdicts = [found[n][:, seconds] if n in found.ports else nothing for n in tests]
        variance = found.filtered_covariance[:, seconds, 0, 0]
        return cls(*(np.asarray(v, np.float32) for v in (error, variance, *verdicts)))

    @classmethod
    def together(cls, parts: Sequence[Outcome]) -> Outcome:
        """All batches as one."""
        names = cls.__dataclass_fields__
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def actual(self, second: int) -> Estimate:
        """One-sigma about the truth at this second: root mean square, m."""
        square = mean(self.error[:, second].astype(float) ** 2)
        root = np.sqrt(square.value)
        return Estimate(float(root), square.error / (2.0 * float(root)))

    def reported(self, second: int) -> float:
        """One-sigma that the filter reports: root of its mean variance, m."""
        return float(np.sqrt(self.variance[:, second].mean(dtype=float)))

    def over_time(self) -> tuple[Floats, Floats]:
        """(S,), (S,): actual and reported one-sigma."""
        square = (self.error.astype(float) ** 2).mean(axis=0)
        return np.sqrt(square), np.sqrt(self.variance.mean(axis=0, dtype=float))

    def rejected(self, seconds: Sequence[int] | slice) -> Estimate:
        """Rate of rejections among the tests made at these seconds."""
        made = self.dof[:, seconds] > 0.0
        return rate(self.declared[:, seconds][made])

    def detected_by(self, second: int) -> Estimate:
        """Share of runs with a rejection between the fault and this second."""
        flags = self.declared[:, sim.FAULT + 1 : second + 1].any(axis=1)
        return rate(flags.astype(float))
