"""Build a recursion and confront it, on random records, with every closed form of its family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fkgen.errors import ValidationError
from fkgen.estimators.ranges import confined
from fkgen.families import family
from fkgen.families.family import Family
from fkgen.oracle.claims.claim import Array, ClosedForm, Ports, Record
from fkgen.oracle.claims.gaussian import EXACT, RANK_DEFICIENT, digits_at_stake
from fkgen.oracle.plants.equations import is_nonlinear
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.proof.mild import without_digits
from fkgen.proof.records import Found, record_for, trial
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.plant import sensed_at_prior
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim, Validated

#: Ports that start as the prior covariance of the spec.
_OF = ("predicted_", "filtered_", "mode_", "mode_filtered_", "riccati_", "compression_")
_PRIORS = {f"{of}covariance" for of in (*_OF, "predicted_compression_")}

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
    return replace(design, findings=caveats, recursion=confined(design.recursion))


def confront(tested: Family, recursion: Recursion) -> Validated:
    """Run every closed form of a family on one recursion."""
    spec = recursion.spec
    found = record_for(spec, tested.closed_forms)
    records = {True: trial(spec, steady=True)[0], False: found.kept}
    tried = (_try(form, recursion, records[form.steady]) for form in tested.closed_forms)
    claims = [claim for claim in tried if claim is not None]
    if found.is_cut:
        claims.append(_end_of(recursion, found))
    return Validated(recursion=recursion, claims=(_start_of(recursion), *claims))


def _as_built(recursion: Recursion) -> Spec:
    """The spec with the form of the update that "auto" has come to: it decides on ranks."""
    spec, form = recursion.spec, recursion.form
    return spec if form is None else replace(spec, code=replace(spec.code, update=form))


def _try(form: ClosedForm, recursion: Recursion, record: Record) -> Claim | None:
    spec = _as_built(recursion)
    try:
        expected = form.expected(spec, record)
    except np.linalg.LinAlgError:  # rounding has left a singular matrix
        return Claim(claim=form.claim, source=form.source, error=float("inf"), tolerance=0.0)
    if expected is None:
        return None
    instance = _instance(recursion, record, dict(form.start(spec, record)) if form.start else {})
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


def _instance(recursion: Recursion, record: Record, start: Ports) -> Interpreter:
    """A filter at the start of a record; ``start``: what replaces the prior."""
    instance = Interpreter(recursion)
    instance.reset(record.first)
    prior = {port.name: record.P0 for port in recursion.ports if port.name in _PRIORS}
    for name, value in (prior | dict(start)).items():
        put(instance, name, value)
    return instance


def _end_of(recursion: Recursion, found: Found) -> Claim:
    """Where equations have no value any more, the filter says so."""
    instance, whole, end = _instance(recursion, found.kept, {}), found.whole, len(found.kept.y)
    taken = [instance.step(*whole.sample(k)) for k in range(end + 1)]
    return Claim(
        claim="the sample at which equations have no value is refused, none before it",
        source=f"{end} samples from x0 on",
        error=0.0 if taken == [True] * end + [False] else float("inf"),
        tolerance=0.0,
    )


def put(instance: Interpreter, name: str, value: Array) -> None:
    """Set a port to what is not packed; one covariance is for all where there are several."""
    port = instance.recursion.port(name)
    if not port.symmetric:
        instance.values[name] = value.ravel()
        return
    rows, columns = np.tril_indices(port.shape[-1])
    packed = np.broadcast_to(value, port.shape)[..., rows, columns].reshape(-1, len(rows))
    instance.values[name] = packed.ravel()
    factors, recursion = name.replace("covariance", "factors"), instance.recursion
    if factors in recursion.initial and any(recursion.initial[factors]):
        own = [{"P": tuple(each.tolist())} for each in packed]
        begun = [recursion.begun(recursion.spec.defaults, each)[factors] for each in own]
        parts = [np.array(each).reshape(len(own), -1)[i] for i, each in enumerate(begun)]
        instance.values[factors] = np.concatenate(parts)


def _start_of(recursion: Recursion) -> Claim:
    """Sample 0 corrects the prior of the spec: every prediction starts as (x0, P0)."""
    model, defaults = recursion.spec.model, recursion.spec.defaults
    found = model.x0.values(defaults).ravel(), model.P0.values(defaults)
    priors = dict(zip(("state", "covariance"), found, strict=True))
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


def digits(spec: Spec) -> float:
    """The relative error to expect where rounding is not amplified from sample to sample."""
    if is_nonlinear(spec):
        return linearised_digits(spec)
    none = np.zeros((0, 0))
    return digits_at_stake(
        spec, Record(y=none, u=none, parameters={}, P0=spec.model.P0.values(spec.defaults))
    )


def linearised_digits(spec: Spec) -> float:
    """What the ratio of state to measurement noise leaves where equations are linearised at x0."""
    ratios, P0 = [0.0], spec.model.P0.values(spec.defaults)
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
