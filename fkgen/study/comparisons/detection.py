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
    """Counts per trial, (M,) each."""

    healthy: Array  # samples without fault
    alarms: Array  # and those of them that were declared faulty
    onsets: Array  # faults that set in
    found: Array  # and those that were declared before they ended
    waited: Array  # samples between onset and declaration, summed over those found


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
    """(M, T): samples that a filter declares faulty: by its verdict, its modes, or its NIS.

    ``limits`` (M, T) are those of the NIS; the first ``healthy`` modes are those without fault.
    """
    if "fault_declared" in run.ports:
        return _of_any_group(run, "fault_declared")
    if "mode_probability" in run.ports:
        return np.asarray(run["mode_probability"][..., :healthy].sum(axis=2) < DECIDED)
    return np.asarray(run["nis"] > limits) if "nis" in run.ports else None


def tested(run: Run) -> Flags | None:
    """(M, T): samples at which a filter decides, if that is not every sample."""
    return _of_any_group(run, "test_dof") if "test_dof" in run.ports else None


def _of_any_group(run: Run, name: str) -> Flags:
    """Whether a port, which has one number or one per group of rows, is positive."""
    positive = run[name] > 0.0
    return np.asarray(positive if positive.ndim == 2 else positive.any(axis=2))


def detection(
    faults: Flags, declarations: Flags, skip: int, decided: Flags | None = None
) -> Detection:
    """Count what was declared rightly and wrongly, from sample ``skip`` on; flags are (M, T).

    Of the samples without fault those count at which something is ``decided``; all by default.
    """
    faults, declarations = faults[:, skip:], declarations[:, skip:]
    at = np.arange(faults.shape[1])
    next_declared, end = _next(declarations), _next(~faults)
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
