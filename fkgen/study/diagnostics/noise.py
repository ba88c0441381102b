"""Is there noise where the filter needs it, and are there digits enough."""

from __future__ import annotations

import math

import numpy as np

from fkgen.estimators.gaussian.estimate import SHORT_FORM_RATIO, prior_to_noise, update_form
from fkgen.study.diagnostics.findings import Examination
from fkgen.study.diagnostics.model_numbers import listed
from fkgen.study.diagnostics.visibility import correlations, numerical_rank
from fkgen.symbolic.plant import plant_of

#: Variances that the standard form cannot tell apart any more: 1 / eps, with three digits to spare.
_LOST = {"float": 1e4, "double": 1e13}

_WHERE = {
    "innovation_rank": " at the prior with u = 0",
    "innovation_rank_driven": " at the prior with u = 1",
    "innovation_rank_stationary": " at rest",
}


def innovation(model: Examination) -> None:
    """Rank of Om = C P C' + R + D N D', at the prior and at rest, without and with inputs."""
    prior = model.C @ model.P0 @ model.C.T
    ranks = {"innovation_rank": numerical_rank(prior + model.noise(driven=False)[1])}
    if model.has_faults:
        ranks["innovation_rank_driven"] = numerical_rank(prior + model.noise(driven=True)[1])
    if model.steady is not None:
        ranks["innovation_rank_stationary"] = numerical_rank(model.steady.innovation)
    _perfect_measurements(model)
    model.ranks(ranks, _WHERE)


def _perfect_measurements(model: Examination) -> None:
    """Rows of y, or combinations of them, without noise."""
    size, _ = correlations(model.R)
    exact = [name for name, s in zip(model.outputs, size, strict=True) if s == 0.0]
    missing = len(model.R) - numerical_rank(model.R)
    if exact:
        model.add("noise_free_output", len(exact), names=listed(exact))
    elif missing:
        model.add("noise_free_output.combined", missing)


def conditioning(model: Examination) -> None:
    """How many digits the covariance update needs, and which form of it is used."""
    spec, plant = model.spec, plant_of(model.spec)
    form = update_form(spec, plant, augmented=model.has_faults and bool(plant.D.nnz()))
    ratio, scalar = prior_to_noise(spec), spec.code.scalar
    model.values |= dict.fromkeys(("prior_to_noise", "predicted_to_noise"), ratio)
    model.values["joseph_form"] = float(form == "joseph")
    if form == "short" and ratio > _LOST[scalar]:
        severe = model.is_float and ratio > SHORT_FORM_RATIO
        model.add("conditioning.severe" if severe else "conditioning.lost", ratio, scalar=scalar)
    elif ratio > SHORT_FORM_RATIO:
        shown = f"{ratio:.2g}" if math.isfinite(ratio) else "infinite"
        loss = ": the short form would lose that many digits"
        loss = ", which loses that many of the 16 digits" if form == "short" else loss
        model.add("conditioning", ratio, shown=shown, form=form, loss=loss)


def rounding(model: Examination) -> None:
    """Process noise that vanishes in the rounding of the variance it is added to."""
    if model.steady is None:
        return
    eps = float(np.finfo(np.float32 if model.is_float else np.float64).eps)
    Q, P = np.diag(model.Q), np.diag(model.steady.predicted)
    lost = [name for name, q, p in zip(model.states, Q, P, strict=True) if 0.0 < q < eps * p]
    if lost:
        scalar, remedy = model.spec.code.scalar, 'scalar = "double", or ' * model.is_float
        model.add("rounding", len(lost), names=listed(lost), scalar=scalar, remedy=remedy)


def number_range(model: Examination) -> None:
    """Numbers of the model that float cannot hold."""
    limits = np.finfo(np.float32)
    for letter in ("A", "B", "C", "D", "Q", "R", "P0", "x0") if model.is_float else ():
        values = model.system.x0 if letter == "x0" else getattr(model, letter)
        size = np.abs(values[values != 0.0])
        outside = size[(size > float(limits.max)) | (size < float(limits.tiny))]
        if outside.size:
            model.add("float_range", float(outside[0]), letter=letter)
