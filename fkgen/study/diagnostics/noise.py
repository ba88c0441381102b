"""Is there noise where the filter needs it, and are there digits enough."""

from __future__ import annotations

import math

import numpy as np

from fkgen.estimators.gaussian.estimate import (
    SHORT_FORM_RATIO,
    prior_to_noise,
    update_form,
)
from fkgen.study.diagnostics.findings import Finding, Part, Severity
from fkgen.study.diagnostics.model_numbers import Array, Figures, listed
from fkgen.study.diagnostics.visibility import RANK_TOLERANCE, correlations, numerical_rank
from fkgen.symbolic.plant import plant_of

#: Variances that the short form cannot tell apart any more: 1 / eps, with three digits to spare.
_LOST = {"float": 1e4, "double": 1e13}


def innovation(figures: Figures) -> Part:
    """Rank of Om = C P C' + R + D N D', at the prior and at rest, without and with inputs."""
    C, P0, p = figures.C, figures.P0, len(figures.C)
    ranks = {
        f"innovation_rank{name}": numerical_rank(C @ P0 @ C.T + figures.noise(driven=driven)[1])
        for name, driven in (("", False), ("_driven", True))
        if figures.has_faults or not driven
    }
    if figures.rest is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(figures.rest.innovation)
    values = {name: float(rank) for name, rank in ranks.items()}
    findings = list(_exact_rows(figures))
    lowest = min(ranks.values())
    if lowest < p:
        where = {
            "innovation_rank": "at the prior with u = 0",
            "innovation_rank_driven": "at the prior with u = 1",
            "innovation_rank_stationary": "at rest",
        }[min(ranks, key=ranks.__getitem__)]
        message = (
            f"the innovation covariance has rank {lowest} of {p} {where}: some rows of y follow "
            "exactly from the others, and are left out by a decision on rank"
        )
        remedy = "give every measurement some noise, at least that of its last digit"
        findings.append(Finding("innovation_rank", "warning", message, lowest, remedy))
    return Part(tuple(findings), values)


def _exact_rows(figures: Figures) -> list[Finding]:
    """Rows of y, or combinations of them, without noise."""
    size, correlation = correlations(figures.R)
    exact = [name for name, s in zip(figures.outputs, size, strict=True) if s == 0.0]
    remedy = "a quantised signal has the variance step**2 / 12"
    if exact:
        message = f"{listed(exact)} without noise: taken as exact, whatever happens"
        return [Finding("noise_free_output", "warning", message, len(exact), remedy)]
    eigenvalues = np.linalg.eigvalsh(correlation)
    missing = int(np.count_nonzero(eigenvalues <= RANK_TOLERANCE))
    if not missing:
        return []
    message = f"R is singular: {missing} combination(s) of the measurements without noise"
    return [Finding("noise_free_output", "warning", message, missing, remedy)]


def conditioning(figures: Figures) -> Part:
    """How many digits the covariance update needs, and which form of it is used."""
    spec = figures.spec
    plant = plant_of(spec)
    senses = figures.has_faults and bool(plant.D.nnz())
    form = update_form(spec, plant, augmented=senses)
    prior, predicted = prior_to_noise(spec), _predicted_to_noise(figures)
    values = {
        "prior_to_noise": prior,
        "predicted_to_noise": predicted,
        "joseph_form": float(form == "joseph"),
    }
    ratio, scalar = max(prior, predicted), spec.code.scalar
    short = form == "short"
    if short and ratio > _LOST[scalar]:
        severity: Severity = (
            "error" if scalar == "float" and ratio > SHORT_FORM_RATIO else "warning"
        )
        message = (
            f"prior to noise variance is {ratio:.2g}: the short form of the covariance update "
            f"loses that many digits, and {scalar} has no more"
        )
        remedy = 'code.update = "auto" or "joseph", or a smaller P0'
        return Part((Finding("conditioning", severity, message, ratio, remedy),), values)
    if ratio <= SHORT_FORM_RATIO:
        return Part((), values)
    shown = f"{ratio:.2g}" if math.isfinite(ratio) else "infinite"
    message = (
        f"prior to noise variance is {shown}; the {form} form of the covariance update is used"
    )
    if short:
        message += ", which loses that many of the 16 digits"
    else:
        message += ": the short form would lose that many digits"
    return Part((Finding("conditioning", "note", message, ratio),), values)


def _predicted_to_noise(figures: Figures) -> float:
    """`prior_to_noise` with P0 + Q."""
    noise = np.diag(figures.R)
    prior = np.einsum("ij,jk,ik->i", figures.C, figures.P0 + figures.Q, figures.C)
    if np.any((noise <= 0.0) & (prior > 0.0)):
        return float("inf")
    known = noise > 0.0
    return float(np.max(prior[known] / noise[known], initial=0.0))


def rounding(figures: Figures) -> Part:
    """Process noise that vanishes in the rounding of the variance it is added to."""
    if figures.rest is None:
        return Part()
    eps = float(np.finfo(np.float32 if figures.is_float else np.float64).eps)
    Q, P = np.diag(figures.Q), np.diag(figures.rest.predicted)
    lost = [
        name
        for name, q, variance in zip(figures.states, Q, P, strict=True)
        if 0.0 < q < eps * variance
    ]
    if not lost:
        return Part()
    scalar = figures.spec.code.scalar
    message = f"process noise of {listed(lost)} is lost in {scalar}: Q is below the rounding of P"
    remedy = (
        'scalar = "double", or more process noise' if figures.is_float else "more process noise"
    )
    return Part((Finding("rounding", "warning", message, len(lost), remedy),))


def number_range(figures: Figures) -> Part:
    """Numbers of the model that float cannot hold."""
    if not figures.is_float:
        return Part()
    limits = np.finfo(np.float32)
    arrays: dict[str, Array] = {
        letter: getattr(figures, letter) for letter in ("A", "B", "C", "D", "Q", "R", "P0")
    }
    arrays["x0"] = figures.system.x0
    findings = []
    for letter, values in arrays.items():
        size = np.abs(values[values != 0.0])
        outside = size[(size > float(limits.max)) | (size < float(limits.tiny))]
        if outside.size:
            message = f"{letter} holds {outside[0]:.3g}, which float cannot"
            remedy = 'other units, or scalar = "double"'
            findings.append(Finding("float_range", "error", message, float(outside[0]), remedy))
    return Part(tuple(findings))
