"""What a filter made of trials: errors and consistency, one number per trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.comparisons.candidates import Told, healthy_modes
from fkgen.study.comparisons.detection import Detection, declared, detection, faulty, tested
from fkgen.symbolic.interface import Status
from fkgen.trials.simulation import Simulation

Array = NDArray[np.float64]

#: Ports that scores need, as far as a filter has them.
PORTS = (
    "filtered_state",
    "filtered_covariance",
    "nis",
    "mode_probability",
    "fault_declared",
    "test_dof",
)
#: A pivot below this share of its variance is the rounding of a zero, per unit of round-off.
_ROUNDED = 512.0


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """One filter over M trials.

    Attributes
    ----------
    squared : (M, n) ndarray
        Mean squared error of every state.
    nees, nis : (M,) ndarray
        Mean normalised squares, per dimension: 1 if the filter is right about itself.
    refused : (M,) ndarray
        Samples that the filter refused.
    detection : (5, M) ndarray
        The fields of a `Detection`; NaN where the filter declares nothing.
    """

    squared: Array
    nees: Array
    nis: Array
    refused: Array
    detection: Array

    @classmethod
    def empty(cls, runs: int, states: int) -> Scores:
        """Room for M trials."""
        each = np.full((3, runs), np.nan)
        return cls(
            np.full((runs, states), np.nan), each[0], each[1], each[2], np.full((5, runs), np.nan)
        )

    @property
    def found(self) -> Detection:
        """Counts of declarations."""
        return Detection(*self.detection)

    def fill(self, start: int, stop: int, part: Scores) -> None:
        """Put the scores of some trials in place."""
        for name in ("squared", "nees", "nis", "refused"):
            getattr(self, name)[start:stop] = getattr(part, name)
        self.detection[:, start:stop] = part.detection


def score(
    compiled: CompiledFilter, given: Told, simulation: Simulation, *, skip: int, limits: Array
) -> Scores:
    """Run a filter over a simulation and compare it with the truth.

    Parameters
    ----------
    compiled : CompiledFilter
    given : Told
        What it is told.
    simulation : Simulation
    skip : int
        Samples at the start that do not count.
    limits : (p + 1,) ndarray
        NIS of 0, 1, ... p rows beyond which a filter without modes declares a fault.
    """
    kept = [name for name in PORTS if name in compiled.ports]
    run = compiled.run_batch(given.y, given.u, given.params, keep=kept)
    error = (simulation.state - run["filtered_state"])[:, skip:].astype(np.float64)
    covariance = run["filtered_covariance"][:, skip:]
    runs, rows = len(error), np.isfinite(given.y[..., list(given.judged)]).sum(axis=2)
    nees = normalised(error, covariance, float(np.finfo(covariance.dtype).eps))
    nis = _nis(run, rows, skip, host=len(given.judged) < given.y.shape[2])
    counts = np.full((5, runs), np.nan)
    faults = faulty(simulation)
    alarms = declared(run, limits[rows], healthy_modes(simulation.spec))
    if faults is not None and alarms is not None:
        found = detection(faults, alarms, skip, tested(run))
        counts = np.array([getattr(found, name) for name in Detection.__slots__])
    refused = run.refused.sum(axis=1).astype(np.float64)
    return Scores((error**2).mean(axis=1), nees, nis, refused, counts)


def _nis(run: Run, rows: NDArray[np.int64], skip: int, *, host: bool) -> Array:
    """Sum over samples that were used, per row that was there; a host always uses its rows."""
    if "nis" not in run.ports:
        return np.full(len(rows), np.nan)
    used = (run.status >= 0 if host else run.status == Status.OK.value)[:, skip:]
    total = (run["nis"][:, skip:] * used).sum(axis=1, dtype=np.float64)
    count = (rows[:, skip:] * used).sum(axis=1)
    return np.asarray(np.divide(total, count, out=np.full(len(rows), np.nan), where=count > 0))


def normalised(error: Array, covariance: NDArray[np.floating], unit: float) -> Array:
    """Mean of e' P^-1 e over its dimensions, per trial: LDL' of all samples at once.

    Directions in which P is zero are left out.

    Parameters
    ----------
    error : (M, T, n) ndarray
    covariance : (M, T, n, n) ndarray
    unit : float
        Unit round-off of the covariance.

    Returns
    -------
    (M,) ndarray
        NaN where no direction is left.
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
    total, count = total.sum(axis=1), dimensions.sum(axis=1)
    return np.asarray(np.divide(total, count, out=np.full(len(e), np.nan), where=count > 0.0))
