"""Tests whether a sample holds a signal: statistic and threshold, and what follows from a verdict.

A loss is declared when the statistic exceeds the threshold; a tie is no loss, and a sample without
a row is no test. Rejections in a row are counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca
from scipy.special import gammainccinv

from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.models.weights import LOG_ZERO, logarithm_of
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Outcome, Port, Status
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.linalg import column, diagonal, total
from fkgen.symbolic.ports import PARAMETER, carried, shown

#: Between two whole numbers.
HALF = 0.5

_ABSENT = "; 0 if no row is present"
_MEANING = {
    "llr": "log of Pr(lost | y[0..k]) over Pr(arrived | y[0..k])",
    "nis": "normalised innovation squared",
    "energy": "mean of |innovation|^2 over the window",
}
_BOUND = {
    "llr": "0",
    "nis": f"chi-square quantile at 1 - alpha{_ABSENT}",
    "energy": f"kappa times what is expected of it{_ABSENT}",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a test says."""

    excess: ca.SX  # positive if a loss is declared; to be asked where a row is present
    locked: ca.SX  # positive if so many samples were rejected in a row, this one among them
    results: dict[str, ca.SX]  # values of the ports


def judges(spec: Spec) -> bool:
    """Whether a test decides which samples are lost."""
    return spec.faults.jump is not None and spec.filter.options.detector != "none"


def loss_ports(spec: Spec) -> tuple[Port, ...]:
    """What a detector shows; nothing without one."""
    if not judges(spec):
        return ()
    detector, window = spec.filter.options.detector, spec.filter.options.window
    ports = [
        shown("fault_declared", (), f"1 if sample k was rejected as lost, else 0{_ABSENT}"),
        shown("test_statistic", (), f"{_MEANING[detector]}{_ABSENT}"),
        shown("test_threshold", (), _BOUND[detector]),
        shown("test_dof", (), "rows of y that were tested"),
        carried("consecutive_rejections", (), "samples rejected in a row, up to k"),
    ]
    if detector == "energy" and window > 1:
        past = "|innovation|^2 of the last samples with a row, newest first"
        ports += [
            carried("energy_window", (window - 1,), past),
            carried("energy_count", (), "how many of them there are"),
        ]
    return tuple(ports)


def loss_outcomes(spec: Spec) -> tuple[Outcome, ...]:
    """Statuses of rejected samples."""
    if not judges(spec):
        return ()
    return (
        Outcome(Status.LOCKED_OUT, "consecutive_rejections", spec.filter.options.lock_out - HALF),
        Outcome(Status.FAULT_DECLARED, "fault_declared", HALF),
    )


