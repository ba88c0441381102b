"""Which success rate is it? The posterior, exactly and by the textbook, eq. (14)-(18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fkgen.oracle.exact.batch import BatchResult, joint_distribution
from fkgen.oracle.exact.gaussian import Array, log_density, mixture, whiten
from fkgen.oracle.plants import actuator
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.mkf import log_likelihood, scaled_pseudo_inverse, textbook_step


def batch_posterior(
    systems: Sequence[LinearSystem], prior: Array, y: Array, u: Array | None
) -> Array:
    """p(xi_i | Y_k), (T, N), from p(xi_i) p(y_0, ..., y_k | xi_i); prior (N,), y (T, p), u (T, q).

    The Gaussian density of all finite entries at once: no innovation, filter or recursion appears.
    """
    from scipy.special import logsumexp  # noqa: PLC0415 - slow to import

    joints = [joint_distribution(system, u) for system in systems]
    posterior = np.empty((len(y), len(systems)))
    for k in range(len(y)):
        so_far = slice(k + 1)
        finite = np.isfinite(y[so_far])
        densities = [
            log_density(
                (y[so_far] - joint.measurement_mean[so_far])[finite],
                whiten(joint.measurement_root[so_far][finite]),
            )
            for joint in joints
        ]
        # A hypothesis of no prior probability may fit so much better that its density overflows.
        evidence = np.where(prior > 0.0, densities, -np.inf)
        posterior[k] = np.exp(evidence - logsumexp(evidence, b=prior)) * prior
    return posterior


@dataclass(frozen=True, eq=False, kw_only=True)
class MultipleModelResult(BatchResult):
    """Estimates combined with p(xi_i | Y_k); the innovation against that with p(xi_i | Y_{k-1})."""

    mode_probability: Array  # (T, N): p(xi_i | Y_k), eq. (14), as held after sample k
    #: (T, q): Sum of p(xi_i | Y_k) xi_i; (T,) where one rate holds for all inputs
    success_rate_estimate: Array
    paper_state: Array  # (T, n): Eq. (18) as printed: x(k|k-1) combined with p(xi_i | Y_k)


def textbook_mme(
    systems: Sequence[LinearSystem],
    prior: Array,
    y: Array,
    u: Array | None,
    *,
    weight_floor: float,
    likelihood: Literal["mixture", "gaussian"],
) -> MultipleModelResult:
    """Run one MKF per hypothesis and weigh them, in plain probabilities, eq. (14)-(18)."""
    from scipy.special import logsumexp  # noqa: PLC0415 - slow to import

    u, patterns = systems[0].inputs(u), likelihood == "mixture"
    weights = np.asarray(prior, dtype=float)
    predictions = [(system.x0, system.P0) for system in systems]
    one_rate, rows = _one_rate(systems), []
    for k, now in enumerate(y):
        pairs = list(zip(systems, predictions, strict=True))
        steps = [textbook_step(system, k, before, now, u[k]) for system, before in pairs]
        logs = np.array(
            [log_likelihood(s, k, before, now, u[k], mixture=patterns) for s, before in pairs]
        )
        each = {name: np.array([step[name] for step in steps]) for name in steps[0]}
        expected, S = mixture(weights, each["expected_measurement"], each["innovation_covariance"])
        finite = np.isfinite(now)
        residual = (now - expected)[finite]
        row: dict[str, ArrayLike] = {
            "innovation": now - expected,
            "innovation_covariance": S,
            "nis": residual @ scaled_pseudo_inverse(S[np.ix_(finite, finite)]) @ residual,
            "log_likelihood": logsumexp(logs, b=weights) if finite.any() else 0.0,
        }
        weights = reweigh(weights, logs, now, weight_floor)
        rate = weights @ np.array([s.rate[k] for s in systems])
        row |= {
            "mode_probability": weights,
            "success_rate_estimate": rate[0] if one_rate else rate,
            "paper_state": weights @ np.array([x for x, _ in predictions]),
        }
        for when in ("filtered", "predicted"):
            names = (f"{when}_state", f"{when}_covariance")
            row |= dict(zip(names, mixture(weights, *(each[name] for name in names)), strict=True))
        rows.append(row)
        predictions = [(step["predicted_state"], step["predicted_covariance"]) for step in steps]
    return MultipleModelResult.of(rows)


def reweigh(weights: Array, logs: Array, y: Array, floor: float) -> Array:
    """Eq. (14) and the floor; a sample that is missing or impossible everywhere says nothing."""
    # A hypothesis that is dead may fit so much better that its density overflows.
    logs = np.where(weights > 0.0, logs, -np.inf)
    if not np.isfinite(y).any() or not np.isfinite(logs).any():
        return weights
    likelihoods = np.exp(logs - logs.max())
    updated = weights * likelihoods / np.sum(weights * likelihoods)
    return np.asarray(floor + (1.0 - weights.size * floor) * updated)


def _one_rate(systems: Sequence[LinearSystem]) -> bool:
    """Whether each hypothesis is one number: one input, or one coin for all."""
    return systems[0].nu > 0 and all(
        actuator.is_common(rate, covariance)
        for system in systems
        for rate, covariance in zip(system.rate, system.fault_covariance, strict=True)
    )
