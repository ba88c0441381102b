"""Build a recursion and confront it with every closed form of its family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fkgen.families import family
from fkgen.families.family import Family
from fkgen.oracle.claims.claim import Array, ClosedForm, Record
from fkgen.problem import Spec
from fkgen.proof.experiment import distance, natural_deviation, trial
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.packing import triangle, unpacked
from fkgen.symbolic.recursion import Recursion
from fkgen.symbolic.validated import Claim, Validated


def validate(spec: Spec) -> Validated:
    """Build the recursion of a spec and run every closed form of its family.

    Raises
    ------
    ValidationError
        If one is contradicted: a defect of fkgen, never of the spec.
    """
    found = family(spec.filter.family)
    caveats = found.caveats(spec)
    recursion = found.build(spec)
    warned = (each.message for each in caveats)
    design = confront(found, replace(recursion, notes=(*recursion.notes, *warned)))
    return replace(design, findings=caveats)


def confront(tested: Family, recursion: Recursion) -> Validated:
    """Run every closed form of a family on one recursion."""
    spec = recursion.spec
    records = {steady: trial(spec, steady=steady) for steady in (False, True)}
    claims = [
        claim
        for form in tested.closed_forms
        if (claim := _try(form, recursion, records[form.steady])) is not None
    ]
    return Validated(recursion=recursion, claims=(_start_of(recursion), *claims))


def _try(form: ClosedForm, recursion: Recursion, record: Record) -> Claim | None:
    spec = recursion.spec
    expected = form.expected(spec, record)
    if expected is None:
        return None
    instance = Interpreter(recursion)
    _start(instance, _prior(recursion, record))
    if form.start is not None:
        _start(instance, form.start(spec, record))
    found = instance.run(record.y, record.u, record.parameters, keep=tuple(expected))
    error = max(
        distance(
            np.asarray(found[name][: len(value)] if name in found else np.nan, float),
            np.asarray(value, float),
            symmetric=name in found and recursion.port(name).symmetric,
            deviation=natural_deviation(name, expected),
        )
        for name, value in expected.items()
    )
    return Claim(
        claim=form.claim, source=form.source, error=error, tolerance=form.tolerance(spec, record)
    )


def _start_of(recursion: Recursion) -> Claim:
    """Sample 0 corrects the prior of the spec: every prediction starts as (x0, P0)."""
    model = recursion.spec.model
    priors = {"state": model.x0.values().ravel(), "covariance": model.P0.values()}
    values = Interpreter(recursion).values
    errors = [
        np.abs(unpacked(port, values[port.name]) - prior).max()
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


def _prior(recursion: Recursion, record: Record) -> Mapping[str, Array]:
    """The record's prior covariance, in every port that starts as the spec's."""
    stacked = {"mode_covariance", "mode_filtered_covariance", "riccati_covariance"}
    stacked |= {"predicted_compression_covariance", "compression_covariance"}
    names = {"predicted_covariance", "filtered_covariance"} | stacked
    ports = [port for port in recursion.ports if port.name in names]
    return {port.name: np.broadcast_to(record.P0, port.shape) for port in ports}


def _start(instance: Interpreter, values: Mapping[str, Array]) -> None:
    for name, value in values.items():
        if not instance.recursion.port(name).symmetric:
            instance.values[name] = value.ravel()
            continue
        n = value.shape[-1]
        packed = np.stack([value[..., i, j] for i, j in triangle(n)], axis=-1)
        instance.values[name] = packed.ravel()
