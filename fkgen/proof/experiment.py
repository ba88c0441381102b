"""Random records on which recursions are tried, and the distance between two answers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.claims.claim import Array, Record
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec

#: Ratio of prior to measurement variance beyond which a milder prior takes the place of the spec's.
MILD = 1e4

#: Samples; fewer for large models, whose joint covariance grows with them.
LONG, SHORT, MANY_STATES = 6, 4, 8


def trial(spec: Spec, *, steady: bool) -> Record:
    """A record from the model itself: random inputs, shaken parameters, missing rows."""
    rng = np.random.default_rng(20130905)
    model = spec.model
    T = LONG if model.nx < MANY_STATES else SHORT
    parameters = {item.name: np.full(T, item.default) for item in spec.stated_parameters}
    if not steady:
        parameters = _varied(spec, parameters, rng)
    u = rng.normal(size=(1 if steady else T, model.nu)).repeat(T if steady else 1, axis=0)
    P0 = _mild_prior(spec)
    y, drawn = draw_record(spec, parameters, u, rng)
    parameters = {name: np.full(T, spec.defaults[name]) for name in drawn} if steady else drawn
    if not steady:
        y[_missing(y.shape, rng)] = np.nan
    return Record(y=y, u=u, parameters=parameters, P0=P0)


def _missing(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Rows to be left out: none at first, then row 0 alone, then all of them, then some."""
    missing = rng.random(shape) < 0.25
    missing[:3] = False
    missing[1, 0] = True
    missing[2] = True
    return missing


def _varied(
    spec: Spec, parameters: Mapping[str, Array], rng: np.random.Generator
) -> dict[str, Array]:
    """Parameters shaken by some percent, sample by sample, where the model still makes sense."""
    varied = {name: values.copy() for name, values in parameters.items()}
    for k in range(len(next(iter(varied.values()), ()))):
        shaken = {name: v[k] * (1.0 + 0.05 * rng.uniform(-1, 1)) for name, v in varied.items()}
        if _makes_sense(spec, shaken):
            for name, value in shaken.items():
                varied[name][k] = value
    return varied


def _makes_sense(spec: Spec, parameters: Mapping[str, float]) -> bool:
    """Whether all matrices are finite, all covariances positive and all rates probabilities."""
    try:
        for plant in (spec.model, *(spec.faults.jump.modes if spec.faults.jump else ())):
            for letter in ("A", "B", "C", "D"):
                getattr(plant, letter).values(parameters)
            for letter in ("Q", "R"):
                M = getattr(plant, letter).values(parameters)
                if np.linalg.eigvalsh(M)[0] < -1e-12 * np.abs(M).max():
                    return False
        system = LinearSystem.from_spec(spec, 1, dict(parameters), spec.first_rates)
    except ArithmeticError:
        return False
    return bool(np.all((system.rate >= 0.0) & (system.rate <= 1.0)))


def _mild_prior(spec: Spec) -> Array:
    """P0, scaled down where it dwarfs the measurement noise: a start value, not an equation.

    Not where P0 is part of the second moments that a gain depends on.
    """
    if spec.filter.traits.moments:
        return np.asarray(spec.model.P0.values())
    C, P0, R = (getattr(spec.model, m).values(spec.defaults) for m in ("C", "P0", "R"))
    noise, prior = np.diag(R), np.diag(C @ P0 @ C.T)
    known = (noise > 0.0) & (prior > 0.0)
    if not known.any():
        return np.asarray(P0)
    excess = float(np.max(prior[known] / noise[known])) / MILD
    return np.asarray(P0 / max(1.0, excess))


def distance(
    found: Array, expected: Array, *, symmetric: bool = False, deviation: Array | None = None
) -> float:
    """Largest error relative to the size that each entry has over the record.

    Entries of a symmetric matrix are measured by the geometric mean of the two diagonal entries;
    those of a vector by at least their standard ``deviation``, if it is given. NaNs have to be in
    the same places; otherwise the distance is infinite.
    """
    if found.shape != expected.shape or not np.array_equal(np.isnan(found), np.isnan(expected)):
        return float("inf")
    if found.size == 0 or np.isnan(expected).all():
        return 0.0
    if symmetric:
        size = np.sqrt(np.abs(np.diagonal(expected, axis1=-2, axis2=-1)))
        scale = size[..., :, np.newaxis] * size[..., np.newaxis, :]
    elif deviation is None:
        scale = np.abs(expected)
    else:
        scale = np.fmax(np.abs(expected), deviation)
    scale = np.nanmax(scale, axis=0)
    largest = float(np.nanmax(scale))
    scale = np.maximum(scale, 1e-6 * largest) if largest > 0.0 else np.ones_like(scale)
    return float(np.nanmax(np.abs(found - expected) / scale))


def natural_deviation(port: str, expected: Mapping[str, Array]) -> Array | None:
    """Standard deviation of a port, from the covariance that belongs to it; one for logarithms."""
    if port in {"log_likelihood", "log_weight"}:
        return np.array(1.0)
    covariance = expected.get(_COVARIANCE.get(port, ""))
    if covariance is None:
        return None
    return np.asarray(np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1))))


_COVARIANCE = {
    "filtered_state": "filtered_covariance",
    "predicted_state": "predicted_covariance",
    "innovation": "innovation_covariance",
}
