"""What a filter made of trials: errors, consistency, faults noticed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.comparisons.candidates import FilterInputs
from fkgen.symbolic.interface import Status
from fkgen.trials.errors import errors_of
from fkgen.trials.simulation import Simulation

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Ports that scores need, as far as a filter has them.
_VERDICTS = ("mode_probability", "fault_declared", "test_dof")
PORTS = ("filtered_state", "filtered_covariance", "nis", *_VERDICTS)
#: A pivot below this share of its variance is the rounding of a zero, per unit of round-off.
ROUNDED = 512.0
TINY = float(np.finfo(float).tiny)  # of a smaller pivot there is no inverse
#: A sensor is declared faulty when it is more probably so than not.
_DECIDED = 0.5


class Detection(NamedTuple):
    """Counts per trial, (M,) each."""

    healthy: Array  # samples without fault
    alarms: Array  # and those of them that were declared faulty
    onsets: Array  # faults that set in
    found: Array  # and those that were declared before they ended
    waited: Array  # samples between onset and declaration, summed over those found


class Scores(NamedTuple):
    """One filter over M trials."""

    squared: Array  # (M, ne), mean squared error of every state, of an attitude by axes
    nees: Array  # (M,), mean normalised square of the error per dimension: 1 if P is right
    nis: Array  # (M,), the same of the innovation
    refused: Array  # (M,), samples that the filter refused
    detection: Array  # (M, 5), the fields of a `Detection`; NaN where it declares nothing


class Outcome(NamedTuple):
    """A filter over M trials next to the truth, from some sample on."""

    run: Run  # of all samples, as the rest is but for the first two
    error: Array  # (M, T, ne)
    covariance: NDArray[np.floating]  # (M, T, ne, ne)
    rows: NDArray[np.int64]  # (M, T), rows of y that are there, of those that are tested
    used: Flags  # (M, T), samples whose innovation counts
    faults: Flags | None  # (M, T); None where there is nothing to detect
    alarms: Flags | None  # (M, T); None where nothing is declared
    decided: Flags | None  # (M, T), samples at which something is declared or not; None is all


def score(
    compiled: CompiledFilter, given: FilterInputs, drawn: Simulation, skip: int, false_alarm: float
) -> Scores:
    """Run a filter over a simulation and compare it with the truth, from sample ``skip`` on.

    A filter without modes declares a fault by a test of the NIS with this false alarm rate.
    """
    found = outcome(compiled, given, drawn, false_alarm, skip=skip)
    unit = float(np.finfo(found.covariance.dtype).eps)
    nees = _over(*weighted_squares(found.error, found.covariance, unit))
    counts = np.full((len(nees), 5), np.nan)
    if found.faults is not None and found.alarms is not None:
        counts = np.stack(detection(found.faults, found.alarms, skip, found.decided), axis=1)
    refused = found.run.refused.sum(axis=1).astype(np.float64)
    return Scores((found.error**2).mean(axis=1), nees, _nis(found, skip), refused, counts)


def outcome(
    compiled: CompiledFilter,
    given: FilterInputs,
    drawn: Simulation,
    false_alarm: float,
    *,
    skip: int = 0,
    more: Sequence[str] = (),
) -> Outcome:
    """What `score` looks at; the run has ``more`` ports than those that scores need."""
    from scipy.special import gammainccinv  # noqa: PLC0415 - scipy.stats would take a second

    kept = [name for name in (*PORTS, *more) if name in compiled.ports]
    run = compiled.run_batch(given.y, given.u, given.params, keep=kept)
    states = drawn.spec.model.states
    error = errors_of(states, drawn.state[:, skip:], run["filtered_state"][:, skip:])
    rows = np.isfinite(given.y[..., list(given.tested)]).sum(axis=2)
    host = len(given.tested) < given.y.shape[2]  # which always uses its rows
    used = run.status >= 0 if host else run.status == Status.OK.value
    half = 0.5 * np.arange(1, given.y.shape[2] + 1)
    limits = np.array([np.inf, *(2.0 * gammainccinv(half, false_alarm))])  # of 0, 1, ... rows
    faults, jump = _faulty(drawn), drawn.spec.faults.jump
    alarms = decided = None
    if faults is not None:
        alarms = _declared(run, limits, rows, 1 if jump is None else len(jump.modes))
        decided = _positive(run, "test_dof")  # a filter with windows decides at their ends
    covariance = run["filtered_covariance"][:, skip:]
    return Outcome(run, error, covariance, rows, used, faults, alarms, decided)


def _nis(found: Outcome, skip: int) -> Array:
    """Sum over samples that were used, per row that was there."""
    if "nis" not in found.run.ports:
        return np.full(len(found.rows), np.nan)
    used = found.used[:, skip:]
    total = (found.run["nis"][:, skip:] * used).sum(axis=1, dtype=np.float64)
    return _over(total, (found.rows[:, skip:] * used).sum(axis=1))


def weighted_squares(
    error: Array, covariance: NDArray[np.floating], unit: float
) -> tuple[Array, Array]:
    """Sums of e' P^-1 e and of its dimensions, (M,), of (M, T, n) errors: LDL' of all at once.

    Directions in which P (M, T, n, n), of this unit round-off, is zero are left out.
    """
    left, e = covariance.astype(np.float64), error.copy()
    total, dimensions = np.zeros(e.shape[:2]), np.zeros(e.shape[:2])
    for j in range(e.shape[2]):
        pivot = left[..., j, j].copy()
        there = pivot > np.maximum(ROUNDED * unit * covariance[..., j, j], TINY)
        inverse = np.divide(1.0, pivot, out=np.zeros_like(pivot), where=there)
        total += e[..., j] ** 2 * inverse
        dimensions += there
        share, below = left[..., j + 1 :, j] * inverse[..., None], left[..., j, None, j + 1 :]
        e[..., j + 1 :] -= share * e[..., j, None]
        left[..., j + 1 :, j + 1 :] -= share[..., None] * below
    return total.sum(axis=1), dimensions.sum(axis=1)


def _over(total: Array, count: NDArray[np.number]) -> Array:
    """Means; NaN where nothing was counted."""
    return np.asarray(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0))


def _faulty(simulation: Simulation) -> Flags | None:
    """(M, T): samples whose measurement is struck by a fault; None if that is not for a detector.

    Actuators that fail at random and modes of the plant act on the state: no sample is good or bad
    by itself.
    """
    if simulation.spec.faults.sensor is not None:
        return np.asarray(simulation.mode != 0)
    if simulation.arrival is not None:
        return ~simulation.arrival
    if simulation.gamma is not None or simulation.mode is not None:
        return None
    clean = simulation.trials.measurement
    return np.asarray(((simulation.y != clean) & np.isfinite(clean)).any(axis=2))


def _declared(run: Run, limits: Array, rows: NDArray[np.int64], healthy: int) -> Flags | None:
    """(M, T): samples that a filter declares faulty: by its verdict, its modes, or its NIS.

    ``limits`` are those of the NIS by number of rows; the first ``healthy`` modes are those without
    fault.
    """
    if "fault_declared" in run.ports:
        return _positive(run, "fault_declared")
    if "mode_probability" in run.ports:
        return np.asarray(run["mode_probability"][..., :healthy].sum(axis=2) < _DECIDED)
    return np.asarray(run["nis"] > limits[rows]) if "nis" in run.ports else None


def _positive(run: Run, name: str) -> Flags | None:
    """(M, T): whether a port is positive, for any group of rows; None if there is no such port."""
    if name not in run.ports:
        return None
    return np.asarray((run[name] > 0.0).reshape(*run.status.shape, -1).any(axis=2))


def detection(faults: Flags, alarms: Flags, skip: int, decided: Flags | None = None) -> Detection:
    """Count what was declared rightly and wrongly, from sample ``skip`` on; flags are (M, T).

    Of the samples without fault those count at which something is ``decided``; all by default.
    """
    faults, alarms = faults[:, skip:], alarms[:, skip:]
    next_declared, end = _next(alarms), _next(~faults)
    onset = faults & np.diff(faults, axis=1, prepend=True)  # the first may have set in before
    found = onset & (next_declared < end)
    wait = np.where(found, next_declared - np.arange(faults.shape[1]), 0)
    healthy = ~faults if decided is None else ~faults & decided[:, skip:]
    counts = (healthy, healthy & alarms, onset, found, wait)
    return Detection(*(each.sum(axis=1).astype(np.float64) for each in counts))


def _next(flags: Flags) -> NDArray[np.int64]:
    """Index of the first flag at or after each sample; the number of samples if there is none."""
    steps = flags.shape[1]
    index = np.where(flags, np.arange(steps), steps)
    return np.asarray(np.minimum.accumulate(index[:, ::-1], axis=1)[:, ::-1])
