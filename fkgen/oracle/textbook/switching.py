"""Filters over modes by the textbook: one-step near-optimal, and interacting multiple models.

Full matrices, weights as logarithms. `fkgen.oracle.exact.enumeration` is their judge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fkgen.oracle.exact.batch import BatchResult
from fkgen.oracle.exact.gaussian import Array, mixture
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, aggregate, nominal_share, sensed_modes

#: Means (..., n) and covariances (..., n, n).
Gaussian: TypeAlias = tuple[Array, Array]
Ports: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class OneStepResult(BatchResult):
    """Estimates; the innovation against the mixture weighted with Pr(mode at k | y[0..k-1])."""

    mode_probability: Array  # (T, N): Law of the mode at k, and at k+1, given y[0..k]
    predicted_mode_probability: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractingResult(OneStepResult):
    """Estimates of the interacting-multiple-model filter."""

    mode_filtered_state: Array  # (T, N, n), (T, N, n, n): x(k|k) of every mode
    mode_filtered_covariance: Array
    mode_state: Array  # (T, N, n), (T, N, n, n): x(k+1|k) of every mode at k+1, after mixing
    mode_covariance: Array


def textbook_one_step(
    system: LinearSystem,
    law: SensorLaw,
    y: Array,
    u: Array | None,
    *,
    covariance: Literal["moment_matched", "weighted", "paper", "paper_nominal"] = "moment_matched",
) -> OneStepResult:
    """Run the one-step near-optimal filter, (3)-(10), x(k|k-1) and P(k|k-1) in (9); y (T, p)."""
    u, modes = system.inputs(u), sensed_modes(system, law)
    (x, P), log_held, rows = _repeated((system.x0, system.P0), 4), log_of(law.initial), []
    for k, now in enumerate(y):
        C, R = modes.C[k], modes.R[k]
        filtered, expected, logs = _update((x, P), (C, R, modes.D[k] @ u[k] + modes.d[k]), now)
        log_posterior, row = _bayes(log_held, logs, expected, now)
        weights = np.exp(log_posterior)
        estimate = mixture(weights, *filtered)
        if covariance != "moment_matched":
            estimate = estimate[0], np.einsum("i,iab->ab", weights, filtered[1])
        A, Q = system.A[k], system.Q[k]
        ahead = A @ estimate[0] + system.B[k] @ u[k] + system.c[k], A @ estimate[1] @ A.T + Q
        before, (x, P) = P, _repeated(ahead, 4)
        if covariance.startswith("paper"):  # (7) to the letter: as if delta were the only fault
            delta = [0, 0, 0, 0] if covariance == "paper_nominal" else [0, 1, 0, 1]
            _, E = _gain(C[delta], R[delta], before[delta], now)
            P = A @ E @ before[delta] @ A.T + Q
        log_held = step_law(log_posterior, modes.transitions[k])
        rows.append({**row, **estimates(estimate, ahead, log_posterior, _said(modes, k, log_held))})
    return OneStepResult.of(rows)


@dataclass(frozen=True, eq=False, kw_only=True)
class Lumping:
    """M modes, each a fixed mixture of N conditions that move alike."""

    shares: Array  # (M, N): Pr(condition | mode)
    kernels: Array  # kernels, initial: (T, M, M), (M,): The chain of the modes
    initial: Array


def interacting(
    system: JumpSystem, y: Array, u: Array, lumping: Lumping | None = None
) -> InteractingResult:
    """Run the filter of Blom & Bar-Shalom 1988; y (T, p), u (T, q).

    Sigalov & Oshman, eq. (15)-(18), where all modes move alike.
    """
    if lumping is None:  # every condition is a mode
        N = system.count
        lumping = Lumping(shares=np.eye(N), kernels=system.transitions, initial=system.initial)
    M, (of, condition) = len(lumping.initial), np.nonzero(lumping.shares)
    own = of == np.arange(M)[:, None]
    log_share = log_of(np.where(own, lumping.shares[of, condition], 0.0))
    moving = (lumping.shares != 0.0).argmax(axis=1)
    of_mode = [int(np.flatnonzero(each)[0]) for each in lumping.shares]
    held = tuple(each[of_mode] for each in system.priors)
    log_held, rows = log_of(lumping.initial), []
    for k, now in enumerate(y):
        C, D, R, d = (each[k, condition] for each in (system.C, system.D, system.R, system.d))
        plant = C, R, D @ u[k] + d
        filtered, expected, logs = _update((held[0][of], held[1][of]), plant, now)
        # The update of a mode merges its conditions, in given shares.
        joint, expected = log_share + logs, mixture(np.exp(log_share), *expected)
        filtered = mixture(np.exp(normalised(joint)), *filtered)
        log_posterior, row = _bayes(log_held, np.logaddexp.reduce(joint, axis=1), expected, now)
        log_held = step_law(log_posterior, lumping.kernels[k])
        # Eq. (17). A mode that cannot come next has weight 0; any mixture will do for it.
        mixing = log_posterior + log_of(lumping.kernels[k].T)
        mixing[np.isneginf(log_held)] = log_posterior
        x, P = mixture(np.exp(normalised(mixing)), *filtered)
        A, B, c, Q = (each[k, moving] for each in (system.A, system.B, system.c, system.Q))
        held = (A @ x[..., None])[..., 0] + B @ u[k] + c, A @ P @ A.transpose(0, 2, 1) + Q
        estimate = mixture(np.exp(log_posterior), *filtered)
        said = _said(system, k, log_held)
        row |= estimates(estimate, mixture(np.exp(said), *held), log_posterior, said)
        row |= {"mode_filtered_state": filtered[0], "mode_filtered_covariance": filtered[1]}
        rows.append(row | {"mode_state": held[0], "mode_covariance": held[1]})
    return InteractingResult.of(rows)


def textbook_imm(
    system: LinearSystem, law: SensorLaw, y: Array, u: Array | None, *, modes: Literal[4, 3] = 4
) -> InteractingResult:
    """Run the interacting-multiple-model filter over the conditions of a sensor, eq. (15)-(18)."""
    lumping = silent_lumped(law, system.length) if modes == 3 else None
    return interacting(sensed_modes(system, law), y, system.inputs(u), lumping)


def silent_lumped(law: SensorLaw, T: int) -> Lumping:
    """Three modes of a sensor: (1, 1), (1, C), and gamma = 0 with delta as if drawn anew."""
    kernel, initial = aggregate(law)
    shares = np.eye(3, 4)
    shares[2, 2:] = nominal_share(law), 1.0 - nominal_share(law)
    return Lumping(shares=shares, kernels=np.broadcast_to(kernel, (T, 3, 3)), initial=initial)


def _repeated(prior: Gaussian, N: int) -> Gaussian:
    """The same estimate for N modes."""
    return np.tile(prior[0], (N, 1)), np.tile(prior[1], (N, 1, 1))


def _gain(C: Array, R: Array, P: Array, y: Array) -> tuple[Array, Array]:
    """Gain of the finite rows of y in N modes, zero for the others, and what it leaves of P."""
    finite = np.isfinite(y)
    Cf, Rf = C[:, finite], R[:, finite][:, :, finite]
    F2 = np.zeros(C.transpose(0, 2, 1).shape)
    S = Cf @ P @ Cf.transpose(0, 2, 1) + Rf
    F2[..., finite] = np.linalg.solve(S, Cf @ P).transpose(0, 2, 1)
    return F2, np.eye(P.shape[-1]) - F2 @ C


def _update(
    prior: Gaussian, plant: tuple[Array, Array, Array], y: Array
) -> tuple[Gaussian, Gaussian, Array]:
    """Update N modes as if each were known, (5), (6), (9).

    Returns x(k|k), what was expected of y, and the log densities of its finite rows.
    """
    (x, P), (C, R, known), finite = prior, plant, np.isfinite(y)
    expected, S = (C @ x[..., None])[..., 0] + known, C @ P @ C.transpose(0, 2, 1) + R
    residual, Sf = np.where(finite, y - expected, 0.0), S[:, finite][:, :, finite]
    F2, E = _gain(C, R, P, y)
    after = E @ P @ E.transpose(0, 2, 1) + F2 @ R @ F2.transpose(0, 2, 1)
    white = np.linalg.solve(Sf, residual[:, finite, None])[..., 0]
    squares = (residual[:, finite] * white).sum(axis=1)
    logs = -0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * Sf)[1])
    return (x + (F2 @ residual[..., None])[..., 0], after), (expected, S), logs


def _bayes(log_held: Array, logs: Array, expected: Gaussian, y: Array) -> tuple[Array, Ports]:
    """Logs of the posterior, eq. (8), and the ports that compare y with what was expected."""
    finite, joint = np.isfinite(y), log_held + logs
    mean, S = mixture(np.exp(log_held), *expected)
    residual = (y - mean)[finite]
    ports = {
        "innovation": y - mean,
        "innovation_covariance": S,
        "nis": residual @ np.linalg.solve(S[np.ix_(finite, finite)], residual),
        "log_likelihood": np.logaddexp.reduce(joint) if finite.any() else np.zeros(()),
    }
    return normalised(joint), ports


def step_law(log_posterior: Array, kernel: Array) -> Array:
    """Eq. (10): logs of the law of the next mode."""
    return np.asarray(np.logaddexp.reduce(log_posterior[:, None] + log_of(kernel), axis=0))


def _said(system: JumpSystem, k: int, log_held: Array) -> Array:
    """Logs of the law of the next mode as sample k has it, which knows its own parameters only."""
    return log_held if system.announced is None else log_of(system.announced[k])


def estimates(estimate: Gaussian, ahead: Gaussian, log_posterior: Array, log_held: Array) -> Ports:
    """The ports of one sample: x(k|k), x(k+1|k), and the law of the mode at k and k + 1."""
    return {
        "filtered_state": estimate[0],
        "filtered_covariance": estimate[1],
        "predicted_state": ahead[0],
        "predicted_covariance": ahead[1],
        "mode_probability": np.exp(log_posterior),
        "predicted_mode_probability": np.exp(log_held),
    }


def log_of(probability: Array) -> Array:
    """Logarithm with log 0 = -inf."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability))


def normalised(logs: Array) -> Array:
    """Logs of weights (..., N) that add up to one, without adding them first: they may be huge."""
    relative = logs - logs.max(axis=-1, keepdims=True)
    return np.asarray(relative - np.logaddexp.reduce(relative, axis=-1, keepdims=True))
