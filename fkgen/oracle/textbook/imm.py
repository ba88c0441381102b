"""Interacting multiple models by the textbook, for modes that move and measure as they like.

Full matrices, probabilities in the log domain. `fkgen.oracle.exact.enumeration` is its judge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, aggregate, nominal_share, sensed_modes
from fkgen.oracle.textbook.gpb1 import OneStepResult
from fkgen.oracle.textbook.mixture import (
    Gaussian,
    Matched,
    bayes,
    estimates,
    log,
    matched,
    merge,
    normalised,
    stacked,
    step_law,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractingResult(OneStepResult):
    """Estimates of the interacting-multiple-model filter."""

    #: mode_filtered_state, mode_filtered_covariance: (T, N, n), (T, N, n, n): x(k|k) of every
    #: mode
    mode_filtered_state: Array
    mode_filtered_covariance: Array
    #: mode_state, mode_covariance: (T, N, n), (T, N, n, n): x(k+1|k) of every mode at k+1,
    #: after mixing
    mode_state: Array
    mode_covariance: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Lumping:
    """M modes, each a fixed mixture of N conditions that move alike."""

    shares: Array  # (M, N): Pr(condition | mode)
    kernel: Array  # kernel, initial: (M, M), (M,): The chain of the modes
    initial: Array

    @classmethod
    def none(cls, system: JumpSystem) -> Self:
        """Every condition is a mode."""
        return cls(shares=np.eye(system.count), kernel=system.transition, initial=system.initial)


def interacting(
    system: JumpSystem, y: Array, u: Array, lumping: Lumping | None = None
) -> InteractingResult:
    """Run the interacting-multiple-model filter.

    Shapes: y (T, p); u (T, q). Blom, Bar-Shalom, The interacting multiple model algorithm, 1988;
    Sigalov & Oshman, eq. (15)-(18), where all modes move alike.
    """
    lumping = lumping or Lumping.none(system)
    members = [np.flatnonzero(row) for row in lumping.shares]
    held: list[Gaussian] = [(system.x0, system.P0)] * len(members)
    log_held, rows = log(lumping.initial), []
    for k in range(len(y)):
        modes = [
            _seen((system, k), (which, log(lumping.shares[m, which])), held[m], y[k], u[k])
            for m, which in enumerate(members)
        ]
        log_posterior, row = bayes(log_held, modes, y[k])
        filtered = [mode.filtered for mode in modes]
        estimate = merge(log_posterior, filtered)
        log_held = step_law(log_posterior, lumping.kernel)
        mixing = _mixing(log_posterior, lumping.kernel, log_held)
        held = [
            _moved(system, k, int(which[0]), merge(weights, filtered), u[k])
            for which, weights in zip(members, mixing, strict=True)
        ]
        row |= estimates(estimate, merge(log_held, held), log_posterior, log_held)
        for name, states in {"mode_filtered": filtered, "mode": held}.items():
            row[f"{name}_state"] = np.array([x for x, _ in states])
            row[f"{name}_covariance"] = np.array([P for _, P in states])
        rows.append(row)
    return InteractingResult(**stacked(rows))


def textbook_imm(
    system: LinearSystem, law: SensorLaw, y: Array, u: Array | None, *, modes: Literal[4, 3] = 4
) -> InteractingResult:
    """Run the interacting-multiple-model filter over the conditions of a sensor, eq. (15)-(18)."""
    lumping = silent_lumped(law) if modes == 3 else None
    return interacting(sensed_modes(system, law), y, system.inputs(u), lumping)


def silent_lumped(law: SensorLaw) -> Lumping:
    """Three modes of a sensor: (1, 1), (1, C), and gamma = 0 with delta as if drawn anew."""
    kernel, initial = aggregate(law)
    shares = np.eye(3, 4)
    shares[2, 2:] = nominal_share(law), 1.0 - nominal_share(law)
    return Lumping(shares=shares, kernel=kernel, initial=initial)


def _seen(
    at: tuple[JumpSystem, int],
    conditions: tuple[NDArray[np.int64], Array],
    held: Gaussian,
    y: Array,
    u: Array,
) -> Matched:
    """What a mode makes of sample ``at``: the update merges its conditions, in given shares."""
    (system, k), (which, log_share) = at, conditions
    each = [matched((system.C[k, i], system.D[k, i], system.R[k, i]), held, y, u) for i in which]
    joint = log_share + np.array([one.log_likelihood for one in each])
    return Matched(
        filtered=merge(normalised(joint), [one.filtered for one in each]),
        expected=merge(log_share, [one.expected for one in each]),
        log_likelihood=float(np.logaddexp.reduce(joint)),
    )


def _mixing(log_posterior: Array, kernel: Array, log_held: Array) -> list[Array]:
    """Eq. (17), normalised for each j: logs of Pr(mode i at k | mode j at k+1, y[0..k])."""
    return [
        # A mode that cannot come next has weight 0; any finite mixture will do for it.
        log_posterior if np.isneginf(log_held[j]) else normalised(log_posterior + log(column))
        for j, column in enumerate(kernel.T)
    ]


def _moved(system: JumpSystem, k: int, i: int, filtered: Gaussian, u: Array) -> Gaussian:
    """From x(k|k) to x(k+1|k) under condition i."""
    A, B = system.A[k, i], system.B[k, i]
    return A @ filtered[0] + B @ u + system.c[k, i], A @ filtered[1] @ A.T + system.Q[k, i]
