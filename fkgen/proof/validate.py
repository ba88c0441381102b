"""Build a recursion and confront it, on random records, with every closed form of its family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fkgen.errors import ValidationError
from fkgen.families import family
from fkgen.families.family import Family
from fkgen.oracle.claims.claim import Array, ClosedForm, Record
from fkgen.oracle.claims.gaussian import EXACT, RANK_DEFICIENT, digits_at_stake
from fkgen.oracle.plants.actuator import actuation_of
from fkgen.oracle.plants.equations import is_nonlinear
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.model import joint_noise
from fkgen.proof.mild import without_digits
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.plant import sensed_at_prior
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim, Validated

#: Ratio of prior to measurement variance beyond which a milder prior takes the place of the spec's.
MILD = 1e4

#: Samples; fewer for large models, whose joint covariance grows with them.
LONG, SHORT, MANY_STATES = 6, 4, 8

#: Ports that start as the prior covariance of the spec.
_OF = ("predicted_", "filtered_", "mode_", "mode_filtered_", "riccati_", "compression_")
_PRIORS = {f"{of}covariance" for of in (*_OF, "predicted_compression_")}

#: How far out, in terms of the largest entry, is what a gate meets.
OUTLIER = 30.0

_COVARIANCE = {
    "filtered_state": "filtered_covariance",
    "predicted_state": "predicted_covariance",
    "innovation": "innovation_covariance",
}


def validate(spec: Spec) -> Validated:
    """Build the recursion of a spec and run every closed form of its family; all have to hold.

    Raises
    ------
    ValidationError
        If one does not: a defect of fkgen.
    SpecError
        If one does not because the numbers of the spec leave no digits.
    """
    try:
        return _proved(spec)
    except ValidationError as wrong:
        told = without_digits(spec, wrong, _proved)
        if told is None:
            raise
        raise told from None


def _proved(spec: Spec) -> Validated:
    found = family(spec.filter.family)
    caveats = found.remarks(spec)
    recursion = found.build(spec)
    warned = (each.message for each in caveats)
    design = confront(found, replace(recursion, notes=(*recursion.notes, *warned)))
    return replace(design, findings=caveats)


def confront(tested: Family, recursion: Recursion) -> Validated:
    """Run every closed form of a family on one recursion."""
    records = {steady: _trial(recursion.spec, steady=steady) for steady in (False, True)}
    tried = (_try(form, recursion, records[form.steady]) for form in tested.closed_forms)
    claims = tuple(claim for claim in tried if claim is not None)
    return Validated(recursion=recursion, claims=(_start_of(recursion), *claims))


def _try(form: ClosedForm, recursion: Recursion, record: Record) -> Claim | None:
    spec = recursion.spec
    try:
        expected = form.expected(spec, record)
    except np.linalg.LinAlgError:  # rounding has left a singular matrix
        return Claim(claim=form.claim, source=form.source, error=float("inf"), tolerance=0.0)
    if expected is None:
        return None
    instance = Interpreter(recursion)
    start = {port.name: record.P0 for port in recursion.ports if port.name in _PRIORS}
    for name, value in (start | dict(form.start(spec, record) if form.start else {})).items():
        put(instance, name, value)
    found = instance.run(record.y, record.u, record.parameters, keep=tuple(expected))
    error = max(
        distance(
            np.asarray(found[name][: len(value)] if name in found else np.nan, float),
            np.asarray(value, float),
            symmetric=name in found and recursion.port(name).symmetric,
            deviation=natural_deviation(name, expected, spec.model.attitudes),
        )
        for name, value in expected.items()
    )
    return Claim(
        claim=form.claim, source=form.source, error=error, tolerance=form.tolerance(spec, record)
    )


def put(instance: Interpreter, name: str, value: Array) -> None:
    """Set a port to what is not packed; one covariance is for all where there are several."""
    port = instance.recursion.port(name)
    if port.symmetric:
        rows, columns = np.tril_indices(port.shape[-1])
        value = np.broadcast_to(value, port.shape)[..., rows, columns]
    instance.values[name] = value.ravel()


def _start_of(recursion: Recursion) -> Claim:
    """Sample 0 corrects the prior of the spec: every prediction starts as (x0, P0)."""
    model = recursion.spec.model
    priors = {"state": model.x0.values().ravel(), "covariance": model.P0.values()}
    values = Interpreter(recursion).values
    faults, kept = recursion.spec.faults.jump, {}
    if faults is not None and faults.unequal:
        held = np.array(faults.held, float)
        kept = {"mode_state": held, "mode_covariance": held[:, :, None] * held[:, None, :]}
    errors = [
        np.abs(port.unpacked(values[port.name]) - kept.get(port.name, 1.0) * prior).max()
        for port in recursion.ports
        for what, prior in priors.items()
        if port.name in {f"predicted_{what}", f"mode_{what}"}
    ]
    return Claim(
        claim="the prediction for sample 0 is (x0, P0)",
        source="time convention",
        error=float(max(errors)),
        tolerance=0.0,
    )


def _trial(spec: Spec, *, steady: bool) -> Record:
    """A record from the model itself: random inputs, shaken parameters, missing rows."""
    rng = np.random.default_rng(20130905)
    model = spec.model
    T = LONG if model.nx < MANY_STATES else SHORT
    parameters = {item.name: np.full(T, item.default) for item in spec.stated_parameters}
    if not steady:
        _vary(spec, parameters, rng)
    u = rng.normal(size=(1 if steady else T, model.nu)).repeat(T if steady else 1, axis=0)
    y, drawn = draw_record(spec, parameters, u, rng)
    if steady:
        drawn = {name: np.full(T, spec.defaults[name]) for name in drawn}
    else:
        if spec.filter.option("gate", None) is not None:
            _disturb(spec, y, rng)
        # none is missing at first, then row 0 alone, then all of them, then some
        missing = rng.random(y.shape) < 0.25
        missing[:3] = False
        missing[1, 0] = True
        missing[2] = True
        y[missing] = np.nan
    return Record(y=y, u=u, parameters=drawn, P0=_mild_prior(spec))


def _disturb(spec: Spec, y: Array, rng: np.random.Generator) -> None:
    """Move rows far out, or whole samples where rows without noise may have to agree."""
    out = rng.random(y.shape) < 0.25
    out[3, 0] = True
    if is_singular(spec.model.R.values(spec.defaults)):
        y *= 1.0 + OUTLIER * out[:, :1]
    else:
        y += OUTLIER * np.abs(y).max() * out


def _vary(spec: Spec, parameters: dict[str, Array], rng: np.random.Generator) -> None:
    """Shake parameters by some percent, sample by sample, where the model still makes sense."""
    for k in range(len(next(iter(parameters.values()), ()))):
        shaken = {name: v[k] * (1.0 + 0.05 * rng.uniform(-1, 1)) for name, v in parameters.items()}
        if _makes_sense(spec, shaken):
            for name, value in shaken.items():
                parameters[name][k] = value


def _makes_sense(spec: Spec, parameters: Mapping[str, float]) -> bool:
    """Whether all matrices are finite, all covariances positive and all rates probabilities.

    And all parameters in their ranges.
    """
    if not all(item.low <= parameters[item.name] <= item.high for item in spec.stated_parameters):
        return False
    try:
        if not spec.faults.in_domain({**spec.defaults, **parameters}):
            return False
        for plant in (spec.model, *spec.plants):
            for letter in "ABCDQRcd" if plant.equations is None else "QR":
                M = getattr(plant, letter).values(parameters)
                if letter in "QR" and np.linalg.eigvalsh(M)[0] < -1e-12 * np.abs(M).max():
                    return False
        rate, _ = actuation_of(spec, 1, dict(parameters), spec.first_rates)
        noise = joint_noise(spec.model.Q, spec.model.S, spec.model.R).values(parameters)
        if np.linalg.eigvalsh(noise)[0] < -1e-12 * np.abs(noise).max():
            return False
    except ArithmeticError:
        return False
    return bool(np.all((rate >= 0.0) & (rate <= 1.0)))


def _mild_prior(spec: Spec) -> Array:
    """P0, scaled down where it dwarfs the measurement noise: a start value, not an equation.

    Not where P0 is part of the second moments that a gain depends on.
    """
    C, P0 = sensed_at_prior(spec, spec.model), spec.model.P0.values()
    R = spec.model.R.values(spec.defaults)
    noise, prior = np.diag(R), np.diag(C @ P0 @ C.T)
    known = (noise > 0.0) & (prior > 0.0)
    if spec.filter.traits.moments or not known.any():
        return np.asarray(P0)
    excess = float(np.max(prior[known] / noise[known])) / MILD
    return np.asarray(P0 / max(1.0, excess))


def digits(spec: Spec) -> float:
    """The relative error to expect where rounding is not amplified from sample to sample."""
    if is_nonlinear(spec):
        return linearised_digits(spec)
    none = np.zeros((0, 0))
    return digits_at_stake(spec, Record(y=none, u=none, parameters={}, P0=spec.model.P0.values()))


def linearised_digits(spec: Spec) -> float:
    """What the ratio of state to measurement noise leaves where equations are linearised at x0."""
    ratios, P0 = [0.0], spec.model.P0.values()
    for plant in spec.plants:
        C = sensed_at_prior(spec, plant)
        Q, R = (getattr(plant, letter).values(spec.defaults) for letter in "QR")
        if is_singular(R):
            return RANK_DEFICIENT
        ratios.append(float(np.max(np.diag(C @ (P0 + Q) @ C.T) / np.diag(R))))
    return max(EXACT, 1e3 * float(np.finfo(float).eps) * max(ratios))


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
    scale = np.abs(expected)
    if symmetric:
        size = np.sqrt(np.diagonal(scale, axis1=-2, axis2=-1))
        scale = size[..., :, np.newaxis] * size[..., np.newaxis, :]
    elif deviation is not None:
        scale = np.fmax(scale, deviation)
    scale = np.nanmax(scale, axis=0)
    largest = float(np.nanmax(scale))
    scale = np.maximum(scale, 1e-6 * largest) if largest > 0.0 else np.ones_like(scale)
    return float(np.nanmax(np.abs(found - expected) / scale))


def natural_deviation(
    port: str, expected: Mapping[str, Array], attitudes: Sequence[int] = ()
) -> Array | None:
    """Standard deviation of a port, from the covariance that belongs to it; one for logarithms.

    The four numbers of an attitude have the largest of its three.
    """
    if port in {"log_likelihood", "log_weight"}:
        return np.array(1.0)
    covariance = expected.get(_COVARIANCE.get(port, ""))
    if covariance is None:
        return None
    found = np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1)))
    for at in attitudes if port.endswith("state") else ():
        largest = found[..., at : at + 3].max(axis=-1, keepdims=True).repeat(4, axis=-1)
        found = np.concatenate((found[..., :at], largest, found[..., at + 3 :]), axis=-1)
    return np.asarray(found)
