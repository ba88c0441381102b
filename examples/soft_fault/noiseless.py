"""Figures that need no random numbers: covariances, and what the ramp alone does to each filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import simulation as sim
from scipy.stats import chi2, ncx2
from simulation import Floats

import fkgen

ENDS = (720, 750, 780, 810)
DRIFT_AT = (720, 750, 780, 810, 840, 900, 990)


def record(*, until: int = sim.END, since: int = 0) -> Floats:
    """(T, 2): zeros with the ramp; positions from ``since`` on and up to ``until`` after 690 s.

    690 s is the end of the last window before the fault, so between 690 and ``since`` nothing is
    collected, and no window is accepted or rejected.
    """
    y, t = np.zeros((sim.SAMPLES, 2)), sim.seconds()
    y[:, 0] = sim.fault()
    gap = (t > 690 + 1e-6) & (t < since + 1e-6)
    y[~sim.has_position() | gap | (t > until + 1e-6), 0] = np.nan
    return y


def variances(names: Sequence[str], at: Sequence[int], y: Floats) -> dict[str, list[float]]:
    """P11 of filters at these seconds."""
    specs, result = sim.specifications(), {}
    for name in names:
        found = fkgen.build(specs[name]).run(y, keep=("filtered_covariance",))
        result[name] = [float(found.filtered_covariance[5 * t, 0, 0]) for t in at]
    return result


def drift() -> list[float]:
    """Mean error of the Kalman filter without a test at `DRIFT_AT`, m."""
    found = fkgen.build(sim.specifications()[sim.KF]).run(record())
    return [-float(found.filtered_state[5 * t, 0]) for t in DRIFT_AT]


def non_centrality(name: str, *, accepting: bool) -> list[float]:
    """Mean of the statistic minus its degrees of freedom at the ends of windows with the ramp.

    ``accepting``: the host took all windows before over, else none since 690 s.
    """
    compiled, result = fkgen.build(sim.specifications()[name]), []
    for end in ENDS:
        y = record(since=0 if accepting else end - sim.WINDOW)
        result.append(float(compiled.run(y).test_statistic[5 * end]))
    return result


def power(non_centralities: Sequence[float], dof: int) -> list[float]:
    """Probability that a window with this non-centrality is rejected."""
    threshold = chi2.isf(sim.FALSE_ALARM, dof)
    return [float(ncx2.sf(threshold, dof, each)) for each in non_centralities]


def by_window(at: int = 900) -> Mapping[int, dict[str, float]]:
    """P11 after an update at ``at`` seconds, by length of the windows in seconds."""
    result = {}
    for seconds in (10, 30, 60, 150):
        changes = {"faults": {"soft": {"window": 5 * seconds}}}
        result[seconds] = {}
        for care in ("paper", "optimal"):
            options = {"test": False, "maintenance": care}
            spec = sim.specification(filter=options, **changes)
            found = fkgen.build(spec).run(record(), keep=("filtered_covariance",))
            result[seconds][care] = float(found.filtered_covariance[5 * at, 0, 0])
    return result


def counter_example() -> dict[str, float]:
    """A random walk, two samples: compressed, the last one alone, and both in a Kalman filter."""
    one = [[1.0]]
    walk = {"A": one, "C": one, "Q": [[100.0]], "R": [[1000.0]], "x0": [0.0], "P0": one}
    table = {"name": "walk", "model": walk, "filter": {"family": "kf"}}
    faults = {"soft": {"host": [], "window": 1}}
    kalman = fkgen.build(fkgen.Spec.from_dict(table))
    partial = fkgen.Spec.from_dict(table | {"faults": faults, "filter": {"family": "cpcf"}})
    compressed = fkgen.build(partial).run(np.zeros(2))
    last = kalman.run(np.array([np.nan, 0.0]))
    both = kalman.run(np.zeros(2))
    return {
        "R of the compressed measurement": float(compressed.compressed_noise[1, 0, 0]),
        "P, host with the compressed measurement": float(compressed.filtered_covariance[1, 0, 0]),
        "P, host with the last raw measurement": float(last.filtered_covariance[1, 0, 0]),
        "P, Kalman filter with both": float(both.filtered_covariance[1, 0, 0]),
    }
