"""Gaussian mixtures whose weights are logarithms: what the textbook filters over modes share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fkgen.oracle.exact.gaussian import Array, mixture

Gaussian: TypeAlias = tuple[Array, Array]
Ports: TypeAlias = dict[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Matched:
    """x(k|k) of one mode, what it expected of y[k], and the density of the finite rows."""

    filtered: Gaussian
    expected: Gaussian
    log_likelihood: float


def matched(plant: tuple[Array, Array, Array], prior: Gaussian, y: Array, u: Array) -> Matched:
    """Update with the finite rows of y as if the mode were known, eq. (5), (6), (9)."""
    (C, D, R), (x, P) = plant, prior
    expected, S = C @ x + D @ u, C @ P @ C.T + R
    finite = np.isfinite(y)
    Cf, Rf, Sf = C[finite], R[np.ix_(finite, finite)], S[np.ix_(finite, finite)]
    residual = (y - expected)[finite]
    F2 = np.linalg.solve(Sf, Cf @ P).T
    E = np.eye(x.size) - F2 @ Cf
    square = residual @ np.linalg.solve(Sf, residual)
    return Matched(
        filtered=(x + F2 @ residual, E @ P @ E.T + F2 @ Rf @ F2.T),
        expected=(expected, S),
        log_likelihood=-0.5 * float(square + np.linalg.slogdet(2.0 * np.pi * Sf)[1]),
    )


def bayes(log_held: Array, modes: Sequence[Matched], y: Array) -> tuple[Array, Ports]:
    """Logs of the posterior, eq. (8), and the ports that compare y with what was expected."""
    finite = np.isfinite(y)
    joint = log_held + np.array([m.log_likelihood for m in modes])
    expected, S = merge(log_held, [m.expected for m in modes])
    residual = (y - expected)[finite]
    ports = {
        "innovation": y - expected,
        "innovation_covariance": S,
        "nis": residual @ np.linalg.solve(S[np.ix_(finite, finite)], residual),
        "log_likelihood": np.logaddexp.reduce(joint) if finite.any() else np.zeros(()),
    }
    return normalised(joint), ports


def step_law(log_posterior: Array, kernel: Array) -> Array:
    """Eq. (10): logs of the law of the next mode."""
    return np.asarray(np.logaddexp.reduce(log_posterior[:, None] + log(kernel), axis=0))


def within(log_weights: Array, parts: Sequence[Gaussian]) -> Array:
    """Mean of the covariances of a mixture."""
    return np.asarray(sum(np.exp(one) * P for one, (_, P) in zip(log_weights, parts, strict=True)))


def merge(log_weights: Array, parts: Sequence[Gaussian]) -> Gaussian:
    """Mean and covariance of a mixture, the latter with the spread of the means."""
    means, covariances = (np.array(each) for each in zip(*parts, strict=True))
    return mixture(np.exp(log_weights), means, covariances)


def moved(A: Array, Q: Array, filtered: Gaussian, added: Array) -> Gaussian:
    """Eq. (1): from x(k|k) to x(k+1|k)."""
    return A @ filtered[0] + added, A @ filtered[1] @ A.T + Q


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


def log(probability: Array) -> Array:
    """Logarithm with log 0 = -inf."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability))


def normalised(logs: Array) -> Array:
    """Logs of weights that add up to one; where they are huge, without adding them first."""
    relative = logs - logs.max()
    return np.asarray(relative - np.logaddexp.reduce(relative))