class LossTest:
    """Writes the blocks of a test; the options of the spec are detector and thresholds."""

    def __init__(self, builder: PhaseBuilder, spec: Spec) -> None:
        self.builder, self.spec, self.options = builder, spec, spec.filter.options

    def verdict(self, found: Conditioned, measurement: Measurement, noise: ca.SX) -> Verdict:
        """Judge a sample from its innovation, as ``measurement`` and the noise alone explain it."""
        results: dict[str, ca.SX] = {}
        count = self._rows()
        with self.builder.titled(f"test for a loss: {self.options.detector}"):
            match self.options.detector:
                case "nis":
                    statistic, threshold = found.nis, self._quantile(count)
                case "energy":
                    statistic, threshold, results = self._energy(found)
                case _:
                    statistic, threshold = self._log_odds(found, measurement, noise), ca.SX(0)
            statistic = self._chosen("statistic", 0.0, (None, statistic))
            threshold = self._chosen("threshold", 0.0, (None, threshold))
            excess = statistic - threshold
            declared = self._chosen("declared", 0.0, (excess, ca.SX(1)))
            rejections = self._count(excess)
            locked = ca.fmin(self._locked(rejections), excess)
            if "energy_window" in results and self.options.reinitialise:  # empty after a new start
                kept, none = ca.vertcat(*results.values()), ca.SX.zeros(self.options.window)
                results = _window(self._chosen("energies_kept", kept, (locked, none)))
        results |= {
            "fault_declared": declared,
            "test_statistic": statistic,
            "test_threshold": threshold,
            "test_dof": count,
            "consecutive_rejections": rejections,
        }
        return Verdict(excess, locked, results)

    def _chosen(self, name: str, first: float | ca.SX, *cases: tuple[ca.SX | None, ca.SX]) -> ca.SX:
        """A variable: the first value, then those whose condition is positive or None.

        Conditions count where a row is present.
        """
        if isinstance(first, float):
            symbol = self.builder.local(name, 1, initial=first)
        else:
            symbol = self.builder.local(name, first.numel())
            self.builder.assign({name: first})
        for positive, value in cases:
            with self.builder.if_present(None, positive):
                self.builder.assign({name: value})
        return symbol

    def _locked(self, rejections: ca.SX) -> ca.SX:
        """Positive if so many samples were rejected in a row that the filter is locked out."""
        limit: int = self.options.lock_out
        return rejections - (limit - HALF)

    def _rows(self) -> ca.SX:
        """How many rows are present."""
        count = self.builder.local("rows_present", 1, initial=0.0)
        for i in range(self.spec.model.ny):
            with self.builder.if_present(i):
                self.builder.assign({"rows_present": count + 1})
        return count

    def _quantile(self, count: ca.SX) -> ca.SX:
        """Chi-square quantile for as many rows as are present."""
        rows = range(1, self.spec.model.ny + 1)
        first, *others = (2.0 * float(gammainccinv(HALF * m, self.options.alpha)) for m in rows)
        if not others:
            return ca.SX(first)
        cases = ((count - (m - HALF), ca.SX(bound)) for m, bound in enumerate(others, 2))
        return self._chosen("quantile", first, *cases)

    def _energy(self, found: Conditioned) -> tuple[ca.SX, ca.SX, dict[str, ca.SX]]:
        """Mean square over the window, what it is expected to be, and the window moved on."""
        builder = self.builder
        energy, expected = (builder.local(name, 1, initial=0.0) for name in ("energy", "expected"))
        for i, variance in enumerate(diagonal(found.innovation_covariance)):
            square = found.innovation[i] * found.innovation[i]
            with builder.if_present(i):
                builder.assign({"energy": energy + square, "expected": expected + variance})
        threshold, window = self.options.kappa * expected, self.options.window
        if window == 1:
            return energy, threshold, {}
        past, count = builder.symbol("energy_window"), builder.symbol("energy_count")
        # Places that are not filled yet hold 0.
        mean = (energy + total([past[i] for i in range(window - 1)])) / (count + 1)
        older = [past[i] for i in range(window - 2)]
        moved = column([energy, *older, ca.fmin(count + 1, window - 1)])
        held = self._chosen("energies_held", ca.vertcat(past, count), (None, moved))
        return mean, threshold, _window(held)

    def _log_odds(self, found: Conditioned, measurement: Measurement, noise: ca.SX) -> ca.SX:
        """Log of the odds of a loss: both hypotheses are tested, noise alone and signal."""
        faults = self.spec.faults.jump
        rate = faults.arrival_rate if faults else None
        log_zero = LOG_ZERO[self.spec.code.scalar]
        varying = faults.rate if faults else None
        if varying is None and rate == 1.0:
            return ca.SX(log_zero)
        if rate is None or (varying is None and not rate):
            return ca.SX(-log_zero)
        none = ca.SX(measurement.C.shape[0], 1)
        alone = replace(measurement, C=none, offset=none, R=noise, rank_tolerance=None)
        nothing = (ca.SX(1, 1), ca.SX(1, 1))
        lost = condition(self.builder, nothing, alone, tag="_lost", form="short")
        if varying is not None:
            scalar, names = self.spec.code.scalar, [each.name for each in self.spec.parameters]
            given = {name: self.builder.symbol(PARAMETER + name) for name in names}
            chance = lift_expression(varying, given)
            prior = logarithm_of(1 - chance, scalar) - logarithm_of(chance, scalar)
        else:
            prior = ca.SX(math.log1p(-rate) - math.log(rate))
        return prior + lost.log_likelihood - found.log_likelihood

    def _count(self, excess: ca.SX) -> ca.SX:
        """Rejections in a row; a sample without a row changes nothing."""
        before = self.builder.symbol("consecutive_rejections")
        cases = [(None, ca.SX(0)), (excess, before + 1)]
        if self.options.reinitialise:  # the run before ended when the filter started again
            cases.append((ca.fmin(self._locked(before), excess), ca.SX(1)))
        return self._chosen("rejections", before, *cases)


def _window(held: ca.SX) -> dict[str, ca.SX]:
    """The energies of the last samples, and how many they are."""
    return {"energy_window": held[:-1], "energy_count": held[-1]}
