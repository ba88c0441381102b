"""Tests whether a sample holds a signal: statistic and threshold, and what follows from a verdict.

A loss is declared when the statistic exceeds the threshold; a tie is no loss, and a sample without
a row is no test. Rejections in a row are counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca
from scipy.special import gammainccinv

from fkgen.estimators.gaussian.conditioning import Conditioned, condition
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.models.weights import LOG_ZERO
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Outcome, Port, Status
from fkgen.symbolic.linalg import column, diagonal, total
from fkgen.symbolic.ports import carried, shown

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

    def __init__(self, script: Script, spec: Spec) -> None:
        self.script, self.spec, self.options = script, spec, spec.filter.options

    def verdict(self, found: Conditioned, measurement: Measurement, noise: ca.SX) -> Verdict:
        """Judge a sample from its innovation, as ``measurement`` and the noise alone explain it."""
        results: dict[str, ca.SX] = {}
        count = self._rows()
        with self.script.titled(f"test for a loss: {self.options.detector}"):
            match self.options.detector:
                case "nis":
                    statistic, threshold = found.nis, self._quantile(count)
                case "energy":
                    statistic, threshold, results = self._energy(found)
                case _:
                    statistic, threshold = self._log_odds(found, measurement, noise), ca.SX(0)
            statistic = self._present("statistic", statistic)
            threshold = self._present("threshold", threshold)
            excess = statistic - threshold
            declared = self.script.local("declared", 1, initial=0.0)
            with self.script.when(None, excess):
                self.script.put({"declared": ca.SX(1)})
            rejections = self._count(excess)
            locked = ca.fmin(self._locked(rejections), excess)
            if "energy_window" in results and self.options.reinitialise:
                results = self._forgotten(results, locked)
        results |= {
            "fault_declared": declared,
            "test_statistic": statistic,
            "test_threshold": threshold,
            "test_dof": count,
            "consecutive_rejections": rejections,
        }
        return Verdict(excess, locked, results)

    def _locked(self, rejections: ca.SX) -> ca.SX:
        """Positive if so many samples were rejected in a row that the filter is locked out."""
        limit: int = self.options.lock_out
        return rejections - (limit - HALF)

    def _present(self, name: str, value: ca.SX) -> ca.SX:
        """The value, or 0 if no row is present."""
        symbol = self.script.local(name, 1, initial=0.0)
        with self.script.when(None):
            self.script.put({name: value})
        return symbol

    def _rows(self) -> ca.SX:
        """How many rows are present."""
        count = self.script.local("rows_present", 1, initial=0.0)
        for i in range(self.spec.model.ny):
            with self.script.when(i):
                self.script.put({"rows_present": count + 1})
        return count

    def _quantile(self, count: ca.SX) -> ca.SX:
        """Chi-square quantile for as many rows as are present."""
        p, script = self.spec.model.ny, self.script
        bounds = [2.0 * float(gammainccinv(HALF * m, self.options.alpha)) for m in range(1, p + 1)]
        if p == 1:
            return ca.SX(bounds[0])
        quantile = script.local("quantile", 1, initial=bounds[0])
        for m in range(2, p + 1):
            with script.when(None, count - (m - HALF)):
                script.put({"quantile": ca.SX(bounds[m - 1])})
        return quantile

    def _energy(self, found: Conditioned) -> tuple[ca.SX, ca.SX, dict[str, ca.SX]]:
        """Mean square over the window, what it is expected to be, and the window moved on."""
        script = self.script
        energy, expected = (script.local(name, 1, initial=0.0) for name in ("energy", "expected"))
        for i, variance in enumerate(diagonal(found.innovation_covariance, self.spec.model.ny)):
            with script.when(i):
                script.put(
                    {
                        "energy": energy + found.innovation[i] * found.innovation[i],
                        "expected": expected + variance,
                    }
                )
        threshold, window = self.options.kappa * expected, self.options.window
        if window == 1:
            return energy, threshold, {}
        past, count = script.symbol("energy_window"), script.symbol("energy_count")
        # Places that are not filled yet hold 0.
        mean = (energy + total([past[i] for i in range(window - 1)])) / (count + 1)
        held = script.local("energies_held", window)
        script.put({"energies_held": ca.vertcat(past, count)})
        with script.when(None):
            older = [past[i] for i in range(window - 2)]
            script.put({"energies_held": column([energy, *older, ca.fmin(count + 1, window - 1)])})
        return mean, threshold, {"energy_window": held[:-1], "energy_count": held[-1]}

    def _forgotten(self, results: dict[str, ca.SX], restarted: ca.SX) -> dict[str, ca.SX]:
        """An empty window after a new start."""
        held = self.script.local("energies_kept", self.options.window)
        self.script.put({"energies_kept": ca.vertcat(*results.values())})
        with self.script.when(None, restarted):
            self.script.put({"energies_kept": ca.SX.zeros(self.options.window)})
        return dict(zip(results, (held[:-1], held[-1]), strict=True))

    def _log_odds(self, found: Conditioned, measurement: Measurement, noise: ca.SX) -> ca.SX:
        """Log of the odds of a loss: both hypotheses are tested, noise alone and signal."""
        rate = self.spec.faults.jump.arrival_rate if self.spec.faults.jump else None
        log_zero = LOG_ZERO[self.spec.code.scalar]
        if not rate:
            return ca.SX(-log_zero)
        if rate == 1.0:
            return ca.SX(log_zero)
        none = ca.SX(measurement.C.shape[0], 1)
        alone = replace(measurement, C=none, offset=none, R=noise, rank_tolerance=None)
        nothing = (ca.SX(1, 1), ca.SX(1, 1))
        lost = condition(self.script, nothing, alone, tag="_lost", form="short")
        prior = math.log1p(-rate) - math.log(rate)
        return prior + lost.log_likelihood - found.log_likelihood

    def _count(self, excess: ca.SX) -> ca.SX:
        """Rejections in a row; a sample without a row changes nothing."""
        script, before = self.script, self.script.symbol("consecutive_rejections")
        rejections = script.local("rejections", 1)
        script.put({"rejections": before})
        with script.when(None):
            script.put({"rejections": ca.SX(0)})
        with script.when(None, excess):
            script.put({"rejections": before + 1})
        if self.options.reinitialise:  # the run before ended when the filter started again
            again = self._locked(before)
            with script.when(None, ca.fmin(again, excess)):
                script.put({"rejections": ca.SX(1)})
        return rejections
