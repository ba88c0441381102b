"""What a filter made of trials: errors and consistency, one number per trial."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.comparisons.candidates import FilterInputs
from fkgen.study.comparisons.detection import Detection, declared, detection, faulty, tested
from fkgen.symbolic.interface import Status
from fkgen.trials.simulation import Simulation

Array = NDArray[np.float64]

#: Ports that scores need, as far as a filter has them.
PORTS = (
    *("filtered_state", "filtered_covariance", "nis"),
    *("mode_probability", "fault_declared", "test_dof"),
)
#: A pivot below this share of its variance is the rounding of a zero, per unit of round-off.
_ROUNDED = 512.0


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """One filter over M trials."""

    squared: Array  # (M, n), mean squared error of every state
    nees: Array  # (M,), mean normalised square of the error per dimension: 1 if P is right
    nis: Array  # (M,), the same of the innovation
    refused: Array  # (M,), samples that the filter refused
    detection: Array  # (M, 5), the fields of a `Detection`; NaN where it declares nothing

    @classmethod
    def joined(cls, parts: list[Scores]) -> Scores:
        """The scores of all trials from those of some after the others."""
        of_each = [[getattr(part, field.name) for part in parts] for field in fields(cls)]
        return cls(*(np.concatenate(each) for each in of_each))

    @property
    def found(self) -> Detection:
        """Counts of declarations."""
        return Detection(*self.detection.T)


def score(
    compiled: CompiledFilter,
    given: FilterInputs,
    simulation: Simulation,
    *,
    skip: int,
    limits: Array,
) -> Scores:
    """Run a filter over a simulation and compare it with the truth, from sample ``skip`` on.

    A filter without modes declares a fault where the NIS of 0, 1, ... p rows is above ``limits``.
    """
    kept = [name for name in PORTS if name in compiled.ports]
    run = compiled.run_batch(given.y, given.u, given.params, keep=kept)
    error = (simulation.state - run["filtered_state"])[:, skip:].astype(np.float64)
    covariance = run["filtered_covariance"][:, skip:]
    runs, rows = len(error), np.isfinite(given.y[..., list(given.tested)]).sum(axis=2)
    nees = normalised(error, covariance, float(np.finfo(covariance.dtype).eps))
    nis = _nis(run, rows, skip, host=len(given.tested) < given.y.shape[2])
    jump = simulation.spec.faults.jump
    counts = np.full((runs, 5), np.nan)
    faults = faulty(simulation)
    alarms = declared(run, limits[rows], 1 if jump is None else len(jump.modes))
    if faults is not None and alarms is not None:
        counts = np.stack(astuple(detection(faults, alarms, skip, tested(run))), axis=1)
    refused = run.refused.sum(axis=1).astype(np.float64)
    return Scores((error**2).mean(axis=1), nees, nis, refused, counts)


def _nis(run: Run, rows: NDArray[np.int64], skip: int, *, host: bool) -> Array:
    """Sum over samples that were used, per row that was there; a host always uses its rows."""
    if "nis" not in run.ports:
        return np.full(len(rows), np.nan)
    used = (run.status >= 0 if host else run.status == Status.OK.value)[:, skip:]
    total = (run["nis"][:, skip:] * used).sum(axis=1, dtype=np.float64)
    return _over(total, (rows[:, skip:] * used).sum(axis=1))


def normalised(error: Array, covariance: NDArray[np.floating], unit: float) -> Array:
    """Mean of e' P^-1 e over its dimensions, (M,), of (M, T, n) errors: LDL' of all at once.

    Directions in which P (M, T, n, n), of this unit round-off, is zero are left out; NaN where none
    is left.
    """
    n = error.shape[2]
    left = covariance.astype(np.float64)
    e = error.copy()
    total, dimensions = np.zeros(e.shape[:2]), np.zeros(e.shape[:2])
    for j in range(n):
        pivot = left[..., j, j].copy()
        there = pivot > _ROUNDED * unit * covariance[..., j, j]
        inverse = np.divide(1.0, pivot, out=np.zeros_like(pivot), where=there)
        total += e[..., j] ** 2 * inverse
        dimensions += there
        for i in range(j + 1, n):
            share = left[..., i, j] * inverse
            e[..., i] -= share * e[..., j]
            left[..., i, j + 1 :] -= share[..., None] * left[..., j, j + 1 :]
    return _over(total.sum(axis=1), dimensions.sum(axis=1))


def _over(total: Array, count: NDArray[np.number]) -> Array:
    """Means; NaN where nothing was counted."""
    return np.asarray(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0))
