"""One-step and interacting-multiple-model filters by the textbook, eq. (3)-(10) and (15)-(18).

Full matrices, probabilities in the log domain. `fkgen.closed_form.enumeration` is its judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fkgen.closed_form.gaussian import Array
from fkgen.closed_form.sensor import SensorLaw, aggregate, mode_plant, nominal_share
from fkgen.closed_form.system import LinearSystem

Gaussian: TypeAlias = tuple[Array, Array]
Ports: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class OneStepResult:
    """Estimates of the one-step filter; names and times as the ports of the family.

    Attributes
    ----------
    filtered_state, filtered_covariance : (T, n), (T, n, n) ndarray
        x(k|k) and its covariance.
    predicted_state, predicted_covariance : (T, n), (T, n, n) ndarray
        x(k+1|k) and its covariance.
    innovation, innovation_covariance : (T, p), (T, p, p) ndarray
        y[k] against the mixture of the modes weighted with Pr(mode at k | y[0..k-1]), all rows;
        NaN where y is.
    nis, log_likelihood : (T,) ndarray
        Of the finite rows; 0 if there are none.
    mode_probability, predicted_mode_probability : (T, N) ndarray
        Law of the mode at k and at k+1 given y[0..k].
    """

    filtered_state: Array
    filtered_covariance: Array
    predicted_state: Array
    predicted_covariance: Array
    innovation: Array
    innovation_covariance: Array
    nis: Array
    log_likelihood: Array
    mode_probability: Array
    predicted_mode_probability: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractingResult(OneStepResult):
    """Estimates of the interacting-multiple-model filter.

    Attributes
    ----------
    mode_filtered_state, mode_filtered_covariance : (T, N, n), (T, N, n, n) ndarray
        x(k|k) of every mode.
    mode_state, mode_covariance : (T, N, n), (T, N, n, n) ndarray
        x(k+1|k) of every mode at k+1, after mixing.
    """

    mode_filtered_state: Array
    mode_filtered_covariance: Array
    mode_state: Array
    mode_covariance: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class _Matched:
    """x(k|k) of one mode, what it expected of y[k], and the density of the finite rows."""

    filtered: Gaussian
    expected: Gaussian
    log_likelihood: float


def textbook_one_step(
    system: LinearSystem,
    law: SensorLaw,
    y: Array,
    u: Array | None,
    *,
    covariance: Literal["moment_matched", "weighted", "paper", "paper_nominal"] = "moment_matched",
) -> OneStepResult:
    """Run the one-step near-optimal filter, eq. (3)-(10), with x(k|k-1) and P(k|k-1) in eq. (9).

    Parameters
    ----------
    system : LinearSystem
        The plant; R positive definite, its actuators do not fail.
    law : SensorLaw
        The law of the modes.
    y : (T, p) ndarray
        Measurements; NaN = missing.
    u : (T, q) ndarray or None
        Known inputs.
    covariance : {"moment_matched", "weighted", "paper", "paper_nominal"}
        What stands for P of eq. (7): covariance of the mixture (GPB1), the same without the spread
        of the means, one Riccati equation per value of delta that knows of no other fault, or the
        one of delta = 1 for both.

    Returns
    -------
    OneStepResult
    """
    u = system.inputs(u)
    priors: list[Gaussian] = [(system.x0, system.P0)] * 4
    log_held = _log(law.initial)
    rows = []
    for k in range(len(y)):
        matched = [
            _matched(mode_plant(system, law, k, mode), priors[mode], y[k], u[k])
            for mode in range(4)
        ]
        log_posterior, row = _bayes(log_held, matched, y[k])
        estimate = _merge(log_posterior, [m.filtered for m in matched])
        if covariance != "moment_matched":
            estimate = estimate[0], _within(log_posterior, [m.filtered for m in matched])
        ahead = _predict(system, k, estimate, u[k])
        if covariance in {"moment_matched", "weighted"}:
            priors = [ahead] * 4
        else:
            errors = _paper_covariances(system, law, k, [P for _, P in priors], y[k])
            if covariance == "paper_nominal":
                errors = [errors[0]] * 2
            priors = [(ahead[0], errors[mode % 2]) for mode in range(4)]  # delta is 1, C, 1, C
        log_held = _step_law(log_posterior, law.kernel)
        rows.append({**row, **_ports(estimate, ahead, log_posterior, log_held)})
    return OneStepResult(**_stacked(rows))


def _paper_covariances(
    system: LinearSystem, law: SensorLaw, k: int, priors: list[Array], y: Array
) -> list[Array]:
    """Eq. (7) to the letter: P(k+1|k) for delta = 1 and C, as if that were the only fault."""
    finite = np.isfinite(y)
    ahead = []
    for mode in (0, 1):
        C, _, R = mode_plant(system, law, k, mode)
        C, R, P = C[finite], R[np.ix_(finite, finite)], priors[mode]
        F2 = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        after = (np.eye(system.nx) - F2 @ C) @ P
        ahead.append(system.A[k] @ after @ system.A[k].T + system.Q[k])
    return ahead


def textbook_imm(
    system: LinearSystem, law: SensorLaw, y: Array, u: Array | None, *, modes: Literal[4, 3] = 4
) -> InteractingResult:
    """Run the interacting-multiple-model filter, eq. (15)-(18).

    Parameters
    ----------
    system, law, y, u
        As for `textbook_one_step`.
    modes : {4, 3}
        All modes, or (1, 1), (1, C) and {gamma = 0}, the last with the mixture of its two
        likelihoods in the constant share `nominal_share`.

    Returns
    -------
    InteractingResult
    """
    u = system.inputs(u)
    kernel, initial = (law.kernel, law.initial) if modes == 4 else aggregate(law)
    share = np.array([nominal_share(law), 1.0 - nominal_share(law)])
    held: list[Gaussian] = [(system.x0, system.P0)] * modes
    log_held = _log(initial)
    rows = []
    for k in range(len(y)):
        plants = [mode_plant(system, law, k, mode) for mode in range(4)]
        four = [*held, held[-1]] if modes == 3 else held
        matched = [_matched(plants[mode], four[mode], y[k], u[k]) for mode in range(4)]
        if modes == 3:
            matched = [matched[0], matched[1], _either(_log(share), matched[2:])]
        log_posterior, row = _bayes(log_held, matched, y[k])
        filtered = [m.filtered for m in matched]
        estimate = _merge(log_posterior, filtered)
        ahead = _predict(system, k, estimate, u[k])
        log_held = _step_law(log_posterior, kernel)
        held = [
            _predict(system, k, _merge(weights, filtered), u[k])
            for weights in _mixing(log_posterior, kernel, log_held)
        ]
        row |= _ports(estimate, ahead, log_posterior, log_held)
        for name, states in {"mode_filtered": filtered, "mode": held}.items():
            row[f"{name}_state"] = np.array([x for x, _ in states])
            row[f"{name}_covariance"] = np.array([P for _, P in states])
        rows.append(row)
    return InteractingResult(**_stacked(rows))


def _mixing(log_posterior: Array, kernel: Array, log_held: Array) -> list[Array]:
    """Eq. (17), normalised for each j: logs of Pr(mode i at k | mode j at k+1, y[0..k])."""
    return [
        # A mode that cannot come next has weight 0; any finite mixture will do for it.
        log_posterior if np.isneginf(log_held[j]) else _normalised(log_posterior + _log(column))
        for j, column in enumerate(kernel.T)
    ]


def _either(log_share: Array, matched: Sequence[_Matched]) -> _Matched:
    """The mode {gamma = 0}: delta is 1 or C in a given share; the update merges the two."""
    joint = log_share + np.array([m.log_likelihood for m in matched])
    return _Matched(
        filtered=_merge(_normalised(joint), [m.filtered for m in matched]),
        expected=_merge(log_share, [m.expected for m in matched]),
        log_likelihood=float(np.logaddexp.reduce(joint)),
    )


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


def _bayes(log_held: Array, matched: Sequence[_Matched], y: Array) -> tuple[Array, Ports]:
    """Logs of the posterior, eq. (8), and the ports that compare y with what was expected."""
    finite = np.isfinite(y)
    joint = log_held + np.array([m.log_likelihood for m in matched])
    expected, S = _merge(log_held, [m.expected for m in matched])
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


def _within(log_weights: Array, parts: Sequence[Gaussian]) -> Array:
    """Mean of the covariances of a mixture."""
    return np.asarray(sum(np.exp(log) * P for log, (_, P) in zip(log_weights, parts, strict=True)))


def _merge(log_weights: Array, parts: Sequence[Gaussian]) -> Gaussian:
    """Mean and covariance of a mixture, the latter with the spread of the means."""
    weights, means = np.exp(log_weights), np.array([x for x, _ in parts])
    mean = weights @ means
    spread = means - mean
    return mean, _within(log_weights, parts) + np.einsum("i,ij,ik->jk", weights, spread, spread)


def _predict(system: LinearSystem, k: int, filtered: Gaussian, u: Array) -> Gaussian:
    """Eq. (1): from x(k|k) to x(k+1|k)."""
    A, B = system.A[k], system.B[k]
    return A @ filtered[0] + B @ u, A @ filtered[1] @ A.T + system.Q[k]


def _ports(estimate: Gaussian, ahead: Gaussian, log_posterior: Array, log_held: Array) -> Ports:
    """The estimates of one sample."""
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


def _stacked(rows: list[Ports]) -> Ports:
    """One array per port."""
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
