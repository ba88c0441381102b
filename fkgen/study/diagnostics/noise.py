"""Is there noise where the filter needs it, and are there digits enough."""

from __future__ import annotations

import math

import numpy as np

from fkgen.estimators.gaussian.estimate import SHORT_FORM_RATIO, prior_to_noise, update_form
from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import ModelNumbers, listed
from fkgen.study.diagnostics.visibility import RANK_TOLERANCE, correlations, numerical_rank
from fkgen.symbolic.plant import plant_of

#: Variances that the standard form cannot tell apart any more: 1 / eps, with three digits to spare.
_LOST = {"float": 1e4, "double": 1e13}

_WHERE = {
    "innovation_rank": " at the prior with u = 0",
    "innovation_rank_driven": " at the prior with u = 1",
    "innovation_rank_stationary": " at rest",
}


def innovation(model: ModelNumbers, report: ReportBuilder) -> None:
    """Rank of Om = C P C' + R + D N D', at the prior and at rest, without and with inputs."""
    prior = model.C @ model.P0 @ model.C.T
    ranks = {"innovation_rank": numerical_rank(prior + model.noise(driven=False)[1])}
    if model.has_faults:
        ranks["innovation_rank_driven"] = numerical_rank(prior + model.noise(driven=True)[1])
    if model.steady is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(model.steady.innovation)
    report.values |= {name: float(rank) for name, rank in ranks.items()}
    _perfect_measurements(model, report)
    lowest = min(ranks, key=ranks.__getitem__)
    report.rank(ranks[lowest], len(model.C), _WHERE[lowest])


def _perfect_measurements(model: ModelNumbers, report: ReportBuilder) -> None:
    """Rows of y, or combinations of them, without noise."""
    size, correlation = correlations(model.R)
    exact = [name for name, s in zip(model.outputs, size, strict=True) if s == 0.0]
    missing = int(np.count_nonzero(np.linalg.eigvalsh(correlation) <= RANK_TOLERANCE))
    remedy = "a quantised signal has the variance step**2 / 12"
    if exact:
        message = f"{listed(exact)} without noise: taken as exact, whatever happens"
        report.warning("noise_free_output", message, len(exact), remedy)
    elif missing:
        message = f"R is singular: {missing} combination(s) of the measurements without noise"
        report.warning("noise_free_output", message, missing, remedy)


def conditioning(model: ModelNumbers, report: ReportBuilder) -> None:
    """How many digits the covariance update needs, and which form of it is used."""
    spec, plant = model.spec, plant_of(model.spec)
    form = update_form(spec, plant, augmented=model.has_faults and bool(plant.D.nnz()))
    prior, predicted = prior_to_noise(spec), _predicted_to_noise(model)
    report.values |= {
        "prior_to_noise": prior,
        "predicted_to_noise": predicted,
        "joseph_form": float(form == "joseph"),
    }
    ratio, scalar = max(prior, predicted), spec.code.scalar
    if form == "short" and ratio > _LOST[scalar]:
        message = (
            f"prior to noise variance is {ratio:.2g}: the short form of the covariance update "
            f"loses that many digits, and {scalar} has no more"
        )
        remedy = 'code.update = "auto" or "joseph", or a smaller P0'
        severe = model.is_float and ratio > SHORT_FORM_RATIO
        add = report.error if severe else report.warning
        add("conditioning", message, ratio, remedy)
    elif ratio > SHORT_FORM_RATIO:
        shown = f"{ratio:.2g}" if math.isfinite(ratio) else "infinite"
        message = (
            f"prior to noise variance is {shown}; the {form} form of the covariance update is used"
        )
        loss = ", which loses that many of the 16 digits"
        message += loss if form == "short" else ": the short form would lose that many digits"
        report.note("conditioning", message, ratio)


def _predicted_to_noise(model: ModelNumbers) -> float:
    """`prior_to_noise` with P0 + Q."""
    noise = np.diag(model.R)
    prior = np.einsum("ij,jk,ik->i", model.C, model.P0 + model.Q, model.C)
    if np.any((noise <= 0.0) & (prior > 0.0)):
        return float("inf")
    known = noise > 0.0
    return float(np.max(prior[known] / noise[known], initial=0.0))


def rounding(model: ModelNumbers, report: ReportBuilder) -> None:
    """Process noise that vanishes in the rounding of the variance it is added to."""
    if model.steady is None:
        return
    eps = float(np.finfo(np.float32 if model.is_float else np.float64).eps)
    Q, P = np.diag(model.Q), np.diag(model.steady.predicted)
    lost = [name for name, q, p in zip(model.states, Q, P, strict=True) if 0.0 < q < eps * p]
    if lost:
        scalar, remedy = model.spec.code.scalar, "more process noise"
        message = f"process noise of {listed(lost)} is lost in {scalar}: Q is below the rounding"
        remedy = f'scalar = "double", or {remedy}' if model.is_float else remedy
        report.warning("rounding", f"{message} of P", len(lost), remedy)


def number_range(model: ModelNumbers, report: ReportBuilder) -> None:
    """Numbers of the model that float cannot hold."""
    if not model.is_float:
        return
    limits = np.finfo(np.float32)
    for letter in ("A", "B", "C", "D", "Q", "R", "P0", "x0"):
        values = model.system.x0 if letter == "x0" else getattr(model, letter)
        size = np.abs(values[values != 0.0])
        outside = size[(size > float(limits.max)) | (size < float(limits.tiny))]
        if outside.size:
            message = f"{letter} holds {outside[0]:.3g}, which float cannot"
            remedy = 'other units, or scalar = "double"'
            report.error("float_range", message, float(outside[0]), remedy)
