"""Which success rate is it? The posterior, exactly and by the textbook, eq. (14)-(18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fkgen.oracle.exact.batch import joint_distribution
from fkgen.oracle.exact.gaussian import Array, log_density, whiten
from fkgen.oracle.plants import actuator
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.mkf import (
    TextbookStep,
    log_likelihood,
    scaled_pseudo_inverse,
    textbook_step,
)


def batch_posterior(
    systems: Sequence[LinearSystem], prior: Array, y: Array, u: Array | None
) -> Array:
    """Posterior of every hypothesis from the joint density of the whole record so far.

    p(xi_i | Y_k) is proportional to p(xi_i) p(y_0, ..., y_k | xi_i) with the Gaussian density of
    all finite entries at once: no innovation, no filter and no recursion of weights appears.

    Shapes: prior (N,); y (T, p); u (T, q); returns (T, N).
    """
    from scipy.special import logsumexp  # noqa: PLC0415 - slow to import

    joints = [joint_distribution(system, u) for system in systems]
    posterior = np.empty((len(y), len(systems)))
    for k in range(len(y)):
        finite = np.isfinite(y[: k + 1])
        evidence = np.array(
            [
                log_density(
                    (y[: k + 1] - joint.measurement_mean[: k + 1])[finite],
                    whiten(joint.measurement_root[: k + 1][finite]),
                )
                for joint in joints
            ]
        )
        # A hypothesis of no prior probability may fit so much better that its density overflows.
        evidence = np.where(prior > 0.0, evidence, -np.inf)
        posterior[k] = np.exp(evidence - logsumexp(evidence, b=prior)) * prior
    return posterior


@dataclass(frozen=True, eq=False, kw_only=True)
class MultipleModelResult:
    """Estimates of a bank of filters; names and times as the ports of the family."""

    mode_probability: Array  # (T, N): p(xi_i | Y_k), eq. (14), as held after sample k
    #: (T,): Sum of p(xi_i | Y_k) xi_i; (T,) where one rate holds for all inputs
    success_rate_estimate: Array
    #: filtered_state, filtered_covariance: (T, n), (T, n, n): x(k|k) combined with p(xi_i |
    #: Y_k), its covariance with the spread of the means
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): x(k+1|k) combined with p(xi_i |
    #: Y_k), its covariance with the spread of the means
    predicted_state: Array
    predicted_covariance: Array
    paper_state: Array  # (T, n): Eq. (18) as printed: x(k|k-1) combined with p(xi_i | Y_k)
    #: innovation, innovation_covariance: (T, p), (T, p, p): y[k] against the mixture of the
    #: hypotheses weighted with p(xi_i | Y_{k-1}); NaN where y is
    innovation: Array
    innovation_covariance: Array
    nis: Array  # nis, log_likelihood: (T,): Of the finite rows; 0 if there are none
    log_likelihood: Array


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
    u, mixture = systems[0].inputs(u), likelihood == "mixture"
    weights = np.asarray(prior, dtype=float)
    predictions = [(system.x0, system.P0) for system in systems]
    rows: list[dict[str, Array | float]] = []
    for k in range(len(y)):
        pairs = list(zip(systems, predictions, strict=True))
        steps = [textbook_step(system, k, before, y[k], u[k]) for system, before in pairs]
        logs = np.array(
            [log_likelihood(s, k, before, y[k], u[k], mixture=mixture) for s, before in pairs]
        )
        held, weights = weights, _reweigh(weights, logs, y[k], weight_floor)
        rows.append(
            {
                "mode_probability": weights,
                "success_rate_estimate": weights @ np.array([s.rate[k] for s in systems]),
                "paper_state": weights @ np.array([x for x, _ in predictions]),
                **_estimates(weights, steps),
                **_innovation(held, steps, logs, y[k]),
            }
        )
        predictions = [(step.predicted_state, step.predicted_covariance) for step in steps]
    return _collected(rows, one_rate=_one_rate(systems))


def _collected(rows: list[dict[str, Array | float]], *, one_rate: bool) -> MultipleModelResult:
    """Stack the rows of all samples."""
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    if one_rate:
        columns["success_rate_estimate"] = columns["success_rate_estimate"][:, 0]
    return MultipleModelResult(**columns)


def _reweigh(weights: Array, logs: Array, y: Array, floor: float) -> Array:
    """Eq. (14) and the floor; a sample that is missing or impossible everywhere says nothing."""
    # A hypothesis that is dead may fit so much better that its density overflows.
    logs = np.where(weights > 0.0, logs, -np.inf)
    if not np.isfinite(y).any() or not np.isfinite(logs).any():
        return weights
    likelihoods = np.exp(logs - logs.max())
    updated = weights * likelihoods / np.sum(weights * likelihoods)
    floored: Array = floor + (1.0 - weights.size * floor) * updated
    return floored


def _merge(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture, the latter with the spread of the means."""
    mean = weights @ means
    spread = means - mean
    return mean, np.einsum(
        "i,ijk->jk", weights, covariances + spread[:, :, None] * spread[:, None, :]
    )


def _estimates(weights: Array, steps: list[TextbookStep]) -> dict[str, Array | float]:
    """Coherent combination of the filters' estimates."""
    ports: dict[str, Array | float] = {}
    for time in ("filtered", "predicted"):
        means = np.array([getattr(step, f"{time}_state") for step in steps])
        covariances = np.array([getattr(step, f"{time}_covariance") for step in steps])
        ports[f"{time}_state"], ports[f"{time}_covariance"] = _merge(weights, means, covariances)
    return ports


def _innovation(
    held: Array, steps: list[TextbookStep], logs: Array, y: Array
) -> dict[str, Array | float]:
    """Compare a sample with the bank's mixture, weighted with p(xi_i | Y_{k-1})."""
    from scipy.special import logsumexp  # noqa: PLC0415 - slow to import

    expected, covariance = _merge(
        held,
        np.array([step.expected_measurement for step in steps]),
        np.array([step.innovation_covariance for step in steps]),
    )
    innovation = y - expected
    finite = np.isfinite(y)
    inverse = scaled_pseudo_inverse(covariance[np.ix_(finite, finite)])
    return {
        "innovation": innovation,
        "innovation_covariance": covariance,
        "nis": float(innovation[finite] @ inverse @ innovation[finite]),
        "log_likelihood": float(logsumexp(logs, b=held)) if finite.any() else 0.0,
    }


def _one_rate(systems: Sequence[LinearSystem]) -> bool:
    """Whether each hypothesis is one number: one input, or one coin for all."""
    return systems[0].nu > 0 and all(
        actuator.is_common(rate, covariance)
        for system in systems
        for rate, covariance in zip(system.rate, system.fault_covariance, strict=True)
    )
