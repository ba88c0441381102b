"""Filters over modes by the textbook: one-step near-optimal, and interacting multiple models.

Full matrices, probabilities in the log domain. `fkgen.oracle.exact.enumeration` is their judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from fkgen.oracle.exact.batch import BatchResult
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, aggregate, mode_plant, nominal_share, sensed_modes
from fkgen.oracle.textbook.mixture import (
    Gaussian,
    Matched,
    bayes,
    estimates,
    log,
    matched,
    merge,
    moved,
    normalised,
    step_law,
    within,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class OneStepResult(BatchResult):
    """Estimates of the one-step filter.

    The innovation is that against the mixture weighted with Pr(mode at k | y[0..k-1]).
    """

    mode_probability: Array  # (T, N): Law of the mode at k, and at k+1, given y[0..k]
    predicted_mode_probability: Array


def textbook_one_step(
    system: LinearSystem,
    law: SensorLaw,
    y: Array,
    u: Array | None,
    *,
    covariance: Literal["moment_matched", "weighted", "paper", "paper_nominal"] = "moment_matched",
) -> OneStepResult:
    """Run the one-step near-optimal filter, eq. (3)-(10), with x(k|k-1) and P(k|k-1) in eq. (9).

    Shapes: y (T, p); u (T, q).
    """
    u = system.inputs(u)
    priors: list[Gaussian] = [(system.x0, system.P0)] * 4
    log_held, rows = log(law.initial), []
    for k, now in enumerate(y):
        plants = [mode_plant(system, law, k, mode) for mode in range(4)]
        modes = [matched(*pair, now, u[k]) for pair in zip(plants, priors, strict=True)]
        log_posterior, row = bayes(log_held, modes, now)
        filtered = [mode.filtered for mode in modes]
        estimate = merge(log_posterior, filtered)
        if covariance != "moment_matched":
            estimate = estimate[0], within(log_posterior, filtered)
        A, Q = system.A[k], system.Q[k]
        ahead = moved(A, Q, estimate, system.B[k] @ u[k])
        if covariance in {"moment_matched", "weighted"}:
            priors = [ahead] * 4
        else:
            errors = [
                A @ _paper_covariance(plants[delta], priors[delta][1], now) @ A.T + Q
                for delta in (0, 1)
            ]
            which = (0, 0, 0, 0) if covariance == "paper_nominal" else (0, 1, 0, 1)  # delta
            priors = [(ahead[0], errors[delta]) for delta in which]
        log_held = step_law(log_posterior, law.kernel)
        rows.append({**row, **estimates(estimate, ahead, log_posterior, log_held)})
    return OneStepResult.of(rows)


def _paper_covariance(plant: tuple[Array, Array, Array], P: Array, y: Array) -> Array:
    """Eq. (7) to the letter: P(k|k) as if delta were the only fault."""
    finite = np.isfinite(y)
    C, R = plant[0][finite], plant[2][np.ix_(finite, finite)]
    F2 = np.linalg.solve(C @ P @ C.T + R, C @ P).T
    after: Array = (np.eye(len(P)) - F2 @ C) @ P
    return after


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractingResult(OneStepResult):
    """Estimates of the interacting-multiple-model filter."""

    mode_filtered_state: Array  # (T, N, n), (T, N, n, n): x(k|k) of every mode
    mode_filtered_covariance: Array
    mode_state: Array  # (T, N, n), (T, N, n, n): x(k+1|k) of every mode at k+1, after mixing
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
    """Run the interacting-multiple-model filter; y (T, p), u (T, q).

    Blom, Bar-Shalom, The interacting multiple model algorithm, 1988; Sigalov & Oshman, eq.
    (15)-(18), where all modes move alike.
    """
    lumping = lumping or Lumping.none(system)
    held: list[Gaussian] = [(system.x0, system.P0)] * len(lumping.initial)
    log_held, rows = log(lumping.initial), []
    for k, now in enumerate(y):
        modes = []
        for shares, prior in zip(lumping.shares, held, strict=True):
            plants = [
                (system.C[k, i], system.D[k, i], system.R[k, i]) for i in np.flatnonzero(shares)
            ]
            each = [matched(plant, prior, now, u[k]) for plant in plants]
            modes.append(_lumped(log(shares[shares != 0.0]), each))
        log_posterior, row = bayes(log_held, modes, now)
        filtered = [mode.filtered for mode in modes]
        log_held = step_law(log_posterior, lumping.kernel)
        mixed = [merge(w, filtered) for w in _mixing(log_posterior, lumping.kernel, log_held)]
        held = [
            moved(system.A[k, i], system.Q[k, i], x, system.B[k, i] @ u[k] + system.c[k, i])
            for i, x in zip((lumping.shares != 0.0).argmax(axis=1), mixed, strict=True)
        ]
        estimate = merge(log_posterior, filtered)
        row |= estimates(estimate, merge(log_held, held), log_posterior, log_held)
        for name, states in {"mode_filtered": filtered, "mode": held}.items():
            row[f"{name}_state"] = np.array([x for x, _ in states])
            row[f"{name}_covariance"] = np.array([P for _, P in states])
        rows.append(row)
    return InteractingResult.of(rows)


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


def _lumped(log_share: Array, each: Sequence[Matched]) -> Matched:
    """What a mode makes of a sample: the update merges its conditions, in given shares."""
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
