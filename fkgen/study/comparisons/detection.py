"""How well a filter notices faults: shares of samples, and delays after an onset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.results import Run
from fkgen.trials.simulation import Simulation

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A sensor is declared faulty when it is more probably so than not.
DECIDED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """Counts per trial, (M,) each.

    Attributes
    ----------
    healthy, alarms : ndarray
        Samples without fault, and those of them that were declared faulty.
    onsets, found : ndarray
        Faults that set in, and those that were declared before they ended.
    waited : ndarray
        Samples between onset and declaration, summed over those found.
    """

    healthy: Array
    alarms: Array
    onsets: Array
    found: Array
    waited: Array


def faulty(simulation: Simulation) -> Flags | None:
    """(M, T): samples whose measurement is struck by a fault; None if that is not for a detector.

    Actuators that fail at random and modes of the plant act on the state: no sample is good or bad
    by itself.
    """
    if simulation.delta is not None:
        return np.asarray(simulation.mode != 0)
    if simulation.arrival is not None:
        return ~simulation.arrival
    if simulation.gamma is not None or simulation.mode is not None:
        return None
    clean = simulation.trials.measurement
    return np.asarray(((simulation.y != clean) & np.isfinite(clean)).any(axis=2))


def declared(run: Run, limits: Array, healthy: int) -> Flags | None:
    """(M, T): samples that a filter declares faulty: by its modes, or by a test of its innovation.

    Parameters
    ----------
    run : Run
        With ``mode_probability`` of a sensor, or ``nis``.
    limits : (M, T) ndarray
        Of the NIS.
    healthy : int
        The first so many modes are those without fault.
    """
    if "fault_declared" in run.ports:  # one verdict, or one per group of rows
        verdict = run["fault_declared"] > 0.0
        return np.asarray(verdict if verdict.ndim == 2 else verdict.any(axis=2))
    if "mode_probability" in run.ports:
        return np.asarray(run["mode_probability"][..., :healthy].sum(axis=2) < DECIDED)
    return np.asarray(run["nis"] > limits) if "nis" in run.ports else None


def tested(run: Run) -> Flags | None:
    """(M, T): samples at which a filter decides, if that is not every sample."""
    if "test_dof" not in run.ports:
        return None
    freedom = run["test_dof"] > 0.0
    return np.asarray(freedom if freedom.ndim == 2 else freedom.any(axis=2))


def detection(
    faults: Flags, declarations: Flags, skip: int, decided: Flags | None = None
) -> Detection:
    """Count what was declared rightly and wrongly, from sample ``skip`` on.

    Parameters
    ----------
    faults, declarations : (M, T) ndarray of bool
    skip : int
    decided : (M, T) ndarray of bool, optional
        Samples without fault that count: those at which something is decided. All by default.
    """
    faults, declarations = faults[:, skip:], declarations[:, skip:]
    steps = faults.shape[1]
    at = np.arange(steps)
    next_declared = _next(declarations)
    end = _next(~faults)
    onset = faults.copy()
    onset[:, 0] = False  # it may have set in before
    onset[:, 1:] &= ~faults[:, :-1]
    found = onset & (next_declared < end)
    wait = np.where(found, next_declared - at, 0)
    healthy = ~faults if decided is None else ~faults & decided[:, skip:]
    counts = (healthy, healthy & declarations, onset, found, wait)
    return Detection(*(each.sum(axis=1).astype(np.float64) for each in counts))


def _next(flags: Flags) -> NDArray[np.int64]:
    """Index of the first flag at or after each sample; the number of samples if there is none."""
    steps = flags.shape[1]
    index = np.where(flags, np.arange(steps), steps)
    return np.asarray(np.minimum.accumulate(index[:, ::-1], axis=1)[:, ::-1])
