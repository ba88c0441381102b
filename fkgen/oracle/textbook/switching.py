"""Filters over modes by the textbook: one-step near-optimal, and interacting multiple models.

Full matrices, weights as logarithms. `fkgen.oracle.exact.enumeration` is their judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fkgen.oracle.exact.batch import BatchResult
from fkgen.oracle.exact.gaussian import Array, mixture
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, aggregate, mode_plant, nominal_share, sensed_modes

Gaussian: TypeAlias = tuple[Array, Array]
Ports: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class OneStepResult(BatchResult):
    """Estimates; the innovation against the mixture weighted with Pr(mode at k | y[0..k-1])."""

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
    """Run the one-step near-optimal filter, (3)-(10), x(k|k-1) and P(k|k-1) in (9); y (T, p)."""
    u = system.inputs(u)
    priors: list[Gaussian] = [(system.x0, system.P0)] * 4
    log_held, rows = _log(law.initial), []
    for k, now in enumerate(y):
        plants = [mode_plant(system, law, k, mode) for mode in range(4)]
        modes = [_matched(*pair, now, u[k]) for pair in zip(plants, priors, strict=True)]
        log_posterior, row = _bayes(log_held, modes, now)
        filtered = [mode.filtered for mode in modes]
        estimate = _merge(log_posterior, filtered)
        if covariance != "moment_matched":
            within = zip(np.exp(log_posterior), filtered, strict=True)
            estimate = estimate[0], np.asarray(sum(weight * P for weight, (_, P) in within))
        A, Q = system.A[k], system.Q[k]
        ahead = _moved(A, Q, estimate, system.B[k] @ u[k])
        if covariance in {"moment_matched", "weighted"}:
            priors = [ahead] * 4
        else:
            which = (0, 0, 0, 0) if covariance == "paper_nominal" else (0, 1, 0, 1)  # delta
            errors = [_paper_covariance(plants[i], priors[i][1], now) for i in which]
            priors = [(ahead[0], A @ P @ A.T + Q) for P in errors]
        log_held = _step_law(log_posterior, law.kernel)
        rows.append({**row, **_estimates(estimate, ahead, log_posterior, log_held)})
    return OneStepResult.of(rows)


def _paper_covariance(plant: tuple[Array, Array, Array], P: Array, y: Array) -> Array:
    """Eq. (7) to the letter: P(k|k) as if delta were the only fault."""
    finite = np.isfinite(y)
    C, R = plant[0][finite], plant[2][np.ix_(finite, finite)]
    F2 = np.linalg.solve(C @ P @ C.T + R, C @ P).T
    return np.asarray((np.eye(len(P)) - F2 @ C) @ P)


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


def interacting(
    system: JumpSystem, y: Array, u: Array, lumping: Lumping | None = None
) -> InteractingResult:
    """Run the filter of Blom & Bar-Shalom 1988; y (T, p), u (T, q).

    Sigalov & Oshman, eq. (15)-(18), where all modes move alike.
    """
    if lumping is None:  # every condition is a mode
        N = system.count
        lumping = Lumping(shares=np.eye(N), kernel=system.transition, initial=system.initial)
    held: list[Gaussian] = [(system.x0, system.P0)] * len(lumping.initial)
    log_held, rows = _log(lumping.initial), []
    for k, now in enumerate(y):
        modes = []
        for shares, prior in zip(lumping.shares, held, strict=True):
            plants = [
                (system.C[k, i], system.D[k, i], system.R[k, i]) for i in np.flatnonzero(shares)
            ]
            each = [_matched(plant, prior, now, u[k]) for plant in plants]
            modes.append(_lumped(_log(shares[shares != 0.0]), each))
        log_posterior, row = _bayes(log_held, modes, now)
        filtered = [mode.filtered for mode in modes]
        log_held = _step_law(log_posterior, lumping.kernel)
        mixed = [_merge(w, filtered) for w in _mixing(log_posterior, lumping.kernel, log_held)]
        held = [
            _moved(system.A[k, i], system.Q[k, i], x, system.B[k, i] @ u[k] + system.c[k, i])
            for i, x in zip((lumping.shares != 0.0).argmax(axis=1), mixed, strict=True)
        ]
        estimate = _merge(log_posterior, filtered)
        row |= _estimates(estimate, _merge(log_held, held), log_posterior, log_held)
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


def _lumped(log_share: Array, each: Sequence[_Matched]) -> _Matched:
    """What a mode makes of a sample: the update merges its conditions, in given shares."""
    joint = log_share + np.array([one.log_likelihood for one in each])
    return _Matched(
        filtered=_merge(_normalised(joint), [one.filtered for one in each]),
        expected=_merge(log_share, [one.expected for one in each]),
        log_likelihood=float(np.logaddexp.reduce(joint)),
    )


def _mixing(log_posterior: Array, kernel: Array, log_held: Array) -> list[Array]:
    """Eq. (17), normalised for each j: logs of Pr(mode i at k | mode j at k+1, y[0..k])."""
    return [
        # A mode that cannot come next has weight 0; any finite mixture will do for it.
        log_posterior if np.isneginf(log_held[j]) else _normalised(log_posterior + _log(column))
        for j, column in enumerate(kernel.T)
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Matched:
    """x(k|k) of one mode, what it expected of y[k], and the density of the finite rows."""

    filtered: Gaussian
    expected: Gaussian
    log_likelihood: float


def _matched(plant: tuple[Array, Array, Array], prior: Gaussian, y: Array, u: Array) -> _Matched:
    """Update with the finite rows of y as if the mode were known, eq. (5), (6), (9)."""
    (C, D, R), (x, P) = plant, prior
    expected, S = C @ x + D @ u, C @ P @ C.T + R
    finite = np.isfinite(y)
    Cf, Rf, Sf = C[finite], R[np.ix_(finite, finite)], S[np.ix_(finite, finite)]
    residual = (y - expected)[finite]
    F2 = np.linalg.solve(Sf, Cf @ P).T
    E = np.eye(x.size) - F2 @ Cf
    square = residual @ np.linalg.solve(Sf, residual)
    return _Matched(
        filtered=(x + F2 @ residual, E @ P @ E.T + F2 @ Rf @ F2.T),
        expected=(expected, S),
        log_likelihood=-0.5 * float(square + np.linalg.slogdet(2.0 * np.pi * Sf)[1]),
    )


def _bayes(log_held: Array, modes: Sequence[_Matched], y: Array) -> tuple[Array, Ports]:
    """Logs of the posterior, eq. (8), and the ports that compare y with what was expected."""
    finite = np.isfinite(y)
    joint = log_held + np.array([m.log_likelihood for m in modes])
    expected, S = _merge(log_held, [m.expected for m in modes])
    residual = (y - expected)[finite]
    ports = {
        "innovation": y - expected,
        "innovation_covariance": S,
        "nis": residual @ np.linalg.solve(S[np.ix_(finite, finite)], residual),
        "log_likelihood": np.logaddexp.reduce(joint) if finite.any() else np.zeros(()),
    }
    return _normalised(joint), ports


def _step_law(log_posterior: Array, kernel: Array) -> Array:
    """Eq. (10): logs of the law of the next mode."""
    return np.asarray(np.logaddexp.reduce(log_posterior[:, None] + _log(kernel), axis=0))


def _merge(log_weights: Array, parts: Sequence[Gaussian]) -> Gaussian:
    """Mean and covariance of a mixture, the latter with the spread of the means."""
    means, covariances = (np.array(each) for each in zip(*parts, strict=True))
    return mixture(np.exp(log_weights), means, covariances)


def _moved(A: Array, Q: Array, filtered: Gaussian, added: Array) -> Gaussian:
    """Eq. (1): from x(k|k) to x(k+1|k)."""
    return A @ filtered[0] + added, A @ filtered[1] @ A.T + Q


def _estimates(estimate: Gaussian, ahead: Gaussian, log_posterior: Array, log_held: Array) -> Ports:
    """The ports of one sample: x(k|k), x(k+1|k), and the law of the mode at k and k + 1."""
    return {
        "filtered_state": estimate[0],
        "filtered_covariance": estimate[1],
        "predicted_state": ahead[0],
        "predicted_covariance": ahead[1],
        "mode_probability": np.exp(log_posterior),
        "predicted_mode_probability": np.exp(log_held),
    }


def _log(probability: Array) -> Array:
    """Logarithm with log 0 = -inf."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability))


def _normalised(logs: Array) -> Array:
    """Logs of weights that add up to one; where they are huge, without adding them first."""
    relative = logs - logs.max()
    return np.asarray(relative - np.logaddexp.reduce(relative))
